# pyright: reportAttributeAccessIssue=false
# (the names compiled into mujoco have no stubs)

"""The paper's six environments for Gymnasium, one or many."""

import copy
import functools
import importlib
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import gymnasium
import mujoco
import mujoco.rollout
import numpy as np
from gymnasium.envs.registration import find_highest_version, get_env_id, parse_env_id
from gymnasium.spaces import Box
from jaxtyping import Float

from headway.cpus import num_cpus
from headway.envs.physics import adapted, divergence
from headway.envs.vector import HeadwayVectorEnv, ProcessVectorEnv, SequentialVectorEnv, SimParams
from headway.errors import BrokenEpisodeError, ConfigError
from headway.sim_params import SimParamSets
from headway.task import EnvSpec, env_spec
from headway.worlds import classic, locomotion
from headway.worlds.base import World
from headway.worlds.locomotion import Robot, RobotState

_WORLDS: Mapping[Any, type[World]] = {
    world.spec.env_id: world for world in (*classic.WORLDS, *locomotion.WORLDS)
}


class WorldVectorEnv(HeadwayVectorEnv):
    """Many copies of one world."""

    def __init__(self, world: World, num_envs: int, episode_length: int | None = None):
        task, dtype = world.task, world.obs_dtype
        bounds = np.broadcast_to(world.obs_bounds, task.obs_size).astype(dtype)
        low, high = np.array(task.action_low, np.float32), np.array(task.action_high, np.float32)
        spaces = Box(-bounds, bounds, dtype=dtype), Box(low, high, dtype=np.float32)
        super().__init__(num_envs, spaces, episode_length)
        self.world: Any = world
        self.metadata = self.metadata | {"render_fps": round(1 / world.time_step)}
        for i in range(num_envs):
            self._note(i, world.spec.default_sim_params)

    def _check_actions(self, actions: np.ndarray) -> np.ndarray:
        actions = np.asarray(super()._check_actions(actions), np.float64)
        return np.clip(actions, self.action_space.low, self.action_space.high)

    def _check_sim_params(self, values: dict[str, Any]) -> SimParams:
        return self.world.check(values)

    def _begin(self, seeds: Mapping[int, int | None], requested: Sequence[SimParams]) -> None:
        for i in seeds:
            self._set_state(i, self.world.initial_state(self.rngs[i]))
            # What was requested is drawn all the same, so the next draws do not depend on it.
            drawn = self.world.sim_params.sample(self.rngs[i])
            self.set_sim_params(i, self.world.spec.default_sim_params | drawn | requested[i])

    def physics(self, i: int) -> SimParams:
        """Simulator parameters of environment `i` now in force."""
        return {name: float(values[i]) for name, values in self._sim_params.items()}

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

    def get_state(self, i: int) -> np.ndarray:
        """Return everything that the future of environment `i` depends on, but its physics."""
        raise NotImplementedError

    def frame(self, i: int) -> np.ndarray:
        """Draw environment `i`."""
        raise NotImplementedError

    def render(self) -> tuple[np.ndarray, ...]:
        """Draw all environments."""
        return tuple(map(self.frame, range(self.num_envs)))

    def _set_state(self, i: int, state: np.ndarray) -> None:
        """Do what `set_state` says."""
        raise NotImplementedError


class ClassicVectorEnv(WorldVectorEnv):
    """Many copies of a classic world, stepped by one NumPy formula."""

    def __init__(self, world: World, num_envs: int, episode_length: int | None = None):
        super().__init__(world, num_envs, episode_length)
        # As they are now, and the actions that led there: [env, ...].
        self.states = np.zeros((num_envs, self.world.state_size))
        self._action = np.zeros((num_envs, self.world.task.action_size))

    def _advance(self, active: np.ndarray, actions: np.ndarray, rewards: np.ndarray) -> None:
        sim_params = {name: values[active] for name, values in self._sim_params.items()}
        state, action = self.states[active], actions[active]
        after = self.world.next_state(state, action, sim_params)
        self.states[active], self._action[active] = after, action
        self._ends[0, active] = self.world.terminated(after)
        rewards[active] = self.world.reward(state, action, after)

    def observe(self) -> np.ndarray:
        """Observe all states."""
        return self.world.observe(self.states)

    def get_state(self, i: int) -> np.ndarray:
        """Return positions and velocities."""
        return self.states[i].copy()

    def _set_state(self, i: int, state: np.ndarray) -> None:
        self.states[i], self._action[i] = state, 0.0

    def frame(self, i: int) -> np.ndarray:
        """Draw the state and the action that led to it."""
        from headway.worlds import rendering

        draw = rendering.DRAWINGS[self.world.spec.name]
        return draw(self.states[i], float(self._action[i, 0]), self.physics(i))


