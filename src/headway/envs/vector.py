"""Many environments stepped at once, each with its own physics."""

import abc
from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Any, NamedTuple

import gymnasium
import numpy as np
from gymnasium.utils import seeding
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from headway.envs.schedule import read_schedules
from headway.envs.world import SimParams, World, read_options
from headway.errors import BrokenEpisodeError, ConfigError

Seeds = int | Sequence[int | None] | None


class Outcome(NamedTuple):
    """What a step returned for some of the environments."""

    reward: np.ndarray
    terminated: np.ndarray
    truncated: np.ndarray
    broken: Mapping[int, str] = MappingProxyType({})
    """Environments whose episode cannot go on, and why."""


class HeadwayVectorEnv(VectorEnv[np.ndarray, np.ndarray, np.ndarray]):
    """What all vector environments share: seeds, resets, the time limit, finished episodes.

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
        mode = AutoresetMode(autoreset_mode)
        if mode is AutoresetMode.SAME_STEP:
            raise ConfigError("autoreset_mode is SAME_STEP, allowed: NEXT_STEP or DISABLED.")
        self.num_envs = num_envs
        self.single_observation_space, self.single_action_space = spaces
        self.observation_space = batch_space(spaces[0], num_envs)
        self.action_space = batch_space(spaces[1], num_envs)
        self.autoreset_mode = mode
        self.metadata = self.metadata | {"autoreset_mode": mode}
        self.episode_length = episode_length
        self._elapsed = np.zeros(num_envs, int)
        self._ends = np.zeros((2, num_envs), bool)
        self._broken: dict[int, str] = {}
        self._sim_params: dict[str, np.ndarray] = {}
        self._schedules: list[dict[int, SimParams]] = [{}] * num_envs

    def reset(  # pyright: ignore[reportIncompatibleMethodOverride]
        self, *, seed: Seeds = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Start episodes in all environments, or in those of the mask.

        Raises:
            ConfigError: A seed, option, parameter or value is not allowed.
        """
        options = read_options(options, ("sim_params", "reset_mask", "schedule"))
        seeds = self._read_seeds(seed)
        requested = self._read_sim_params(options["sim_params"])
        chosen = np.flatnonzero(self._read_mask(options.get("reset_mask")))
        schedule = options.get("schedule")
        schedules = read_schedules(schedule, self.num_envs, self._check_sim_params)
        self._start(chosen, seeds, requested)
        for i in chosen:
            self._schedules[i] = schedules[i]
        return self._observe_sound(), self._info()

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
        terminated, truncated = self._ends & (not next_step)
        restart = self._finished & next_step
        if restart.any():
            nothing = [{}] * self.num_envs
            self._start(np.flatnonzero(restart), [None] * self.num_envs, nothing)
        broken = {i: why for i, why in self._broken.items() if restart[i]}
        active = np.flatnonzero(~self._finished & ~restart)
        broken |= self._follow_schedules(active)
        active = np.setdiff1d(active, list(broken))
        if active.size:
            outcome = self._advance(active, actions)
            self._elapsed[active] += 1
            rewards[active], terminated[active], truncated[active] = outcome[:3]
            broken |= outcome.broken
            if self.episode_length is not None:
                truncated[active] |= self._elapsed[active] >= self.episode_length
        rewards[list(broken)], truncated[list(broken)] = np.nan, True
        self._broken |= broken
        self._ends = np.stack([terminated, truncated])
        return self._observe_sound(), rewards, terminated, truncated, self._info()

    @property
    def _finished(self) -> np.ndarray:
        return np.asarray(self._ends.any(0))

    @property
    def sim_params(self) -> dict[str, np.ndarray]:
        """The simulator parameters now in force, one value per environment."""
        return {name: values.copy() for name, values in self._sim_params.items()}

    def _info(self) -> dict[str, Any]:
        broken = {"broken": dict(self._broken)} if self._broken else {}
        return {"sim_params": self.sim_params, **broken}

    def _observe_sound(self) -> np.ndarray:
        """All observations; nothing is known of where an episode broke."""
        obs, broken = self._observe(), list(self._broken)
        if broken and obs.dtype.kind == "f":
            obs[broken] = np.nan
        return obs

    def _start(
        self, chosen: np.ndarray, seeds: Sequence[int | None], requested: Sequence[SimParams]
    ) -> None:
        self._elapsed[chosen] = 0
        self._ends[:, chosen] = False
        for i, begun in self._begin(chosen, seeds, requested).items():
            self._broken.pop(i, None)
            values = requested[i] if isinstance(begun, BrokenEpisodeError) else begun
            if isinstance(begun, BrokenEpisodeError):
                self._broken[i], self._ends[1, i] = str(begun), True
            self._note_sim_params(i, values)
            self._schedules[i] = {}

    def _note_sim_params(self, i: int, values: SimParams) -> None:
        for name, value in values.items():
            self._sim_params.setdefault(name, np.full(self.num_envs, np.nan))[i] = value

    def _follow_schedules(self, active: np.ndarray) -> dict[int, str]:
        """Change the physics of the environments where it is time to; return what broke."""
        broken = {}
        for i in active:
            changed = self._schedules[i].get(int(self._elapsed[i])) or {}
            try:
                if changed:
                    self._change(int(i), changed)
            except BrokenEpisodeError as error:
                broken[int(i)] = str(error)
            self._note_sim_params(int(i), changed)
        return broken

    def _read_seeds(self, seed: Seeds) -> list[int | None]:
        if seed is None or isinstance(seed, int | np.integer):
            return [None if seed is None else int(seed) + i for i in range(self.num_envs)]
        if len(seed) != self.num_envs:
            raise ConfigError(
                f"seed has {len(seed)} entries, allowed: an int, or {self.num_envs} of them."
            )
        return [None if one is None else int(one) for one in seed]

    def _read_sim_params(self, values: Mapping[str, Any]) -> list[SimParams]:
        """Turn values per parameter into parameters per environment."""
        rows: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        for name, column in values.items():
            given = np.asarray(column)
            if given.shape not in ((), (self.num_envs,)):
                raise ConfigError(
                    f"sim_params {name} has shape {given.shape}, allowed: one value, or"
                    f" {self.num_envs}, one per environment."
                )
            for row, value in zip(rows, np.broadcast_to(given, self.num_envs), strict=True):
                row[name] = value.item()
        return [self._check_sim_params(row) for row in rows]

    def _read_mask(self, mask: Any) -> np.ndarray:
        mask = np.ones(self.num_envs, bool) if mask is None else np.asarray(mask)
        if mask.shape != (self.num_envs,) or mask.dtype != bool:
            raise ConfigError(
                f"reset_mask has shape {mask.shape} and dtype {mask.dtype}, allowed:"
                f" {self.num_envs} booleans."
            )
        return mask

    def _check_actions(self, actions: np.ndarray) -> np.ndarray:
        return actions

    def _check_sim_params(self, values: dict[str, Any]) -> SimParams:
        return values

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
    def _observe(self) -> np.ndarray:
        """Return all observations, in an array of their own."""


