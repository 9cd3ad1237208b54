"""The improved cross-entropy method (iCEM)."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PRNGKeyArray

from headway.planning.optimizers.base import (
    Optimizer,
    Plan,
    Score,
    SearchState,
    shift_steps,
    where_env,
)
from headway.planning.optimizers.noise import colored_noise
from headway.planning.optimizers.ranking import best_candidates, moments, rank_non_finite_last


class ICEM(Optimizer):
    """Cross-entropy method with coloured noise and memory (Pinneri et al., 2020, algorithm 1).

    Candidates are clipped to the bounds. Fewer are drawn in each iteration. A share of the
    elites competes again in the next iteration and, moved on by one step, in the next search;
    they are scored anew, because `score` may be random. In the last iteration the mean competes
    too. The plan is the best elite of the last iteration, and the expected return its return.

    Every iteration has its own shapes and is compiled by itself.
    """

    num_candidates: int = 200
    num_elites: int = 10
    num_iterations: int = 5
    smoothing: float = 0.1
    initial_std: float = 0.5
    noise_beta: float = 2.0
    population_decay: float = 1.25
    kept_elite_fraction: float = 0.3

    @property
    def populations(self) -> tuple[int, ...]:
        """Candidates drawn in each iteration."""
        least = 2 * self.num_elites
        sizes = (self.num_candidates / self.population_decay**i for i in range(self.num_iterations))
        return tuple(max(int(size), least) for size in sizes)

    @property
    def num_kept(self) -> int:
        """Elites that compete once more."""
        return round(self.kept_elite_fraction * self.num_elites)

    @property
    def max_evaluations(self) -> int:
        """See `Optimizer.max_evaluations`; kept elites and the final mean are scored too."""
        return sum(self.populations) + self.num_kept * self.num_iterations + 1

    def init(self, num_envs: int, horizon: int, action_size: int) -> SearchState:
        """See `Optimizer.init`."""
        state = super().init(num_envs, horizon, action_size)
        return state._replace(elites=self._remembered(state))

    def optimize(self, score: Score, state: SearchState, *, key: PRNGKeyArray) -> Plan:
        """See `Optimizer.optimize`."""
        search = self.begin(state)
        for iteration, part in enumerate(jax.random.split(key, self.num_iterations)):
            search = self.iterate(score, search, part, iteration)
        return self.end(search)

    def ask(
        self, search: "_Search", key: PRNGKeyArray, iteration: int = 0
    ) -> Float[Array, "env candidate horizon action"]:
        """See `Optimizer.ask`."""
        candidates = self._candidates(search, self.populations[iteration], key)
        if iteration == self.num_iterations - 1:
            candidates = jnp.concatenate([candidates, search.mean[:, None]], axis=1)
        return candidates

    def end(self, search: "_Search") -> Plan:
        """See `Optimizer.end`."""
        actions, mean = jnp.clip(search.best, -1.0, 1.0), jnp.clip(search.mean, -1.0, 1.0)
        ended = SearchState(mean, elites=search.elites)
        return Plan(actions, search.best_return, search.failures, search.evaluations, ended)

    def kind(self, iteration: int) -> int:
        """See `Optimizer.kind`; each draws its own number of candidates."""
        return iteration

    def shift(self, state: SearchState) -> SearchState:
        """See `Optimizer.shift`; the mean repeats its last action, the elites' is drawn."""
        guess = shift_steps(state.guess, last=state.guess[:, -1:])
        return SearchState(guess, elites=shift_steps(self._remembered(state), last=jnp.inf))

    def _remembered(self, state: SearchState) -> Float[Array, "env elite horizon action"]:
        """The elites of a state; where it has none, all of them are still to be drawn."""
        if state.elites is not None:
            return state.elites
        num_envs, *sequence_shape = state.guess.shape
        return jnp.full((num_envs, self.num_kept, *sequence_shape), jnp.inf, state.guess.dtype)

    def begin(self, state: SearchState) -> "_Search":
        """See `Optimizer.begin`."""
        num_envs = len(state.guess)
        return _Search(
            mean=state.guess,
            std=jnp.full_like(state.guess, self.initial_std),
            elites=self._remembered(state),
            best=state.guess,
            best_return=jnp.full(num_envs, -jnp.inf),
            failures=jnp.zeros(num_envs, jnp.int32),
            evaluations=jnp.zeros(num_envs, jnp.int32),
        )

    def _candidates(
        self, search: "_Search", population: int, key: PRNGKeyArray
    ) -> Float[Array, "env candidate horizon action"]:
        """New draws, then the kept elites, with new draws for what is unknown of them."""
        num_envs, *sequence_shape = search.mean.shape
        shape = (num_envs, population + self.num_kept, *sequence_shape)
        noise = colored_noise(key, shape, self.noise_beta)
        drawn = jnp.clip(search.mean[:, None] + search.std[:, None] * noise, -1.0, 1.0)
        known = jnp.isfinite(search.elites)
        kept = jnp.where(known, search.elites, drawn[:, population:])
        return jnp.concatenate([drawn[:, :population], kept], axis=1)

    def tell(
        self,
        search: "_Search",
        candidates: Float[Array, "env candidate horizon action"],
        returns: Float[Array, "env candidate"],
    ) -> "_Search":
        """See `Optimizer.tell`; nothing moves where no return is finite."""
        search = search._replace(evaluations=search.evaluations + candidates.shape[1])
        returns = rank_non_finite_last(returns)
        elites, elite_returns = best_candidates(candidates, returns, self.num_elites)
        finite = jnp.isfinite(elite_returns)
        mean, var = moments(elites, finite)
        keep = self.smoothing
        learned = _Search(
            mean=keep * search.mean + (1.0 - keep) * mean,
            std=keep * search.std + (1.0 - keep) * jnp.sqrt(var),
            elites=jnp.where(finite[..., None, None], elites, jnp.inf)[:, : self.num_kept],
            best=elites[:, 0],
            best_return=elite_returns[:, 0],
            failures=search.failures,
            evaluations=search.evaluations,
        )
        failed = search._replace(failures=search.failures + 1)
        return where_env(finite[:, 0], learned, failed)


class _Search(NamedTuple):
    """A search under way."""

    mean: Float[Array, "env horizon action"]
    std: Float[Array, "env horizon action"]
    elites: Float[Array, "env elite horizon action"]
    best: Float[Array, "env horizon action"]
    best_return: Float[Array, " env"]
    failures: Int[Array, " env"]
    evaluations: Int[Array, " env"]
