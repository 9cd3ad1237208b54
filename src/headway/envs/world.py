"""What all environments of Headway share: spaces, simulator parameters, resets."""

import abc
import math
from collections.abc import Mapping
from typing import Any, ClassVar

import gymnasium
import numpy as np
from gymnasium.spaces import Box

from headway.envs.schedule import read_schedule
from headway.errors import ConfigError, unknown_name
from headway.sim_params import SimParamSets
from headway.tasks.base import Task
from headway.tasks.catalog import EnvSpec, env_spec

SimParams = dict[str, float]


class World(abc.ABC):
    """The laws of one environment, shared by its single and its vector form.

    Functions of states, observations and rewards work on arrays with any number of leading
    axes, so that stepping one environment and stepping many are the same arithmetic.
    """

    name: ClassVar[str]
    """Short name in the catalog."""
    obs_dtype: ClassVar[type[np.floating]]
    choices: ClassVar[Mapping[str, tuple[float, ...]]] = {}
    """Allowed values of the parameters that are no positive numbers."""

    def __init__(self, task: Task, sim_params: SimParamSets | None):
        self.task = task
        self.sim_params = sim_params or self.catalog_entry.sim_params
        for group in self.sim_params.group_names:
            for values in self.sim_params.group(group):
                self.check(values)

    @property
    def catalog_entry(self) -> EnvSpec:
        """The environment's line in the catalog."""
        return env_spec(self.name)

    @property
    def action_space(self) -> Box:
        """Actions in the environment's own units."""
        low = np.array(self.task.action_low, np.float32)
        return Box(low, np.array(self.task.action_high, np.float32), dtype=np.float32)

    @property
    def observation_space(self) -> Box:
        """Observations, by default without bounds."""
        return Box(-np.inf, np.inf, (self.task.obs_size,), self.obs_dtype)

    def check(self, values: Mapping[str, Any]) -> SimParams:
        """Return simulator parameters as floats.

        Raises:
            ConfigError: A name is unknown or a value not allowed.
        """
        return {name: self._check_one(name, value) for name, value in values.items()}

    def _check_one(self, name: str, value: Any) -> float:
        known = self.catalog_entry.default_sim_params
        if name not in known:
            raise ConfigError(str(unknown_name(f"{self.name} sim_param", str(name), known)))
        number, choices = _as_float(value), self.choices.get(name)
        if choices is not None:
            fits, allowed = number in choices, ", ".join(f"{choice:g}" for choice in choices)
        else:
            fits, allowed = math.isfinite(number) and number > 0, "finite numbers above 0"
        if not fits:
            raise ConfigError(f"{self.name} sim_params {name} is {value!r}, allowed: {allowed}.")
        return number

    def draw(self, rng: np.random.Generator, requested: SimParams) -> SimParams:
        """Draw what was not requested from the training values.

        The same random numbers are used up whatever was requested.
        """
        defaults = dict(self.catalog_entry.default_sim_params)
        return {**defaults, **self.sim_params.sample(rng), **requested}

    def clip(self, actions: Any, shape: tuple[int, ...]) -> np.ndarray:
        """Return actions as float64 within bounds.

        Raises:
            ConfigError: The shape is wrong or a number is not finite.
        """
        actions = np.asarray(actions, np.float64)
        if actions.shape != shape or not np.isfinite(actions).all():
            raise ConfigError(
                f"{self.name} was given an action of shape {actions.shape},"
                f" {actions.tolist()}, allowed: finite numbers of shape {shape}."
            )
        low, high = self.task.action_low, self.task.action_high
        return np.clip(actions, np.asarray(low, np.float32), np.asarray(high, np.float32))


def read_options(options: Mapping[str, Any] | None, known: tuple[str, ...]) -> dict[str, Any]:
    """Return a copy of the options of `reset`.

    Raises:
        ConfigError: An option is unknown, or its sim_params are no mapping.
    """
    options = dict(options or {})
    for name in options:
        if name not in known:
            raise ConfigError(str(unknown_name("reset option", str(name), known)))
    sim_params = options.get("sim_params") or {}
    if not isinstance(sim_params, Mapping):
        raise ConfigError(f"sim_params is {sim_params!r}, allowed: values by parameter name.")
    return options | {"sim_params": sim_params}


def _as_float(value: Any) -> float:
    try:
        return float(value)
    except (TypeError, ValueError):
        return math.nan


class WorldEnv(gymnasium.Env[np.ndarray, np.ndarray]):
    """One environment of a world, whose physics can be set and whose state can be copied."""

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": 50}  # noqa: RUF012 (as in Gymnasium)

    def __init__(self, world: World, render_mode: str | None):
        if render_mode not in (None, "rgb_array"):
            raise ConfigError(f"render_mode is {render_mode!r}, allowed: None or 'rgb_array'.")
        self._world = world
        self.render_mode = render_mode
        self.action_space = world.action_space
        self.observation_space = world.observation_space
        self._sim_params: SimParams = dict(world.catalog_entry.default_sim_params)
        self._schedule: dict[int, SimParams] = {}
        self._elapsed = 0

    @property
    def sim_params(self) -> SimParams:
        """The simulator parameters now in force."""
        return dict(self._sim_params)

    @property
    def sim_param_sets(self) -> SimParamSets:
        """Where `reset` draws simulator parameters from."""
        return self._world.sim_params

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
        options = read_options(options, ("sim_params", "schedule"))
        requested = self._world.check(options["sim_params"])
        schedule = read_schedule(options.get("schedule"), self._world.check)
        super().reset(seed=seed)
        self._schedule, self._elapsed = schedule, 0
        self._reset_state()
        self.set_sim_params(self._world.draw(self.np_random, requested))
        return self.observation(), self._info()

    def set_sim_params(self, values: Mapping[str, float]) -> None:
        """Change some simulator parameters and leave the state as it is.

        Raises:
            ConfigError: A parameter or value is not allowed.
        """
        self._sim_params |= self._world.check(values)
        self._apply_sim_params()

    def _begin_step(self) -> None:
        """Change the physics if it is time to; every step begins with it."""
        changed = self._schedule.get(self._elapsed)
        self._elapsed += 1
        if changed:
            self.set_sim_params(changed)

    def _info(self) -> dict[str, Any]:
        return {"sim_params": self.sim_params}

    def _apply_sim_params(self) -> None:
        """Change the physics to `self._sim_params`; nothing to do where they are read."""

    @abc.abstractmethod
    def _reset_state(self) -> None:
        """Draw a state with `self.np_random`."""

    @abc.abstractmethod
    def observation(self) -> np.ndarray:
        """Return the observation of the present state."""

    @abc.abstractmethod
    def get_state(self) -> np.ndarray:
        """Return everything that the future depends on, besides the physics."""

    @abc.abstractmethod
    def set_state(self, state: np.ndarray) -> None:
        """Go to a state that `get_state` returned."""


def check_state(name: str, state: Any, size: int) -> np.ndarray:
    """Return a state as float64.

    Raises:
        ConfigError: It is not of the environment's size, or not finite.
    """
    state = np.asarray(state, np.float64)
    if state.shape != (size,) or not np.isfinite(state).all():
        raise ConfigError(
            f"{name} was given a state of shape {state.shape}, allowed: {size} finite numbers, as"
            " get_state returns them."
        )
    return state
