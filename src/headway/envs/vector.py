"""Many environments stepped at once, each with its own physics; also environments of your own.

What runs in a process of its own imports this module and the environment, nothing else of Headway.
"""

import abc
import contextlib
import multiprocessing
import os
import signal
import time
import warnings
import weakref
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import gymnasium
import numpy as np
from gymnasium.utils import seeding
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from headway.errors import (
    BadEnvironmentError,
    BrokenEpisodeError,
    ConfigError,
    HeadwayError,
    unknown_name,
)
from headway.sim_params import SimParamSets

SimParams = dict[str, float]
Schedule = Mapping[int, Mapping[str, float]]
"""New simulator parameters by the step before which they come into force; 0 is the first."""


Outcome = tuple[np.ndarray, np.ndarray, np.ndarray, dict[int, str]]
"""Reward, terminated and truncated of some environments; which episodes cannot go on, and why."""


class HeadwayVectorEnv(VectorEnv[np.ndarray, np.ndarray, np.ndarray]):
    """Seeds, resets, the time limit and finished episodes, as all vector environments have them.

    `reset` takes as seed an integer (environment i gets seed + i), one seed per environment,
    or None, and these options, all of which may be left out:

    - `"sim_params"`: for each named parameter one value, or one per environment; parameters
      that are not named are drawn from the training values;
    - `"schedule"`: simulator parameters that change during the episode, by the step before which
      they do, `{100: {"mass_scale": 2.0}}`; one for all environments or a list of one for each;
    - `"reset_mask"`: which environments are reset; the others go on as they are.

    With `AutoresetMode.NEXT_STEP` the step after the end of an episode ignores its action,
    starts the next episode with physics drawn from the training values, and pays 0. With
    `AutoresetMode.DISABLED` a finished environment stands still, pays 0 and repeats its last
    observation and flags until it is reset.

    An episode that breaks (a simulation diverged, a process hung) does not disturb the others:
    it is truncated, pays NaN, has NaN as its last observation, and `info["broken"]` says why,
    by environment.
    """

    metadata: dict[str, Any] = {"render_modes": []}  # noqa: RUF012 (as in Gymnasium)

    def __init__(
        self,
        num_envs: int,
        spaces: tuple[gymnasium.Space, gymnasium.Space],
        autoreset_mode: AutoresetMode | str,
        episode_length: int | None,
    ):
        if num_envs < 1 or (episode_length is not None and episode_length < 1):
            raise ConfigError(
                f"num_envs is {num_envs} and episode_length {episode_length}, allowed: at least 1."
            )
        self.autoreset_mode = AutoresetMode(autoreset_mode)
        if self.autoreset_mode is AutoresetMode.SAME_STEP:
            raise ConfigError("autoreset_mode is SAME_STEP, allowed: NEXT_STEP or DISABLED.")
        self.num_envs = num_envs
        self.single_observation_space, self.single_action_space = spaces
        self.observation_space = batch_space(spaces[0], num_envs)
        self.action_space = batch_space(spaces[1], num_envs)
        self.metadata = self.metadata | {"autoreset_mode": self.autoreset_mode}
        self.episode_length = episode_length
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
        for name in options:
            if name not in known:
                raise ConfigError(str(unknown_name("reset option", str(name), known)))
        if seed is None or isinstance(seed, int | np.integer):
            seed = [None if seed is None else int(seed) + i for i in range(self.num_envs)]
        if len(seed) != self.num_envs:
            raise ConfigError(
                f"seed has {len(seed)} entries, allowed: an int, or {self.num_envs} of them."
            )
        requested = self._read_sim_params(options.get("sim_params") or {})
        schedules = self._read_schedules(options.get("schedule"))
        mask = np.asarray(options.get("reset_mask", np.ones(self.num_envs, bool)))
        if mask.shape != (self.num_envs,) or mask.dtype != bool:
            raise ConfigError(f"reset_mask is {mask}, allowed: {self.num_envs} booleans.")
        chosen = np.flatnonzero(mask)
        self._start(chosen, [None if one is None else int(one) for one in seed], requested)
        for i in chosen:
            self._schedules[i] = schedules[i]
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
        rewards = np.zeros(self.num_envs)
        next_step = self.autoreset_mode is AutoresetMode.NEXT_STEP
        # Without autoreset a finished environment stands still: same flags, reward 0.
        terminated, truncated = np.zeros_like(self._ends) if next_step else self._ends.copy()
        finished = np.asarray(self._ends.any(0))
        restart = finished & next_step
        if restart.any():
            nothing = [{}] * self.num_envs
            self._start(np.flatnonzero(restart), [None] * self.num_envs, nothing)
        broken = {i: why for i, why in self._broken.items() if restart[i]}
        active = np.flatnonzero(~finished)
        for i in active.tolist():
            changed = self._schedules[i].get(int(self._elapsed[i]))
            if changed:
                try:
                    self._change(i, changed)
                except BrokenEpisodeError as error:
                    broken[i] = str(error)
                self._note_sim_params(i, changed)
        active = np.setdiff1d(active, list(broken))
        if active.size:
            self._elapsed[active] += 1
            *stepped, failed = self._advance(active, actions)
            rewards[active], terminated[active], truncated[active] = stepped
            truncated[active] |= self._elapsed[active] >= (self.episode_length or np.inf)
            broken |= failed
        rewards[list(broken)], truncated[list(broken)] = np.nan, True
        self._broken |= broken
        self._ends = np.stack([terminated, truncated])
        obs, info = self._result()
        return obs, rewards, terminated, truncated, info

    @property
    def sim_params(self) -> dict[str, np.ndarray]:
        """The simulator parameters now in force, one value per environment."""
        return {name: values.copy() for name, values in self._sim_params.items()}

    def _result(self) -> tuple[np.ndarray, dict[str, Any]]:
        """Observations, NaN where an episode broke, and infos."""
        obs, info = self.observe(), {"sim_params": self.sim_params}
        if not self._broken:
            return obs, info
        if obs.dtype.kind == "f":
            obs[list(self._broken)] = np.nan
        return obs, info | {"broken": dict(self._broken)}

    def _start(
        self, chosen: np.ndarray, seeds: Sequence[int | None], requested: Sequence[SimParams]
    ) -> None:
        self._elapsed[chosen] = 0
        self._ends[:, chosen] = False
        for i, begun in self._begin(chosen, seeds, requested).items():
            self._broken.pop(i, None)
            failed = isinstance(begun, BrokenEpisodeError)
            if failed:
                self._broken[i], self._ends[1, i] = str(begun), True
            self._note_sim_params(i, requested[i] if failed else begun)
            self._schedules[i] = {}

    def _note_sim_params(self, i: int, values: SimParams) -> None:
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
            for row, value in zip(rows, np.broadcast_to(given, self.num_envs), strict=True):
                row[name] = value.item() if isinstance(value, np.generic) else value
        return [self._check_sim_params(row) for row in rows]

    def _read_schedules(self, value: Any) -> list[dict[int, SimParams]]:
        """Check the schedules: one for all environments, or a sequence of one for each."""
        given = value or {}
        each = [given] * self.num_envs if isinstance(given, Mapping) else given
        sequence = isinstance(each, Sequence) and len(each) == self.num_envs
        if not sequence or not all(isinstance(one, Mapping) for one in each):
            raise ConfigError(
                f"schedule is {value!r}, allowed: one mapping, or {self.num_envs} of them, one per"
                " environment."
            )
        schedules: list[dict[int, SimParams]] = [{} for _ in each]
        for checked, one in zip(schedules, each, strict=True):
            for step, sim_params in one.items():
                whole = isinstance(step, int) and not isinstance(step, bool) and step >= 0
                if not whole or not isinstance(sim_params, Mapping):
                    raise ConfigError(
                        f"schedule has {step!r}: {sim_params!r}, allowed: whole numbers from 0, and"
                        " values by parameter name, {100: {'mass_scale': 2.0}}."
                    )
                checked[step] = self._check_sim_params(dict(sim_params))
        return schedules

    def _check_sim_params(self, values: dict[str, Any]) -> SimParams:
        return values

    @abc.abstractmethod
    def _check_actions(self, actions: np.ndarray) -> np.ndarray:
        """Refuse actions of a wrong shape."""

    @abc.abstractmethod
    def _begin(
        self, chosen: np.ndarray, seeds: Sequence[int | None], requested: Sequence[SimParams]
    ) -> dict[int, SimParams | BrokenEpisodeError]:
        """Start episodes in the environments of the given indices.

        Returns:
            Their simulator parameters, or why an episode cannot begin.
        """

    @abc.abstractmethod
    def _change(self, i: int, changed: SimParams) -> None:
        """Change some simulator parameters of environment `i` during an episode."""

    @abc.abstractmethod
    def _advance(self, active: np.ndarray, actions: np.ndarray) -> Outcome:
        """Step the environments of the given indices; `actions` has a row for each of all."""

    @abc.abstractmethod
    def observe(self) -> np.ndarray:
        """Return all observations, in an array of their own."""


