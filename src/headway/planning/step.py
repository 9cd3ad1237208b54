"""What a step of an agent that plans is made of: prepare, search, decide."""

from typing import Any, Protocol, runtime_checkable

import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from headway.config import PlannerConfig
from headway.planning.acting import Acting, Decision
from headway.planning.devices import whole_on_each
from headway.planning.optimizers import Plan, Score, SearchState, make_optimizer
from headway.planning.returns import Dynamics, RolloutSettings, candidate_returns
from headway.task import Task


class Known(Protocol):
    """All that is known in a step before its search; agents add what they need later."""

    @property
    def dynamics(self) -> Dynamics:
        """What the search imagines with."""
        ...

    @property
    def plan_key(self) -> PRNGKeyArray:
        """The draws of the search."""
        ...


class PlanState(Protocol):
    """What an agent that plans remembers; the rest is its own."""

    @property
    def search(self) -> SearchState:
        """Where the last search ended, one step later."""
        ...


@runtime_checkable
class Planning(Acting, Protocol):
    """An agent that plans. Its step is in parts, so that a search can be cut off.

    What it remembers is a `PlanState`.
    """

    @property
    def planner(self) -> PlannerConfig:
        """Settings of the planner."""
        ...

    def prepare(self, state: Any, obs: Float[Array, "env obs"]) -> Any:
        """Everything of a step that comes before its search: what is `Known`, as a pytree."""
        ...

    def decide(
        self, state: Any, obs: Float[Array, "env obs"], prepared: Any, plan: Plan
    ) -> tuple[Any, Decision]:
        """Take a plan's first action; where its search ended, one step later, is the next start."""
        ...


def scoring(
    task: Task, planner: PlannerConfig, dynamics: Dynamics, obs: Float[Array, "env obs"]
) -> Score:
    """Returns of candidates, imagined from where each environment is now."""
    settings = RolloutSettings.of(planner, dynamics.num_members)

    def score(candidates, key):
        return candidate_returns(dynamics, task, obs, candidates, settings=settings, key=key)

    return score


def hold(planner: PlannerConfig, state: Any) -> Any:
    """Go on along the last plan without a look: its next action is the state's `action`.

    The plan is what the search's distribution was centred on in the end. The transition that the
    action causes is not remembered, because it begins unseen.

    Args:
        planner: What made the plan.
        state: Of an agent that plans.
    """
    search = make_optimizer(planner).shift(state.search)
    unseen = jnp.zeros_like(state.acted)
    held = state._replace(action=state.search.guess[:, 0], acted=unseen, search=search)
    return whole_on_each(held)
