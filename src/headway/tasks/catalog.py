"""The table of environments: what a user can train on, and the physics each comes with."""

import dataclasses
from collections.abc import Callable, Mapping

from headway.config import Config
from headway.errors import ConfigError, unknown_name
from headway.sim_params import SimParamSets
from headway.tasks.base import Task
from headway.tasks.classic import CartPoleSwingUpTask, PendulumTask
from headway.tasks.locomotion import (
    CrippledAntTask,
    HalfCheetahTask,
    HopperTask,
    SlimHumanoidTask,
)


@dataclasses.dataclass(frozen=True)
class EnvSpec:
    """What Headway must know of an environment before it makes one."""

    name: str
    """Short name, as the command line takes it."""
    env_id: str
    """Gymnasium id; any id that `gymnasium.make` knows."""
    make_task: Callable[..., Task]
    """Builds the Task; takes the options as keywords."""
    sim_params: SimParamSets
    """Physics to train on and to test on; passed to `reset` as `options["sim_params"]`."""
    episode_length: int
    """Steps after which an episode is cut."""
    default_sim_params: Mapping[str, float]
    """The physics of the unchanged environment."""
    options: Mapping[str, bool] = dataclasses.field(default_factory=dict)
    """Boolean options of the environment and its Task, with their defaults."""
    description: str = ""
    """One line for lists."""
    epochs: int = 50
    """Passes over the data per iteration at the paper's scale (supplement A.2)."""
    noise_beta: float | None = None
    """Exponent of the power spectrum of the noise with which iCEM searches in the preset `fast`;
    None searches with CEM, whose noise is white."""


_SPECS: dict[str, EnvSpec] = {}


def env_names() -> list[str]:
    """Return the short names of all environments, in the order they were registered."""
    return list(_SPECS)


def env_spec(name_or_id: str) -> EnvSpec:
    """Look an environment up by its short name or its Gymnasium id.

    Raises:
        UnknownNameError: No such environment.
    """
    for spec in _SPECS.values():
        if name_or_id in (spec.name, spec.env_id):
            return spec
    known = [spec.env_id for spec in _SPECS.values()] if "/" in name_or_id else _SPECS
    raise unknown_name("environment", name_or_id, known)


def episode_length(config: Config) -> int:
    """Steps of an episode: the run's own, or else the environment's."""
    return config.collection.episode_length or env_spec(config.env).episode_length


def env_options(config: Config) -> dict[str, bool]:
    """All options of a run's environment: its own over the defaults."""
    return {**env_spec(config.env).options, **config.env_options}


def sim_param_sets(config: Config) -> SimParamSets:
    """Training and unseen physics: the run's own, or else the environment's."""
    return config.sim_params or env_spec(config.env).sim_params


def register(spec: EnvSpec) -> None:
    """Add an environment of your own, or replace an earlier one of the same name.

    Its `reset` must take `options={"sim_params": {name: value}}`, and the environment must
    take the options as keywords.

    Raises:
        ConfigError: The spec contradicts itself, or has the name of a built-in environment.
    """
    if spec.name in BUILT_IN:
        raise ConfigError(
            f"environment name {spec.name!r} is taken, allowed: any but {', '.join(BUILT_IN)}."
        )
    _add(spec)


def _add(spec: EnvSpec) -> None:
    if not spec.name or spec.episode_length < 1 or spec.epochs < 1:
        raise ConfigError(
            f"environment {spec.name!r} has episode_length {spec.episode_length} and epochs"
            f" {spec.epochs}, allowed: a name, and at least 1 each."
        )
    if set(spec.default_sim_params) != set(spec.sim_params.names):
        raise ConfigError(
            f"environment {spec.name!r} has default_sim_params for"
            f" {sorted(spec.default_sim_params)}, allowed: exactly those of its sim_params,"
            f" {sorted(spec.sim_params.names)}."
        )
    _SPECS[spec.name] = spec


def _masses(train: tuple[float, ...], low: tuple[float, ...], high: tuple[float, ...]):
    """Sets of mass scales whose damping scale is always 1, as in the paper."""
    values = {"train": train, "low": low, "high": high}
    groups = {
        name: {"mass_scale": scales, "damping_scale": (1.0,)} for name, scales in values.items()
    }
    return SimParamSets(groups.pop("train"), groups)


_NO_SCALING = {"mass_scale": 1.0, "damping_scale": 1.0}

_BUILT_IN = (
    EnvSpec(
        name="pendulum",
        env_id="headway/Pendulum-v0",
        make_task=PendulumTask,
        sim_params=SimParamSets(
            {"length": (0.5, 0.75, 1.0, 1.25), "mass": (1.0,)},
            {
                "low": {"length": (0.25, 0.375), "mass": (1.0,)},
                "high": {"length": (1.5, 1.75), "mass": (1.0,)},
            },
        ),
        episode_length=200,
        default_sim_params={"length": 1.0, "mass": 1.0},
        description="swing a pendulum of unknown length up",
        epochs=5,
        noise_beta=0.25,
    ),
    EnvSpec(
        name="cartpole-swingup",
        env_id="headway/CartPoleSwingUp-v0",
        make_task=CartPoleSwingUpTask,
        sim_params=SimParamSets(
            {"mass_scale": (0.25, 0.5, 1.5, 2.5)},
            {"low": {"mass_scale": (0.1, 0.15)}, "high": {"mass_scale": (2.75, 3.0)}},
        ),
        episode_length=500,
        default_sim_params={"mass_scale": 1.0},
        options={"terminate_off_track": False},
        description="swing a pole of unknown mass up by its cart, also of unknown mass",
        noise_beta=0.25,
    ),
    EnvSpec(
        name="hopper",
        env_id="headway/Hopper-v0",
        make_task=HopperTask,
        sim_params=_masses((0.5, 0.75, 1.0, 1.25, 1.5), (0.25, 0.375), (1.75, 2.0)),
        episode_length=500,
        default_sim_params=_NO_SCALING,
        options={"scale_inertia": False, "observe_average_velocity": True},
        description="hop forward on one leg with unknown masses",
    ),
    EnvSpec(
        name="slim-humanoid",
        env_id="headway/SlimHumanoid-v0",
        make_task=SlimHumanoidTask,
        sim_params=_masses((0.8, 0.9, 1.0, 1.15, 1.25), (0.6, 0.7), (1.5, 1.6)),
        episode_length=1000,
        default_sim_params=_NO_SCALING,
        options={"scale_inertia": False},
        description="walk upright as a humanoid with unknown masses",
    ),
    EnvSpec(
        name="half-cheetah",
        env_id="headway/HalfCheetah-v0",
        make_task=HalfCheetahTask,
        sim_params=_masses((0.25, 0.5, 1.5, 2.5), (0.1, 0.15), (2.75, 3.0)),
        episode_length=1000,
        default_sim_params=_NO_SCALING,
        options={"scale_inertia": False},
        description="run forward on two legs with unknown masses",
    ),
    EnvSpec(
        name="crippled-ant",
        env_id="headway/CrippledAnt-v0",
        make_task=CrippledAntTask,
        sim_params=SimParamSets(
            {"crippled_leg": (0.0, 1.0, 2.0)}, {"leg-3": {"crippled_leg": (3.0,)}}
        ),
        episode_length=1000,
        default_sim_params={"crippled_leg": -1.0},
        options={"shrink_leg": False},
        description="walk on four legs, one of which does not obey",
    ),
)

for _spec in _BUILT_IN:
    _add(_spec)

BUILT_IN: tuple[str, ...] = tuple(_SPECS)
"""Names of the paper's six environments."""
