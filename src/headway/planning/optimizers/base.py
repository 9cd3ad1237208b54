"""What every optimizer keeps to: a score function in, a plan and a state for later out."""

import abc
from collections.abc import Callable
from typing import Any, NamedTuple, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

Score = Callable[
    [Float[Array, "env candidate horizon action"], PRNGKeyArray], Float[Array, "env candidate"]
]

Tree = TypeVar("Tree")


class SearchState(NamedTuple):
    """What a search starts from, and what it hands on to the search of the next step.

    Every optimizer fills what it uses; what is None takes no memory.
    """

    guess: Float[Array, "env horizon action"]
    """Where to start, within [-1, 1]; also the answer if every return is non-finite."""
    elites: Float[Array, "env elite horizon action"] | None = None
    """Good sequences to try again; infinite where an action is unknown, to be drawn."""


class Plan(NamedTuple):
    """The result of a search."""

    actions: Float[Array, "env horizon action"]
    """The chosen sequence, within [-1, 1]."""
    expected_return: Float[Array, " env"]
    """What the search expects of it, as its optimizer says; -inf where nothing was finite."""
    failures: Int[Array, " env"]
    """Iterations in which no candidate had a finite return; the old plan was kept then."""
    evaluations: Int[Array, " env"]
    """Candidates that were scored to find it."""
    state: SearchState
    """Where the search ended; shifted by one step, the next one starts there."""


class Optimizer(eqx.Module):
    """Searches for the action sequence of the highest return, iteration by iteration.

    A search under way is a pytree of the optimizer's own; its plan may be taken after any
    iteration.
    """

    num_iterations: eqx.AbstractVar[int]

    @property
    @abc.abstractmethod
    def max_evaluations(self) -> int:
        """Candidates scored for one environment's plan; fewer where it is cut off."""

    def init(self, num_envs: int, horizon: int, action_size: int) -> SearchState:
        """Know nothing yet: start from actions of zero."""
        return SearchState(jnp.zeros((num_envs, horizon, action_size)))

    @abc.abstractmethod
    def begin(self, state: SearchState) -> Any:
        """A search before its first iteration."""

    @abc.abstractmethod
    def ask(
        self, search: Any, key: PRNGKeyArray, iteration: int = 0
    ) -> Float[Array, "env candidate horizon action"]:
        """Draw the candidates of an iteration.

        Args:
            search: The search so far.
            key: Draws them.
            iteration: Which iteration; only its `kind` matters.
        """

    @abc.abstractmethod
    def tell(
        self,
        search: Any,
        candidates: Float[Array, "env candidate horizon action"],
        returns: Float[Array, "env candidate"],
    ) -> Any:
        """Learn from the returns of candidates; a non-finite one ranks last.

        Args:
            search: The search that asked for them.
            candidates: Action sequences.
            returns: Their returns.
        """

    def iterate(self, score: Score, search: Any, key: PRNGKeyArray, iteration: int = 0) -> Any:
        """Ask for candidates, score them, tell their returns.

        Args:
            score: Returns of candidates.
            search: The search so far.
            key: Draws the candidates, and is handed on to `score`.
            iteration: Which iteration; only its `kind` matters.
        """
        ask_key, score_key = jax.random.split(key)
        candidates = self.ask(search, ask_key, iteration)
        return self.tell(search, candidates, score(candidates, score_key))

    @abc.abstractmethod
    def end(self, search: Any) -> Plan:
        """The plan of a search as it is now."""

    def kind(self, iteration: int) -> int:
        """The first iteration that is compiled alike; by default all are."""
        del iteration
        return 0

    def optimize(self, score: Score, state: SearchState, *, key: PRNGKeyArray) -> Plan:
        """Search for the best action sequence of every environment.

        Args:
            score: Returns of candidates; a non-finite one ranks last.
            state: Where to start.
            key: Draws the candidates, and is handed on to `score`.
        """
        search, _ = jax.lax.scan(
            lambda search, key: (self.iterate(score, search, key), None),
            self.begin(state),
            jax.random.split(key, self.num_iterations),
        )
        return self.end(search)

    def shift(self, state: SearchState) -> SearchState:
        """Move a state on by one step of time; the new last action is zero."""
        return SearchState(shift_steps(state.guess))


def shift_steps(
    values: Float[Array, "*batch horizon action"], last: float | Array = 0.0
) -> Float[Array, "*batch horizon action"]:
    """Drop the first step and append `last`."""
    appended = jnp.broadcast_to(last, values[..., :1, :].shape)
    return jnp.concatenate([values[..., 1:, :], appended], axis=-2)


def where_env(condition: Bool[Array, " env"], chosen: Tree, other: Tree) -> Tree:
    """For each environment, the arrays of one tree or those of the other."""

    def pick(x, y):
        return jnp.where(condition.reshape(-1, *[1] * (x.ndim - 1)), x, y)

    return jax.tree.map(pick, chosen, other)
