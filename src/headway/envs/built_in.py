# pyright: reportAttributeAccessIssue=false
# (the names compiled into mujoco have no stubs)

"""The paper's six environments for Gymnasium, one or many; importing this registers their ids."""

import abc
import functools
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import gymnasium
import mujoco
import numpy as np
from gymnasium.spaces import Box
from gymnasium.utils import seeding
from gymnasium.vector import AutoresetMode

from headway.cpus import num_cpus
from headway.envs import classic, locomotion
from headway.envs.classic import ClassicWorld
from headway.envs.locomotion import Robot, RobotState
from headway.envs.vector import (
    HeadwayVectorEnv,
    Outcome,
    ProcessVectorEnv,
    SequentialVectorEnv,
    SimParams,
)
from headway.envs.world import World
from headway.errors import BrokenEpisodeError, ConfigError
from headway.sim_params import SimParamSets
from headway.task import BUILT_IN, EnvSpec, env_spec

_WORLDS: tuple[type[World], ...] = (
    classic.Pendulum,
    classic.CartPoleSwingUp,
    locomotion.Hopper,
    locomotion.SlimHumanoid,
    locomotion.HalfCheetah,
    locomotion.CrippledAnt,
)


class WorldVectorEnv(HeadwayVectorEnv):
    """Many copies of one world."""

    def __init__(
        self,
        world: World,
        num_envs: int,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        episode_length: int | None = None,
    ):
        task, high = world.task, world.obs_bounds().astype(world.obs_dtype)
        low, upper = np.array(task.action_low, np.float32), np.array(task.action_high, np.float32)
        spaces = Box(-high, high, dtype=world.obs_dtype), Box(low, upper, dtype=np.float32)
        super().__init__(num_envs, spaces, autoreset_mode, episode_length)
        self.world: Any = world
        self.rngs: list[np.random.Generator | None] = [None] * num_envs
        self._sim_params = {
            name: np.full(num_envs, float(value))
            for name, value in world.spec.default_sim_params.items()
        }

    def _check_actions(self, actions: np.ndarray) -> np.ndarray:
        return self.world.clip(actions, self.num_envs)

    def _check_sim_params(self, values: dict[str, Any]) -> SimParams:
        return self.world.check(values)

    def _begin(
        self, chosen: np.ndarray, seeds: Sequence[int | None], requested: Sequence[SimParams]
    ) -> dict[int, SimParams | BrokenEpisodeError]:
        begun: dict[int, SimParams | BrokenEpisodeError] = {}
        for i in chosen.tolist():
            rng = self.rngs[i]
            if rng is None or seeds[i] is not None:
                rng = self.rngs[i] = seeding.np_random(seeds[i])[0]
            self._set_initial_state(i, rng)
            begun[i] = sim_params = self.world.draw(rng, requested[i])
            self._apply_sim_params(i, sim_params)
        return begun

    def _change(self, i: int, changed: SimParams) -> None:
        before = {name: float(values[i]) for name, values in self._sim_params.items()}
        self._apply_sim_params(i, before | changed)

    def set_sim_params(self, i: int, values: Mapping[str, Any]) -> None:
        """Change some simulator parameters of environment `i`, and leave its state as it is.

        Raises:
            ConfigError: A parameter or value is not allowed.
        """
        checked = self.world.check(values)
        self._change(i, checked)
        self._note_sim_params(i, checked)

    def set_state(self, i: int, state: np.ndarray) -> None:
        """Bring environment `i` to a state that `get_state` returned.

        Raises:
            ConfigError: The state has the wrong size or is not finite.
        """
        state, size = np.asarray(state, np.float64), len(self.get_state(i))
        if state.shape != (size,) or not np.isfinite(state).all():
            raise ConfigError(
                f"{self.world.spec.name} was given a state of shape {state.shape}, allowed:"
                f" {size} finite numbers, as get_state returns them."
            )
        self._broken.pop(i, None)
        self._ends[:, i] = False
        self._set_state(i, state)

    @abc.abstractmethod
    def get_state(self, i: int) -> np.ndarray:
        """Return everything that the future of environment `i` depends on, but its physics."""

    @abc.abstractmethod
    def frame(self, i: int) -> np.ndarray:
        """Draw environment `i`."""

    @abc.abstractmethod
    def _set_state(self, i: int, state: np.ndarray) -> None:
        """Do what `set_state` says."""

    @abc.abstractmethod
    def _set_initial_state(self, i: int, rng: np.random.Generator) -> None:
        """Put environment `i` into the state that an episode starts in."""

    def _apply_sim_params(self, i: int, sim_params: SimParams) -> None:
        """Change the physics of environment `i`; nothing to do where they are read."""


