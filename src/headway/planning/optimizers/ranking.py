"""Ranking candidates by their returns."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float


def rank_non_finite_last(
    returns: Float[Array, "env candidate"],
) -> Float[Array, "env candidate"]:
    """Turn every non-finite return into -inf, so that it ranks last."""
    return jnp.where(jnp.isfinite(returns), returns, -jnp.inf)


def best_candidates(
    candidates: Float[Array, "env candidate horizon action"],
    returns: Float[Array, "env candidate"],
    count: int,
) -> tuple[Float[Array, "env elite horizon action"], Float[Array, "env elite"]]:
    """The candidates of the highest returns, and these returns, best first."""
    elite_returns, elite = jax.lax.top_k(returns, count)
    return jnp.take_along_axis(candidates, elite[:, :, None, None], axis=1), elite_returns


def moments(
    elites: Float[Array, "env elite horizon action"], counted: Bool[Array, "env elite"]
) -> tuple[Float[Array, "env horizon action"], Float[Array, "env horizon action"]]:
    """Mean and population variance over the counted elites."""
    weight = counted[..., None, None] / jnp.maximum(counted.sum(-1), 1)[:, None, None, None]
    mean = (weight * elites).sum(1)
    return mean, (weight * jnp.square(elites - mean[:, None])).sum(1)
