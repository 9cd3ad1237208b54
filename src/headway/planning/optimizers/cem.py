"""The cross-entropy method, as the paper plans with it."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from headway.planning.optimizers.base import (
    Optimizer,
    Plan,
    Score,
    SearchState,
    rank_non_finite_last,
)


class CEM(Optimizer):
    """Cross-entropy method with clipped variance and smoothing (PETS; fact sheet C.1).

    It plans the final mean, not the best candidate. The expected return is the mean over the
    finite elites of the last iteration.
    """

    num_candidates: int = 200
    num_elites: int = 50
    num_iterations: int = 5
    smoothing: float = 0.1
    initial_std: float = 0.5

    @property
    def max_evaluations(self) -> int:
        """See `Optimizer.max_evaluations`."""
        return self.num_candidates * self.num_iterations

    def optimize(self, score: Score, state: SearchState, *, key: PRNGKeyArray) -> Plan:
        """See `Optimizer.optimize`."""
        keys = jax.random.split(key, self.num_iterations)
        search, _ = jax.lax.scan(
            lambda search, key: (self._iterate(score, search, key), None), self._start(state), keys
        )
        actions = jnp.clip(search.mean, -1.0, 1.0)
        return Plan(
            actions, search.expected, search.failures, search.evaluations, SearchState(actions)
        )

    def _start(self, state: SearchState) -> "_Search":
        none = jnp.zeros(len(state.guess), jnp.int32)
        var = jnp.full_like(state.guess, self.initial_std**2)
        return _Search(state.guess, var, jnp.zeros(len(state.guess)), none, none)

    def _iterate(self, score: Score, search: "_Search", key: PRNGKeyArray) -> "_Search":
        draw_key, score_key = jax.random.split(key)
        candidates = self._draw(search.mean, search.var, draw_key)
        returns = rank_non_finite_last(score(candidates, score_key))
        # The elites: the best candidates, those with a finite return only.
        elite_returns, elite = jax.lax.top_k(returns, self.num_elites)
        finite = jnp.isfinite(elite_returns)
        elites = jnp.take_along_axis(candidates, elite[:, :, None, None], axis=1)
        new_mean, new_var = moments(elites, finite)
        # Keep a share of the old distribution; keep all of it when nothing was finite.
        found = finite.any(-1)
        keep = jnp.where(found[:, None, None], self.smoothing, 1.0)
        total = jnp.where(finite, elite_returns, 0.0).sum(-1)
        return _Search(
            mean=keep * search.mean + (1.0 - keep) * new_mean,
            var=keep * search.var + (1.0 - keep) * new_var,
            expected=jnp.where(found, total / jnp.maximum(finite.sum(-1), 1), -jnp.inf),
            failures=search.failures + ~found,
            evaluations=search.evaluations + self.num_candidates,
        )

    def _draw(
        self, mean: Float[Array, "env horizon action"], var: Float[Array, "env horizon action"], key
    ) -> Float[Array, "env candidate horizon action"]:
        """Draw from a normal truncated at two deviations, narrowed to stay inside ±1."""
        room = jnp.minimum(jnp.square((mean + 1) / 2), jnp.square((1 - mean) / 2))
        std = jnp.sqrt(jnp.minimum(room, var))
        shape = (mean.shape[0], self.num_candidates, *mean.shape[1:])
        draws = jax.random.truncated_normal(key, -2.0, 2.0, shape)
        return mean[:, None] + std[:, None] * draws


class _Search(NamedTuple):
    """A search under way."""

    mean: Float[Array, "env horizon action"]
    var: Float[Array, "env horizon action"]
    expected: Float[Array, " env"]
    failures: Int[Array, " env"]
    evaluations: Int[Array, " env"]


def moments(
    elites: Float[Array, "env elite horizon action"], counted: Bool[Array, "env elite"]
) -> tuple[Float[Array, "env horizon action"], Float[Array, "env horizon action"]]:
    """Mean and population variance over the counted elites."""
    weight = counted[..., None, None] / jnp.maximum(counted.sum(-1), 1)[:, None, None, None]
    mean = (weight * elites).sum(1)
    return mean, (weight * jnp.square(elites - mean[:, None])).sum(1)
