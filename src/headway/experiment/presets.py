"""The table of presets: scales of experiment, as named settings."""

import dataclasses
from collections.abc import Callable, Mapping
from typing import Any

from headway.task import EnvSpec

Settings = Mapping[str, Any]
"""Values by dotted name."""


@dataclasses.dataclass(frozen=True)
class Preset:
    """A scale of experiment; `settings` may depend on the environment.

    What only some methods can use belongs in their `Method.by_preset`: whatever a preset sets is
    in the directory names of all its runs (`headway.sweeps.jobs.fingerprint`).
    """

    name: str
    description: str
    settings: Callable[[EnvSpec], Settings]


def _paper(spec: EnvSpec) -> Settings:
    return {"fitting.epochs": spec.epochs}


_FAST_PLANNER: Settings = {
    "planner.num_candidates": 100,
    "planner.num_elites": 20,
    "planner.num_iterations": 3,
    "planner.num_particles": 5,
}


def _fast(spec: EnvSpec) -> Settings:
    settings = {**_paper(spec), **_FAST_PLANNER}
    if spec.noise_beta is None:
        return settings
    colored = {"optimizer": "icem", "num_elites": 10, "noise_beta": spec.noise_beta}
    return settings | {f"planner.{name}": value for name, value in colored.items()}


def _released_code(spec: EnvSpec) -> Settings:
    options = {"observe_average_velocity": False}
    return {
        "fitting.epochs": spec.epochs,
        "env_options": {name: options[name] for name in options if name in spec.options},
        "fitting.bootstrap": True,
        "fitting.drop_first_anchor": True,
        "fitting.context_weight_decay": False,
        "planner.selection_error": "sampled",
        "planner.selection_skips_newest": True,
        "planner.reward": "released",
    }


def _quick(spec: EnvSpec) -> Settings:
    return {
        "model.hidden_sizes": (128, 128, 128, 128),
        "collection.num_iterations": 5,
        "collection.num_episodes": 5,
        "collection.episode_length": min(spec.episode_length, 200),
        "fitting.epochs": 20,
        "fitting.warmup_iterations": 2,
        "fitting.relation_transitions": 20,
        "planner.horizon": 20,
        **_FAST_PLANNER,
        "evaluation.every": 5,
        "evaluation.num_episodes": 8,
    }


def _smoke(spec: EnvSpec) -> Settings:
    del spec
    return {
        "model.num_members": 2,
        "model.hidden_sizes": (16, 16),
        "model.context_hidden_sizes": (16,),
        "collection.num_iterations": 2,
        "collection.num_episodes": 2,
        "collection.episode_length": 20,
        "fitting.epochs": 2,
        "fitting.batch_size": 32,
        "fitting.warmup_iterations": 1,
        "fitting.relation_transitions": 4,
        "planner.horizon": 4,
        "planner.num_candidates": 16,
        "planner.num_elites": 4,
        "planner.num_iterations": 2,
        "planner.num_particles": 2,
        "evaluation.num_episodes": 2,
    }


_PRESETS = (
    Preset("paper", "the supplement's numbers; wants a GPU", _paper),
    Preset("fast", "the paper's, but for a planner of at most a tenth of its arithmetic", _fast),
    Preset("quick", "a smaller network, planner and schedule; minutes on a laptop", _quick),
    Preset("smoke", "tiny sizes that only show that everything runs; seconds", _smoke),
    Preset(
        "released-code",
        "the paper's numbers with every choice of the released code that differs from the paper",
        _released_code,
    ),
)

PRESETS: dict[str, Preset] = {preset.name: preset for preset in _PRESETS}
