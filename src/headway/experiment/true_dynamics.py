"""Planning on the true dynamics: the ceiling of an environment.

The planner is the one that every method has. What it imagines with is the simulator, in the
state and under the physics that the environments have at that moment.
"""

import functools
from collections.abc import Mapping
from typing import Any, NamedTuple, Protocol, runtime_checkable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental import io_callback
from jaxtyping import Array, Float, PRNGKeyArray

from headway.config import PlannerConfig
from headway.envs.built_in import ClassicVectorEnv, RobotVectorEnv
from headway.envs.classic import ClassicWorld
from headway.envs.futures import RobotFutures
from headway.errors import ConfigError
from headway.planning.acting import Decision, Physics
from headway.planning.controller import env_action
from headway.planning.devices import brought_to_each, whole_on_each
from headway.planning.imagination import over_rows
from headway.planning.optimizers import Plan, SearchState, make_optimizer
from headway.planning.step import scoring
from headway.task import Task
from headway.training.collect import Environments


@runtime_checkable
class Simulator(Protocol):
    """Environments that can be planned with."""

    @property
    def task(self) -> Task:
        """Their Task."""
        ...

    def plan(self, search: SearchState, key: PRNGKeyArray) -> Plan:
        """Search for the best actions from where every environment is now."""
        ...


class SimulatorState(NamedTuple):
    """What the agent remembers: where its search ended. The rest is in the simulator."""

    action: Float[Array, "env action"]
    search: SearchState
    key: PRNGKeyArray


class SimulatorAgent:
    """Plans on the simulator that it acts in.

    Args:
        simulator: The environments.
        planner: Settings of the planner.
    """

    def __init__(self, simulator: Simulator, planner: PlannerConfig):
        self._simulator = simulator
        self._planner = planner
        self.task = simulator.task

    sim_param_names = ()  # its simulator knows them

    def init(
        self, num_envs: int, *, key: PRNGKeyArray, sim_params: Physics | None = None
    ) -> SimulatorState:
        """See `Acting.init`."""
        del sim_params
        size = self.task.action_size
        search = make_optimizer(self._planner).init(num_envs, self._planner.horizon, size)
        return SimulatorState(jnp.zeros((num_envs, size)), search, key)

    def act(
        self, state: SimulatorState, obs: Float[Array | np.ndarray, "env obs"]
    ) -> tuple[SimulatorState, Decision]:
        """See `Acting.act`; the observation says nothing that the simulator does not know."""
        del obs
        key, plan_key = jax.random.split(state.key)
        plan = self._simulator.plan(state.search, plan_key)
        action = plan.actions[:, 0]
        shifted = make_optimizer(self._planner).shift(plan.state)
        decision = Decision(action, None, plan.failures, plan.evaluations)
        return SimulatorState(action, shifted, key), decision


def make_simulator(environments: Environments, planner: PlannerConfig) -> Simulator:
    """The simulator behind some environments.

    Raises:
        ConfigError: It is none of the built-in ones.
    """
    if isinstance(environments.vector, ClassicVectorEnv):
        return ClassicSimulator(environments.vector, environments.task, planner)
    if isinstance(environments.vector, RobotVectorEnv):
        return RobotSimulator(environments.vector, environments.task, planner)
    raise ConfigError(
        f"{environments.name} has no simulator to plan with, allowed: the built-in environments;"
        " choose another method than true-dynamics."
    )


class ClassicSimulator:
    """The classic worlds' equations, compiled; one imagined rollout is one trajectory.

    Args:
        vector: The environments.
        task: Their Task.
        planner: Settings of the planner.
    """

    def __init__(self, vector: ClassicVectorEnv, task: Task, planner: PlannerConfig):
        self.task = task
        self._vector = vector
        self._plan = jax.jit(functools.partial(_plan, vector.world, task, planner))

    def plan(self, search: SearchState, key: PRNGKeyArray) -> Plan:
        """See `Simulator.plan`."""
        states = jnp.asarray(self._vector.states, jnp.float32)
        sim_params = {
            name: jnp.asarray(values, jnp.float32)
            for name, values in self._vector.sim_params.items()
        }
        search, key = brought_to_each((search, key))
        return self._plan(states, sim_params, search, key)


