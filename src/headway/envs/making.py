"""Making environments by name, one or many, and telling Gymnasium about them."""

import functools
import inspect
from collections.abc import Callable, Mapping
from typing import Any

import gymnasium
from gymnasium.vector import AutoresetMode

from headway.envs.classic import CartPoleWorld, ClassicWorld, PendulumWorld
from headway.envs.processes.vector import ProcessVectorEnv
from headway.envs.robots import CrippledAnt, HalfCheetah, Hopper, Robot, SlimHumanoid
from headway.envs.separate import SequentialVectorEnv
from headway.envs.vector import HeadwayVectorEnv, WorldVectorEnv
from headway.envs.vector_worlds import ClassicVectorEnv, RolloutVectorEnv
from headway.envs.world import World
from headway.errors import unknown_name
from headway.sim_params import SimParamSets
from headway.tasks.catalog import BUILT_IN, EnvSpec, env_spec

_WORLDS: dict[str, Callable[..., World]] = {
    "pendulum": PendulumWorld,
    "cartpole-swingup": CartPoleWorld,
    "hopper": Hopper,
    "slim-humanoid": SlimHumanoid,
    "half-cheetah": HalfCheetah,
    "crippled-ant": CrippledAnt,
}


def make(name_or_id: str, **kwargs: Any) -> gymnasium.Env:
    """Make one environment, as `gymnasium.make` does, also by its short name.

    Args:
        name_or_id: For example `"hopper"` or `"headway/Hopper-v0"`.
        **kwargs: The environment's options, `sim_params` (a `SimParamSets`), `render_mode`, and
            what else `gymnasium.make` takes.

    Raises:
        UnknownNameError: No such environment or option.
    """
    spec = env_spec(name_or_id)
    known = list(inspect.signature(gymnasium.make).parameters)
    if _built_in(spec) is not None:
        _check_options(spec, kwargs, [*spec.options, "sim_params", "render_mode", *known])
        kwargs.setdefault("disable_env_checker", True)
    return gymnasium.make(spec.env_id, **kwargs)


def make_vec(
    name_or_id: str,
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
        name_or_id: For example `"hopper"` or `"headway/Hopper-v0"`.
        num_envs: How many.
        sim_params: Replaces the catalog's training and unseen physics.
        options: Boolean options of the environment.
        autoreset_mode: NEXT_STEP or DISABLED, see `HeadwayVectorEnv`.
        episode_length: Steps after which an episode is cut; None takes the catalog's.
        step_timeout_s: Steps every environment in a process of its own, and gives it up when a
            step takes longer (`ProcessVectorEnv`); None steps all in this process.

    Raises:
        UnknownNameError: No such environment or option.
        ConfigError: A number or a parameter is not allowed.
        BadEnvironmentError: An environment could not be made in its process.
    """
    spec = env_spec(name_or_id)
    given: dict[str, Any] = dict(options or {})
    _check_options(spec, given, spec.options)
    sets = sim_params or spec.sim_params
    length = spec.episode_length if episode_length is None else episode_length
    built_in = _built_in(spec)
    if built_in is not None and step_timeout_s is None:
        return _vector(_WORLDS[built_in](sets, **given), num_envs, autoreset_mode, length)
    if built_in is not None:  # these draw physics themselves
        given |= {"sim_params": sets, "disable_env_checker": True}
    shared: dict[str, Any] = {
        "sim_params": None if built_in is not None else sets,
        "autoreset_mode": autoreset_mode,
        "episode_length": length,
    }
    # A longer episode than Gymnasium's own limit must be possible, so ours replaces it.
    registered = gymnasium.spec(spec.env_id)  # another process may not have registered it
    one = functools.partial(gymnasium.make, registered, max_episode_steps=length, **given)
    if step_timeout_s is None:
        return SequentialVectorEnv([one] * num_envs, **shared)
    return ProcessVectorEnv([one] * num_envs, step_timeout_s=step_timeout_s, **shared)


def _vector(
    world: World, num_envs: int, autoreset_mode: AutoresetMode | str, length: int | None
) -> WorldVectorEnv:
    if isinstance(world, Robot):
        return RolloutVectorEnv(world, num_envs, autoreset_mode, length)
    assert isinstance(world, ClassicWorld)
    return ClassicVectorEnv(world, num_envs, autoreset_mode, length)


def _built_in(spec: EnvSpec) -> str | None:
    """Return the built-in environment that a spec is about, maybe with physics of its own."""
    return next((name for name in BUILT_IN if env_spec(name).env_id == spec.env_id), None)


def _check_options(spec: EnvSpec, given: Mapping[str, Any], known: Any) -> None:
    for name in given:
        if name not in known:
            raise unknown_name(f"{spec.name} option", name, spec.options)


def _entry_point(
    name: str,
    num_envs: int = 1,
    max_episode_steps: int | None = None,
    autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
    **kwargs: Any,
) -> WorldVectorEnv:
    """What `gymnasium.make_vec` calls."""
    return _vector(_WORLDS[name](**kwargs), num_envs, autoreset_mode, max_episode_steps)


pendulum_vec = functools.partial(_entry_point, "pendulum")
cartpole_swingup_vec = functools.partial(_entry_point, "cartpole-swingup")
hopper_vec = functools.partial(_entry_point, "hopper")
slim_humanoid_vec = functools.partial(_entry_point, "slim-humanoid")
half_cheetah_vec = functools.partial(_entry_point, "half-cheetah")
crippled_ant_vec = functools.partial(_entry_point, "crippled-ant")

_ENTRY_POINTS = {
    "pendulum": "classic:PendulumEnv",
    "cartpole-swingup": "classic:CartPoleSwingUpEnv",
    "hopper": "locomotion:HopperEnv",
    "slim-humanoid": "locomotion:SlimHumanoidEnv",
    "half-cheetah": "locomotion:HalfCheetahEnv",
    "crippled-ant": "locomotion:CrippledAntEnv",
}


def register_all() -> None:
    """Tell Gymnasium about the built-in environments, once."""
    for name, entry_point in _ENTRY_POINTS.items():
        spec = env_spec(name)
        if spec.env_id in gymnasium.registry:
            continue
        gymnasium.register(
            spec.env_id,
            entry_point=f"headway.envs.{entry_point}",
            vector_entry_point=f"headway.envs.making:{name.replace('-', '_')}_vec",
            max_episode_steps=spec.episode_length,
        )
