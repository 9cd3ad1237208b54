"""One agent for every method: observe, specialise the model, search, act (paper, section 3.3)."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from headway.config import PlannerConfig
from headway.data import sim_params_row
from headway.models.base import Model, Transition
from headway.models.compilation import in_each_precision, jit_networks
from headway.planning import cpu
from headway.planning.optimizers import ILQR, Optimizer, make_optimizer
from headway.planning.rollouts import candidate_returns, within_members
from headway.task import Task


class AgentState(NamedTuple):
    """All that an agent keeps of its environments between two steps; a pytree."""

    belief: Any
    """The model's own."""
    obs: Float[Array, "env obs"]
    action: Float[Array, "env action"]
    """The last action, in [-1, 1]."""
    acted: Bool[Array, " env"]
    """Environments in which that action, taken at `obs`, led to the next observation."""
    search: Any
    """The last search as it ended, one step later (`Search`, or iLQR's `Policy`); None for a random
    agent."""
    key: PRNGKeyArray


class Decision(NamedTuple):
    """The outcome of one step."""

    action: Float[Array, "env action"]
    """The action to take, in [-1, 1]."""
    heads: Int[Array, "env member"] | None
    """The head each member plans with; with `average`, the one that would be adaptive. None
    where a model has no heads."""
    failures: Int[Array, " env"]
    """Planner iterations without any finite return."""
    evaluations: Int[Array, " env"]
    """Candidates whose return was imagined, each with `num_particles` rollouts (iLQR: one of each
    member)."""


class Plan(NamedTuple):
    """A step under way: all that is known before its search, and the search so far."""

    belief: Any
    dynamics: Any
    obs: Float[Array, "env obs"]
    search: Any
    key: PRNGKeyArray
    """Of the search."""
    next_key: PRNGKeyArray
    """Of the next step."""


class Agent(eqx.Module):
    """Plans for many environments at once, each with its own physics.

    All arrays have a leading environment axis. The agent itself holds no state; weights are
    leaves, so one compiled step serves a model through all of its training.
    """

    model: Model | None
    """None acts at random."""
    task: Task
    planner: PlannerConfig = eqx.field(static=True)

    @property
    def optimizer(self) -> Optimizer | ILQR:
        """The search for the best action sequence."""
        return make_optimizer(self.planner)

    @property
    def sim_param_names(self) -> tuple[str, ...]:
        """The true simulator parameters that the model must be told; mostly none."""
        return self.model.sim_param_names if self.model is not None else ()

    def init(
        self,
        num_envs: int,
        *,
        key: PRNGKeyArray,
        sim_params: Sequence[Mapping[str, float]] | None = None,
    ) -> AgentState:
        """The state at the beginning of an episode.

        Args:
            num_envs: Number of environments.
            key: The planner's draws.
            sim_params: The true simulator parameters of each environment. Only a model with
                `model.context="sim-params"` looks at them.

        Raises:
            ConfigError: The model is told simulator parameters, and one has no value.
        """
        belief, search, told, names = (), None, None, self.sim_param_names
        action_size = self.task.action_size
        if names:
            rows = [sim_params_row(row, names) for row in sim_params or [{}]]
            told = jnp.broadcast_to(np.stack(rows), (num_envs, len(names)))
        if self.model is not None:
            belief = self.model.init_belief(num_envs, told)
            sizes = self.planner.horizon, action_size, self.task.obs_size
            search = self.optimizer.init(num_envs, *sizes)
        obs = jnp.zeros((num_envs, self.task.obs_size))
        action = jnp.zeros((num_envs, action_size))
        return AgentState(belief, obs, action, jnp.zeros(num_envs, bool), search, key)

    def act(
        self, state: AgentState, obs: Float[Array | np.ndarray, "env obs"]
    ) -> tuple[AgentState, Decision]:
        """Choose the next action of every environment."""
        obs = jnp.asarray(obs, jnp.float32)
        if self.model is None:
            key, draw = jax.random.split(state.key)
            action = jax.random.uniform(draw, state.action.shape, minval=-1.0)
            action = self.task.project_action(action)
            none = jnp.zeros(len(obs), jnp.int32)
            return state._replace(action=action, key=key), Decision(action, None, none, none)
        # Threads know nothing of a step that is part of another program (jit, vmap).
        traced = any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves((state, obs)))
        if traced or (self.model.traceable and self._num_shards(len(obs)) == 1):
            return _step[self.planner.precision](self, state, obs)
        plan = self.begin(state, obs)
        for iteration in range(self.planner.num_iterations):
            plan = self.iterate(plan, iteration)
        return self.end(plan)

    # The same step in several programs: a search can be cut off by a deadline, the cores of a CPU
    # can share its candidates, and a simulator that JAX cannot trace can score them.

    def begin(self, state: AgentState, obs: Float[Array, "env obs"]) -> Plan:
        """All of a step that comes before its first iteration."""
        return _observe[self.planner.precision](self, state, obs)

    def iterate(self, plan: Plan, iteration: int) -> Plan:
        """The plan after another iteration: ask for candidates, score them, tell their returns."""
        assert self.model is not None
        optimizer, precision = self.optimizer, self.planner.precision
        if isinstance(optimizer, ILQR):
            args = optimizer, plan.dynamics, self.task, plan.obs, plan.search
            return plan._replace(search=_improve[precision](*args))
        # Iterations of a kind are one program; which of them it is decides the key alone.
        which = plan.key, np.int32(iteration), iteration * optimizer.unrolled
        candidates, key = _ask(optimizer, self.task, plan.search, *which)

        def returns_of(shard: cpu.Shard | None) -> Float[Array, "shard_env shard_candidate"]:
            args = plan.dynamics, self.task, plan.obs, candidates
            return _score[precision](*args, planner=self.planner, key=key, shard=shard)

        if self.model.traceable:
            shape, shards = candidates.shape[:2], self._num_shards(len(plan.obs))
            returns = cpu.in_shards(returns_of, shape, shards)
        else:
            returns = [jnp.asarray(plan.dynamics.returns(candidates))]
        members = getattr(plan.dynamics, "num_members", 1)  # a simulator has none
        search = _tell(optimizer, plan.search, candidates, returns, self.planner, members)
        return plan._replace(search=search)

    def end(self, plan: Plan) -> tuple[AgentState, Decision]:
        """The decision, by the search as it is now."""
        return _decide(self, plan)

    def shift(self, search: Any) -> Any:
        """The start of the search one step later.

        A category that all elites had leads by half only: the others would not be drawn again.
        """
        start, ordered = self.optimizer.shift(search), self.task.spaces.action_kind != "categories"
        return start if ordered else start._replace(nominal=0.5 * start.nominal)

    def _num_shards(self, num_envs: int) -> int:
        planner = self.planner
        per_env = planner.num_candidates * planner.num_particles * planner.horizon
        return cpu.num_shards(num_envs * per_env)