def _plan(
    world: ClassicWorld,
    task: Task,
    planner: PlannerConfig,
    states: Float[Array, "env state"],
    sim_params: Mapping[str, Float[Array, " env"]],
    search: SearchState,
    key: PRNGKeyArray,
) -> Plan:
    dynamics = ClassicDynamics(states, sim_params, world)
    obs = world.observe(states, jnp)
    score = scoring(task, planner, dynamics, obs)
    plan = make_optimizer(planner).optimize(score, search, key=key)
    return whole_on_each(plan)


class ClassicDynamics(eqx.Module):
    """A classic world as one plan imagines with it (see `Dynamics`); the state is carried."""

    state: Float[Array, "*env state"]
    sim_params: Mapping[str, Float[Array, "*env"]]
    world: ClassicWorld = eqx.field(static=True)
    num_members = 1
    stochastic = False

    @property
    def widest(self) -> int:
        """See `Dynamics.widest`."""
        return self.world.state_size

    @property
    def per_env(self) -> tuple[Any, Any]:
        """See `Dynamics.per_env`."""
        return self.state, self.sim_params

    def of_env(self, part: tuple[Any, Any]) -> "ClassicDynamics":
        """See `Dynamics.of_env`."""
        return ClassicDynamics(*part, self.world)

    def start(self) -> Float[Array, "1 state"]:
        """See `Dynamics.start`."""
        return self.state[None]

    def step(
        self,
        task: Task,
        carry: Float[Array, "1 state particle candidate"],
        obs: Float[Array, "1 obs particle candidate"],
        action: Float[Array, "1 action particle candidate"],
        noise: None,
    ) -> tuple[Array, Float[Array, "1 obs particle candidate"]]:
        """See `Dynamics.step`."""
        del obs, noise

        def advance(state, scaled):
            force = task.clip_action(task.scale_action(scaled))
            return self.world.next_state(state, force, self.sim_params, jnp)

        after = over_rows(advance)(carry, action)
        return after, over_rows(functools.partial(self.world.observe, xp=jnp))(after)


class RobotSimulator:
    """MuJoCo's threaded rollout; the compiled search calls it for every iteration's candidates.

    Args:
        vector: The environments.
        task: Their Task.
        planner: Settings of the planner.
    """

    def __init__(self, vector: RobotVectorEnv, task: Task, planner: PlannerConfig):
        self.task = task
        self._planner = planner
        self._futures = RobotFutures(vector)
        self._plan = jax.jit(self._search)

    def plan(self, search: SearchState, key: PRNGKeyArray) -> Plan:
        """See `Simulator.plan`."""
        return jax.block_until_ready(self._plan(search, key))  # before the environments step on

    def _search(self, search: SearchState, key: PRNGKeyArray) -> Plan:
        def score(candidates, key):
            del key
            shape = jax.ShapeDtypeStruct(candidates.shape[:2], jnp.float32)
            # No pure function, because the environments move: it must run every time.
            return io_callback(self.returns, shape, candidates, ordered=True)

        return make_optimizer(self._planner).optimize(score, search, key=key)

    def returns(
        self, candidates: Float[Array | np.ndarray, "env candidate horizon action"]
    ) -> Float[np.ndarray, "env candidate"]:
        """Sums of rewards; not finite where MuJoCo gives up on a candidate."""
        actions = env_action(self.task, np.asarray(candidates)).astype(np.float64)
        found = [self._of_env(i, sequences) for i, sequences in enumerate(actions)]
        return np.stack(found).astype(np.float32)

    def _of_env(
        self, i: int, actions: Float[np.ndarray, "candidate horizon action"]
    ) -> Float[np.ndarray, " candidate"]:
        world = self._futures.vector.world
        before, after = self._futures.roll_out(i, actions)
        return world.reward(before, actions, after).sum(-1)
