"""Random shooting: no learning from one round to the next."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PRNGKeyArray

from headway.planning.optimizers.base import Optimizer, Plan, SearchState
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

    def begin(self, state: SearchState) -> "_Search":
        """See `Optimizer.begin`."""
        none = jnp.zeros(len(state.guess), jnp.int32)
        return _Search(state.guess, jnp.full(len(state.guess), -jnp.inf), none, none)

    def ask(
        self, search: "_Search", key: PRNGKeyArray, iteration: int = 0
    ) -> Float[Array, "env candidate horizon action"]:
        """See `Optimizer.ask`."""
        del iteration  # all are alike
        num_envs, *sequence_shape = search.best.shape
        shape = (num_envs, self.num_candidates, *sequence_shape)
        return jax.random.uniform(key, shape, minval=-1.0, maxval=1.0)

    def tell(
        self,
        search: "_Search",
        candidates: Float[Array, "env candidate horizon action"],
        returns: Float[Array, "env candidate"],
    ) -> "_Search":
        """See `Optimizer.tell`."""
        returns = rank_non_finite_last(returns)
        winner = jnp.argmax(returns, axis=-1)
        top = jnp.take_along_axis(returns, winner[:, None], axis=1)[:, 0]
        sequence = jnp.take_along_axis(candidates, winner[:, None, None, None], axis=1)[:, 0]
        better = top > search.best_return
        return _Search(
            best=jnp.where(better[:, None, None], sequence, search.best),
            best_return=jnp.maximum(search.best_return, top),
            failures=search.failures + ~jnp.isfinite(top),
            evaluations=search.evaluations + self.num_candidates,
        )

    def end(self, search: "_Search") -> Plan:
        """See `Optimizer.end`."""
        actions = jnp.clip(search.best, -1.0, 1.0)
        ended = SearchState(actions)
        return Plan(actions, search.best_return, search.failures, search.evaluations, ended)


class _Search(NamedTuple):
    """A search under way."""

    best: Float[Array, "env horizon action"]
    best_return: Float[Array, " env"]
    failures: Int[Array, " env"]
    evaluations: Int[Array, " env"]
