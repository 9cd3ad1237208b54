"""Optimizers of action sequences. They know nothing of models: a score function is all.

Each is a set of hyperparameters with one pure method `optimize`. Actions are scaled to
[-1, 1]. Environments are independent; they are searched side by side.
"""

import abc
from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from headway.config import PlannerConfig

Score = Callable[
    [Float[Array, "env candidate horizon action"], PRNGKeyArray], Float[Array, "env candidate"]
]


class Plan(NamedTuple):
    """The result of a search."""

    actions: Float[Array, "env horizon action"]
    """The chosen sequence, within [-1, 1]."""
    expected_return: Float[Array, " env"]
    """Mean return of the last iteration's finite elites (CEM) or the best return (shooting);
    -inf where nothing was finite."""
    failures: Int[Array, " env"]
    """Iterations in which no candidate had a finite return; the old plan was kept then."""


class Optimizer(eqx.Module):
    """Searches for the action sequence of the highest return."""

    @abc.abstractmethod
    def optimize(
        self, score: Score, guess: Float[Array, "env horizon action"], *, key: PRNGKeyArray
    ) -> Plan:
        """Improve on a guess.

        Args:
            score: Returns of candidates; a non-finite one ranks last.
            guess: Where to start; also the answer if every return is non-finite.
            key: Draws the candidates, and is handed on to `score`.
        """


class CEM(Optimizer):
    """Cross-entropy method with clipped variance and smoothing (PETS; fact sheet C.1)."""

    num_candidates: int = 200
    num_elites: int = 50
    num_iterations: int = 5
    smoothing: float = 0.1
    initial_std: float = 0.5

    def optimize(
        self, score: Score, guess: Float[Array, "env horizon action"], *, key: PRNGKeyArray
    ) -> Plan:
        """See `Optimizer.optimize`; returns the final mean, not the best candidate."""

        def iterate(carry, key):
            mean, var, failures, _ = carry
            draw_key, score_key = jax.random.split(key)
            candidates = self._draw(mean, var, draw_key)
            returns = rank_non_finite_last(score(candidates, score_key))
            # The elites: the best candidates, those with a finite return only.
            elite_returns, elite = jax.lax.top_k(returns, self.num_elites)
            finite = jnp.isfinite(elite_returns)
            elites = jnp.take_along_axis(candidates, elite[:, :, None, None], axis=1)
            new_mean, new_var = _moments(elites, finite)
            # Keep a share of the old distribution; keep all of it when nothing was finite.
            found = finite.any(-1)[:, None, None]
            keep = jnp.where(found, self.smoothing, 1.0)
            mean = keep * mean + (1.0 - keep) * new_mean
            var = keep * var + (1.0 - keep) * new_var
            total = jnp.where(finite, elite_returns, 0.0).sum(-1)
            expected = jnp.where(finite.any(-1), total / jnp.maximum(finite.sum(-1), 1), -jnp.inf)
            return (mean, var, failures + ~found[:, 0, 0], expected), None

        num_envs = guess.shape[0]
        var = jnp.full_like(guess, self.initial_std**2)
        carry = guess, var, jnp.zeros(num_envs, jnp.int32), jnp.zeros(num_envs)
        keys = jax.random.split(key, self.num_iterations)
        (mean, _, failures, expected), _ = jax.lax.scan(iterate, carry, keys)
        return Plan(jnp.clip(mean, -1.0, 1.0), expected, failures)

    def _draw(
        self, mean: Float[Array, "env horizon action"], var: Float[Array, "env horizon action"], key
    ) -> Float[Array, "env candidate horizon action"]:
        """Draw from a normal truncated at two deviations, narrowed to stay inside ±1."""
        room = jnp.minimum(jnp.square((mean + 1) / 2), jnp.square((1 - mean) / 2))
        std = jnp.sqrt(jnp.minimum(room, var))
        shape = (mean.shape[0], self.num_candidates, *mean.shape[1:])
        draws = jax.random.truncated_normal(key, -2.0, 2.0, shape)
        return mean[:, None] + std[:, None] * draws


class RandomShooting(Optimizer):
    """The best of uniformly drawn sequences, drawn in rounds to bound memory."""

    num_candidates: int = 200
    num_iterations: int = 5

    def optimize(
        self, score: Score, guess: Float[Array, "env horizon action"], *, key: PRNGKeyArray
    ) -> Plan:
        """See `Optimizer.optimize`; the guess is used only when nothing is finite."""

        def iterate(carry, key):
            best, best_return, failures = carry
            draw_key, score_key = jax.random.split(key)
            shape = (guess.shape[0], self.num_candidates, *guess.shape[1:])
            candidates = jax.random.uniform(draw_key, shape, minval=-1.0, maxval=1.0)
            returns = rank_non_finite_last(score(candidates, score_key))
            winner = jnp.argmax(returns, axis=-1)
            top = jnp.take_along_axis(returns, winner[:, None], axis=1)[:, 0]
            sequence = jnp.take_along_axis(candidates, winner[:, None, None, None], axis=1)[:, 0]
            better = top > best_return
            best = jnp.where(better[:, None, None], sequence, best)
            failures = failures + ~jnp.isfinite(top)
            return (best, jnp.maximum(best_return, top), failures), None

        num_envs = guess.shape[0]
        carry = guess, jnp.full(num_envs, -jnp.inf), jnp.zeros(num_envs, jnp.int32)
        keys = jax.random.split(key, self.num_iterations)
        (best, best_return, failures), _ = jax.lax.scan(iterate, carry, keys)
        return Plan(jnp.clip(best, -1.0, 1.0), best_return, failures)


def make_optimizer(config: PlannerConfig) -> Optimizer:
    """Build the optimizer that the settings name."""
    if config.optimizer == "random-shooting":
        return RandomShooting(config.num_candidates, config.num_iterations)
    return CEM(
        config.num_candidates,
        config.num_elites,
        config.num_iterations,
        config.smoothing,
        config.initial_std,
    )


def rank_non_finite_last(
    returns: Float[Array, "env candidate"],
) -> Float[Array, "env candidate"]:
    """Turn every non-finite return into -inf, so that it ranks last."""
    return jnp.where(jnp.isfinite(returns), returns, -jnp.inf)


def _moments(
    elites: Float[Array, "env elite horizon action"], counted: Bool[Array, "env elite"]
) -> tuple[Float[Array, "env horizon action"], Float[Array, "env horizon action"]]:
    """Mean and population variance over the counted elites."""
    weight = counted[..., None, None] / jnp.maximum(counted.sum(-1), 1)[:, None, None, None]
    mean = (weight * elites).sum(1)
    return mean, (weight * jnp.square(elites - mean[:, None])).sum(1)