class SequentialVectorEnv(HeadwayVectorEnv):
    """Any Gymnasium environments, stepped one after the other.

    For environments of your own: they must take `options={"sim_params": {name: value}}` in
    `reset`, end no step with NaN, and share their spaces.

    Args:
        env_fns: Make the environments.
        sim_params: Draws the parameters that `reset` is not told; None leaves that to the
            environments, which must then return them in `info["sim_params"]`.
        autoreset_mode: What happens after the end of an episode.
        episode_length: Steps after which an episode is cut; None leaves it to the environments.

    Raises:
        ConfigError: There are none.
        BadEnvironmentError: Their spaces differ.
    """

    def __init__(
        self,
        env_fns: Sequence[Callable[[], gymnasium.Env]],
        *,
        sim_params: SimParamSets | None = None,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        episode_length: int | None = None,
    ):
        if not env_fns:
            raise ConfigError("env_fns is empty, allowed: at least one.")
        self.envs: list[Any] = self._make_all(env_fns)
        spaces = [self._spaces(env) for env in self.envs]
        super().__init__(len(spaces), spaces[0], autoreset_mode, episode_length)
        for own in spaces:
            self._check_spaces(own)
        self._sets = sim_params
        self._rngs = [seeding.np_random()[0] for _ in spaces]
        self._obs: list[Any] = [np.zeros(spaces[0][0].shape or ()) for _ in spaces]

    def _make_all(self, env_fns: Sequence[Callable[[], gymnasium.Env]]) -> list[Any]:
        return [make() for make in env_fns]

    def _spaces(self, env: Any) -> tuple[gymnasium.Space, gymnasium.Space]:
        return env.observation_space, env.action_space

    def _call(self, method: str, calls: Mapping[int, tuple[Any, ...]]) -> dict[int, Any]:
        """Call `reset(seed, options)`, `step(action)` or `change(values)` of some environments.

        Returns:
            What it returned, or a `BrokenEpisodeError`.
        """
        found: dict[int, Any] = {}
        for i, given in calls.items():
            env = self.envs[i]
            try:
                if method == "reset":
                    found[i] = env.reset(seed=given[0], options=given[1])
                    self._check_spaces(self._spaces(env))
                elif method == "step":
                    found[i] = env.step(*given)
                else:
                    found[i] = env.get_wrapper_attr("set_sim_params")(*given)
            except BrokenEpisodeError as error:
                found[i] = error
        return found

    def _check_actions(self, actions: np.ndarray) -> np.ndarray:
        allowed = self.action_space.shape
        if allowed is not None and np.shape(actions) != allowed:
            raise ConfigError(
                f"actions have shape {np.shape(actions)}, allowed: {allowed}, an action for each"
                " environment."
            )
        return actions

    def _begin(
        self, chosen: np.ndarray, seeds: Sequence[int | None], requested: Sequence[SimParams]
    ) -> dict[int, SimParams | BrokenEpisodeError]:
        asked: dict[int, SimParams] = {}
        for i in chosen.tolist():
            asked[i] = requested[i]
            if self._sets is not None:
                if seeds[i] is not None:
                    self._rngs[i] = seeding.np_random(seeds[i])[0]
                asked[i] = self._sets.sample(self._rngs[i]) | requested[i]
        calls = {i: (seeds[i], {"sim_params": asked[i]} if asked[i] else None) for i in asked}
        begun: dict[int, SimParams | BrokenEpisodeError] = {}
        for i, found in self._call("reset", calls).items():
            if isinstance(found, BrokenEpisodeError):
                begun[i] = found
                continue
            self._obs[i] = self._check_obs(found[0])
            begun[i] = asked[i] | found[1].get("sim_params", {})
        return begun

    def _change(self, i: int, changed: SimParams) -> None:
        try:
            found = self._call("change", {i: (changed,)})[i]
        except AttributeError as error:
            raise ConfigError(
                "schedule was given, but the environment has no method set_sim_params(values); add"
                " one, or leave the schedule out."
            ) from error
        if isinstance(found, BrokenEpisodeError):
            raise found

    def _advance(self, active: np.ndarray, actions: np.ndarray) -> Outcome:
        found = self._call("step", {int(i): (actions[i],) for i in active})
        rewards, ends, broken = np.zeros(len(active)), np.zeros((2, len(active)), bool), {}
        for row, (i, result) in enumerate(found.items()):
            if isinstance(result, BrokenEpisodeError):
                broken[i] = str(result)
                continue
            obs, reward, *ends[:, row] = result[:4]
            self._obs[i] = self._check_obs(obs)
            try:
                rewards[row] = float(reward)
            except (TypeError, ValueError):
                raise BadEnvironmentError(
                    f"an environment returned the reward {reward!r}, allowed: a number; correct"
                    " the environment."
                ) from None
        return rewards, ends[0], ends[1], broken

    def _check_spaces(self, spaces: tuple[gymnasium.Space, gymnasium.Space]) -> None:
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

    def close_extras(self, **kwargs: Any) -> None:
        """Close the environments."""
        for env in self.envs:
            env.close()


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
        ConfigError: A number is not allowed.
        BadEnvironmentError: An environment could not be made, or their spaces differ.
    """

    def __init__(
        self,
        env_fns: Sequence[Callable[[], gymnasium.Env]],
        *,
        step_timeout_s: float,
        **kwargs: Any,
    ):
        if not step_timeout_s > 0:
            raise ConfigError(f"step_timeout_s is {step_timeout_s}, allowed: more than 0.")
        self._env_fns, self._timeout_s = list(env_fns), step_timeout_s
        self._living: dict[int, AsyncVectorEnv] = {}
        self._end = weakref.finalize(self, _kill, self._living)
        try:
            super().__init__(env_fns, **kwargs)
        except BaseException:
            self._end()
            raise

    def _make_all(self, env_fns: Sequence[Callable[[], gymnasium.Env]]) -> list[Any]:
        with ThreadPoolExecutor(len(env_fns)) as pool:  # each waits for its process to begin
            return list(pool.map(self._make_one, range(len(env_fns))))

    def _make_one(self, i: int) -> AsyncVectorEnv:
        make, parent = self._env_fns[i], os.getpid()

        def made() -> gymnasium.Env:
            if os.getpid() != parent:
                # In a group of its own Ctrl-C reaches only the parent, and what the environment
                # starts can be killed with it.
                os.setpgrp()
            return _Raising(make())

        try:
            env = AsyncVectorEnv(
                [made], context="spawn", daemon=False, autoreset_mode=AutoresetMode.DISABLED
            )
        except (EOFError, ConnectionError) as error:
            raise BadEnvironmentError(
                "an environment's process ended while it was begun; see to it that it can be made"
                ' in a new process, and keep a script\'s own lines under if __name__ == "__main__":'
            ) from error
        self._living[i] = env
        return env

    @property
    def pids(self) -> list[int]:
        """Numbers of the processes, each the first of a group."""
        return [env.processes[0].pid for env in self.envs]

    def _spaces(self, env: Any) -> tuple[gymnasium.Space, gymnasium.Space]:
        return env.single_observation_space, env.single_action_space

    def _call(self, method: str, calls: Mapping[int, tuple[Any, ...]]) -> dict[int, Any]:
        ends = time.monotonic() + self._timeout_s
        for i, given in calls.items():
            env = self.envs[i]
            with contextlib.suppress(OSError):  # its process is gone; waiting will tell
                if method == "reset":
                    env.reset_async(*given)
                elif method == "step":
                    env.step_async(given[0][None])
                else:
                    env.call_async("set_sim_params", *given)
        waiting = {"reset": "reset_wait", "step": "step_wait", "change": "call_wait"}[method]
        found: dict[int, Any] = {}
        failed: Exception | None = None
        for i in calls:
            env = self.envs[i]
            try:
                with warnings.catch_warnings(action="ignore"):  # Gymnasium's, of what it raises
                    found[i] = getattr(env, waiting)(timeout=max(0.0, ends - time.monotonic()))
            except multiprocessing.TimeoutError:
                why = f"did not answer to {method} within {self._timeout_s:g} s"
                found[i] = BrokenEpisodeError(why)
            except (EOFError, OSError):
                env.processes[0].join()
                code = env.processes[0].exitcode or 0
                how = f"killed by {signal.Signals(-code).name}" if code < 0 else f"over ({code})"
                found[i] = BrokenEpisodeError(f"had its process {how} during {method}")
            except BrokenEpisodeError as error:
                found[i] = error
            except Exception as error:  # only once all have answered
                failed = error
            else:
                found[i] = _single(found[i]) if method != "change" else None
                continue
            _kill({i: self._living.pop(i)})  # Gymnasium's workers end with the first error
            self.envs[i] = self._make_one(i)
        if failed is not None:
            raise failed
        return found

    def close_extras(self, **kwargs: Any) -> None:
        """End the processes."""
        self._end()


class _Raising(gymnasium.Wrapper):
    """Raises only what can be sent to the parent: one of Headway's errors, with a text."""

    def reset(self, **given: Any) -> tuple[Any, dict[str, Any]]:
        with _headway_errors():
            return self.env.reset(**given)

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        with _headway_errors():
            return self.env.step(action)


@contextlib.contextmanager
def _headway_errors():
    try:
        yield
    except HeadwayError as error:
        raise type(error)(str(error)) from error
    except Exception as error:
        raise BadEnvironmentError(f"raised {type(error).__name__}: {error}") from error


def _single(batch: tuple[Any, ...]) -> tuple[Any, ...]:
    """Take a batch of one apart: what an environment itself returned."""
    *arrays, info = batch
    sim_params = {
        name: values[0]
        for name, values in info.get("sim_params", {}).items()
        if not name.startswith("_")  # Gymnasium's masks
    }
    return *(array[0] for array in arrays), {"sim_params": sim_params}


def _kill(envs: dict[int, AsyncVectorEnv]) -> None:
    """End processes with all that they started."""
    for env in envs.values():
        for process in env.processes:
            if process.pid is not None:
                with contextlib.suppress(ProcessLookupError, PermissionError):
                    os.killpg(process.pid, signal.SIGKILL)
                process.kill()
            process.join()
        for pipe in env.parent_pipes:
            if pipe is not None:
                pipe.close()
        env.closed = True
    envs.clear()
