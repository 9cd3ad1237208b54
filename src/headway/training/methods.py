"""Methods and presets: tables of settings by name, and how a configuration is put together.

A configuration starts from the paper's defaults, takes the preset's settings, then the method's,
then the user's.
"""

import dataclasses
from collections.abc import Callable, Mapping
from typing import Any

from headway.config import TOLERANCE, Config, MultiHeadedConfig, known_settings, override
from headway.errors import ConfigError, check_names
from headway.task import (
    BUILT_IN,
    EnvSpec,
    env_options,
    env_spec,
    episode_length,
    sim_param_sets,
    task_of,
)

Settings = Mapping[str, Any]
"""Values by dotted name."""


@dataclasses.dataclass(frozen=True)
class Method:
    """A way of learning and planning, as differences from T-MCL."""

    name: str
    """Short name, as the command line takes it."""
    description: str
    """One line for lists."""
    settings: Settings
    """Settings that differ from T-MCL, by dotted name."""
    by_preset: Mapping[str, Settings] = dataclasses.field(default_factory=dict)
    """Settings that replace some of them in a preset, by its name."""


@dataclasses.dataclass(frozen=True)
class Preset:
    """A scale of experiment; `settings` may depend on the environment."""

    name: str
    """Short name, as the command line takes it."""
    description: str
    """One line for lists."""
    settings: Callable[[EnvSpec], Settings]


NO_CONTEXT = {"model.context_size": 0, "model.backward_net": False}
ONE_HEAD = {"model.num_heads": 1, "fitting.oracle": "independent"}
ONE_STEP = {"fitting.future_length": 1}
ONE_NETWORK = {
    **ONE_HEAD,
    "model.num_members": 1,
    "model.deterministic": True,
    "planner.num_particles": 1,
}
CADM = {
    "model.context_at": "input",
    "fitting.future_length": 10,
    "fitting.context_weight_decay": True,
}
AT_INPUT = {**ONE_STEP, "model.context_at": "input", "model.backward_net": False}
PETS = {**NO_CONTEXT, **ONE_HEAD, **ONE_STEP}
NO_HEADS = {"fitting.oracle": "independent", **ONE_STEP, "planner.num_particles": 1}
ONLY_A_TEST = {"collection.num_iterations": 1}
KEEP_LEARNING = {"planner.adaptation": "last-layer", "planner.change_threshold": 20.0}

_METHODS = (
    Method("tmcl", "trajectory-wise multiple choice learning (the paper's method)", {}),
    Method(
        "tmcl-bayes",
        "T-MCL whose heads keep learning while they act: a Bayesian last layer",
        KEEP_LEARNING,
    ),
    Method(
        "mcl",
        "multiple choice learning: heads compete for single transitions (Fig. 13)",
        {"fitting.oracle": "transition"},
    ),
    Method(
        "pets",
        "ensemble of single-headed probabilistic networks, no context (Chua et al., 2018)",
        PETS,
    ),
    Method(
        "pets-bayes",
        "PETS whose head keeps learning while it acts: a Bayesian last layer",
        {**PETS, **KEEP_LEARNING},
    ),
    Method(
        "mh-pets",
        "PETS with several heads that all learn from all data; plans with their average (Fig. 10)",
        {
            **NO_CONTEXT,
            **ONE_STEP,
            "fitting.oracle": "independent",
            "planner.head_selection": "average",
        },
    ),
    Method("vanilla", "one deterministic network", {**NO_CONTEXT, **ONE_NETWORK, **ONE_STEP}),
    Method(
        "stacked",
        "vanilla with the flattened history appended to the input",
        {**ONE_NETWORK, **AT_INPUT, "model.context": "history"},
    ),
    Method(
        "cadm",
        "vanilla with a learned context at the input (Lee et al., 2020)",
        {**ONE_NETWORK, **CADM},
    ),
    Method(
        "pets-cadm",
        "PETS with CaDM's learned context at the input (Lee et al., 2020)",
        {**ONE_HEAD, **CADM, "model.backward_deterministic": True},
    ),
    Method(
        "oracle-params",
        "PETS that is told the true simulator parameters, an upper line; not a fair method",
        {**ONE_HEAD, **AT_INPUT, "model.context": "sim-params"},
    ),
    Method(
        "ria",
        "one head, context shaped by relational intervention (Guo et al., 2022)",
        {
            **ONE_HEAD,
            "model.context_at": "last-hidden",
            "model.relation_head": True,
            "fitting.batch_size": 200,
            "fitting.context_weight_decay": False,  # the relation loss decays it
        },
    ),
    Method(
        "grbal",
        "one network that a gradient step adapts online (Nagabandi et al., 2019)",
        {**NO_HEADS, "model.kind": "gradient-adapted", "model.hidden_sizes": (512, 512, 512)},
        {
            "quick": {"model.hidden_sizes": (128, 128, 128)},
            "smoke": {"model.hidden_sizes": (16, 16)},
        },
    ),
    Method(
        "rebal",
        "one recurrent network that remembers the episode (Nagabandi et al., 2019)",
        {
            **NO_HEADS,
            "model.kind": "recurrent",
            "model.hidden_sizes": (256,),
            "fitting.learning_rate": 1e-2,
        },
        {"quick": {"model.hidden_sizes": (128,)}, "smoke": {"model.hidden_sizes": (16,)}},
    ),
    Method(
        "random",
        "uniform random actions; nothing is learned",
        {**NO_HEADS, **ONLY_A_TEST, "model.kind": "none"},
    ),
    Method(
        "true-dynamics",
        "the same planner on the real simulator: the environment's ceiling",
        {**NO_HEADS, **ONLY_A_TEST, "model.kind": "simulator", "planner.reward": "task"},
    ),
)