class RobotVectorEnv(WorldVectorEnv):
    """Many robots with a model and a solver of their own, stepped on several threads.

    `mj_step` frees Python's lock, so threads share the environments. Every `MjData` keeps its
    constraint solver's last result (`qacc_warmstart`), so neighbours change no number.
    """

    def __init__(self, world: Robot, num_envs: int, episode_length: int | None = None):
        super().__init__(world, num_envs, episode_length)
        self.models = [copy.copy(world.nominal) for _ in range(num_envs)]
        self.datas = [mujoco.MjData(model) for model in self.models]
        self.velocity = np.zeros(num_envs)
        self._num_threads = min(num_cpus(), num_envs)
        self._pool = ThreadPoolExecutor(self._num_threads)
        self._renderers: dict[int, Any] = {}

    def _change(self, i: int, changed: SimParams) -> None:
        self.world.set_physics(self.models[i], self.physics(i))

    def _advance(self, active: np.ndarray, actions: np.ndarray, rewards: np.ndarray) -> None:
        def step(share: np.ndarray) -> None:
            for i in share:
                mujoco.mj_step(self.models[i], self.datas[i], nstep=self.world.frame_skip)

        before = self._robot_state()
        control = self.world.control(actions, self._sim_params)
        for data, row in zip(self.datas, control, strict=True):
            data.ctrl[:] = row
        first, *others = np.array_split(active, min(len(active), self._num_threads))
        begun = self._pool.map(step, others)
        step(first)  # in this thread, meanwhile
        list(begun)  # wait for the others
        qpos, qvel, _ = self._robot_state()
        after = self.world.after_step(before.qpos, qpos, qvel)
        self.velocity[active] = after.velocity[active]
        rewards[active] = self.world.reward(before, actions, after)[active]
        for i in active.tolist():  # after huge numbers MuJoCo quietly starts over, but warns
            if name := divergence(self.datas[i]):
                self._broken[i] = f"the simulation of {self.world.spec.name} diverged ({name})"

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
        mujoco.mj_resetData(self.models[i], data)
        data.qpos[:], data.qvel[:], data.qacc_warmstart[:], self.velocity[i : i + 1] = np.split(
            state, [nq, nq + nv, nq + 2 * nv]
        )

    @functools.cached_property
    def _rollout(self) -> tuple[Any, list[Any], Any]:
        """A model, a state per thread, and the threads of `mujoco.rollout`, one per CPU."""
        model = copy.copy(self.world.nominal)
        # A robot that MuJoCo gives up on stays where it is instead of starting over.
        model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET.value
        threads = num_cpus()
        datas = [mujoco.MjData(model) for _ in range(threads)]
        return model, datas, mujoco.rollout.Rollout(nthread=threads if threads > 1 else 0)

    def try_out(
        self, i: int, actions: Float[np.ndarray, "candidate horizon action"]
    ) -> Float[np.ndarray, " candidate"]:
        """Return the sums of rewards that sequences would earn from where an environment is.

        The environments themselves are not touched. A future repeats what they will do to the
        bit: same physics, same constraint solver's warm start. Where MuJoCo gives up on a
        sequence, its sum is NaN.

        Args:
            i: The environment to start from.
            actions: In the environment's own units, within its bounds.
        """
        world, data, sim_params = self.world, self.datas[i], self.physics(i)
        model, datas, rollout = self._rollout
        actions = actions.astype(np.float64)
        world.set_physics(model, sim_params)
        count, skip, nq, nv = len(actions), world.frame_skip, model.nq, model.nv
        full_physics = mujoco.mjtState.mjSTATE_FULLPHYSICS.value
        start = np.empty(mujoco.mj_stateSize(model, full_physics))
        mujoco.mj_getState(self.models[i], data, start, full_physics)
        found, _ = rollout.rollout(
            model,
            datas,
            np.tile(start, (count, 1)),
            np.repeat(world.control(actions, sim_params), skip, axis=1),
            control_spec=mujoco.mjtState.mjSTATE_CTRL.value,
            initial_warmstart=np.tile(data.qacc_warmstart, (count, 1)),
        )
        states = np.asarray(found)
        # Given up: numbers too large for MuJoCo, or its clock, the first of them, stands still.
        end = start[0] + (states.shape[1] - 0.5) * model.opt.timestep
        sound = (np.abs(states) < mujoco.mjMAXVAL).all((1, 2)) & (states[:, -1, 0] > end)
        states[~sound] = np.nan
        first = np.broadcast_to(start, (count, 1, len(start)))
        reached = np.concatenate([first, states[:, skip - 1 :: skip]], axis=1)
        qpos, qvel = reached[..., 1 : 1 + nq], reached[..., 1 + nq : 1 + nq + nv]
        after = world.after_step(qpos[:, :-1], qpos[:, 1:], qvel[:, 1:])
        before = RobotState(qpos[:, :-1], qvel[:, :-1], np.array(np.nan))  # no reward reads it
        return world.reward(before, actions, after).sum(-1)

    def frame(self, i: int) -> np.ndarray:
        """Draw the robot.

        Raises:
            BadEnvironmentError: No OpenGL library for drawing without a screen was found.
        """
        from headway.worlds.rendering import RobotRenderer

        if i not in self._renderers:
            self._renderers[i] = RobotRenderer(self.models[i], self.world.camera)
        return self._renderers[i].frame(self.models[i], self.datas[i])

    def close_extras(self, **kwargs: Any) -> None:
        """Stop the threads and free the renderers."""
        self._pool.shutdown()
        while self._renderers:
            self._renderers.popitem()[1].close()


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
        self.vector: Any = _vector(_WORLDS[env_spec(name).env_id](sim_params, **options), 1)
        self.render_mode = render_mode
        self.metadata = self.metadata | {"render_fps": self.vector.metadata["render_fps"]}
        self.action_space = self.vector.single_action_space
        self.observation_space = self.vector.single_observation_space

    @property
    def sim_params(self) -> SimParams:
        """The simulator parameters now in force."""
        return self.vector.physics(0)

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
        **kwargs: Options over those of the spec, `sim_params` (a `SimParamSets`), `render_mode`,
            and what else `gymnasium.make` takes.

    Raises:
        UnknownNameError: No such environment or option.
        gymnasium.error.Error: Gymnasium does not know the environment's id.
    """
    spec = env_spec(name)
    own: dict[str, Any] = {"sim_params": spec.sim_params} if spec.env_id in _WORLDS else {}
    if isinstance(spec.env_id, str) and spec.episode_length:
        own["max_episode_steps"] = spec.episode_length
    return adapted(_maker(spec), None, **{**own, **spec.options, **kwargs})


def _maker(spec: EnvSpec) -> Callable[..., gymnasium.Env]:
    """What makes the environment from keywords; also in a process that has registered nothing."""
    if not isinstance(spec.env_id, str):
        return spec.env_id
    return functools.partial(gymnasium.make, registered(spec.env_id))


def registered(env_id: str) -> Any:
    """Gymnasium's entry of an id, which may name a module and lack a version, as for `make`."""
    module, _, env_id = env_id.rpartition(":")
    if module:
        try:
            importlib.import_module(module)
        except ModuleNotFoundError as error:
            raise ConfigError(
                f"{module}:{env_id} wants the module {error.name}, which is missing; install it,"
                " for dm_control by `pip install 'headway[dm-control]'`."
            ) from error
    namespace, name, version = parse_env_id(env_id)
    if version is None:
        version = find_highest_version(namespace, name)
    return gymnasium.spec(get_env_id(namespace, name, version))


