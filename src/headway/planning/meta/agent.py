"""The agent around a model that changes while it acts."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from headway.config import PlannerConfig
from headway.models.compilation import jit_networks
from headway.planning.acting import Physics
from headway.planning.agent import Decision
from headway.planning.heads import RecentTransitions
from headway.planning.meta.models import AdaptiveModel, Transition
from headway.planning.optimizers import SearchState, make_optimizer
from headway.planning.returns import RolloutSettings, candidate_returns, follow
from headway.tasks.base import Task


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
    def method(self) -> str:
        """The name of the method that made the model."""
        return self.model.method

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
        act = _act_bfloat16 if self.planner.precision == "bfloat16" else _act_float32
        return act(self, state, jnp.asarray(obs, jnp.float32))


def _act(
    agent: AdaptiveAgent, state: AdaptiveState, obs: Float[Array, "env obs"]
) -> tuple[AdaptiveState, Decision]:
    key, plan_key = jax.random.split(state.key)
    # 1. Learn from the transition that the last action caused.
    memory = agent.model.remember(
        state.memory, Transition(state.obs, state.action, obs, state.acted)
    )
    # 2. Imagine candidates with what the model is now, and search for the best sequence.
    dynamics = agent.model.dynamics(memory, agent.planner.precision)
    settings = RolloutSettings.of(agent.planner, dynamics.num_members)

    def score(candidates, key):
        return candidate_returns(dynamics, agent.task, obs, candidates, settings=settings, key=key)

    optimizer = make_optimizer(agent.planner)
    plan = optimizer.optimize(score, state.search, key=plan_key)
    # 3. Take the first action; where the search ended, one step later, is the next start.
    action = plan.actions[:, 0]
    acted = jnp.ones_like(state.acted)
    search = optimizer.shift(plan.state)
    decision = Decision(action, None, plan.failures, plan.evaluations)
    return AdaptiveState(memory, obs, action, acted, search, key), decision


_act_float32 = jit_networks(_act)
_act_bfloat16 = jit_networks(_act, precision="bfloat16")


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