METHODS: dict[str, Method] = {method.name: method for method in _METHODS}
REFERENCES = ("random", "true-dynamics")

PAPERS_SEARCH = {"planner.optimizer.narrow_at_bounds": True}
SMALL_SEARCH = {
    "planner.optimizer.name": "icem",
    "planner.optimizer.num_elites": 10,
    "planner.optimizer.noise_beta": 0.25,
    "planner.optimizer.initial_std": 0.3,
    "planner.horizon": 20,
    "planner.num_candidates": 100,
    "planner.num_iterations": 3,
    "planner.num_particles": 1,
    "planner.particle_noise": "none",
}
"""At most 1 % of the paper's arithmetic, for its return or more (docs/methods.md)."""


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
        **PAPERS_SEARCH,
    }


def _quick(spec: EnvSpec) -> Settings:
    full = 5 * (spec.episode_length or 200)  # steps of five episodes that do not end early
    return {
        "model.hidden_sizes": (128, 128, 128, 128),
        "collection.num_iterations": 5,
        "collection.num_episodes": 5,
        "fitting.epochs": 20,
        "fitting.warmup_iterations": 2,
        "fitting.relation_transitions": 20,
        **SMALL_SEARCH,
        "evaluation.every": 5,
        "evaluation.num_episodes": 8,
        "collection.min_steps": 0 if spec.name in BUILT_IN else min(1000, full),
    }


def _smoke(spec: EnvSpec) -> Settings:
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
        "planner.optimizer.num_elites": 4,
        "planner.num_iterations": 2,
        "planner.num_particles": 2,
        "evaluation.num_episodes": 2,
    }


_PRESETS = (
    Preset(
        "paper",
        "the supplement's numbers; wants a GPU",
        lambda spec: {"fitting.epochs": spec.epochs, **PAPERS_SEARCH},
    ),
    Preset(
        "fast",
        "the paper's, but for a planner of a hundredth of its arithmetic",
        lambda spec: {"fitting.epochs": spec.epochs, **SMALL_SEARCH},
    ),
    Preset(
        "quick",
        "a smaller network and schedule; minutes on a laptop, half an hour for a robot",
        _quick,
    ),
    Preset("smoke", "tiny sizes that only show that everything runs; seconds", _smoke),
    Preset(
        "released-code",
        "the paper's numbers with every choice of the released code that differs from the paper",
        _released_code,
    ),
)

