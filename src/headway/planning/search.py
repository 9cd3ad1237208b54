"""One step of an agent that plans, compiled: as one program, or iteration by iteration.

One program is what several devices share, and what costs least to call. Iteration by iteration
a search can be cut off, and the cores of a CPU can share its candidates.
"""

from typing import Any, NamedTuple

import jax
from jax.core import Tracer
from jaxtyping import Array, Float, PRNGKeyArray

from headway.models.compilation import in_each_precision
from headway.planning.acting import Decision
from headway.planning.devices import brought_to_each, whole_on_each
from headway.planning.optimizers import Optimizer, make_optimizer
from headway.planning.shares import Question, joined, num_shares, returns_of_shares
from headway.planning.step import Planning, scoring


class Begun(NamedTuple):
    """A step whose search is under way."""

    prepared: Any
    """What is known before the search."""
    obs: Float[Array, "env obs"]
    keys: list[PRNGKeyArray]
    """One for each iteration."""


def act(agent: Planning, state: Any, obs: Float[Array, "env obs"]) -> tuple[Any, Decision]:
    """One whole step."""
    if num_shares(agent.planner, len(obs)) > 1 and not _traced((agent, state, obs)):
        return _act_by_iteration(agent, state, obs)
    state = brought_to_each(state)
    return _compiled(agent, "act")(agent, state, obs)


def _act_by_iteration(
    agent: Planning, state: Any, obs: Float[Array, "env obs"]
) -> tuple[Any, Decision]:
    planner = agent.planner
    begun, search = begin(agent, state, obs)
    for iteration in range(planner.num_iterations):
        search = iterate(agent, begun, search, iteration)
    return end(agent, state, begun, search)


def begin(agent: Planning, state: Any, obs: Float[Array, "env obs"]) -> tuple[Begun, Any]:
    """All of a step that comes before its first iteration, and the search as it is then."""
    state = brought_to_each(state)
    return _compiled(agent, "begin")(agent, state, obs)


def iterate(agent: Planning, begun: Begun, search: Any, iteration: int) -> Any:
    """The search after another iteration."""
    planner, optimizer = agent.planner, make_optimizer(agent.planner)
    kind, key = optimizer.kind(iteration), begun.keys[iteration]
    shares = num_shares(planner, len(begun.obs))
    if shares == 1:
        return _compiled(agent, "iterate")(agent, begun, search, key, kind)
    candidates, score_key = _compiled(agent, "ask")(optimizer, search, key, kind)
    question = Question(begun.prepared.dynamics, agent.task, begun.obs, candidates, score_key)
    returns = returns_of_shares(question, planner, shares)
    return _compiled(agent, "tell")(optimizer, search, candidates, returns)


def end(agent: Planning, state: Any, begun: Begun, search: Any) -> tuple[Any, Decision]:
    """The decision, by the search as it is now."""
    return _compiled(agent, "end")(agent, state, begun, search)


def act_in_one(agent: Planning, state: Any, obs: Float[Array, "env obs"]) -> tuple[Any, Decision]:
    """One whole step, not compiled yet."""
    prepared = agent.prepare(state, obs)
    # Imagine candidates, and search for the best action sequence.
    score = scoring(agent.task, agent.planner, prepared.dynamics, obs)
    optimizer = make_optimizer(agent.planner)
    plan = optimizer.optimize(score, state.search, key=prepared.plan_key)
    return whole_on_each(agent.decide(state, obs, prepared, plan))


def _begin(agent: Planning, state: Any, obs: Float[Array, "env obs"]) -> tuple[Begun, Any]:
    prepared = agent.prepare(state, obs)
    optimizer = make_optimizer(agent.planner)
    keys = jax.random.split(prepared.plan_key, optimizer.num_iterations)
    begun = Begun(prepared, obs, list(keys)), optimizer.begin(state.search)
    return whole_on_each(begun)


def _iterate(agent: Planning, begun: Begun, search: Any, key: PRNGKeyArray, iteration: int) -> Any:
    optimizer = make_optimizer(agent.planner)
    score = scoring(agent.task, agent.planner, begun.prepared.dynamics, begun.obs)
    search = optimizer.iterate(score, search, key, iteration)
    return whole_on_each(search)


def _ask(
    optimizer: Optimizer, search: Any, key: PRNGKeyArray, iteration: int
) -> tuple[Float[Array, "env candidate horizon action"], PRNGKeyArray]:
    """The first half of `Optimizer.iterate`, with the key that the second half draws with."""
    ask_key, score_key = jax.random.split(key)
    return optimizer.ask(search, ask_key, iteration), score_key


def _tell(
    optimizer: Optimizer,
    search: Any,
    candidates: Float[Array, "env candidate horizon action"],
    returns: list[Float[Array, "env share"]],
) -> Any:
    return optimizer.tell(search, candidates, joined(returns, candidates.shape[1]))


def _end(agent: Planning, state: Any, begun: Begun, search: Any) -> tuple[Any, Decision]:
    plan = make_optimizer(agent.planner).end(search)
    decided = agent.decide(state, begun.obs, begun.prepared, plan)
    return whole_on_each(decided)


_PARTS = {
    "act": act_in_one,
    "begin": _begin,
    "iterate": _iterate,
    "ask": _ask,
    "tell": _tell,
    "end": _end,
}
_COMPILED = {name: in_each_precision(function) for name, function in _PARTS.items()}


def _traced(tree: Any) -> bool:
    """Whether a call is part of another program, which other threads know nothing of."""
    return any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves(tree))


def _compiled(agent: Planning, name: str) -> Any:
    return _COMPILED[name][agent.planner.precision]
