"""The agent around a model that changes while it acts."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from headway.config import PlannerConfig
from headway.models.dynamics import Statistics
from headway.planning.acting import Decision, Physics
from headway.planning.heads import RecentTransitions
from headway.planning.meta.models import AdaptiveModel, Transition
from headway.planning.optimizers import Plan, SearchState, make_optimizer
from headway.planning.returns import Dynamics, follow
from headway.planning.search import act
from headway.task import Task


class AdaptiveState(NamedTuple):
    """What an agent remembers of each environment between two steps."""

    memory: Any
    """The model's own."""
    obs: Float[Array, "env obs"]
    action: Float[Array, "env action"]
    acted: Bool[Array, " env"]
    search: SearchState
    key: PRNGKeyArray


class AdaptiveAgent(eqx.Module):
    """Lets a model learn from every step, and plans with what it has become."""

    model: AdaptiveModel
    task: Task
    planner: PlannerConfig = eqx.field(static=True)
    sim_param_names = ()

    @property
    def statistics(self) -> Statistics | None:
        """Normalisers of the training data; None for a model that has none."""
        return getattr(self.model, "statistics", None)

    def init(
        self, num_envs: int, *, key: PRNGKeyArray, sim_params: Physics | None = None
    ) -> AdaptiveState:
        """See `Acting.init`."""
        del sim_params
        action_size = self.task.action_size
        return AdaptiveState(
            self.model.start(num_envs),
            jnp.zeros((num_envs, self.task.obs_size)),
            jnp.zeros((num_envs, action_size)),
            jnp.zeros(num_envs, bool),
            make_optimizer(self.planner).init(num_envs, self.planner.horizon, action_size),
            key,
        )

    def act(
        self, state: AdaptiveState, obs: Float[Array | np.ndarray, "env obs"]
    ) -> tuple[AdaptiveState, Decision]:
        """See `Acting.act`."""
        return act(self, state, jnp.asarray(obs, jnp.float32))

    def prepare(self, state: AdaptiveState, obs: Float[Array, "env obs"]) -> "Prepared":
        """See `Planning.prepare`: learn from the transition that the last action caused."""
        key, plan_key = jax.random.split(state.key)
        seen = Transition(state.obs, state.action, obs, state.acted)
        memory = self.model.remember(state.memory, seen)
        dynamics = self.model.dynamics(memory, self.planner.precision)
        return Prepared(memory, dynamics, key, plan_key)

    def decide(
        self, state: AdaptiveState, obs: Float[Array, "env obs"], prepared: "Prepared", plan: Plan
    ) -> tuple[AdaptiveState, Decision]:
        """See `Planning.decide`."""
        action = plan.actions[:, 0]
        acted = jnp.ones_like(state.acted)
        search = make_optimizer(self.planner).shift(plan.state)
        decision = Decision(action, None, plan.failures, plan.evaluations)
        return AdaptiveState(prepared.memory, obs, action, acted, search, prepared.key), decision


class Prepared(NamedTuple):
    """All that is known in a step before its search."""

    memory: Any
    dynamics: Dynamics
    key: PRNGKeyArray
    plan_key: PRNGKeyArray


@eqx.filter_jit
def imagine(
    agent: AdaptiveAgent,
    recent: RecentTransitions,
    actions: Float[Array, "env horizon action"],
) -> Float[Array, "member env horizon obs"]:
    """Predictions along given actions, after living through what went before.

    Args:
        agent: The agent.
        recent: What went before, from the beginning of each episode or as much as it needs.
        actions: What is done then, in [-1, 1].
    """
    slots = recent.obs.shape[1]

    def live(memory, slot):
        index, obs, action, next_obs = slot
        happened = index >= slots - recent.count
        return agent.model.remember(memory, Transition(obs, action, next_obs, happened)), None

    first = agent.model.start(len(actions))
    by_slot = [jnp.moveaxis(x, 1, 0) for x in (recent.obs, recent.action, recent.next_obs)]
    memory, _ = jax.lax.scan(live, first, (jnp.arange(slots), *by_slot))
    dynamics = agent.model.dynamics(memory, "float32")
    return follow(dynamics, agent.task, recent.next_obs[:, -1], actions)
