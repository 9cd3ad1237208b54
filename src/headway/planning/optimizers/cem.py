"""The cross-entropy method, as the paper plans with it."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Key, PRNGKeyArray

from headway.planning.optimizers.base import (
    Optimizer,
    Plan,
    Score,
    SearchState,
    shift_steps,
    where_env,
)
from headway.planning.optimizers.ranking import best_candidates, moments, rank_non_finite_last


class CEM(Optimizer):
    """Cross-entropy method with clipped variance and smoothing (PETS; released `core/utils.py`).

    It plans the final mean, not the best candidate. The expected return is the mean over the
    finite elites of the last iteration.

    With `warm_variance` the variance of the last plan is kept like its mean, instead of
    starting from `initial_std` at every step. With a `settle_tolerance` an environment is
    settled once its mean moves by less in one iteration (root mean square over the plan); it
    keeps its plan, and the search ends when all environments are settled.
    """

    num_candidates: int = 200
    num_elites: int = 50
    num_iterations: int = 5
    smoothing: float = 0.1
    initial_std: float = 0.5
    warm_variance: bool = False
    warm_min_std: float = 0.1
    settle_tolerance: float = 0.0

    @property
    def max_evaluations(self) -> int:
        """See `Optimizer.max_evaluations`."""
        return self.num_candidates * self.num_iterations

    def init(self, num_envs: int, horizon: int, action_size: int) -> SearchState:
        """See `Optimizer.init`."""
        state = super().init(num_envs, horizon, action_size)
        return state._replace(variance=self._initial(state.guess)) if self.warm_variance else state

    def optimize(self, score: Score, state: SearchState, *, key: PRNGKeyArray) -> Plan:
        """See `Optimizer.optimize`."""
        if not self.settle_tolerance:
            return super().optimize(score, state, key=key)
        keys = jax.random.split(key, self.num_iterations)
        return self.end(self._until_settled(score, self.begin(state), keys))

    def end(self, search: "_Search") -> Plan:
        """See `Optimizer.end`."""
        actions = jnp.clip(search.mean, -1.0, 1.0)
        variance = search.var if self.warm_variance else None
        ended = SearchState(actions, variance)
        return Plan(actions, search.expected, search.failures, search.evaluations, ended)

    def settled(self, search: "_Search") -> Bool[Array, " env"]:
        """See `Optimizer.settled`."""
        return search.settled

    def shift(self, state: SearchState) -> SearchState:
        """See `Optimizer.shift`; the new last step starts from `initial_std`."""
        shifted = super().shift(state)
        if state.variance is None:
            return shifted
        return shifted._replace(variance=shift_steps(state.variance, self.initial_std**2))

    def _initial(
        self, guess: Float[Array, "env horizon action"]
    ) -> Float[Array, "env horizon action"]:
        return jnp.full_like(guess, self.initial_std**2)

    def begin(self, state: SearchState) -> "_Search":
        """See `Optimizer.begin`."""
        num_envs = len(state.guess)
        if state.variance is None:
            var = self._initial(state.guess)
        else:
            var = jnp.maximum(state.variance, self.warm_min_std**2)
        none = jnp.zeros(num_envs, jnp.int32)
        return _Search(state.guess, var, jnp.zeros(num_envs), none, none, jnp.zeros(num_envs, bool))

    def _until_settled(
        self, score: Score, search: "_Search", keys: Key[Array, " iteration"]
    ) -> "_Search":
        """Iterate while an environment is not settled."""

        def unsettled(carry):
            iteration, search = carry
            return (iteration < self.num_iterations) & ~search.settled.all()

        def iterate(carry):
            iteration, search = carry
            return iteration + 1, self.iterate(score, search, keys[iteration])

        return jax.lax.while_loop(unsettled, iterate, (0, search))[1]

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
        """See `Optimizer.tell`; an environment that is settled stays as it is."""
        found = self._learned(search, candidates, rank_non_finite_last(returns))
        return where_env(search.settled, search, found) if self.settle_tolerance else found

    def _learned(
        self,
        search: "_Search",
        candidates: Float[Array, "env candidate horizon action"],
        returns: Float[Array, "env candidate"],
    ) -> "_Search":
        # The elites: the best candidates, those with a finite return only.
        elites, elite_returns = best_candidates(candidates, returns, self.num_elites)
        finite = jnp.isfinite(elite_returns)
        new_mean, new_var = moments(elites, finite)
        # Keep a share of the old distribution; keep all of it when nothing was finite.
        found = finite.any(-1)
        keep = jnp.where(found[:, None, None], self.smoothing, 1.0)
        mean = keep * search.mean + (1.0 - keep) * new_mean
        total = jnp.where(finite, elite_returns, 0.0).sum(-1)
        moved = jnp.sqrt(jnp.square(mean - search.mean).mean((1, 2)))
        return _Search(
            mean=mean,
            var=keep * search.var + (1.0 - keep) * new_var,
            expected=jnp.where(found, total / jnp.maximum(finite.sum(-1), 1), -jnp.inf),
            failures=search.failures + ~found,
            evaluations=search.evaluations + self.num_candidates,
            settled=found & (moved < self.settle_tolerance),
        )


class _Search(NamedTuple):
    """A search under way."""

    mean: Float[Array, "env horizon action"]
    var: Float[Array, "env horizon action"]
    expected: Float[Array, " env"]
    failures: Int[Array, " env"]
    evaluations: Int[Array, " env"]
    settled: Bool[Array, " env"]
