"""What each command takes. The field docstrings are the help texts."""

import dataclasses
from pathlib import Path
from typing import Annotated, Literal, TypeVar

import tyro

from headway.config import (
    CollectionConfig,
    Config,
    EvaluationConfig,
    FittingConfig,
    ModelConfig,
    PlannerConfig,
)

Flag = Annotated[bool, tyro.conf.FlagCreatePairsOff, tyro.conf.arg(help_behavior_hint="")]


def default_text(text: str):
    """What help says of the default of an option, in words."""
    return tyro.conf.arg(help_behavior_hint=f"(default: {text})")


class _Unchecked:
    """Leaves the checks to the library, which words them better than a parser can."""

    def __post_init__(self):
        pass


@dataclasses.dataclass(frozen=True)
class ModelSettings(_Unchecked, ModelConfig):
    """The dynamics model: an ensemble of multi-headed networks."""


@dataclasses.dataclass(frozen=True)
class FittingSettings(_Unchecked, FittingConfig):
    """How the model is fitted to the data after each collection."""


@dataclasses.dataclass(frozen=True)
class PlannerSettings(_Unchecked, PlannerConfig):
    """How actions are chosen with the model."""


@dataclasses.dataclass(frozen=True)
class CollectionSettings(_Unchecked, CollectionConfig):
    """How much data is collected."""


@dataclasses.dataclass(frozen=True)
class EvaluationSettings(_Unchecked, EvaluationConfig):
    """How controllers are tested."""


SECTIONS = {
    "model": ModelSettings,
    "fitting": FittingSettings,
    "planner": PlannerSettings,
    "collection": CollectionSettings,
    "evaluation": EvaluationSettings,
}


WithSettings = TypeVar("WithSettings", bound="Train | Evaluate | Record | Diagnose")
AboutRun = TypeVar("AboutRun", bound="Evaluate | Record | Diagnose")


def with_settings(arguments: WithSettings, config: Config) -> WithSettings:
    """The same arguments with the settings of a configuration."""
    sections = {name: cls for name, cls in SECTIONS.items() if hasattr(arguments, name)}
    values = {name: dataclasses.asdict(getattr(config, name)) for name in sections}
    return dataclasses.replace(arguments, **{n: cls(**values[n]) for n, cls in sections.items()})


def changed_settings(arguments: WithSettings, default: WithSettings) -> dict[str, object]:
    """The settings that differ from some defaults, by dotted name."""
    changed = {}
    for section in SECTIONS:
        given, before = getattr(arguments, section, None), getattr(default, section, None)
        for name, value in vars(given).items() if given else ():
            if value != getattr(before, name):
                changed[f"{section}.{name}"] = value
    return changed


@dataclasses.dataclass(frozen=True)
class Train:
    """Train a controller on an environment whose physics vary; resume if it was begun before.

    The defaults shown are those of the environment, method and preset named before --help. Name
    ENV first: without it they are those of the preset paper.
    """

    env: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="ENV")]
    """Short name or id of an environment; `headway list envs` shows them."""
    method: str = "tmcl"
    """What to train; `headway list methods` shows the choice."""
    preset: str = "paper"
    """At which scale; `headway list presets` shows the choice."""
    seed: int = 0
    """Makes the run repeatable."""
    run_dir: Annotated[Path | None, default_text("runs/ENV-METHOD-PRESET-seedSEED")] = None
    """Where everything is written."""
    sim_params: Annotated[Path | None, default_text("the environment's own")] = None
    """A JSON file with the training and unseen physics."""
    env_options: Annotated[tuple[str, ...], default_text("those of the preset")] = ()
    """Switches of the environment: NAME or NAME=on turns one on, NAME=off turns it off."""
    resume_from_last_good: Flag = False
    """Where a file of the run is damaged, go back to the newest iteration that is intact."""
    ignore_limits: Flag = False
    """Try what seems too large for the free memory."""
    json: Flag = False
    """Print one JSON line on stdout instead of tables."""
    quiet: Flag = False
    """Show no progress."""
    model: ModelSettings = dataclasses.field(default_factory=ModelSettings)
    fitting: FittingSettings = dataclasses.field(default_factory=FittingSettings)
    planner: PlannerSettings = dataclasses.field(default_factory=PlannerSettings)
    collection: CollectionSettings = dataclasses.field(default_factory=CollectionSettings)
    evaluation: EvaluationSettings = dataclasses.field(default_factory=EvaluationSettings)

    def with_defaults(self, config: Config) -> "Train":
        """The same arguments with the names and settings of a configuration."""
        named = dataclasses.replace(self, method=config.method, preset=config.preset)
        return with_settings(named, config)


