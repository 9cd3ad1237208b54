"""The cross-entropy method, as the paper plans with it."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PRNGKeyArray

from headway.planning.optimizers.base import Optimizer, Plan, SearchState
from headway.planning.optimizers.ranking import best_candidates, moments, rank_non_finite_last


class CEM(Optimizer):
    """Cross-entropy method with clipped variance and smoothing (PETS; released `core/utils.py`).

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

    def end(self, search: "_Search") -> Plan:
        """See `Optimizer.end`."""
        actions = jnp.clip(search.mean, -1.0, 1.0)
        ended = SearchState(actions)
        return Plan(actions, search.expected, search.failures, search.evaluations, ended)

    def begin(self, state: SearchState) -> "_Search":
        """See `Optimizer.begin`."""
        num_envs = len(state.guess)
        var = jnp.full_like(state.guess, self.initial_std**2)
        none = jnp.zeros(num_envs, jnp.int32)
        return _Search(state.guess, var, jnp.zeros(num_envs), none, none)

    def ask(
        self, search: "_Search", key: PRNGKeyArray, iteration: int = 0
    ) -> Float[Array, "env candidate horizon action"]:
        """See `Optimizer.ask`: a normal truncated at two deviations, narrowed to stay inside ±1."""
        del iteration  # all are alike
        room = jnp.minimum(jnp.square((search.mean + 1) / 2), jnp.square((1 - search.mean) / 2))
        std = jnp.sqrt(jnp.minimum(room, search.var))
        num_envs, *sequence_shape = search.mean.shape
        shape = num_envs, self.num_candidates, *sequence_shape
        draws = jax.random.truncated_normal(key, -2.0, 2.0, shape)
        return search.mean[:, None] + std[:, None] * draws

    def tell(
        self,
        search: "_Search",
        candidates: Float[Array, "env candidate horizon action"],
        returns: Float[Array, "env candidate"],
    ) -> "_Search":
        """See `Optimizer.tell`."""
        returns = rank_non_finite_last(returns)
        # The elites: the best candidates, those with a finite return only.
        elites, elite_returns = best_candidates(candidates, returns, self.num_elites)
        finite = jnp.isfinite(elite_returns)
        new_mean, new_var = moments(elites, finite)
        # Keep a share of the old distribution; keep all of it when nothing was finite.
        found = finite.any(-1)
        keep = jnp.where(found[:, None, None], self.smoothing, 1.0)
        mean = keep * search.mean + (1.0 - keep) * new_mean
        total = jnp.where(finite, elite_returns, 0.0).sum(-1)
        return _Search(
            mean=mean,
            var=keep * search.var + (1.0 - keep) * new_var,
            expected=jnp.where(found, total / jnp.maximum(finite.sum(-1), 1), -jnp.inf),
            failures=search.failures + ~found,
            evaluations=search.evaluations + self.num_candidates,
        )


class _Search(NamedTuple):
    """A search under way."""

    mean: Float[Array, "env horizon action"]
    var: Float[Array, "env horizon action"]
    expected: Float[Array, " env"]
    failures: Int[Array, " env"]
    evaluations: Int[Array, " env"]
