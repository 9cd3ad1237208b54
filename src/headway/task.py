"""Tasks and the table of environments: all that a model and a planner must know of one, in JAX."""

import copy
import dataclasses
import functools
import importlib
import inspect
import json
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from headway.errors import (
    ConfigError,
    UnknownNameError,
    check_names,
    one_line,
    shown,
    unknown_name,
)
from headway.sim_params import SimParamSets
from headway.spaces import Spaces

if TYPE_CHECKING:
    from headway.config import Config

Obs = Float[Array, "*batch obs"]
Action = Float[Array, "*batch action"]
Scaled = Float[Array, "*batch scaled"]
Reward = Float[Array, "*batch"]
Ends = Bool[Array, "*batch"]
HostAction = Float[np.ndarray, "*batch action"]
HostScaled = Float[np.ndarray, "*batch scaled"]


class Task(eqx.Module):
    """The reward, the end of an episode, and how observations enter and leave a model.

    A Task without `reward`, as this class is, leaves reward and end to the model, which learns them
    (`model.learned_reward`).

    Every method is pure JAX and written for one transition with any number of leading
    axes. `action` is always in the environment's own units, in one row: the number of a category
    or of each of several ones. The model and the planner work with actions scaled to [-1, 1]
    (`Spaces`) and convert with `scale_action`.

    Sizes and bounds are the environment's. Where a subclass states one as class variable (a
    property where an option changes one), that counts. Subclasses override what differs from the
    plain case: preprocess = identity, target = next_obs - obs, no termination. Options of an
    environment are fields of its Task.

    Example:
        A point pushed along a line, which should stay at zero:

        >>> class LineTask(Task):
        ...     def reward(self, obs, action, next_obs):
        ...         return -jnp.square(next_obs[..., 0])
    """

    obs_size: ClassVar[int]
    action_size: ClassVar[int]
    action_low: ClassVar[tuple[float, ...]]
    action_high: ClassVar[tuple[float, ...]]
    told_spaces: Spaces | None = eqx.field(static=True, default=None, kw_only=True)
    """The spaces that a run read from its environment."""

    if not TYPE_CHECKING:  # which would take every misspelt name for one of these

        def __getattr__(self, name):
            names = "obs_size", "action_size", "action_low", "action_high"
            if name in names and self.told_spaces is not None:
                return getattr(self.told_spaces, name)
            advice = "; a run reads it from the environment, elsewhere state " + ", ".join(names)
            known = (*names, "spaces")  # where the property below finds that one is missing
            raise AttributeError(f"{type(self).__name__} has no {name}{advice * (name in known)}.")

    @property
    def spaces(self) -> Spaces:
        """Sizes, bounds and kind of actions; by default float32 within the stated bounds."""
        if self.told_spaces is not None:
            return self.told_spaces
        bounds = tuple(self.action_low), tuple(self.action_high)
        return Spaces(self.obs_size, "box", *bounds, (self.action_size,), "float32")

    @property
    def has_reward(self) -> bool:
        """False where the reward is left to the model."""
        return type(self).reward is not Task.reward

    def reward(self, obs: Obs, action: Action, next_obs: Obs) -> Reward:
        """Reward of a transition, equal to what `env.step` returns."""
        raise ConfigError(
            f"{type(self).__name__} has no reward, allowed here: one in JAX; write it."
        )

    def released_reward(self, obs: Obs, action: Action, next_obs: Obs) -> Reward:
        """Reward that the released code plans with; differs where that lags or errs."""
        return self.reward(obs, action, next_obs)

    def terminated(self, obs: Obs, action: Action, next_obs: Obs) -> Ends:
        """Mark transitions that end the episode for good. The paper's tasks never end."""
        return jnp.zeros(obs.shape[:-1], dtype=bool)

    def preprocess(self, obs: Obs) -> Float[Array, "*batch features"]:
        """Turn an observation into the features that enter a network."""
        return obs

    def target(self, obs: Obs, next_obs: Obs) -> Obs:
        """The regression target `delta` of a transition."""
        return next_obs - obs

    def postprocess(self, obs: Obs, delta: Obs) -> Obs:
        """Undo `target`: `postprocess(obs, target(obs, next_obs)) == next_obs`."""
        return obs + delta

    def scale_action(self, action: Scaled) -> Action:
        """Map an action from [-1, 1] to the environment's own units."""
        return self.spaces.scale(action, jnp)

    def unscale_action(self, action: Action) -> Scaled:
        """Map an action from the environment's own units to [-1, 1]."""
        return self.spaces.unscale(action, jnp)

    def project_action(self, action: Scaled) -> Scaled:
        """The nearest action in [-1, 1] that the environment can take: a category, an integer."""
        return self.spaces.project(action, jnp)

    def clip_action(self, action: Action) -> Action:
        """Limit an action in the environment's own units to its range, as the envs do."""
        return jnp.clip(action, jnp.asarray(self.action_low), jnp.asarray(self.action_high))

    @property
    def feature_size(self) -> int:
        """Width of `preprocess`'s result."""
        return eqx.filter_eval_shape(self.preprocess, np.zeros(self.obs_size, np.float32)).shape[-1]