def make_vec(
    name: str,
    num_envs: int,
    *,
    sim_params: SimParamSets | None = None,
    options: Mapping[str, Any] | None = None,
    episode_length: int | None = None,
    step_timeout_s: float | None = None,
    render_mode: str | None = None,
) -> HeadwayVectorEnv:
    """Make many environments that step together, each with physics of its own.

    Finished ones wait for `reset`; `gymnasium.make_vec` makes ones that are reset by themselves.

    Args:
        name: For example `"hopper"`, `"headway/Hopper-v0"` or `"my_package:cart"`.
        num_envs: How many.
        sim_params: Replaces the spec's training and unseen physics.
        options: Options of the environment, over those of the spec.
        episode_length: Steps after which an episode is cut; None takes the spec's.
        step_timeout_s: Steps every environment in a process of its own, and gives it up when a
            step takes longer (`ProcessVectorEnv`); None steps all in this process.
        render_mode: `"rgb_array"` to draw with `render`; given to environments of your own.

    Raises:
        UnknownNameError: No such environment or option.
        ConfigError: A number or a parameter is not allowed.
        gymnasium.error.Error: Gymnasium does not know the environment's id.
        BadEnvironmentError: An environment could not be made in its process.
    """
    spec = env_spec(name)
    given: dict[str, Any] = {**spec.options, **(options or {})}
    sets = sim_params or spec.sim_params
    length = (spec.episode_length or None) if episode_length is None else episode_length
    world, draws = _WORLDS.get(spec.env_id), None
    if world is not None and step_timeout_s is None:
        return _vector(world(sets, **given), num_envs, length)
    if world is None:
        draws = sets
    else:  # these draw physics themselves
        given["sim_params"] = sets
    if render_mode is not None:
        given["render_mode"] = render_mode
    if isinstance(spec.env_id, str) and length is not None:
        given["max_episode_steps"] = -1  # ours replaces Gymnasium's limit
    one = functools.partial(adapted, _maker(spec), draws, **given)
    shared: dict[str, Any] = {"sim_params": draws, "episode_length": length}
    if step_timeout_s is None:
        return SequentialVectorEnv([one] * num_envs, **shared)
    return ProcessVectorEnv([one] * num_envs, step_timeout_s=step_timeout_s, **shared)


def _vector(world: World, num_envs: int, episode_length: int | None = None) -> WorldVectorEnv:
    kind: Any = RobotVectorEnv if isinstance(world, Robot) else ClassicVectorEnv
    return kind(world, num_envs, episode_length)