def observe(agent: Agent, state: AgentState, obs: Float[Array, "env obs"]) -> Plan:
    """Let the model observe what the last action caused, and specialise it to its belief."""
    assert agent.model is not None
    keys = jax.random.split(state.key, 4)
    seen = Transition(state.obs, state.action, obs, state.acted)
    belief = agent.model.observe(state.belief, seen, keys[1:3])
    dynamics = agent.model.dynamics(belief, agent.planner.precision)
    return Plan(belief, dynamics, obs, state.search, key=keys[3], next_key=keys[0])


def decide(agent: Agent, plan: Plan) -> tuple[AgentState, Decision]:
    """Take a plan's first action; where its search ended, one step later, is the next start."""
    search, acted = plan.search, jnp.ones(len(plan.obs), bool)
    action, start = search.answer(plan.obs), agent.shift(search)
    action = agent.task.project_action(action)
    state = AgentState(plan.belief, plan.obs, action, acted, start, plan.next_key)
    heads = getattr(plan.belief, "heads", None)
    return state, Decision(action, heads, search.non_finite, search.evaluations)


def step(
    agent: Agent, state: AgentState, obs: Float[Array, "env obs"]
) -> tuple[AgentState, Decision]:
    """A whole step as one program: observe, specialise, search, decide."""
    plan, optimizer = observe(agent, state, obs), agent.optimizer
    if isinstance(optimizer, ILQR):
        args = plan.dynamics, agent.task, obs
        iterate = lambda _, search: optimizer.iterate(*args, search)  # noqa: E731
        search = jax.lax.fori_loop(0, optimizer.num_iterations, iterate, plan.search)
        return decide(agent, plan._replace(search=search))

    def score(candidates, key):
        args = plan.dynamics, agent.task, obs, candidates
        returns = candidate_returns(*args, planner=agent.planner, key=key)
        return within_members(returns, agent.planner, plan.dynamics.num_members)

    project = agent.task.project_action
    search = optimizer.optimize(score, plan.search, key=plan.key, project=project)
    return decide(agent, plan._replace(search=search))


_step, _observe, _score, _improve = map(
    in_each_precision, (step, observe, candidate_returns, ILQR.iterate)
)
_decide = jit_networks(decide)


@jit_networks
def _ask(
    optimizer: Optimizer, task: Task, search: Any, plan_key: PRNGKeyArray, iteration: Any, kind: int
) -> tuple[Float[Array, "env candidate horizon action"], PRNGKeyArray]:
    """Candidates, and the key that scores them; keys as in `Optimizer.optimize`."""
    key = jax.random.split(plan_key, optimizer.num_iterations)[iteration]
    ask_key, score_key = jax.random.split(key)
    return task.project_action(optimizer.ask(search, ask_key, kind)), score_key


@jit_networks
def _tell(
    optimizer: Optimizer,
    search: Any,
    candidates: Float[Array, "env candidate horizon action"],
    returns: list[Float[Array, "shard_env shard_candidate"]],
    planner: PlannerConfig,
    num_members: int,
) -> Any:
    whole = cpu.joined(returns, candidates.shape[:2])
    return optimizer.tell(search, candidates, within_members(whole, planner, num_members))


@eqx.filter_jit
def open_loop(agent: Agent, state: AgentState) -> AgentState:
    """Go on along the last plan without a look: its next action is the state's `action`.

    The plan is what the search's distribution was centred on in the end. The transition that the
    action causes is not observed, because it begins unseen.

    Args:
        agent: It plans.
        state: Its state.
    """
    search, unseen = agent.shift(state.search), jnp.zeros_like(state.acted)
    action = agent.task.project_action(state.search.nominal[:, 0])
    return state._replace(action=action, acted=unseen, search=search)
