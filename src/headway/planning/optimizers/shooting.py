"""Random shooting: no learning from one round to the next."""

import jax
import jax.numpy as jnp
from jaxtyping import PRNGKeyArray

from headway.planning.optimizers.base import Optimizer, Plan, Score, SearchState
from headway.planning.optimizers.ranking import rank_non_finite_last


class RandomShooting(Optimizer):
    """The best of uniformly drawn sequences, drawn in rounds to bound memory.

    The guess is used only when nothing is finite; the expected return is the best one.
    """

    num_candidates: int = 200
    num_iterations: int = 5

    @property
    def max_evaluations(self) -> int:
        """See `Optimizer.max_evaluations`."""
        return self.num_candidates * self.num_iterations

    def optimize(self, score: Score, state: SearchState, *, key: PRNGKeyArray) -> Plan:
        """See `Optimizer.optimize`."""
        num_envs, *sequence_shape = state.guess.shape

        def iterate(carry, key):
            best, best_return, failures = carry
            draw_key, score_key = jax.random.split(key)
            shape = (num_envs, self.num_candidates, *sequence_shape)
            candidates = jax.random.uniform(draw_key, shape, minval=-1.0, maxval=1.0)
            returns = rank_non_finite_last(score(candidates, score_key))
            winner = jnp.argmax(returns, axis=-1)
            top = jnp.take_along_axis(returns, winner[:, None], axis=1)[:, 0]
            sequence = jnp.take_along_axis(candidates, winner[:, None, None, None], axis=1)[:, 0]
            better = top > best_return
            best = jnp.where(better[:, None, None], sequence, best)
            failures = failures + ~jnp.isfinite(top)
            return (best, jnp.maximum(best_return, top), failures), None

        carry = state.guess, jnp.full(num_envs, -jnp.inf), jnp.zeros(num_envs, jnp.int32)
        keys = jax.random.split(key, self.num_iterations)
        (best, best_return, failures), _ = jax.lax.scan(iterate, carry, keys)
        actions = jnp.clip(best, -1.0, 1.0)
        evaluations = jnp.full(num_envs, self.max_evaluations)
        return Plan(actions, best_return, failures, evaluations, SearchState(actions))