def env_action(task: Task, action: HostScaled) -> Any:
    """`Task.scale_action` in NumPy, of the shape and type that `env.step` takes, within bounds."""
    spaces = task.spaces
    own = spaces.scale(action.astype(np.float64), np)
    if spaces.action_kind != "box":
        own = np.rint(own)
    own = np.clip(own, spaces.action_low, spaces.action_high).astype(spaces.action_dtype)
    return own.reshape((*action.shape[:-1], *spaces.action_shape))[()]


def scaled_action(task: Task, action: HostAction) -> HostScaled:
    """`Task.unscale_action` in NumPy."""
    return task.spaces.unscale(action.astype(np.float64), np).astype(np.float32)


@dataclasses.dataclass(frozen=True, kw_only=True)
class EnvSpec:
    """Name, physics and scale of an environment, and how its Task is made.

    Raises:
        ConfigError: It contradicts itself.
    """

    name: str = ""
    """Short name, as the command line takes it; by default that of what makes the environment."""
    env_id: str | Callable[..., Any]
    """Any id that `gymnasium.make` takes, also `"module:Env-v0"`; or what makes the environment,
    a class or a function. It takes the options as keywords and, to be filmed, `render_mode`."""
    make_task: Callable[..., Task] = Task
    """Builds the Task; takes those of the options as keywords that it depends on. By default
    reward and end of an episode are learned."""
    sim_params: SimParamSets
    """Physics to train on and to test on; passed to `reset` as `options["sim_params"]`."""
    episode_length: int = 0
    """Steps after which an episode is cut; 0 takes the time limit of the id in Gymnasium."""
    default_sim_params: Mapping[str, float] = dataclasses.field(default_factory=dict)
    """The physics of the unchanged environment, also parameters that `sim_params` leaves alone."""
    options: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    """Options of the environment, with their defaults; anything that JSON holds."""
    description: str = ""
    """One line for lists."""
    epochs: int = 50
    """Passes over the data per iteration at the paper's scale (supplement A.2)."""
    quick: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    """Settings of the preset `quick` that are this environment's own, by dotted name."""
    obs_names: tuple[str, ...] = ()
    """Entries of an observation with their units, for figures; unnamed ones are numbered."""

    def __post_init__(self) -> None:
        made = self.env_id if isinstance(self.env_id, str) else getattr(self.env_id, "__name__", "")
        object.__setattr__(self, "name", self.name or made.rpartition(":")[2].strip("<>"))
        default = self.default_sim_params
        known = not default or set(default) >= set(self.sim_params.names)
        if not (self.name and self.episode_length >= 0 and self.epochs >= 1 and known):
            raise ConfigError(
                f"environment {self.name!r} has episode_length {self.episode_length}, epochs"
                f" {self.epochs} and default_sim_params for {sorted(default)},"
                " allowed: a name, at least 0 and 1, and none or also its sim_params,"
                f" {sorted(self.sim_params.names)}."
            )
        try:
            json.dumps(dict(self.options), allow_nan=False)
        except (TypeError, ValueError) as error:
            raise ConfigError(
                f"environment {self.name!r} has options {shown(self.options)} ({error}), allowed:"
                " what JSON holds: numbers, texts, true, false, null, lists and tables of them."
            ) from None

    def task(self, options: Mapping[str, Any]) -> Task:
        """Build the Task with those of the options that it takes."""
        taken = inspect.signature(self.make_task).parameters
        every = any(one.kind is one.VAR_KEYWORD for one in taken.values())
        return self.make_task(**{n: v for n, v in options.items() if every or n in taken})


_HOMES = {
    "pendulum": "headway.worlds.classic:PENDULUM",
    "cartpole-swingup": "headway.worlds.classic:CARTPOLE_SWINGUP",
    "hopper": "headway.worlds.locomotion:HOPPER",
    "slim-humanoid": "headway.worlds.locomotion:SLIM_HUMANOID",
    "half-cheetah": "headway.worlds.locomotion:HALF_CHEETAH",
    "crippled-ant": "headway.worlds.locomotion:CRIPPLED_ANT",
}
BUILT_IN: tuple[str, ...] = tuple(_HOMES)
"""Names of the paper's six environments."""
_registered: dict[str, EnvSpec] = {}


