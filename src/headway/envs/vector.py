"""Many environments stepped at once, each with its own physics; also environments of your own.

What runs in a process of its own imports this module, what it needs, and the environment; no JAX.
"""

import contextlib
import multiprocessing
import os
import re
import signal
import time
import weakref
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from multiprocessing.reduction import ForkingPickler
from typing import Any

import gymnasium
import numpy as np
from gymnasium.error import NoAsyncCallError
from gymnasium.spaces import Box, Discrete, MultiBinary, MultiDiscrete
from gymnasium.utils import seeding
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, VectorEnv
from gymnasium.vector.utils import CloudpickleWrapper, batch_space

from headway.envs.physics import try_out
from headway.errors import (
    BadEnvironmentError,
    BrokenEpisodeError,
    ConfigError,
    HeadwayError,
    check_names,
    one_line,
    shown,
)
from headway.sim_params import SimParamSets, is_finite
from headway.spaces import Spaces

SimParams = dict[str, float]
Schedule = Mapping[int, Mapping[str, float]]
"""New simulator parameters by the step before which they come into force; 0 is the first."""
Makers = Sequence[Callable[[], gymnasium.Env]]
GymSpaces = tuple[gymnasium.Space, gymnasium.Space]
"""Observation and action space."""


class HeadwayVectorEnv(VectorEnv[np.ndarray, np.ndarray, np.ndarray]):
    """Seeds, resets, the time limit and finished episodes, as all vector environments have them.

    `reset` takes as seed an integer (environment i gets seed + i), one seed per environment,
    or None, and these options, all of which may be left out:

    - `"sim_params"`: for each named parameter one value, or one per environment; parameters
      that are not named are drawn from the training values;
    - `"schedule"`: simulator parameters that change during the episode, by the step before which
      they do, `{100: {"mass_scale": 2.0}}`; one for all environments or a list of one for each;
    - `"reset_mask"`: which environments are reset; the others go on as they are.

    Nothing is reset by itself (`AutoresetMode.DISABLED`): a finished environment stands still,
    pays 0 and repeats its last observation and flags until it is reset.

    An episode that breaks (a simulation diverged, a process hung) does not disturb the others:
    it is truncated, pays NaN, has NaN as its last observation, and `info["broken"]` says why,
    by environment.
    """

    metadata: dict[str, Any] = {  # noqa: RUF012 (as in Gymnasium)
        "render_modes": [],
        "autoreset_mode": AutoresetMode.DISABLED,
    }

    def __init__(self, num_envs: int, spaces: GymSpaces, episode_length: int | None):
        if num_envs < 1 or (episode_length is not None and episode_length < 1):
            raise ConfigError(
                f"num_envs is {num_envs} and episode_length {episode_length}, allowed: at least 1."
            )
        self.num_envs, self.episode_length = num_envs, episode_length
        self.spaces = read_spaces(*spaces)
        self.single_observation_space, self.single_action_space = spaces
        self.observation_space = batch_space(spaces[0], num_envs)
        self.action_space = batch_space(spaces[1], num_envs)
        self.rngs: list[Any] = [None] * num_envs  # generators, once they are seeded
        self._elapsed = np.zeros(num_envs, int)
        self._ends = np.zeros((2, num_envs), bool)  # terminated, truncated
        self._broken: dict[int, str] = {}
        self._sim_params: dict[str, np.ndarray] = {}
        self._schedules: list[dict[int, SimParams]] = [{}] * num_envs

    def reset(  # pyright: ignore[reportIncompatibleMethodOverride]
        self,
        *,
        seed: int | Sequence[int | None] | None = None,
        options: dict[str, Any] | None = None,
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Start episodes in all environments, or in those of the mask.

        Raises:
            ConfigError: A seed, option, parameter or value is not allowed.
        """
        options, known = options or {}, ("sim_params", "reset_mask", "schedule")
        check_names("reset option", options, known)
        each: Any = seed
        if seed is None or isinstance(seed, int | np.integer):
            each = [None if seed is None else int(seed) + i for i in range(self.num_envs)]
        if len(each) != self.num_envs:
            raise ConfigError(
                f"seed has {len(each)} entries, allowed: an int, or {self.num_envs} of them."
            )
        requested = self._read_sim_params(options.get("sim_params") or {})
        schedules = self._read_schedules(options.get("schedule") or {})
        mask = np.asarray(options.get("reset_mask", np.ones(self.num_envs, bool)))
        if mask.shape != (self.num_envs,) or mask.dtype != bool:
            raise ConfigError(f"reset_mask is {mask}, allowed: {self.num_envs} booleans.")
        seeds = {
            i: None if each[i] is None else int(each[i]) for i in np.flatnonzero(mask).tolist()
        }
        for i, own in seeds.items():
            if own is not None or self.rngs[i] is None:
                self.rngs[i] = seeding.np_random(own)[0]
            self._elapsed[i], self._ends[:, i], self._schedules[i] = 0, False, schedules[i]
            self._broken.pop(i, None)
        self._begin(seeds, requested)
        return self._result()

    def step(
        self, actions: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Make one step in each environment.

        Raises:
            ConfigError: Actions have the wrong shape or are not finite.
            BadEnvironmentError: An environment returned something misshapen.
        """
        actions = self._check_actions(actions)
        rewards, active = np.zeros(self.num_envs), np.flatnonzero(~self._ends.any(0))
        for i in active.tolist():
            changed = self._schedules[i].get(int(self._elapsed[i]))
            if changed:
                self.set_sim_params(i, changed)
        if active.size:
            self._elapsed[active] += 1
            self._advance(active, actions, rewards)
            self._ends[1, active] |= self._elapsed[active] >= (self.episode_length or np.inf)
        rewards[[i for i in active if i in self._broken]] = np.nan
        obs, info = self._result()
        terminated, truncated = self._ends.copy()
        return obs, rewards, terminated, truncated, info

    @property
    def sim_params(self) -> dict[str, np.ndarray]:
        """The simulator parameters now in force, one value per environment."""
        return {name: values.copy() for name, values in self._sim_params.items()}

    def set_sim_params(self, i: int, values: Mapping[str, Any]) -> None:
        """Change some simulator parameters of environment `i`, and leave its state as it is.

        Raises:
            ConfigError: A parameter or value is not allowed.
        """
        checked = self._check_sim_params(dict(values))
        self._note(i, checked)
        self._change(i, checked)

    def _result(self) -> tuple[np.ndarray, dict[str, Any]]:
        """Observations, NaN where an episode broke, which is cut, and infos."""
        obs, info = self.observe(), {"sim_params": self.sim_params}
        if not self._broken:
            return obs, info
        self._ends[1, list(self._broken)] = True
        if obs.dtype.kind == "f":
            obs[list(self._broken)] = np.nan
        return obs, info | {"broken": dict(self._broken)}

    def _note(self, i: int, values: Mapping[str, float]) -> None:
        """Note the simulator parameters of environment `i` that are in force from now on."""
        for name, value in values.items():
            self._sim_params.setdefault(name, np.full(self.num_envs, np.nan))[i] = value

    def _read_sim_params(self, values: Any) -> list[SimParams]:
        """Turn values per parameter into parameters per environment."""
        if not isinstance(values, Mapping):
            raise ConfigError(f"sim_params is {values!r}, allowed: values by parameter name.")
        rows: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        for name, column in values.items():
            given = np.asarray(column)
            if given.shape not in ((), (self.num_envs,)):
                raise ConfigError(
                    f"sim_params {name} has shape {given.shape}, allowed: one value, or"
                    f" {self.num_envs}, one per environment."
                )
            each = np.broadcast_to(given, self.num_envs).tolist()
            for row, value in zip(rows, each, strict=True):
                row[name] = value
        return [self._check_sim_params(row) for row in rows]

    def _read_schedules(self, value: Any) -> list[dict[int, SimParams]]:
        """Check the schedules: one for all environments, or a sequence of one for each."""
        each = [value] * self.num_envs if isinstance(value, Mapping) else value
        if not (
            isinstance(each, Sequence)
            and len(each) == self.num_envs
            and all(isinstance(one, Mapping) for one in each)
            and all(type(step) is int and step >= 0 for one in each for step in one)
            and all(isinstance(values, Mapping) for one in each for values in one.values())
        ):
            raise ConfigError(
                f"schedule is {value!r}, allowed: values by parameter name by steps, which are"
                " whole numbers from 0, {100: {'mass_scale': 2.0}}, or a list of"
                f" {self.num_envs} such mappings, one per environment."
            )
        check = self._check_sim_params
        return [{step: check(dict(values)) for step, values in one.items()} for one in each]

    def _check_sim_params(self, values: dict[str, Any]) -> SimParams:
        return values

    def _check_actions(self, actions: np.ndarray) -> np.ndarray:
        got, allowed = np.shape(actions), self.action_space.shape
        if allowed is not None and (got != allowed or not np.isfinite(actions).all()):
            raise ConfigError(
                f"actions are {shown(np.asarray(actions).tolist())} of shape {got}, allowed: finite"
                f" numbers of shape {allowed}, a row for each environment."
            )
        return actions

    def _begin(self, seeds: Mapping[int, int | None], requested: Sequence[SimParams]) -> None:
        """Start episodes in the environments that have a seed or None, with their `rngs`.

        Their simulator parameters are noted; why one cannot begin is put into `_broken`.
        """
        raise NotImplementedError

    def _change(self, i: int, changed: SimParams) -> None:
        """Change the physics of environment `i` before its next step; they are noted already."""

    def _advance(self, active: np.ndarray, actions: np.ndarray, rewards: np.ndarray) -> None:
        """Step the environments of the given indices; actions and rewards have a row for each.

        Fills in rewards, `_ends` and, where an episode cannot go on, `_broken`.
        """
        raise NotImplementedError

    def observe(self) -> np.ndarray:
        """Return all observations, in an array of their own."""
        raise NotImplementedError


def read_spaces(obs: gymnasium.Space, action: gymnasium.Space) -> Spaces:
    """Sizes, bounds and kind of an observation and an action space.

    Raises:
        BadEnvironmentError: Observations are no row of numbers, or actions of another kind.
    """
    if len(obs.shape or ()) != 1:
        raise BadEnvironmentError(
            f"the environment has the observation space {obs}, allowed: numbers in one row; wrap"
            " it in gymnasium.wrappers.FlattenObservation where it is made."
        )
    kind: Any = "categories"
    match action:
        case Box(low=low, high=high):
            kind = "box" if low.dtype.kind == "f" else "integers"
        case Discrete(n=n, start=low):
            high = low + n - 1
        case MultiDiscrete(nvec=n, start=low):
            high = low + (n - 1)
        case MultiBinary(shape=shape):
            low, high = np.zeros(shape), np.ones(shape)
        case _:
            raise BadEnvironmentError(
                f"the environment has the action space {action}, allowed: Box, Discrete,"
                " MultiDiscrete, MultiBinary; wrap it in gymnasium.wrappers.TransformAction."
            )
    low, high = (tuple(map(float, np.ravel(bound))) for bound in (low, high))
    return Spaces(obs.shape[0], kind, low, high, tuple(action.shape or ()), str(action.dtype))


class SequentialVectorEnv(HeadwayVectorEnv):
    """Any Gymnasium environments, stepped one after the other.

    For environments of your own: they must take `options={"sim_params": {name: value}}` in
    `reset`, end no step with NaN, and share their spaces.

    Args:
        env_fns: Make the environments.
        sim_params: Draws the parameters that `reset` is not told; None leaves that to the
            environments, which must then return them in `info["sim_params"]`.
        episode_length: Steps after which an episode is cut; None leaves it to the environments.

    Raises:
        ConfigError: There are none.
        BadEnvironmentError: Their spaces differ or are refused (`read_spaces`), or one cannot be
            made after others were. None stays open.
    """

    def __init__(
        self,
        env_fns: Makers,
        *,
        sim_params: SimParamSets | None = None,
        episode_length: int | None = None,
    ):
        if not env_fns:
            raise ConfigError("env_fns is empty, allowed: at least one.")
        self.envs: list[Any] = []
        try:
            for env in self._make_all(env_fns):
                self.envs.append(env)
            spaces = [self._spaces(env) for env in self.envs]
            super().__init__(len(spaces), spaces[0], episode_length)
            for own in spaces:
                self._check_spaces(own)
        except Exception as error:
            self.close_extras()
            if 0 < len(self.envs) < len(env_fns):
                raise BadEnvironmentError(
                    f"environment {len(self.envs) + 1} of {len(env_fns)} could not be made"
                    f" ({type(error).__name__}: {one_line(error, 300)}); if only one can exist, set"
                    " collection.num_episodes to 1."
                ) from error
            raise
        self.metadata = {"render_fps": 20} | self.envs[0].metadata | self.metadata
        self._sets, self._changes = sim_params, {}
        self._obs: list[Any] = [np.zeros(spaces[0][0].shape or ()) for _ in spaces]
        self.told: list[SimParams] = [{} for _ in spaces]
        """Simulator parameters as each environment itself told them at its reset."""

    def _make_all(self, env_fns: Makers) -> Iterable[Any]:
        return (gymnasium.Wrapper(make()) for make in env_fns)  # which refuses what is no Env

    def _spaces(self, env: Any) -> GymSpaces:
        return env.observation_space, env.action_space

    def _call(self, method: str, calls: Mapping[int, tuple[Any, ...]]) -> dict[int, Any]:
        """Let some environments answer, as in `_answer`; those that break do not."""
        answers: dict[int, Any] = {}
        for i, given in calls.items():
            try:
                answers[i] = _answer(self.envs[i], method, *given)
            except BrokenEpisodeError as error:
                self._broken[i] = str(error)
        return answers

    def _check_sim_params(self, values: dict[str, Any]) -> SimParams:
        if self._sets is not None:
            check_names("sim_param", values, self._sets.names)
        for name, value in values.items():
            if not is_finite(value):
                raise ConfigError(f"sim_param {name} is {shown(value)}, allowed: a finite number.")
        return values

    def _begin(self, seeds: Mapping[int, int | None], requested: Sequence[SimParams]) -> None:
        asked = {i: requested[i] for i in seeds}
        if self._sets is not None:
            asked = {i: self._sets.sample(self.rngs[i]) | given for i, given in asked.items()}
        for i, given in asked.items():
            self._note(i, given)
            self._changes.pop(i, None)
        options = {i: {"sim_params": given} if given else None for i, given in asked.items()}
        begun = self._call("reset", {i: (seeds[i], options[i]) for i in seeds})
        for i, (obs, sim_params, spaces) in begun.items():
            self._check_spaces(spaces)
            self._obs[i], self.told[i] = self._check_obs(obs), sim_params
            self._note(i, sim_params)

    def _change(self, i: int, changed: SimParams) -> None:
        self._changes[i] = self._changes.get(i, {}) | changed

    def _advance(self, active: np.ndarray, actions: np.ndarray, rewards: np.ndarray) -> None:
        calls = {i: (actions[i], self._changes.pop(i, None)) for i in active.tolist()}
        for i, (obs, reward, *ends) in self._call("step", calls).items():
            self._obs[i], self._ends[:, i] = self._check_obs(obs), ends
            try:
                rewards[i] = float(reward)
            except (TypeError, ValueError):
                raise BadEnvironmentError(
                    f"an environment returned the reward {reward!r}, allowed: a number; correct"
                    " the environment."
                ) from None

    def _check_spaces(self, spaces: GymSpaces) -> None:
        allowed = self.single_observation_space, self.single_action_space
        if spaces != allowed:
            raise BadEnvironmentError(
                f"an environment has the observation and action space {spaces}, allowed:"
                f" {allowed}, as its neighbours and in every episode; correct the environment."
            )

    def _check_obs(self, obs: Any) -> np.ndarray:
        allowed = self.single_observation_space.shape
        if np.shape(obs) != allowed:
            raise BadEnvironmentError(
                f"an environment returned obs of shape {np.shape(obs)}, allowed: {allowed}, as"
                " its observation_space says; correct the environment."
            )
        return np.asarray(obs)

    def observe(self) -> np.ndarray:
        """Stack what the environments returned last."""
        return np.stack(self._obs)

    def try_out(self, i: int, actions: Any) -> np.ndarray:
        """Return the sums of rewards that sequences would earn in environment `i` (`physics`)."""
        over = self._ends[:, i].any()
        return np.zeros(len(actions)) if over else np.array(try_out(self.envs[i], actions))

    def render(self) -> tuple[Any, ...]:
        """Draw all that do not break meanwhile, as they were told when they were made."""
        frames = self._call("render", dict.fromkeys(range(self.num_envs), ()))
        self._ends[1, list(self._broken)] = True
        return tuple(frames.values())

    def close_extras(self, **kwargs: Any) -> None:
        """Close the environments."""
        for env in self.envs:
            env.close()


def _answer(env: gymnasium.Env, method: str, *given: Any) -> Any:
    """Call a method of an environment and return what matters of the answer.

    `reset` gives observation, simulator parameters and spaces; `step`, maybe after a change of
    simulator parameters, all but the infos; `render` a picture; `close` nothing.
    """
    try:
        if method in ("render", "close"):
            return getattr(env, method)()
        if method == "reset":
            found = env.reset(seed=given[0], options=given[1])
            if not (isinstance(found, tuple) and len(found) == 2):
                raise TypeError("reset returned no (obs, info)")
            obs, info = found
            told = _numbers(info.get("sim_params"))
            return obs, told, (env.observation_space, env.action_space)
        action, changed = given
        if changed:
            if not env.has_wrapper_attr("set_sim_params"):
                raise ConfigError(
                    "physics are to change, but the environment has no method"
                    " set_sim_params(values); add one, or change them at a reset."
                )
            env.get_wrapper_attr("set_sim_params")(changed)
        obs, reward, terminated, truncated, _ = env.step(action)
        return obs, reward, terminated, truncated
    except (TypeError, ValueError) as error:
        if _OF_OLD_GYM.search(str(error)):
            raise BadEnvironmentError(
                f"an environment has the reset or step of old Gym ({error}), allowed:"
                " reset(seed=None, options=None) that returns (obs, info), and a step that returns"
                " (obs, reward, terminated, truncated, info); rewrite it, or wrap it with"
                " GymV21CompatibilityV0 of the package shimmy."
            ) from error
        raise


def _numbers(told: Any) -> SimParams:
    """What an environment told of its physics that is one number; the rest is its own business."""
    found = {}
    for name, value in dict(told or {}).items():
        with contextlib.suppress(TypeError, ValueError):
            found[name] = np.asarray(value, float).item()
    return found


_OF_OLD_GYM = re.compile(r"keyword argument '(seed|options)'|no \(obs, info\)|expected 5, got 4")


class ProcessVectorEnv(SequentialVectorEnv):
    """Any Gymnasium environments, each in a process of its own, stepped side by side.

    Every environment is an `AsyncVectorEnv` of one. An environment that hangs, or whose process
    dies, costs its episode only: the process is killed with all that it started, another one is
    begun, and `info["broken"]` says so. The processes end with this object, and with this
    process unless that is killed while an environment hangs.

    Results equal those of `SequentialVectorEnv`, to the bit. As with all of `multiprocessing`, a
    script keeps its own lines under `if __name__ == "__main__":`.

    Args:
        env_fns: Make the environments. Each is called in its process, and once in this one, to
            read the spaces.
        step_timeout_s: Seconds that a reset or step of an environment may take.
        **kwargs: See `SequentialVectorEnv`.

    Raises:
        ConfigError: A number is not allowed, or what makes an environment cannot be sent to a
            process.
        BadEnvironmentError: An environment could not be made, or their spaces differ.
    """

    def __init__(self, env_fns: Makers, *, step_timeout_s: float, **kwargs: Any):
        if not step_timeout_s > 0:
            raise ConfigError(f"step_timeout_s is {step_timeout_s}, allowed: more than 0.")
        try:
            ForkingPickler.dumps([CloudpickleWrapper(make) for make in env_fns])
        except Exception as error:  # whatever its parts raise
            raise ConfigError(
                f"an environment cannot be sent to a process of its own ({error}), allowed: what"
                " pickle takes; make inside of the environment what it needs, or switch"
                " collection.env_processes off."
            ) from error
        self._env_fns, self._timeout_s = list(env_fns), step_timeout_s
        self._living: dict[int, Any] = {}
        self._end = weakref.finalize(self, _kill, self._living)
        super().__init__(env_fns, **kwargs)

    def _make_all(self, env_fns: Makers) -> Iterable[Any]:
        with ThreadPoolExecutor(len(env_fns)) as pool:  # each waits for its process to begin
            begun = [pool.submit(self._make_one, i) for i in range(len(env_fns))]
        begun.sort(key=lambda one: one.exception() is not None)  # first those that could be made
        return (one.result() for one in begun)

    def _spaces(self, env: Any) -> GymSpaces:
        return env.single_observation_space, env.single_action_space

    def _make_one(self, i: int) -> AsyncVectorEnv:
        make, parent = self._env_fns[i], os.getpid()

        def made() -> gymnasium.Env:
            if os.getpid() != parent:
                # In a group of its own Ctrl-C reaches only the parent, and what the environment
                # starts can be killed with it.
                os.setpgrp()
            return _Answering(make())

        try:
            env = AsyncVectorEnv([made], context="spawn", daemon=False, shared_memory=False)
        except (EOFError, ConnectionError) as error:
            raise BadEnvironmentError(
                "an environment's process ended while it was begun; see to it that it can be made"
                ' in a new process, and keep a script\'s own lines under if __name__ == "__main__":'
            ) from error
        self._living[i] = env
        return env

    def _call(self, method: str, calls: Mapping[int, tuple[Any, ...]]) -> dict[int, Any]:
        ends = time.monotonic() + self._timeout_s
        for i, given in calls.items():
            with contextlib.suppress(OSError):  # its process is gone; waiting will tell
                self.envs[i].call_async("answer", method, *given)
        answers: dict[int, Any] = {}
        for i in calls:
            env = self.envs[i]
            try:
                (answers[i],) = env.call_wait(timeout=max(0.0, ends - time.monotonic()))
                continue
            except multiprocessing.TimeoutError:
                self._broken[i] = f"did not answer to {method} within {self._timeout_s:g} s"
            except (EOFError, OSError, NoAsyncCallError):
                env.processes[0].join()
                code = env.processes[0].exitcode or 0
                how = f"killed by {signal.Signals(-code).name}" if code < 0 else f"over ({code})"
                self._broken[i] = f"had its process {how} during {method}"
            _kill({i: self._living.pop(i)})
            self.envs[i] = self._make_one(i)
        for i, answer in answers.items():  # once all have answered
            if isinstance(answer, BrokenEpisodeError):
                self._broken[i] = str(answer)
            elif isinstance(answer, Exception):
                raise answer
        return {i: answer for i, answer in answers.items() if i not in self._broken}

    def close_extras(self, **kwargs: Any) -> None:
        """Close the environments that are not in the middle of something; end all processes."""
        for env in self._living.values():
            with contextlib.suppress(Exception):  # it hangs or is gone
                env.call_async("answer", "close")
                env.call_wait(timeout=self._timeout_s)
        self._end()


class _Answering(gymnasium.Wrapper):
    """Answers in the process. Gymnasium's worker would end with an error, so that is an answer."""

    def answer(self, method: str, *given: Any) -> Any:
        try:
            return _answer(self.env, method, *given)
        except HeadwayError as error:
            return type(error)(str(error))
        except Exception as error:  # of a class that the parent may not know
            return BadEnvironmentError(f"raised {type(error).__name__}: {one_line(error)}")


def _kill(envs: dict[int, Any]) -> None:
    """End processes with all that they started."""
    for env in envs.values():
        (process,), (pipe,) = env.processes, env.parent_pipes
        with contextlib.suppress(ProcessLookupError, PermissionError):
            os.killpg(process.pid, signal.SIGKILL)
        process.kill()
        process.join()
        if pipe is not None:  # Gymnasium gave it up
            pipe.close()
        env.closed = True
    envs.clear()