class ClassicVectorEnv(WorldVectorEnv):
    """Many copies of a classic world, stepped by one NumPy formula."""

    world: ClassicWorld

    def __init__(self, world: ClassicWorld, num_envs: int, *args: Any):
        super().__init__(world, num_envs, *args)
        self._state = np.zeros((num_envs, world.state_size))
        self._action = np.zeros((num_envs, world.task.action_size))

    @property
    def states(self) -> np.ndarray:
        """The physical states [env, state] as they are now."""
        return self._state.copy()

    def _set_initial_state(self, i: int, rng: np.random.Generator) -> None:
        self._state[i], self._action[i] = self.world.initial_state(rng), 0.0

    def _advance(self, active: np.ndarray, actions: np.ndarray) -> Outcome:
        sim_params = {name: values[active] for name, values in self._sim_params.items()}
        state, action = self._state[active], actions[active]
        after = self.world.next_state(state, action, sim_params)
        self._state[active], self._action[active] = after, action
        terminated = self.world.terminated(after)
        reward = self.world.reward(state, action, after)
        return reward, terminated, np.zeros(len(active), bool), {}

    def observe(self) -> np.ndarray:
        """Observe all states."""
        return self.world.observe(self._state)

    def get_state(self, i: int) -> np.ndarray:
        """Return positions and velocities."""
        return self._state[i].copy()

    def _set_state(self, i: int, state: np.ndarray) -> None:
        self._state[i] = state

    def frame(self, i: int) -> np.ndarray:
        """Draw the state and the action that led to it."""
        sim_params = {name: float(values[i]) for name, values in self._sim_params.items()}
        return self.world.draw_frame(self._state[i], self._action[i], sim_params)


class RobotVectorEnv(WorldVectorEnv):
    """Many robots with a model and a solver of their own, stepped on several threads.

    `mj_step` frees Python's lock, so threads share the environments. Every `MjData` keeps its
    constraint solver's last result (`qacc_warmstart`), so neighbours change no number.
    """

    world: Robot

    def __init__(self, world: Robot, num_envs: int, *args: Any):
        super().__init__(world, num_envs, *args)
        self.models = [world.new_model() for _ in range(num_envs)]
        self.datas = [mujoco.MjData(model) for model in self.models]
        self.velocity = np.zeros(num_envs)
        self._num_threads = min(num_cpus(), num_envs)
        self._pool = ThreadPoolExecutor(self._num_threads)
        self._renderers: dict[int, Any] = {}

    def _set_initial_state(self, i: int, rng: np.random.Generator) -> None:
        data = self.datas[i]
        mujoco.mj_resetData(self.models[i], data)
        data.qpos[:], data.qvel[:] = self.world.initial_state(rng)
        self.velocity[i] = 0.0

    def _apply_sim_params(self, i: int, sim_params: SimParams) -> None:
        self.world.set_physics(self.models[i], sim_params)

    def _advance(self, active: np.ndarray, actions: np.ndarray) -> Outcome:
        def step(share: np.ndarray) -> None:
            for i in share:
                mujoco.mj_step(self.models[i], self.datas[i], nstep=self.world.frame_skip)

        before = self._robot_state()
        control = self.world.control(actions, self._sim_params)
        for data, row in zip(self.datas, control, strict=True):
            data.ctrl[:] = row
        shares = np.array_split(active, self._num_threads)
        waiting = [self._pool.submit(step, share) for share in shares[1:] if share.size]
        step(shares[0])  # in this thread
        for future in waiting:
            future.result()
        qpos, qvel, _ = self._robot_state()
        after = self.world.after_step(before, qpos, qvel)
        self.velocity[active] = after.velocity[active]
        reward = self.world.reward(before, actions, after)[active]
        warnings = {i: self.world.warning(self.datas[i]) for i in active.tolist()}
        never = np.zeros(len(active), bool)
        return reward, never, never, {i: why for i, why in warnings.items() if why}

    def _robot_state(self) -> RobotState:
        qpos = np.array([data.qpos for data in self.datas])
        return RobotState(qpos, np.array([data.qvel for data in self.datas]), self.velocity.copy())

    def observe(self) -> np.ndarray:
        """Observe all states."""
        return self.world.observe(self._robot_state())

    def get_state(self, i: int) -> np.ndarray:
        """Return positions, velocities, the solver's warm start, and the average velocity."""
        data = self.datas[i]
        return np.concatenate([data.qpos, data.qvel, data.qacc_warmstart, self.velocity[i : i + 1]])

    def _set_state(self, i: int, state: np.ndarray) -> None:
        data, (nq, nv) = self.datas[i], (self.world.nominal.nq, self.world.nominal.nv)
        data.warning.number[:] = 0  # they are of where it was before
        data.qpos[:], data.qvel[:], data.qacc_warmstart[:], self.velocity[i : i + 1] = np.split(
            state, [nq, nq + nv, nq + 2 * nv]
        )

    def frame(self, i: int) -> np.ndarray:
        """Draw the robot.

        Raises:
            BadEnvironmentError: No OpenGL library for drawing without a screen was found.
        """
        from headway.envs.rendering import RobotRenderer

        if i not in self._renderers:
            self._renderers[i] = RobotRenderer(self.models[i], self.world.camera)
        return self._renderers[i].frame(self.models[i], self.datas[i])

    def close_extras(self, **kwargs: Any) -> None:
        """Stop the threads and free the renderers."""
        self._pool.shutdown()
        while self._renderers:
            self._renderers.popitem()[1].close()