def register(spec: EnvSpec) -> None:
    """Add an environment of your own, or replace an earlier one of the same name.

    Its `reset` must take `options={"sim_params": {name: value}}`, and the environment must
    take the options as keywords.

    Raises:
        ConfigError: The spec has the name of a built-in environment.
    """
    if spec.name in BUILT_IN:
        raise ConfigError(
            f"environment name {spec.name!r} is taken, allowed: any but {', '.join(BUILT_IN)}."
        )
    _registered[spec.name] = spec


def name_spec(env: Any) -> str:
    """A name by which `env_spec` finds an environment, which is registered if need be.

    Args:
        env: A name, or an EnvSpec; one that a module holds is named so that any process finds it.

    Raises:
        ConfigError: It is neither, or has the name of a built-in environment.
    """
    if isinstance(env, str):
        return env
    if not isinstance(env, EnvSpec):
        raise ConfigError(
            f"env is {shown(env)}, allowed: a name, an EnvSpec, or what makes it with sim_params."
        )
    for name, module in list(sys.modules.items()):
        for key, value in list(getattr(module, "__dict__", {}).items()):
            if value is env and name != "__main__":
                return f"{name}:{key}"
    register(env)
    return env.name


def env_names() -> list[str]:
    """Return the short names of the built-in and the registered environments."""
    return [*BUILT_IN, *_registered]


def env_spec(name: str) -> EnvSpec:
    """Look an environment up.

    Args:
        name: A short name, a Gymnasium id, or `"my_package:cart"`: the EnvSpec `cart` of the
            module `my_package`.

    Raises:
        UnknownNameError: No such environment.
        ConfigError: The module cannot be imported.
    """
    if name in BUILT_IN:
        return _imported(_HOMES[name])
    if name in _registered:
        return _registered[name]
    specs = map(env_spec, reversed(env_names()))
    by_id = {spec.env_id: spec for spec in specs if isinstance(spec.env_id, str)}
    if name in by_id:
        return by_id[name]
    if ":" in name:
        if str(Path.cwd()) not in sys.path:  # a console script does not look there
            sys.path.append(str(Path.cwd()))
        return dataclasses.replace(_imported(name), name=name)
    error = unknown_name("environment", name, by_id if "/" in name else env_names())
    advice = " One of your own is module:name of its EnvSpec, or is known after headway.register."
    raise UnknownNameError(f"{error}{advice}")


@functools.cache
def _imported(path: str) -> EnvSpec:
    """Return what `module:name` means."""
    module_name, _, name = path.partition(":")
    try:
        module = importlib.import_module(module_name)
    except Exception as error:  # whatever the module does while it is imported
        raise ConfigError(
            f"environment {path!r}: importing {module_name!r} raised {type(error).__name__}"
            f" ({one_line(error, 300)}), allowed: module:name of a module that Python finds from"
            " here."
        ) from error
    if not hasattr(module, name):
        known = [key for key, value in vars(module).items() if isinstance(value, EnvSpec)]
        raise unknown_name(f"environment of {module_name}", name, known)
    spec = getattr(module, name)  # never called: the name may come from somebody's config.json
    if not isinstance(spec, EnvSpec):
        raise ConfigError(
            f"environment {path!r} is of type {type(spec).__name__}, allowed: an EnvSpec."
        )
    return spec


def episode_length(config: "Config") -> int:
    """Steps of an episode: the run's own, or else the environment's."""
    return config.collection.episode_length or env_spec(config.env).episode_length


def env_options(config: "Config") -> dict[str, Any]:
    """All options of a run's environment: its own over the defaults.

    Raises:
        ConfigError: The environment has no such option, or it is a switch.
    """
    spec = env_spec(config.env)
    check_names(f"{spec.name} option", config.env_options, spec.options)
    for option, value in config.env_options.items():
        if isinstance(spec.options[option], bool) and not isinstance(value, bool):
            raise ConfigError(
                f"{spec.name} option {option} is {shown(value)}, allowed: True or False (on the"
                " command line on or off)."
            )
    return {**spec.options, **config.env_options}


def task_of(config: "Config") -> Task:
    """The Task of a run, with its environment's options and spaces."""
    task = copy.copy(env_spec(config.env).task(env_options(config)))
    object.__setattr__(task, "told_spaces", config.spaces)  # its own __init__ may take anything
    return task


def sim_param_sets(config: "Config") -> SimParamSets:
    """Training and unseen physics: the run's own, or else the environment's."""
    return config.sim_params or env_spec(config.env).sim_params