class WorldVectorEnv(HeadwayVectorEnv):
    """Many copies of one world."""

    def __init__(
        self,
        world: World,
        num_envs: int,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        episode_length: int | None = None,
    ):
        spaces = world.observation_space, world.action_space
        length = world.catalog_entry.episode_length if episode_length is None else episode_length
        super().__init__(num_envs, spaces, autoreset_mode, length)
        self._world = world
        self._rngs: list[np.random.Generator | None] = [None] * num_envs
        self._sim_params = {
            name: np.full(num_envs, float(value))
            for name, value in world.catalog_entry.default_sim_params.items()
        }

    def _check_actions(self, actions: np.ndarray) -> np.ndarray:
        return self._world.clip(actions, (self.num_envs, self._world.task.action_size))

    def _check_sim_params(self, values: dict[str, Any]) -> SimParams:
        return self._world.check(values)

    def _begin(
        self, chosen: np.ndarray, seeds: Sequence[int | None], requested: Sequence[SimParams]
    ) -> dict[int, SimParams | BrokenEpisodeError]:
        return {int(i): self._begin_one(int(i), seeds[i], requested[i]) for i in chosen}

    def _begin_one(self, i: int, seed: int | None, requested: SimParams) -> SimParams:
        rng = self._rngs[i]
        if rng is None or seed is not None:
            rng = self._rngs[i] = seeding.np_random(seed)[0]
        self._set_initial_state(i, rng)
        sim_params = self._world.draw(rng, requested)
        self._apply_sim_params(i, sim_params)
        return sim_params

    def _change(self, i: int, changed: SimParams) -> None:
        before = {name: float(values[i]) for name, values in self._sim_params.items()}
        self._apply_sim_params(i, before | changed)

    @abc.abstractmethod
    def _set_initial_state(self, i: int, rng: np.random.Generator) -> None:
        """Put environment `i` into the state that an episode starts in."""

    def _apply_sim_params(self, i: int, sim_params: SimParams) -> None:
        """Change the physics of environment `i`; nothing to do where they are read."""
