"""An agent: recent history, head selection, and a planner around a dynamics model."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from headway.config import PlannerConfig
from headway.data import sim_params_row
from headway.errors import ConfigError
from headway.models.dynamics import MultiHeadDynamics, Statistics
from headway.planning.acting import Decision
from headway.planning.heads import RecentTransitions, head_errors, select_heads
from headway.planning.imagination import ImaginedDynamics
from headway.planning.last_layer.learning import Learned, learn
from headway.planning.last_layer.regression import Prior
from headway.planning.optimizers import Plan, SearchState, make_optimizer, where_env
from headway.planning.search import act
from headway.task import Task


class AgentState(NamedTuple):
    """What an agent remembers of each environment between two steps."""

    recent: RecentTransitions
    obs: Float[Array, "env obs"]
    action: Float[Array, "env action"]
    acted: Bool[Array, " env"]
    search: SearchState
    key: PRNGKeyArray
    learned: Learned
    """What the heads learned in this episode."""
    sim_params: Float[Array, "env sim_param"] | None = None
    """The true simulator parameters, for a model that is told them."""


class Agent(eqx.Module):
    """Plans for many environments at once, each with its own physics.

    All arrays have a leading environment axis. The agent itself holds no state; weights are
    leaves, so one compiled `act` serves a model through all of its training.
    """

    model: MultiHeadDynamics
    statistics: Statistics
    task: Task
    planner: PlannerConfig = eqx.field(static=True)
    history_length: int = eqx.field(static=True)
    prior: Prior | None = None
    """Where heads that keep learning start; `last_layer.prior.fit_prior` finds it."""

    def __check_init__(self):
        if self.planner.adaptation != "none" and self.prior is None:
            raise ConfigError(
                "planner.adaptation is 'last-layer', but the agent has no prior; make it with"
                " headway.planning.last_layer.prior.fit_prior, or set planner.adaptation to none."
            )

    @property
    def sim_param_names(self) -> tuple[str, ...]:
        """The true simulator parameters that the model must be told; mostly none."""
        return self.model.sim_param_names

    def init(
        self,
        num_envs: int,
        *,
        key: PRNGKeyArray,
        sim_params: Sequence[Mapping[str, float]] | None = None,
    ) -> AgentState:
        """Remember nothing yet of `num_envs` environments.

        Args:
            num_envs: How many environments.
            key: The planner's draws.
            sim_params: The true simulator parameters of each environment. Only a model with
                `model.context="sim-params"` looks at them.

        Raises:
            ConfigError: The model is told simulator parameters, and one has no value.
        """
        physics, names = None, self.sim_param_names
        if names:
            rows = [sim_params_row(row, names) for row in sim_params or [{}]]
            physics = jnp.broadcast_to(np.stack(rows), (num_envs, len(names)))
        slots = max(self.history_length, self.planner.selection_length)
        action_size = self.task.action_size
        return AgentState(
            RecentTransitions.empty(num_envs, slots, self.task),
            jnp.zeros((num_envs, self.task.obs_size)),
            jnp.zeros((num_envs, action_size)),
            jnp.zeros(num_envs, bool),
            make_optimizer(self.planner).init(num_envs, self.planner.horizon, action_size),
            key,
            Learned.nothing(self, num_envs),
            physics,
        )

    def act(
        self, state: AgentState, obs: Float[Array | np.ndarray, "env obs"]
    ) -> tuple[AgentState, Decision]:
        """Choose the next action of every environment (paper, section 3.3)."""
        return act(self, state, jnp.asarray(obs, jnp.float32))

    def prepare(self, state: AgentState, obs: Float[Array, "env obs"]) -> "Prepared":
        """See `Planning.prepare`."""
        key, head_key, error_key, plan_key = jax.random.split(state.key, 4)
        # 1. Remember the transition that the last action caused.
        recent = state.recent.push(state.obs, state.action, obs, state.acted)
        # 2. Encode the recent past, once per member, for the whole plan.
        context = encode(self, recent, state.sim_params)
        # 3. Learn from that transition, where anything keeps learning.
        learned = learn(self, state.learned, recent, context, state.acted)
        # 4. Choose the head that best explains the recent past.
        heads = choose_heads(self, recent, context, error_key=error_key, head_key=head_key)
        chosen, layer = planning_heads(self, heads), learned.layer
        dynamics = ImaginedDynamics.fold(
            self.model,
            self.statistics,
            chosen,
            context,
            precision=self.planner.precision,
            correction=None if layer is None else layer.weight,
        )
        return Prepared(recent, learned, heads, dynamics, key, plan_key)

    def decide(
        self, state: AgentState, obs: Float[Array, "env obs"], prepared: "Prepared", plan: Plan
    ) -> tuple[AgentState, Decision]:
        """See `Planning.decide`."""
        recent, learned, heads, _, key, _ = prepared
        action = plan.actions[:, 0]
        acted = jnp.ones_like(state.acted)
        search = make_optimizer(self.planner).shift(plan.state)
        state = AgentState(recent, obs, action, acted, search, key, learned, state.sim_params)
        return state, Decision(action, heads, plan.failures, plan.evaluations)


class Prepared(NamedTuple):
    """All that is known in a step before its search."""

    recent: RecentTransitions
    learned: Learned
    heads: Int[Array, "env member"]
    dynamics: ImaginedDynamics
    key: PRNGKeyArray
    plan_key: PRNGKeyArray


def encode(
    agent: Agent,
    recent: RecentTransitions,
    sim_params: Float[Array, "env sim_param"] | None = None,
) -> Float[Array, "member env context"] | None:
    """The context vector of every member and environment."""
    members = agent.model.num_members
    history, sim_params = jax.tree.map(
        lambda x: jnp.broadcast_to(x, (members, *x.shape)),
        (recent.history(agent.history_length), sim_params),
    )
    return agent.model.context(history, agent.statistics, sim_params)


def choose_heads(
    agent: Agent,
    recent: RecentTransitions,
    context: Float[Array, "member env context"] | None,
    *,
    error_key: PRNGKeyArray,
    head_key: PRNGKeyArray,
) -> Int[Array, "env member"]:
    """One head per environment and member, by its error on the recent transitions."""
    slots, used = recent.newest(agent.planner)
    if agent.planner.head_selection == "random":
        used = jnp.zeros_like(used)
    sampling_key = error_key if agent.planner.selection_error == "sampled" else None
    errors = head_errors(
        agent.model, agent.task, agent.statistics, slots, context, sampling_key=sampling_key
    )
    return select_heads(errors, used, key=head_key)


def planning_heads(
    agent: Agent, heads: Int[Array, "env member"]
) -> Int[Array, "env member choice"]:
    """The heads that imagine: the chosen one, or all of them when they are averaged."""
    if agent.planner.head_selection != "average":
        return heads[..., None]
    num_heads = agent.model.num_heads
    return jnp.broadcast_to(jnp.arange(num_heads), (*heads.shape, num_heads))


def reset_where(state: AgentState, fresh: AgentState, done: Bool[Array, " env"]) -> AgentState:
    """Forget everything about the environments where an episode begins anew."""
    kept = where_env(done, fresh._replace(key=None), state._replace(key=None))
    return kept._replace(key=state.key)