@dataclasses.dataclass(frozen=True)
class Evaluate:
    """Test a trained run on training and unseen physics; nothing in its directory changes.

    It can be tested with another planner than it was trained with. The defaults shown are those
    of the run named before --help.
    """

    run: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="RUN")]
    """The run directory."""
    group: Annotated[tuple[str, ...], default_text("all of them")] = ()
    """Groups of physics: `train` or unseen groups."""
    episodes: Annotated[int | None, default_text("as in the run's own tests")] = None
    """Episodes per group; the same as --evaluation.num-episodes."""
    json: Flag = False
    """Print one JSON line on stdout instead of tables."""
    quiet: Flag = False
    """Show no progress."""
    planner: PlannerSettings = dataclasses.field(default_factory=PlannerSettings)
    evaluation: EvaluationSettings = dataclasses.field(default_factory=EvaluationSettings)

    def with_defaults(self, config: Config) -> "Evaluate":
        """The same arguments with the settings of a run."""
        return with_settings(self, config)


@dataclasses.dataclass(frozen=True)
class Record:
    """Film an episode of a trained run, with the heads that it plans with; GIF or WebP.

    The defaults shown are those of the run named before --help.
    """

    run: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="RUN")]
    """The run directory."""
    output: Annotated[Path, tyro.conf.arg(aliases=["-o"])] = Path("episode.gif")
    """The file to write; .gif or .webp."""
    sim_params: Annotated[tuple[str, ...], default_text("drawn from the training physics")] = ()
    """Physics, for example length=1.75."""
    schedule: Annotated[tuple[str, ...], default_text("physics stay")] = ()
    """Physics that change during the episode, for example 60:length=0.5 120:length=1."""
    seed: int = 0
    """Seeds the start and the planner."""
    steps: Annotated[int | None, default_text("a full episode")] = None
    """Steps to film."""
    json: Flag = False
    """Print one JSON line on stdout instead of text."""
    quiet: Flag = False
    """Show no progress."""
    planner: PlannerSettings = dataclasses.field(default_factory=PlannerSettings)

    def with_defaults(self, config: Config) -> "Record":
        """The same arguments with the settings of a run."""
        return with_settings(self, config)


@dataclasses.dataclass(frozen=True)
class Report:
    """Compare runs on one HTML page that needs nothing else: no network, no other file."""

    runs: Annotated[
        tyro.conf.Positional[tuple[Path, ...]],
        tyro.conf.arg(metavar="RUN [RUN ...]", help_behavior_hint=""),
    ]
    """Run directories, or folders that hold some; any methods, environments and seeds."""
    output: Annotated[Path, tyro.conf.arg(aliases=["-o"])] = Path("report.html")
    """The HTML file to write."""
    only: Annotated[tuple[str, ...], default_text("all of them")] = ()
    """Chapters to make, for example `learning-curves` or `contexts`."""
    json: Flag = False
    """Print one JSON line on stdout instead of text."""


@dataclasses.dataclass(frozen=True)
class Diagnose:
    """Measure how well a trained run selects heads, and how well it knows its own error.

    It looks at the run's own last test episodes; nothing in its directory changes. With planner
    settings: how heads would be selected in these episodes. The defaults shown are those of the
    run named before --help.
    """

    run: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="RUN")]
    """The run directory."""
    group: Annotated[tuple[str, ...], default_text("all of them")] = ()
    """Groups of physics: `train` or unseen groups."""
    episodes: Annotated[int | None, default_text("the run's own tests, not run again")] = None
    """Run tests with so many episodes per group."""
    collected: Flag = False
    """Take the episodes that the last iteration collected: training physics only, and the model has
    learned from them since."""
    json: Flag = False
    """Print one JSON line on stdout instead of tables."""
    quiet: Flag = False
    """Show no progress."""
    planner: PlannerSettings = dataclasses.field(default_factory=PlannerSettings)

    def with_defaults(self, config: Config) -> "Diagnose":
        """The same arguments with the settings of a run."""
        return with_settings(self, config)


@dataclasses.dataclass(frozen=True)
class List:
    """List what can be named on the command line."""

    what: Annotated[
        tyro.conf.Positional[Literal["envs", "methods", "presets", "experiments"]],
        tyro.conf.arg(metavar="WHAT"),
    ]
    """envs, methods, presets or experiments."""
    json: Flag = False
    """Print one JSON line on stdout instead of a table."""


@dataclasses.dataclass(frozen=True)
class PlotDynamics:
    """Draw the next states of the same states and actions under each training physics."""

    env: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="ENV")]
    """Short name or id of an environment; `headway list envs` shows them."""
    output: Annotated[
        Path | None,
        tyro.conf.arg(aliases=["-o"], help_behavior_hint="(default: ENV-dynamics.png)"),
    ] = None
    """The PNG file to write."""
    num_states: int = 100
    """States of the trajectory that are drawn."""
    seed: int = 0
    """Seeds the trajectory and its random actions."""
    json: Flag = False
    """Print one JSON line on stdout instead of text."""
