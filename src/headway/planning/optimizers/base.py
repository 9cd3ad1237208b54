"""Base of all optimizers: a search under way, how it goes on, and tools that several share."""

import abc
from collections.abc import Callable
from typing import ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray


class Search(NamedTuple):
    """A search under way; its plan may be taken after any iteration."""

    nominal: Float[Array, "env horizon action"]
    """The nominal plan: what candidates are drawn around, and what the next step starts from."""
    best_return: Float[Array, " env"]
    """Return of the plan, where it is the best candidate of all iterations; else -inf."""
    non_finite: Int[Array, " env"]
    """Iterations in which no candidate had a finite return; they change nothing else."""
    evaluations: Int[Array, " env"]
    """Candidates that were scored."""
    std: Float[Array, "env horizon action"]
    """Standard deviation of the candidates."""
    elites: Float[Array, "env elite horizon action"]
    """Good sequences to try again; infinite where an action is unknown, to be drawn."""
    best: Float[Array, "env horizon action"] | None = None
    """The plan, if it is not the nominal one."""

    @property
    def actions(self) -> Float[Array, "env horizon action"]:
        """The plan, within [-1, 1]."""
        return jnp.clip(self.nominal if self.best is None else self.best, -1.0, 1.0)

    def answer(self, obs: Float[Array, "env obs"]) -> Float[Array, "env action"]:
        """The first action of the plan."""
        return self.actions[:, 0]


class Optimizer(eqx.Module):
    """Searches for the action sequence of the highest return: ask for candidates, tell returns."""

    initial_std: eqx.AbstractVar[float]
    num_candidates: int = 200
    num_iterations: int = 5
    num_kept = 0
    """Elites that compete once more."""
    unrolled: ClassVar[bool] = False
    """Iterations differ in shape, so that each is compiled by itself."""

    def init(self, num_envs: int, horizon: int, action_size: int, obs_size: int = 0) -> Search:
        """The start of a search that knows nothing: actions of zero."""
        none = jnp.zeros(num_envs, jnp.int32)
        nominal = jnp.zeros((num_envs, horizon, action_size))
        std = jnp.full_like(nominal, self.initial_std)
        elites = jnp.full((num_envs, self.num_kept, horizon, action_size), jnp.inf, nominal.dtype)
        nothing = jnp.full(num_envs, -jnp.inf, nominal.dtype)
        return Search(nominal, nothing, none, none, std, elites)

    @abc.abstractmethod
    def ask(
        self, search: Search, key: PRNGKeyArray, iteration: int = 0
    ) -> Float[Array, "env candidate horizon action"]:
        """Draw the candidates of an iteration.

        Args:
            search: The search so far.
            key: Draws them.
            iteration: Which iteration; only an optimizer that is `unrolled` looks at it.
        """

    @abc.abstractmethod
    def tell(
        self,
        search: Search,
        candidates: Float[Array, "env candidate horizon action"],
        returns: Float[Array, "env candidate"],
    ) -> Search:
        """Learn from the returns of candidates; a non-finite one ranks last.

        Args:
            search: The search that asked for them.
            candidates: Action sequences.
            returns: Their returns.
        """

    def optimize(
        self, score: Callable, search: Search, *, key: PRNGKeyArray, project: Callable = lambda x: x
    ) -> Search:
        """Search for the best action sequence of every environment.

        Args:
            score: Returns [env, candidate] of candidates, by a key; a non-finite one ranks last.
            search: Where to start.
            key: Draws the candidates, and is handed on to `score`.
            project: Turns candidates into actions that can be taken, before they are scored.
        """

        def iterate(search, key, iteration=0):
            ask_key, score_key = jax.random.split(key)
            candidates = project(self.ask(search, ask_key, iteration))
            return self.tell(search, candidates, score(candidates, score_key)), None

        keys = jax.random.split(key, self.num_iterations)
        if not self.unrolled:
            return jax.lax.scan(iterate, search, keys)[0]
        for iteration, iteration_key in enumerate(keys):
            search, _ = iterate(search, iteration_key, iteration)
        return search

    def shift(self, search: Search) -> Search:
        """The start of the search one step later, along the nominal plan; its last action is 0."""
        nominal = shift_steps(jnp.clip(search.nominal, -1.0, 1.0), 0.0)
        return self.init(*nominal.shape)._replace(nominal=nominal)


def shift_steps(
    values: Float[Array, "*batch horizon action"], last: float | Array
) -> Float[Array, "*batch horizon action"]:
    """Drop the first step and append `last`."""
    appended = jnp.broadcast_to(last, values[..., :1, :].shape)
    return jnp.concatenate([values[..., 1:, :], appended], axis=-2)


def best_candidates(
    candidates: Float[Array, "env candidate horizon action"],
    returns: Float[Array, "env candidate"],
    count: int,
) -> tuple[Float[Array, "env elite horizon action"], Float[Array, "env elite"]]:
    """The candidates of the highest returns, and these returns, best first.

    What is not finite counts as -inf.
    """
    ranked = jnp.where(jnp.isfinite(returns), returns, -jnp.inf)
    elite_returns, elite = jax.lax.top_k(ranked, count)
    return jnp.take_along_axis(candidates, elite[:, :, None, None], axis=1), elite_returns


def moments(
    elites: Float[Array, "env elite horizon action"], counted: Bool[Array, "env elite"]
) -> tuple[Float[Array, "env horizon action"], Float[Array, "env horizon action"]]:
    """Mean and population variance over the counted elites."""
    weight = counted[..., None, None] / jnp.maximum(counted.sum(-1), 1)[:, None, None, None]
    mean = (weight * elites).sum(1)
    return mean, (weight * jnp.square(elites - mean[:, None])).sum(1)


def colored_noise(
    key: PRNGKeyArray, shape: tuple[int, ...], beta: float
) -> Float[Array, "*batch horizon action"]:
    """Draw normal noise of unit variance whose power falls with frequency as f^-beta.

    Each action has a noise of its own; the spectrum is that along the horizon (Timmer and König,
    1995). The constant part, which would be infinite, counts as one period in the horizon.

    Args:
        key: Draws the noise.
        shape: Any number of axes, then horizon and action.
        beta: 0 gives white noise, 1 pink, 2 red; larger is smoother.
    """
    white, horizon = jax.random.normal(key, shape), shape[-2]
    if beta == 0:
        return white
    # A matrix filters white noise: it scales each frequency by f^(-beta/2); all rows have norm 1.
    amplitude = np.maximum(np.arange(horizon // 2 + 1), 1) ** (-beta / 2)
    filtered = np.fft.irfft(amplitude[:, None] * np.fft.rfft(np.eye(horizon), axis=0), horizon, 0)
    shaping = (filtered / np.linalg.norm(filtered[0])).astype(np.float32)
    return jnp.einsum("ts,...sa->...ta", shaping, white)
