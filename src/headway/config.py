"""Every setting of a run: frozen, typed, checked, and written to JSON as it is.

Defaults are the paper's (supplement A.2, A.3); where the paper is silent they follow the released
code. A setting has a dotted name, for example `planner.horizon`. `model` and `planner.optimizer`
are tagged unions: `model.kind` and `planner.optimizer.name` choose a class, and what another class
has does not exist. Choosing another one keeps the settings that both have; the others take its
defaults (`override`).
"""

import dataclasses
import difflib
import functools
import operator
import re
import typing
from collections.abc import Mapping
from typing import Annotated, Any, Literal, TypeVar

import pydantic
from pydantic import Field

from headway.errors import ConfigError, did_you_mean, shown
from headway.sim_params import SimParamSets
from headway.spaces import Spaces

LARGEST = 10**9
"""No number of anything is larger; a file that says so is wrong, or means harm."""

Count = Annotated[int, Field(strict=True, ge=1, le=LARGEST)]
CountOrNone = Annotated[int, Field(strict=True, ge=0, le=LARGEST)]
Flag = Annotated[bool, Field(strict=True)]
Share = Annotated[float, Field(strict=True, ge=0, le=1)]
Weight = Annotated[float, Field(strict=True, ge=0, le=LARGEST)]
Rate = Annotated[float, Field(strict=True, ge=1e-12, le=1)]
Positive = Annotated[float, Field(strict=True, ge=1e-6, le=1e6)]
Std = Annotated[float, Field(strict=True, ge=1e-6, le=10)]
Beta = Annotated[float, Field(strict=True, ge=0, le=10)]
Widths = Annotated[tuple[Count, ...], Field(min_length=1, max_length=64)]

ContextKind = Literal["learned", "history", "sim-params"]
Precision = Literal["float32", "bfloat16"]

Section = TypeVar("Section")


@typing.dataclass_transform(frozen_default=True)
def settings(cls: type[Section]) -> type[Section]:
    """Make a frozen dataclass that refuses bad values with a `ConfigError` of one line.

    NumPy's scalars and arrays are taken as numbers and lists.
    """
    checks = pydantic.ConfigDict(extra="forbid", allow_inf_nan=False)
    checked: Any = pydantic.dataclasses.dataclass(frozen=True, config=checks)(cls)
    init = checked.__init__

    def checking(self, *args, **values):
        try:
            init(self, *map(_plain, args), **{name: _plain(v) for name, v in values.items()})
        except pydantic.ValidationError as error:
            raise ConfigError(_in_words(error)) from None

    checked.__init__ = checking
    return checked