PRESETS: dict[str, Preset] = {preset.name: preset for preset in _PRESETS}


def register_method(method: Method) -> None:
    """Add a method of your own, or replace an earlier one of the same name.

    Its settings may name a `model.kind` of your own (`register_model`).

    Raises:
        ConfigError: It has the name of a built-in method, or its settings are not allowed.
    """
    built_in = [one.name for one in _METHODS]
    if method.name in built_in or not method.name:
        raise ConfigError(
            f"method name {method.name!r} is not free, allowed: any but {', '.join(built_in)}."
        )
    override(Config(env="pendulum", method=method.name), method.settings)
    METHODS[method.name] = method


def make_config(
    env: str,
    *,
    method: str = "tmcl",
    preset: str = "paper",
    seed: int = 0,
    settings: Settings | None = None,
) -> Config:
    """Resolve a configuration.

    Args:
        env: Short name or id of the environment.
        method: A name in `METHODS`.
        preset: A name in `PRESETS`.
        seed: Seeds everything.
        settings: Changes by dotted name, for example `{"planner.horizon": 20}`.

    Raises:
        UnknownNameError: No such environment, method or preset.
        ConfigError: A setting is unknown, of the wrong type or out of range.
    """
    spec = env_spec(env)
    for kind, name, table in (("method", method, METHODS), ("preset", preset, PRESETS)):
        check_names(kind, [name], table)
    for name in ("env", "method", "preset", "seed"):
        if name in (settings or {}):
            raise ConfigError(f"{name} is no setting to override; pass it as {name}=... instead.")
    chosen = METHODS[method]
    config = Config(env=spec.name, method=method, preset=preset)
    config = override(config, PRESETS[preset].settings(spec))
    config = override(config, spec.quick if preset == "quick" else {})
    own = {**chosen.settings, **chosen.by_preset.get(preset, {}), "seed": seed}
    config = override(config, {**own, **(settings or {})})  # together: each may need the other
    env_options(config)  # refuses unknown ones
    if config.model.learns and not task_of(config).has_reward:
        if not isinstance(config.model, MultiHeadedConfig):
            raise ConfigError(
                f"the Task of {config.env} has no reward, and {method} learns none, allowed: a"
                " method with a multi-headed model, as tmcl; or write the reward."
            )
        config = override(config, {"model.learned_reward": True})
    if not episode_length(config):
        config = override(config, {"collection.episode_length": _time_limit(spec)})
    return config


def _time_limit(spec: EnvSpec) -> int:
    """Steps after which Gymnasium cuts an episode of an environment."""
    from headway.envs.built_in import registered
    from headway.training.environments import raising

    limit = None
    if isinstance(spec.env_id, str):
        with raising(spec.name, "creation"):
            limit = registered(spec.env_id).max_episode_steps
    if limit is None:
        raise ConfigError(
            f"environment {spec.name!r} has episode_length 0, and Gymnasium knows no time limit of"
            " it, allowed: at least 1, there or as collection.episode_length."
        )
    return limit


def config_to_evaluate(
    config: Config, settings: Settings, sections: tuple[str, ...] = ("planner", "evaluation")
) -> Config:
    """Return the settings of a trained run with some of those that training did not fix replaced.

    Args:
        config: The settings that the run was trained with.
        settings: Changes by dotted name, of these sections and of what is done about environments
            that break (`config.TOLERANCE`).
        sections: Sections that may change; `("planner",)` for a controller.

    Raises:
        ConfigError: A setting is unknown, of the wrong type or out of range, or may not change.
    """
    for name in sorted(set(settings) & set(known_settings()) - set(TOLERANCE)):
        if name.partition(".")[0] not in sections:
            raise ConfigError(
                f"{name} cannot change here, allowed: settings of {' and '.join(sections)};"
                " train another run to change what it is trained with."
            )
    return override(config, settings)


def told_sim_params(config: Config) -> tuple[str, ...]:
    """Names of the simulator parameters that the model is told; none but with `sim-params`."""
    if config.model.context != "sim-params":
        return ()
    return sim_param_sets(config).names