def built_in_vec(
    name: str,
    num_envs: int = 1,
    *,
    sim_params: SimParamSets | None = None,
    autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
    max_episode_steps: int | None = None,
    **options: bool,
) -> WorldVectorEnv:
    """Make many copies of a built-in environment; `gymnasium.make_vec` calls it."""
    world = _WORLDS[BUILT_IN.index(name)](sim_params, **options)
    kind: Any = RobotVectorEnv if isinstance(world, Robot) else ClassicVectorEnv
    return kind(world, num_envs, autoreset_mode, max_episode_steps)


class HeadwayEnv(gymnasium.Env[np.ndarray, np.ndarray]):
    """One built-in environment, whose physics can be set and whose state can be copied.

    It is a vector environment of one, so both are the same arithmetic.

    Args:
        name: Short name.
        sim_params: Replaces the spec's training and unseen physics.
        render_mode: `"rgb_array"`, or None to draw nothing.
        **options: Options of the environment.
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": 50}  # noqa: RUF012

    def __init__(
        self,
        name: str,
        *,
        sim_params: SimParamSets | None = None,
        render_mode: str | None = None,
        **options: bool,
    ):
        if render_mode not in (None, "rgb_array"):
            raise ConfigError(f"render_mode is {render_mode!r}, allowed: None or 'rgb_array'.")
        self.vector: Any = built_in_vec(
            name, sim_params=sim_params, autoreset_mode=AutoresetMode.DISABLED, **options
        )
        self.render_mode = render_mode
        self.metadata = self.metadata | {"render_fps": round(1 / self.vector.world.time_step)}
        self.action_space = self.vector.single_action_space
        self.observation_space = self.vector.single_observation_space

    @property
    def sim_params(self) -> SimParams:
        """The simulator parameters now in force."""
        return {name: float(values[0]) for name, values in self.vector.sim_params.items()}

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Start an episode with a random state and random or requested physics.

        Args:
            seed: Seeds the environment's random numbers.
            options: `{"sim_params": {name: value}}` sets parameters; others are drawn from
                the training values. `{"schedule": {step: {name: value}}}` changes parameters
                before some steps of the episode.

        Raises:
            ConfigError: An option, parameter or value is not allowed.
        """
        super().reset(seed=seed)
        self.vector.rngs[0] = self.np_random
        obs, _ = self.vector.reset(options=options)
        return obs[0], {"sim_params": self.sim_params}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Make one step; actions beyond their bounds are clipped.

        Raises:
            ConfigError: The action has the wrong shape or is not finite.
            BrokenEpisodeError: The simulation diverged.
        """
        obs, reward, terminated, _, info = self.vector.step(np.asarray(action)[None])
        if "broken" in info:
            raise BrokenEpisodeError(
                f"{info['broken'][0]} under sim_params {self.sim_params}, allowed: finite states;"
                " use less extreme sim_params."
            )
        sim_params = {"sim_params": self.sim_params}
        return obs[0], float(reward[0]), bool(terminated[0]), False, sim_params

    def observation(self) -> np.ndarray:
        """Return the observation of the present state."""
        return self.vector.observe()[0]

    def set_sim_params(self, values: Mapping[str, float]) -> None:
        """Change some simulator parameters and leave the state as it is.

        Raises:
            ConfigError: A parameter or value is not allowed.
        """
        self.vector.set_sim_params(0, values)

    def get_state(self) -> np.ndarray:
        """Return everything that the future depends on, besides the physics."""
        return self.vector.get_state(0)

    def set_state(self, state: np.ndarray) -> None:
        """Go to a state that `get_state` returned.

        Raises:
            ConfigError: The state has the wrong size or is not finite.
        """
        self.vector.set_state(0, state)

    def render(self) -> np.ndarray | None:  # pyright: ignore[reportIncompatibleMethodOverride]
        """Draw the present state as `uint8` [480, 640, 3], if `render_mode` is `"rgb_array"`.

        Raises:
            BadEnvironmentError: No OpenGL library for drawing without a screen was found.
        """
        return None if self.render_mode is None else self.vector.frame(0)

    def close(self) -> None:
        """Free threads and renderer."""
        self.vector.close()


def make(name: str, **kwargs: Any) -> gymnasium.Env:
    """Make one environment, as `gymnasium.make` does, also by its short name.

    Args:
        name: For example `"hopper"`, `"headway/Hopper-v0"` or `"my_package:cart"`.
        **kwargs: The environment's options, `sim_params` (a `SimParamSets`), `render_mode`, and
            what else `gymnasium.make` takes.

    Raises:
        UnknownNameError: No such environment or option.
    """
    spec = env_spec(name)
    if _built_in(spec) is not None:
        kwargs.setdefault("disable_env_checker", True)
    return gymnasium.make(spec.env_id, **kwargs)


def make_vec(
    name: str,
    num_envs: int,
    *,
    sim_params: SimParamSets | None = None,
    options: Mapping[str, bool] | None = None,
    autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
    episode_length: int | None = None,
    step_timeout_s: float | None = None,
) -> HeadwayVectorEnv:
    """Make many environments that step together, each with physics of its own.

    Args:
        name: For example `"hopper"`, `"headway/Hopper-v0"` or `"my_package:cart"`.
        num_envs: How many.
        sim_params: Replaces the spec's training and unseen physics.
        options: Boolean options of the environment.
        autoreset_mode: NEXT_STEP or DISABLED, see `HeadwayVectorEnv`.
        episode_length: Steps after which an episode is cut; None takes the spec's.
        step_timeout_s: Steps every environment in a process of its own, and gives it up when a
            step takes longer (`ProcessVectorEnv`); None steps all in this process.

    Raises:
        UnknownNameError: No such environment or option.
        ConfigError: A number or a parameter is not allowed.
        BadEnvironmentError: An environment could not be made in its process.
    """
    spec = env_spec(name)
    given: dict[str, Any] = dict(options or {})
    sets = sim_params or spec.sim_params
    length = spec.episode_length if episode_length is None else episode_length
    shared: dict[str, Any] = {"autoreset_mode": autoreset_mode}
    built_in = _built_in(spec)
    if built_in is not None and step_timeout_s is None:
        return built_in_vec(
            built_in, num_envs, sim_params=sets, max_episode_steps=length, **shared, **given
        )
    if built_in is not None:  # these draw physics themselves
        given |= {"sim_params": sets, "disable_env_checker": True}
    else:
        shared["sim_params"] = sets
    # A longer episode than Gymnasium's own limit must be possible, so ours replaces it.
    registered = gymnasium.spec(spec.env_id)  # another process may not have registered it
    one = functools.partial(gymnasium.make, registered, max_episode_steps=length, **given)
    shared |= {"env_fns": [one] * num_envs, "episode_length": length}
    if step_timeout_s is None:
        return SequentialVectorEnv(**shared)
    return ProcessVectorEnv(step_timeout_s=step_timeout_s, **shared)


def _built_in(spec: EnvSpec) -> str | None:
    """Return the built-in environment that a spec is about, maybe with physics of its own."""
    return next((name for name in BUILT_IN if env_spec(name).env_id == spec.env_id), None)


for _name in BUILT_IN:
    gymnasium.register(
        env_spec(_name).env_id,
        entry_point="headway.envs.built_in:HeadwayEnv",
        vector_entry_point="headway.envs.built_in:built_in_vec",
        max_episode_steps=env_spec(_name).episode_length,
        kwargs={"name": _name},
    )