def _plain(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {name: _plain(inner) for name, inner in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(inner) for inner in value]
    return value.tolist() if hasattr(value, "tolist") else value


def _tagged(table: Mapping[str, type], tag: str) -> pydantic.PlainValidator:
    """Build one of several classes from a table of settings whose `tag` names it."""

    def build(value: Any) -> Any:
        if isinstance(value, tuple(table.values())):
            return value
        if not isinstance(value, Mapping):
            raise ValueError(f" is {shown(value)}, allowed: a table of settings.")
        name = value.get(tag, next(iter(table)))
        if not isinstance(name, str) or name not in table:
            hint = did_you_mean(str(name), table)
            raise ValueError(f".{tag} is {shown(name)}.{hint} Allowed: {', '.join(table)}.")
        return pydantic.TypeAdapter(table[name]).validate_python(dict(value))

    return pydantic.PlainValidator(build)


class ModelConfig:
    """Settings of a kind of model; where it says nothing, one network without heads or context."""

    kind: Any  # a Literal in each class
    learns: bool = True
    """False where nothing is fitted."""
    num_members: int = 1
    num_heads: int = 1
    hidden_sizes: tuple[int, ...] = (0,)
    history_length: int = 10  # errors of all methods are measured on the same steps
    context: ContextKind = "learned"
    context_at: Literal["input", "last-hidden", "head"] = "head"
    context_size: int = 0
    context_hidden_sizes: tuple[int, ...] = ()
    backward_net: bool = False
    backward_deterministic: bool = False
    deterministic: bool = True
    relation_head: bool = False
    learned_reward: bool = False


@settings
class MultiHeadedConfig(ModelConfig):
    """An ensemble of multi-headed networks (supplement A.3)."""

    kind: Literal["multi-headed"] = "multi-headed"
    """The method chooses it."""
    num_members: Count = 5
    """Networks in the ensemble."""
    num_heads: Count = 3
    """Prediction heads of each network (H)."""
    hidden_sizes: Widths = (200, 200, 200, 200)
    """Widths of the backbone's hidden layers."""
    context: ContextKind = "learned"
    """Source of the networks' knowledge of the hidden physics: `learned` is the context encoder's
    vector, `history` the encoder's input as it is, `sim-params` the true simulator parameters."""
    context_at: Literal["input", "last-hidden", "head"] = "head"
    """Layer that the context joins: the `input`, the `last-hidden` one, or each `head`."""
    context_size: CountOrNone = 10
    """Width of a `learned` context; 0 builds no context encoder, and the networks see none."""
    context_hidden_sizes: Widths = (256, 128, 64)
    """Widths of the context encoder's hidden layers."""
    history_length: Count = 10
    """Past transitions that enter the context encoder (K)."""
    backward_net: Flag = True
    """A second network predicts backwards in time, to shape the context (A.4)."""
    deterministic: Flag = False
    """Heads predict a mean only and are fitted to the squared error."""
    backward_deterministic: Flag = False
    """The backward net is deterministic even where the forward net is not (CaDM)."""
    relation_head: Flag = False
    """A linear layer learns to tell which contexts come from the same trajectory, and
    thereby shapes the context (RIA); wants one head and a `learned` context."""
    learned_reward: Flag = False
    """The networks also predict the reward and the end of an episode, and plans count what they
    predict; always so where the Task has no `reward`."""

    def __post_init__(self):
        learned = self.context == "learned" and self.context_size > 0
        if self.relation_head and not (learned and self.num_heads == 1):
            raise ValueError(
                f"relation_head with num_heads {self.num_heads}, context {shown(self.context)} and"
                f" context_size {self.context_size}, allowed: one head and a learned context."
            )


@settings
class GradientAdaptedConfig(ModelConfig):
    """One network that a gradient step adapts to the newest transitions (GrBAL)."""

    kind: Literal["gradient-adapted"] = "gradient-adapted"
    """The method chooses it."""
    hidden_sizes: Widths = (512, 512, 512)
    """Widths of the hidden layers."""
    adaptation_length: Count = 16
    """Newest transitions that a gradient step adapts to while acting; in training, also the
    transitions that follow and judge the step."""
    adaptation_rate: Rate = 1e-3
    """Size of that step."""


@settings
class RecurrentConfig(ModelConfig):
    """A recurrent network (ReBAL)."""

    kind: Literal["recurrent"] = "recurrent"
    """The method chooses it."""
    hidden_sizes: Widths = (256,)
    """Widths of the recurrent layers."""


@settings
class SimulatorConfig(ModelConfig):
    """The simulator itself; nothing is fitted."""

    kind: Literal["simulator"] = "simulator"
    """The method chooses it."""
    learns = False


@settings
class NoModelConfig(ModelConfig):
    """Random actions; nothing is fitted."""

    kind: Literal["none"] = "none"
    """The method chooses it."""
    learns = False


@settings
class OwnModelConfig(ModelConfig):
    """A kind of model of your own that was registered without settings of its own."""

    kind: str
    """The method chooses it."""
    hidden_sizes: Widths = (200, 200, 200, 200)
    """Widths of hidden layers."""


_KINDS = MultiHeadedConfig, GradientAdaptedConfig, RecurrentConfig, SimulatorConfig, NoModelConfig
MODELS: dict[str, type[ModelConfig]] = {model.kind: model for model in _KINDS}
BUILT_IN_KINDS = tuple(MODELS)


@settings
class FittingConfig:
    """Fitting of the model to the data after each collection (supplement A.2, A.4)."""

    oracle: Literal["independent", "transition", "trajectory"] = "trajectory"
    """Reduction of the losses over heads once the warm-up is over."""
    segment_length: Count = 10
    """Consecutive transitions that share a winning head (M); used by `trajectory`."""
    warmup_iterations: CountOrNone = 3
    """First iterations, in which every head learns from all data independently."""
    epochs: Count = 50
    """Passes over the data per iteration."""
    min_updates: CountOrNone = 0
    """Updates per iteration at least: more passes while there are few data."""
    batch_size: Count = 256
    """Samples per member and update. Gradient-adapted: transitions per update, half of them to
    adapt to. Recurrent: transitions per update, in whole episodes, at least one."""
    precision: Precision = "float32"
    """Type of the networks' products while fitting, forwards and backwards. Sums, weights and Adam
    are always float32, and so are the first layers of the networks that predict. bfloat16 is
    faster where the processor multiplies it; RIA cannot use it."""
    learning_rate: Rate = 1e-3
    """Adam's step size."""
    future_length: Count = 5
    """Transitions ahead that are predicted with one context (F; released code)."""
    backprop_steps: Count = 100
    """Steps that the gradient flows back through time (recurrent; ReBAL)."""
    max_rollbacks: CountOrNone = 3
    """Most times in an iteration that a diverging epoch is made again, each with a quarter step."""
    backward_weight: Weight = 0.5
    """Weight of the backward net's loss (released code)."""
    logvar_bound_weight: Weight = 0.01
    """Pull of the learned variance bounds towards each other (PETS)."""
    weight_decay: Weight = 1.0
    """Factor on the released code's per-layer weight decay (2.5e-5 to 1e-4)."""
    context_weight_decay: Flag = True
    """The context encoder decays too; the released code forgets it."""
    reduction: Literal["head", "segment"] = "head"
    """Oracle loss: `head` averages within each head and sums over heads (released code);
    `segment` is the plain average (the paper's equation 2)."""
    bootstrap: Flag = False
    """Each member draws its own samples with replacement (released code, not paper)."""
    relation_temperature: Positive = 0.6
    """Softness of the weights exp(-distance / temperature) with which contexts of different
    trajectories count as the same where they predict the same (RIA)."""
    relation_distance_weight: Weight = 1.0
    """Weight of the loss that pulls predictions with contexts of one trajectory together (RIA)."""
    relation_transitions: CountOrNone = 0
    """Transitions of a batch on which all its contexts are compared; 0 takes the whole batch, as
    RIA does. The time of an update grows with it."""
    drop_first_anchor: Flag = False
    """The first anchor of every trajectory is left out (a defect of the released code)."""


class OptimizerConfig:
    """Settings of the search for the best action sequence."""

    name: Any  # a Literal in each class


@settings
class CEMConfig(OptimizerConfig):
    """The cross-entropy method (supplement A.2)."""

    name: Literal["cem"] = "cem"
    """cem, icem, random-shooting or ilqr; another one has other settings."""
    num_elites: Count = 50
    """Best candidates that shape the next iteration."""
    smoothing: Share = 0.1
    """Share of the old mean and spread that is kept at each iteration."""
    initial_std: Std = 0.5
    """Standard deviation of the first candidates, actions being scaled to [-1, 1]."""
    narrow_at_bounds: Flag = False
    """Candidates spread less near the bounds (the paper's way), where plans then stay for many
    steps after what is best has changed; otherwise they are clipped."""


@settings
class ICEMConfig(OptimizerConfig):
    """The cross-entropy method with coloured noise and memory (Pinneri et al., 2020)."""

    name: Literal["icem"] = "icem"
    """cem, icem, random-shooting or ilqr; another one has other settings."""
    num_elites: Count = 10
    """Best candidates that shape the next iteration."""
    smoothing: Share = 0.1
    """Share of the old mean and spread that is kept at each iteration."""
    initial_std: Std = 0.5
    """Standard deviation of the first candidates, actions being scaled to [-1, 1]."""
    noise_beta: Beta = 2.0
    """Exponent of the noise's power spectrum over the horizon: 0 white, 1 pink, 2 red; smoother
    for slow systems."""
    population_decay: Annotated[float, Field(strict=True, ge=1, le=LARGEST)] = 1.25
    """Factor by which each iteration draws fewer candidates, down to twice the elites."""
    kept_elite_fraction: Share = 0.3
    """Share of the elites that competes again in the next iteration and at the next step."""


@settings
class RandomShootingConfig(OptimizerConfig):
    """The best of uniformly random candidates, new ones in each iteration."""

    name: Literal["random-shooting"] = "random-shooting"
    """cem, icem, random-shooting or ilqr; another one has other settings."""


@settings
class ILQRConfig(OptimizerConfig):
    """The iterative linear-quadratic regulator, for unstable machines (Li and Todorov, 2004)."""

    name: Literal["ilqr"] = "ilqr"
    """cem, icem, random-shooting or ilqr; another one has other settings."""
    action_cost: Positive = 0.01
    """Cost of an action's square, scaled to [-1, 1], beside what the reward says: more is calmer.
    """


_SEARCHES = CEMConfig, ICEMConfig, RandomShootingConfig, ILQRConfig
OPTIMIZERS: dict[str, type[OptimizerConfig]] = {search.name: search for search in _SEARCHES}


@settings
class PlannerConfig:
    """Choice of actions with the model (supplement A.2)."""

    optimizer: Annotated[OptimizerConfig, _tagged(OPTIMIZERS, "name")] = CEMConfig()
    """Search for the best action sequence."""
    horizon: Count = 30
    """Imagined steps."""
    num_candidates: Count = 200
    """Action sequences drawn per optimizer iteration; in the first one with iCEM. With ilqr: shares
    of the best change that are tried; 8 are enough."""
    num_iterations: Count = 5
    """Optimizer iterations per plan."""
    num_particles: Count = 20
    """Imagined rollouts per candidate: a multiple of `model.num_members`, or 1: each candidate is
    imagined by one member, and compared with those of the same one (wants `particle_noise` none).
    ilqr imagines with the mean of all members instead."""
    particle_noise: Literal["independent", "none"] = "independent"
    """Noise of imagined steps: every rollout's own, or none: steps are the predicted means, one
    rollout a member."""
    precision: Precision = "float32"
    """Type of the networks' products while planning; sums and states are always float32."""
    head_selection: Literal["adaptive", "average"] = "adaptive"
    """Head that plans: the best on recent transitions, or the average of all."""
    selection_length: Count = 10
    """Past transitions on which heads compete (N)."""
    selection_error: Literal["mean", "sampled"] = "mean"
    """Error of the predicted mean in normalised units, or (released code) of samples in raw
    units."""
    selection_skips_newest: Flag = False
    """The newest transition is not used to select heads (released code)."""
    reward: Literal["task", "released"] = "task"
    """The environment's own reward, or the one that the released code plans with."""
    adaptation: Literal["none", "last-layer"] = "none"
    """Learning of the heads while they act: `last-layer` corrects their means by Bayesian
    regression on the episode so far. Its prior comes from the training data."""
    change_threshold: Weight = 0.0
    """Log Bayes factor for changed physics above which the corrections are dropped; 0 never does
    (last-layer)."""

    def __post_init__(self):
        elites = getattr(self.optimizer, "num_elites", 0)
        share = 2 if self.optimizer.name == "icem" else 1
        if share * elites > self.num_candidates:
            most = f"at most {'half of ' * (share == 2)}num_candidates ({self.num_candidates})"
            raise _refused(self, "optimizer.num_elites", most)
        if self.selection_skips_newest and self.selection_length == 1:
            raise ValueError(
                "selection_skips_newest leaves nothing of a selection_length of 1, allowed: 2 or"
                " more."
            )


@settings
class CollectionConfig:
    """Amount of data that is collected (supplement A.2)."""

    num_iterations: Count = 10
    """Rounds of collecting and fitting; the first one acts at random."""
    num_episodes: Count = 10
    """Episodes per iteration, all stepped and planned together."""
    min_steps: CountOrNone = 0
    """Steps per iteration at least: more rounds of `num_episodes` while episodes end early."""
    episode_length: CountOrNone = 0
    """Steps per episode; 0 takes the environment's own."""
    max_bad_episodes: CountOrNone = 1
    """Most episodes of an iteration that are dropped because they broke: a number was not finite,
    a simulation diverged, a process hung or died."""
    env_processes: Flag = False
    """Every environment runs in a process of its own, also in tests, so that one that
    hangs or crashes costs its episode only; slower where steps are quick."""
    step_timeout_s: Annotated[float, Field(strict=True, ge=1e-3, le=1e6)] = 60.0
    """Seconds that a step or reset may take before its process is given up (env_processes)."""
    num_checkpoints: Annotated[int, Field(strict=True, ge=2, le=LARGEST)] = 2
    """Newest iterations that can be loaded; the best one is kept as well."""
    check: Flag = True
    """An environment of your own is compared with its Task before training, as `headway check`
    does, and with what it was when the run was begun."""


@settings
class EvaluationConfig:
    """Tests of controllers; test episodes have fixed seeds, the same for every method."""

    every: Count = 1
    """Iterations between tests on the unseen groups; the last iteration is always tested."""
    num_episodes: Annotated[int, Field(strict=True, ge=1, le=1000)] = 10
    """Episodes per group, spread evenly over the group's simulator parameters."""
    training_group: Literal["last", "always"] = "last"
    """When the training physics are tested too: after the last iteration, or at every test."""
    seed: Annotated[int, Field(strict=True, ge=0, le=2**30)] = 10_000
    """Seed of the first test episode; the others follow it."""
    max_bad_episodes: CountOrNone = 0
    """Most test episodes of an iteration that are left out because they broke; what is left may
    look better than it is."""


def _sim_params(value: Any) -> SimParamSets | None:
    if value is None or isinstance(value, SimParamSets):
        return value
    return SimParamSets.from_dict(value)


@settings
class Config:
    """Everything that decides a run's numbers."""

    env: str
    """Short name of the environment."""
    method: str = "tmcl"
    """Name of the method the settings started from."""
    preset: str = "paper"
    """Name of the preset the settings started from."""
    seed: Annotated[int, Field(strict=True, ge=0, le=2**31 - 1)] = 0
    """Seeds environments, physics, initial weights, batches and planner."""
    env_options: Mapping[str, pydantic.JsonValue] = dataclasses.field(default_factory=dict)
    """Options of the environment that differ from its defaults."""
    sim_params: Annotated[SimParamSets | None, pydantic.PlainValidator(_sim_params)] = None
    """Training and unseen simulator parameters; None takes the environment's own."""
    spaces: Spaces | None = None
    """Observation and action space; read from the environment when a run begins."""
    log: Mapping[str, pydantic.JsonValue] | None = None
    """The recordings that the first iterations (`rounds`) fit; None where all data are collected.
    """
    model: Annotated[ModelConfig, _tagged(MODELS, "kind")] = MultiHeadedConfig()
    """The dynamics model."""
    fitting: FittingConfig = FittingConfig()
    """Fitting the model."""
    planner: PlannerConfig = PlannerConfig()
    """Planning with the model."""
    collection: CollectionConfig = CollectionConfig()
    """Collecting data."""
    evaluation: EvaluationConfig = EvaluationConfig()
    """Testing."""

    def __post_init__(self):
        model, planner = self.model, self.planner
        simulated = model.kind == "simulator"
        members = model.num_members
        if planner.particle_noise == "none":
            if planner.num_particles not in (1, members):
                allowed = f"1 or model.num_members ({members}) without noise"
                raise _refused(self, "planner.num_particles", allowed)
        elif planner.num_particles % members:
            allowed = f"a multiple of model.num_members ({members}), or 1 without particle_noise"
            raise _refused(self, "planner.num_particles", allowed)
        if planner.adaptation != "none" and model.kind in BUILT_IN_KINDS[1:]:
            allowed = f"none with a model of kind {model.kind}, which has no heads"
            raise _refused(self, "planner.adaptation", allowed)
        continuous = self.spaces is None or self.spaces.action_kind == "box"
        own_reward = planner.reward == "task" and not model.learned_reward
        fit = own_reward and continuous and model.kind not in ("recurrent", "simulator")
        if planner.optimizer.name == "ilqr" and not fit:
            allowed = "another search, or the Task's own reward, continuous actions, and a model"
            raise _refused(self, "planner.optimizer.name", f"{allowed} without inner state")
        if self.fitting.precision != "float32" and model.relation_head:
            allowed = "float32 with a relation head, whose losses are most of a fit"
            raise _refused(self, "fitting.precision", allowed)
        if simulated and planner.num_particles > 1:
            raise _refused(self, "planner.num_particles", "1, because the simulator has no noise")
        if simulated and planner.reward != "task":
            raise _refused(self, "planner.reward", "task, which the simulator pays")
        if simulated and self.collection.env_processes:
            allowed = "False with plans on the simulator itself"
            raise _refused(self, "collection.env_processes", allowed)


def _refused(section: Any, name: str, allowed: str) -> ValueError:
    value = operator.attrgetter(name)(section)
    return ValueError(f"{name} is {shown(value)}, allowed: {allowed}.")


_UNIONS = (("model", "kind", MODELS), ("planner.optimizer", "name", OPTIMIZERS))
"""Section, setting that chooses its class, classes by the values of it."""

TOLERANCE = (
    "collection.max_bad_episodes",
    "collection.env_processes",
    "collection.step_timeout_s",
    "collection.num_checkpoints",
    "collection.check",
    "evaluation.max_bad_episodes",
)
"""Settings about checkpoints, and about environments that are wrong or break; the numbers of sound
episodes do not depend on it, so a run may go on with other values."""


def to_dict(config: Config) -> dict[str, Any]:
    """Return the settings as nested dictionaries of plain values."""
    return dataclasses.asdict(config)


def from_dict(values: Mapping[str, Any]) -> Config:
    """Rebuild the settings that `to_dict` wrote; what is left out has its default.

    Raises:
        ConfigError: A setting is unknown, of the wrong type or out of range.
    """
    try:
        return pydantic.TypeAdapter(Config).validate_python(_plain(values))
    except pydantic.ValidationError as error:
        raise ConfigError(_in_words(error)) from None


def override(config: Config, settings: Mapping[str, Any]) -> Config:
    """Return `config` with some settings replaced.

    Args:
        config: The settings to start from.
        settings: New values by dotted name, for example `{"planner.horizon": 20}`. Another
            `model.kind` or `planner.optimizer.name` keeps the settings that both have.

    Raises:
        ConfigError: A setting is unknown, of the wrong type or out of range.
    """
    values = to_dict(config)
    for path, tag, classes in _UNIONS:
        chosen = classes.get(str(settings.get(f"{path}.{tag}")))
        if chosen is not None:
            *above, last = path.split(".")
            fields = {field.name for field in dataclasses.fields(chosen)}  # pyright: ignore
            section = functools.reduce(operator.getitem, above, values)
            section[last] = {name: v for name, v in section[last].items() if name in fields}
    sections = {name.rpartition(".")[0] for name in known_settings()}
    for name, value in settings.items():
        *above, last = name.split(".")
        if name in sections or ".".join(above) not in sections:
            raise ConfigError(_unknown(name))
        functools.reduce(operator.getitem, above, values)[last] = value
    return from_dict(values)


def known_settings() -> dict[str, list[str]]:
    """Every setting that there is, by dotted name, and the choices of a union that have it."""
    known: dict[str, list[str]] = {name: [] for name in flatten(to_dict(Config(env="")))}
    for path, tag, classes in _UNIONS:
        for choice, cls in classes.items():
            for field in dataclasses.fields(cls):  # pyright: ignore[reportArgumentType]
                known.setdefault(f"{path}.{field.name}", []).append(f"{path}.{tag} {choice}")
    return known


def _unknown(name: str) -> str:
    """Word the error for a setting that does not exist, with the closest one that does."""
    known, name = known_settings(), name[:80]
    if known.get(name):
        return f"{name} is a setting of {' and '.join(known[name])} only; leave it out."
    close = difflib.get_close_matches(name, known, n=1, cutoff=0.4)
    tails = {full.rpartition(".")[2]: full for full in known}
    near = difflib.get_close_matches(name.rpartition(".")[2], tails, n=1)
    if (near and near[0] == name.rpartition(".")[2]) or not close:
        close = [tails[tail] for tail in near]
    hint = f" Did you mean {close[0]!r}?" if close else ""
    return f"unknown setting {name!r}.{hint} `headway train ENV --help-all` lists all settings."


def _in_words(error: pydantic.ValidationError) -> str:
    """Say all that is wrong in one line: what, got, allowed."""
    lines = []
    for found in error.errors(include_url=False):
        name = ".".join(part for part in found["loc"] if isinstance(part, str))
        kind, allowed = found["type"], found["msg"].removeprefix("Input should be ")
        if kind == "unexpected_keyword_argument":
            lines.append(_unknown(name))
        elif kind == "missing":
            lines.append(f"the settings lack {name}.")
        elif kind == "value_error":  # of a check of ours
            text = str(found.get("ctx", {})["error"])
            apart = "" if not name or text.startswith((name, " ", ".")) else "."
            lines.append(f"{'' if text.startswith(name) else name}{apart}{text}")
        else:
            choices = re.findall("'(.*?)'", allowed) if kind == "literal_error" else ()
            hint = did_you_mean(str(found["input"]), choices)
            got = f"{name or 'the settings'} is {shown(found['input'])}"
            lines.append(f"{got}, allowed: {allowed}.{hint}")
    return " ".join(lines)


def differences(old: Config, new: Config) -> list[str]:
    """Return one line per setting that differs, for people to read."""
    before, after = flatten(to_dict(old)), flatten(to_dict(new))
    return [
        f"{name}: {shown(before.get(name))} -> {shown(after.get(name))}"
        for name in sorted({*before, *after})
        if before.get(name) != after.get(name)
    ]


def tolerating_as(config: Config, other: Config) -> Config:
    """Return `config` with the `TOLERANCE` of another one; and its spaces, if one has none yet."""
    values = flatten(to_dict(other))
    found = override(config, {name: values[name] for name in TOLERANCE})
    unknown = None in (config.spaces, other.spaces)
    return dataclasses.replace(found, spaces=other.spaces) if unknown else found


def flatten(
    values: Mapping[str, Any], prefix: str = "", whole: tuple[str, ...] = ()
) -> dict[str, Any]:
    """Return the values of nested tables by dotted name; some tables stay whole."""
    flat = {}
    for name, value in values.items():
        if isinstance(value, Mapping) and value and name not in whole:
            flat |= flatten(value, f"{prefix}{name}.", whole)
        else:
            flat[prefix + name] = list(value) if isinstance(value, tuple) else value
    return flat
