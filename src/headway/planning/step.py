"""One step of an agent that plans: prepare, search for the best action sequence, decide."""

from typing import Any, NamedTuple, Protocol, runtime_checkable

import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PRNGKeyArray

from headway.config import PlannerConfig
from headway.models.compilation import jit_networks
from headway.planning.optimizers import Plan, Score, SearchState, make_optimizer
from headway.planning.returns import Dynamics, RolloutSettings, candidate_returns
from headway.tasks.base import Task


class Decision(NamedTuple):
    """What an agent decided in one step."""

    action: Float[Array, "env action"]
    """The action to take, in [-1, 1]."""
    heads: Int[Array, "env member"] | None
    """The head each member plans with; with `average`, the one that would be adaptive. None
    where a model has no heads."""
    failures: Int[Array, " env"]
    """Planner iterations without any finite return."""
    evaluations: Int[Array, " env"]
    """Candidates whose return was imagined, each with `num_particles` rollouts."""


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
class Planning(Protocol):
    """An agent that plans. Its step is in parts, so that a search can be cut off."""

    @property
    def task(self) -> Task:
        """What the agent knows of the environment."""
        ...

    @property
    def planner(self) -> PlannerConfig:
        """Settings of the planner."""
        ...

    @property
    def sim_param_names(self) -> tuple[str, ...]:
        """See `Acting.sim_param_names`."""
        ...

    def init(self, num_envs: int, *, key: PRNGKeyArray, sim_params: Any = None) -> Any:
        """See `Acting.init`; returns a `PlanState`."""
        ...

    def prepare(self, state: Any, obs: Float[Array, "env obs"]) -> Any:
        """Everything of a step that comes before its search; returns what is `Known`."""
        ...

    def decide(
        self, state: Any, obs: Float[Array, "env obs"], prepared: Any, plan: Plan
    ) -> tuple[Any, Decision]:
        """Take a plan's first action; where its search ended, one step later, is the next start."""
        ...


def scoring(agent: Planning, dynamics: Dynamics, obs: Float[Array, "env obs"]) -> Score:
    """Returns of candidates, imagined from where each environment is now."""
    settings = RolloutSettings.of(agent.planner, dynamics.num_members)

    def score(candidates, key):
        return candidate_returns(dynamics, agent.task, obs, candidates, settings=settings, key=key)

    return score


def act(agent: Planning, state: Any, obs: Float[Array, "env obs"]) -> tuple[Any, Decision]:
    """One whole step, compiled."""
    compiled = _act_bfloat16 if agent.planner.precision == "bfloat16" else _act_float32
    return compiled(agent, state, jnp.asarray(obs, jnp.float32))


def _act(agent: Planning, state: Any, obs: Float[Array, "env obs"]) -> tuple[Any, Decision]:
    prepared = agent.prepare(state, obs)
    # Imagine candidates, and search for the best action sequence.
    score = scoring(agent, prepared.dynamics, obs)
    optimizer = make_optimizer(agent.planner)
    plan = optimizer.optimize(score, state.search, key=prepared.plan_key)
    return agent.decide(state, obs, prepared, plan)


_act_float32 = jit_networks(_act)
_act_bfloat16 = jit_networks(_act, precision="bfloat16")


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
    return state._replace(action=state.search.guess[:, 0], acted=unseen, search=search)
