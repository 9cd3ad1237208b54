"""The table of methods: named settings, not classes; and how a configuration is put together.

A configuration starts from the paper's defaults, takes the preset's settings, then the
method's, then the user's.
"""

import dataclasses
from collections.abc import Mapping

from headway.config import PLAIN, Config
from headway.config.unused import unused_settings
from headway.errors import ConfigError, unknown_name
from headway.experiment.presets import PRESETS, Settings
from headway.settings import TOLERANCE, flatten, override, setting_names, to_dict
from headway.task import env_spec, sim_param_sets


@dataclasses.dataclass(frozen=True)
class Method:
    """A way of learning and planning, as differences from T-MCL."""

    name: str
    """How the command line names it."""
    description: str
    """One line for lists."""
    settings: Settings
    """What differs from T-MCL, by dotted name."""
    by_preset: Mapping[str, Settings] = dataclasses.field(default_factory=dict)
    """What replaces some of them in a preset, by its name."""


_NO_CONTEXT: Settings = {"model.context_size": 0, "model.backward_net": False}

_PLAIN: Settings = {
    **{f"model.{name}": value for name, value in PLAIN.items()},
    "fitting.oracle": "independent",
    "fitting.future_length": 1,
    "planner.num_particles": 1,
}
"""One network without heads, context or noise."""

_KEEP_LEARNING: Settings = {"planner.adaptation": "last-layer", "planner.change_threshold": 20.0}
"""What was learned is dropped when the physics change; where they do not, it costs nothing."""

_ONLY_A_TEST: Settings = {"collection.num_iterations": 1}
_ONE_HEAD: Settings = {"model.num_heads": 1, "fitting.oracle": "independent"}
_PETS: Settings = {**_NO_CONTEXT, **_ONE_HEAD, "fitting.future_length": 1}
_VANILLA: Settings = {
    **_ONE_HEAD,
    "model.num_members": 1,
    "model.deterministic": True,
    "planner.num_particles": 1,
}
_CADM: Settings = {
    "model.context_at": "input",
    "fitting.future_length": 10,
    "fitting.context_weight_decay": True,
}

_METHODS = (
    Method("tmcl", "trajectory-wise multiple choice learning (the paper's method)", {}),
    Method(
        "tmcl-bayes",
        "T-MCL whose heads keep learning while they act: a Bayesian last layer",
        _KEEP_LEARNING,
    ),
    Method(
        "mcl",
        "multiple choice learning: heads compete for single transitions (Fig. 13)",
        {"fitting.oracle": "transition"},
    ),
    Method(
        "pets",
        "ensemble of single-headed probabilistic networks, no context (Chua et al., 2018)",
        _PETS,
    ),
    Method(
        "pets-bayes",
        "PETS whose head keeps learning while it acts: a Bayesian last layer",
        {**_PETS, **_KEEP_LEARNING},
    ),
    Method(
        "mh-pets",
        "PETS with several heads that all learn from all data; plans with their average (Fig. 10)",
        {
            **_NO_CONTEXT,
            "fitting.oracle": "independent",
            "fitting.future_length": 1,
            "planner.head_selection": "average",
        },
    ),
    Method(
        "vanilla",
        "one deterministic network",
        {
            **_NO_CONTEXT,
            **_VANILLA,
            "fitting.future_length": 1,
        },
    ),
    Method(
        "stacked",
        "vanilla with the flattened history appended to the input",
        {
            **_VANILLA,
            "model.context": "history",
            "model.context_at": "input",
            "model.backward_net": False,
            "fitting.future_length": 1,
        },
    ),
    Method(
        "cadm",
        "vanilla with a learned context at the input (Lee et al., 2020)",
        {**_VANILLA, **_CADM},
    ),
    Method(
        "pets-cadm",
        "PETS with CaDM's learned context at the input (Lee et al., 2020)",
        {**_ONE_HEAD, **_CADM, "model.backward_deterministic": True},
    ),
    Method(
        "oracle-params",
        "PETS that is told the true simulator parameters, an upper line; not a fair method",
        {
            **_ONE_HEAD,
            "model.context": "sim-params",
            "model.context_at": "input",
            "model.backward_net": False,
            "fitting.future_length": 1,
        },
    ),
    Method(
        "ria",
        "one head, context shaped by relational intervention (Guo et al., 2022)",
        {
            **_ONE_HEAD,
            "model.context_at": "last-hidden",
            "model.relation_head": True,
            "fitting.batch_size": 200,
            "fitting.context_weight_decay": False,  # the relation loss decays it
        },
    ),
    Method(
        "grbal",
        "one network that a gradient step adapts online (Nagabandi et al., 2019)",
        {
            **_PLAIN,
            "model.kind": "gradient-adapted",
            "model.hidden_sizes": (512, 512, 512),
        },
        {
            "quick": {"model.hidden_sizes": (128, 128, 128)},
            "smoke": {"model.hidden_sizes": (16, 16)},
        },
    ),
    Method(
        "rebal",
        "one recurrent network that remembers the episode (Nagabandi et al., 2019)",
        {
            **_PLAIN,
            "model.kind": "recurrent",
            "model.hidden_sizes": (256,),
            "fitting.learning_rate": 1e-2,
        },
        {
            "quick": {"model.hidden_sizes": (128,)},
            "smoke": {"model.hidden_sizes": (16,)},
        },
    ),
    Method(
        "random",
        "uniform random actions; nothing is learned",
        {**_PLAIN, **_ONLY_A_TEST, "model.kind": "none"},
    ),
    Method(
        "true-dynamics",
        "the same planner on the real simulator: the environment's ceiling",
        {**_PLAIN, **_ONLY_A_TEST, "model.kind": "simulator", "planner.reward": "task"},
    ),
)


