"""Which settings cannot change a run, because its model or its planner has no use for them.

A setting that is not named here counts as used, always. Results are what training writes; a test
with another planner later (`headway evaluate`) may well read what training did not.
"""

import dataclasses
from collections.abc import Callable, Mapping

from headway.config.fitting import FittingConfig
from headway.config.model import BUILT_IN_KINDS
from headway.config.planner import PlannerConfig
from headway.config.run import Config

OPTIMIZER_SETTINGS: Mapping[str, tuple[str, ...]] = {
    "cem": ("num_elites", "smoothing", "initial_std"),
    "icem": (
        "num_elites", "smoothing", "initial_std", "noise_beta", "population_decay",
        "kept_elite_fraction",
    ),
    "mppi": ("initial_std", "noise_beta", "temperature"),
    "random-shooting": (),
}  # fmt: skip
"""What each optimizer reads of the planner's settings, beside what all of them read."""


def unused_settings(config: Config) -> frozenset[str]:
    """Dotted names of the settings whose values make no difference to this run's results.

    What a registered kind of model uses is not known, so all of them count.
    """
    if config.model.kind not in BUILT_IN_KINDS:
        return frozenset()
    idle = {name for used, names in _USED_WHEN if not used(config) for name in names}
    return frozenset(idle | _of_other_optimizers(config.planner))


def _of_other_optimizers(planner: PlannerConfig) -> set[str]:
    known = {name for names in OPTIMIZER_SETTINGS.values() for name in names}
    return {f"planner.{name}" for name in known - {*OPTIMIZER_SETTINGS[planner.optimizer]}}


def _learns(config: Config) -> bool:
    return config.model.learns


def _plans(config: Config) -> bool:
    return config.model.kind != "none"


def _is_multi_headed(config: Config) -> bool:
    return config.model.kind == "multi-headed"


def _heads_compete(config: Config) -> bool:
    several = _is_multi_headed(config) and config.model.num_heads > 1
    return several and config.fitting.oracle != "independent"


def _segments_compete(config: Config) -> bool:
    return _heads_compete(config) and config.fitting.oracle == "trajectory"


def _has_encoder(config: Config) -> bool:
    return config.model.context == "learned" and config.model.context_size > 0


def _has_backward_net(config: Config) -> bool:
    return config.model.backward_net


def _relates(config: Config) -> bool:
    return config.model.relation_head


def _adapts_by_gradient(config: Config) -> bool:
    return config.model.kind == "gradient-adapted"


def _is_recurrent(config: Config) -> bool:
    return config.model.kind == "recurrent"


def _samples_futures(config: Config) -> bool:
    return config.model.kind != "recurrent"


def _adapts_last_layer(config: Config) -> bool:
    return _is_multi_headed(config) and config.planner.adaptation == "last-layer"


def _has_env_processes(config: Config) -> bool:
    return config.collection.env_processes


def _whole(section: str, cls: type) -> tuple[str, ...]:
    """Every setting of a section."""
    return tuple(f"{section}.{field.name}" for field in dataclasses.fields(cls))


_USED_WHEN: tuple[tuple[Callable[[Config], bool], tuple[str, ...]], ...] = (
    (_learns, (*_whole("fitting", FittingConfig), "model.hidden_sizes", "model.history_length")),
    (_plans, _whole("planner", PlannerConfig)),
    (
        _is_multi_headed,
        (
            "fitting.oracle",
            "fitting.logvar_bound_weight",
            "fitting.weight_decay",
            "fitting.precision",
            "planner.head_selection",
            "planner.selection_error",
            "planner.selection_skips_newest",
            "planner.adaptation",
        ),
    ),
    (_heads_compete, ("fitting.warmup_iterations", "fitting.reduction")),
    (_segments_compete, ("fitting.segment_length",)),
    (_has_encoder, ("model.context_hidden_sizes", "fitting.context_weight_decay")),
    (_has_backward_net, ("model.backward_deterministic", "fitting.backward_weight")),
    (
        _relates,
        (
            "fitting.relation_temperature",
            "fitting.relation_distance_weight",
            "fitting.relation_transitions",
        ),
    ),
    (_adapts_by_gradient, ("model.adaptation_length", "model.adaptation_rate")),
    (_is_recurrent, ("fitting.backprop_steps",)),
    (_samples_futures, ("fitting.future_length",)),
    (_adapts_last_layer, ("planner.change_threshold",)),
    (_has_env_processes, ("collection.step_timeout_s",)),
)