EVALUATED_SECTIONS = ("planner", "evaluation")  # what a trained run can be tested with

METHODS: dict[str, Method] = {method.name: method for method in _METHODS}
_BUILT_IN = tuple(METHODS)


def register_method(method: Method) -> None:
    """Add a method of your own, or replace an earlier one of the same name.

    Its settings may name a `model.kind` of your own (`register_learner`).

    Raises:
        ConfigError: It has the name of a built-in method, or its settings are not allowed.
    """
    if method.name in _BUILT_IN or not method.name:
        raise ConfigError(
            f"method name {method.name!r} is not free, allowed: any but {', '.join(_BUILT_IN)}."
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
        if name not in table:
            raise unknown_name(kind, name, table)
    for name in ("env", "method", "preset", "seed"):
        if name in (settings or {}):
            raise ConfigError(f"{name} is no setting to override; pass it as {name}=... instead.")
    chosen = METHODS[method]
    named = {
        **PRESETS[preset].settings(spec),
        **chosen.settings,
        **chosen.by_preset.get(preset, {}),
    }
    start = Config(env=spec.name, method=method, preset=preset)
    config = override(start, {**named, "seed": seed, **(settings or {})})
    check_options(config)
    return config


def config_to_evaluate(config: Config, settings: Settings) -> Config:
    """The settings of a trained run with some of its tests' replaced.

    Args:
        config: The settings that the run was trained with.
        settings: Changes by dotted name, of the sections in `EVALUATED_SECTIONS` only, and of
            what is done about environments that break (`settings.TOLERANCE`).

    Raises:
        ConfigError: A setting is unknown, of the wrong type or out of range, one that training
            has fixed, or one that could change nothing.
    """
    for name in set(settings) - set(TOLERANCE):
        if name in setting_names(config) and name.partition(".")[0] not in EVALUATED_SECTIONS:
            raise ConfigError(
                f"{name} is fixed by training, allowed: settings of"
                f" {' and '.join(EVALUATED_SECTIONS)}; train another run to change it."
            )
    changed = override(config, settings)
    before, after = (flatten(to_dict(each)) for each in (config, changed))
    for name in sorted(unused_settings(changed) & settings.keys()):
        if before[name] != after[name]:
            raise ConfigError(
                f"{name} would change nothing for {config.method} with the other settings,"
                " allowed: settings that are used; leave it out, or change what it belongs to."
            )
    return changed


def config_to_control(config: Config, settings: Settings) -> Config:
    """The settings of a trained run with some of its planner's replaced, for a controller.

    Args:
        config: The settings that the run was trained with.
        settings: Changes by dotted name, of the section `planner` only.

    Raises:
        ConfigError: As `config_to_evaluate`; or a setting means nothing to a controller.
    """
    changed = config_to_evaluate(config, settings)
    for name in settings:
        if not name.startswith("planner."):
            raise ConfigError(f"{name} means nothing to a controller, allowed: planner settings.")
    return changed


def told_sim_params(config: Config) -> tuple[str, ...]:
    """The simulator parameters that the model is told, by name; none but with `sim-params`."""
    if config.model.context != "sim-params":
        return ()
    return sim_param_sets(config).names


def check_options(config: Config) -> None:
    """Refuse switches that the environment does not have.

    Raises:
        ConfigError: An option is unknown.
    """
    spec = env_spec(config.env)
    for option in config.env_options:
        if option not in spec.options:
            raise ConfigError(str(unknown_name(f"{spec.name} option", option, spec.options)))
