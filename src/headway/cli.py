"""The command `headway`: tyro parses the words, a command calls one library function and prints.

Results go to stdout, progress and errors to stderr. Exit codes: 0 done, 1 an error of
Headway's, 2 wrong usage, 130 interrupted, 143 terminated.
"""

import dataclasses
import functools
import inspect
import io
import json
import os
import re
import shlex
import sys
import typing
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal, Self

import tyro

from headway import __version__
from headway.config import (
    CollectionConfig,
    Config,
    EvaluationConfig,
    FittingConfig,
    ModelConfig,
    MultiHeadedConfig,
    PlannerConfig,
    flatten,
    override,
    to_dict,
)
from headway.errors import ConfigError, HeadwayError, one_line
from headway.training.stopping import Terminated

MAX_SEEDS = 1000
PIPE_WIDTH = 130
RESUMABLE = ("train", "fit", "reproduce", "sweep")

RUN_NAMES = ("env", "method", "preset", "seed")
SECTIONS = ("model", "fitting", "planner", "collection", "evaluation")
USUAL = {  # settings that --help shows; --help-all shows all of them
    "fitting": ("epochs", "precision"),
    "planner": ("horizon", "num_candidates", "precision", "adaptation", "change_threshold"),
    "collection": ("num_iterations", "num_episodes", "min_steps", "episode_length"),
    "evaluation": ("num_episodes", "every"),
}

COMMANDS: dict[str, type["Command"]] = {}
"""Every command by its name: the class `PlotDynamics` is `plot-dynamics`."""

Value = typing.TypeVar("Value")
Word = Annotated[Value, tyro.conf.Positional]
Flag = Annotated[bool, tyro.conf.FlagCreatePairsOff, tyro.conf.arg(help_behavior_hint="")]
Output = Annotated[Path, tyro.conf.arg(aliases=["-o"])]
EnvName = Annotated[Word[str], tyro.conf.arg(metavar="ENV")]
RunPath = Annotated[Word[Path], tyro.conf.arg(metavar="RUN")]


def _unless_given(text: str):
    """Say in words what happens by default."""
    return tyro.conf.arg(help_behavior_hint=f"(default: {text})")


Iteration = Annotated[int | Literal["best"] | None, _unless_given("the newest")]


@dataclasses.dataclass(frozen=True)
class Names:
    """The words of a line that say whose settings are the defaults of all others."""

    words: Word[tuple[str, ...]] = ()
    """First of all an environment or a run."""
    method: str = "tmcl"
    preset: str = "paper"
    optimizer: Annotated[str | None, tyro.conf.arg(name="planner.optimizer.name")] = None
    task: str | None = None
    from_run: Annotated[Path | None, tyro.conf.arg(name="from")] = None

    def settings(self) -> dict[str, str]:
        """Choices among settings that others depend on, by dotted name."""
        return {} if self.optimizer is None else {"planner.optimizer.name": self.optimizer}


@typing.dataclass_transform(frozen_default=True)
@dataclasses.dataclass(frozen=True)
class Command:
    """Options of every command; a subclass is a frozen dataclass, and named on the command line."""

    json: Flag = False
    """Print one JSON line of results on stdout."""
    quiet: Flag = False
    """Show no progress."""

    def __init_subclass__(cls):
        dataclasses.dataclass(frozen=True)(cls)
        if not cls.__name__.startswith("_"):
            COMMANDS[re.sub(r"\B(?=[A-Z])", "-", cls.__name__).lower()] = cls

    def run(self, words: Sequence[str]) -> int:
        """Do it, and return the exit code; `words` are those that asked for it."""
        raise NotImplementedError

    def with_defaults(self, names: Names) -> Self:
        """Take the settings of what is named."""
        return self

    def show(self, facts: Mapping[str, Any] | Sequence[Any], *tables: Any) -> int:
        """Print facts as one JSON line, or tables and text for people."""
        if self.json:
            print(json.dumps(facts, allow_nan=False))
            return 0
        from rich.console import Console

        width = None if sys.stdout.isatty() else PIPE_WIDTH
        console = Console(width=width, highlight=False, markup=False, emoji=False)
        for table in tables:
            console.print(table, soft_wrap=isinstance(table, str))
        return 0

    def progress(self) -> Any:
        """Make what shows the progress of training and tests."""
        from headway.training.progress import make_progress

        return make_progress(self.quiet)

    @property
    def sections(self) -> dict[str, Any]:
        """Those of a run's settings that this command has."""
        return {name: value for name, value in vars(self).items() if name in SECTIONS}

    def changed(self, config: Config) -> dict[str, Any]:
        """Settings by dotted name that differ from those of a configuration."""
        mine = {name: dataclasses.asdict(section) for name, section in self.sections.items()}
        asked = flatten(mine)
        tag = "planner.optimizer.name"
        chosen = {} if asked[tag] == config.planner.optimizer.name else {tag: asked[tag]}
        usual = flatten(to_dict(override(config, chosen)))
        return chosen | {name: value for name, value in asked.items() if value != usual[name]}


class Train(Command):
    """Train a controller on an environment whose physics vary; resume if it was begun before.

    The defaults shown are those of the environment, method and preset named before --help. Name
    ENV first: without it they are those of the preset paper.
    """

    env: EnvName = tyro.MISSING
    """Short name or id of an environment; `headway list envs` shows them."""
    method: str = "tmcl"
    """Method; `headway list methods` shows the choice."""
    preset: str = "paper"
    """At which scale; `headway list presets` shows the choice."""
    seed: int = 0
    """Makes the run repeatable."""
    run_dir: Annotated[Path | None, _unless_given("runs/ENV-METHOD-PRESET-seedSEED")] = None
    """Directory of the run."""
    from_run: Annotated[Path | None, tyro.conf.arg(name="from"), _unless_given("a new run")] = None
    """A finished run, such as one of `headway fit`, whose copy goes on; ENV may be left out."""
    sim_params: Annotated[Path | None, _unless_given("the environment's own")] = None
    """A JSON file with the training and unseen physics."""
    env_options: Annotated[tuple[str, ...], _unless_given("those of the preset")] = ()
    """Options of the environment as NAME=VALUE; switches are on or off, lists and tables JSON."""
    resume_from_last_good: Flag = False
    """If a file of the run is damaged, go back to the newest iteration that is intact."""
    model: ModelConfig = MultiHeadedConfig()
    fitting: FittingConfig = FittingConfig()
    planner: PlannerConfig = PlannerConfig()
    collection: CollectionConfig = CollectionConfig()
    evaluation: EvaluationConfig = EvaluationConfig()

    def with_defaults(self, names):
        """Take the settings of environment, method and preset."""
        named = {"env": names.task or names.words[0]} if names.task or names.words else {}
        named |= {name: getattr(names, name) for name in ("method", "preset", "from_run")}
        config = override(dataclasses.replace(self, **named).base(), names.settings())
        taken = (*RUN_NAMES, *SECTIONS)
        return dataclasses.replace(self, **{name: getattr(config, name) for name in taken})

    def base(self) -> Config:
        """The settings that all changes are made to."""
        from headway.training.methods import make_config
        from headway.training.train import continued

        if self.from_run:
            return continued(self.from_run)
        return make_config(self.env, method=self.method, preset=self.preset)

    def settings(self) -> dict[str, Any]:
        """Settings by dotted name that differ from those of method and preset."""
        config = self.base()
        settings = self.changed(config)
        for name in RUN_NAMES if self.from_run else ():
            asked, own = getattr(self, name), getattr(config, name)
            if asked != own:
                raise ConfigError(
                    f"{name} is {asked!r}, allowed with --from: {own!r}, that of {self.from_run};"
                    " leave it out."
                )
        if self.env_options:
            options = dict(config.env_options)
            for word in self.env_options:
                name, _, text = word.partition("=")
                value = {"on": True, "off": False}.get(text, _json_or_text(text))
                if value == "":
                    raise ConfigError(f"--env-options is {word!r}, allowed: NAME=VALUE.")
                options[name.replace("-", "_")] = value
            settings["env_options"] = options
        if self.sim_params is not None:
            try:
                settings["sim_params"] = json.loads(self.sim_params.read_text())
            except (ValueError, RecursionError) as error:
                raise ConfigError(
                    f"{self.sim_params} is not JSON ({error}); write training and unseen sets."
                ) from None
        return settings

    def options(self) -> dict[str, Any]:
        """Keywords that training and fitting share."""
        names = ("method", "preset", "seed", "run_dir", "resume_from_last_good")
        options = {name: getattr(self, name) for name in names}
        return options | {"settings": self.settings(), "progress": self.progress()}

    def run(self, words):
        """Train, print the last tests, and what to do next."""
        options = self.options()
        from headway import api
        from headway.lab import figures, tables

        run = api.train(self.env, from_run=self.from_run, **options)
        drawn = [str(path) for path in figures.save_run_figures(run.path)]
        after = f" after {len(run.metrics)} iterations" * run.config.model.learns
        title = f"{run.config.env}, {run.config.method}{after}"
        tested, table = tables.evaluation(run.last_tests, run.config, title)
        facts = {
            "run_dir": str(run.path),
            **{name: getattr(run.config, name) for name in RUN_NAMES},
            "iterations": len(run.metrics),
            "timesteps": run.metrics[-1]["timesteps"],
            **tested,
            "figures": drawn,
        }
        again = shlex.join(["headway", *words])
        return self.show(
            facts,
            table,
            "\n  ".join(["Figures:", *drawn]),
            f"Test it again:\n  {shlex.join(['headway', 'evaluate', str(run.path)])}",
            f"The command, which resumes what was interrupted:\n  {again}",
        )


class Fit(Train):
    """Fit a model to recordings alone, and show how well and what its heads are for.

    A recording has `obs` and `action` by row, and perhaps more: see the page on logged data. The
    defaults shown are those of the environment, method and preset named before --help.
    """

    data: Annotated[Word[str], tyro.conf.arg(metavar="DATA")] = tyro.MISSING
    """An .npz or Parquet file, a folder of them, a Minari data set (its folder, or minari:ID)."""
    env: Annotated[str, tyro.conf.arg(name="task")] = tyro.MISSING
    """Short name or id of the environment whose Task they were recorded for."""
    run_dir: Annotated[Path | None, _unless_given("runs/ENV-METHOD-PRESET-seedSEED-fit")] = None
    """Directory of the run."""
    held_out: float = 0.2
    """Share of the recordings on which errors are measured and nothing is fitted."""
    names: Annotated[tuple[str, ...], _unless_given("guessed")] = ()
    """What arrays are called, for example obs=angle,speed action=torque."""
    from_run: tyro.conf.Suppress[None] = None

    def run(self, words):
        """Fit, print errors by imagined step and the heads of each recording."""
        options = self.options()
        from headway import api
        from headway.lab import figures, tables

        names = {name: text for name, _, text in (word.partition("=") for word in self.names)}
        run = api.fit(self.data, self.env, held_out=self.held_out, names=names, **options)
        drawn = [str(path) for path in figures.save_run_figures(run.path)]
        facts, *shown = tables.fitted(run.path)
        facts = {"run_dir": str(run.path), **facts, "figures": drawn}
        go_on = shlex.join(["headway", "train", "--from", str(run.path)])
        return self.show(
            facts, *shown, "\n  ".join(["Figures:", *drawn]), f"Go on collecting:\n  {go_on}"
        )


class ExportData(Command):
    """Write what a run collected as a Minari data set."""

    run_dir: RunPath = tyro.MISSING
    """The run directory."""
    out: Annotated[Word[Path], tyro.conf.arg(metavar="OUT")] = tyro.MISSING
    """The folder to make, with a version at its end, as pendulum-v0."""

    def run(self, words):
        """Write, and print where it is."""
        from headway.training.recordings import export_data

        episodes = export_data(self.run_dir, self.out)
        facts = {"data_set": str(self.out), "episodes": episodes}
        return self.show(facts, f"{self.out}: {episodes} episodes")


class _OfRun(Command):
    """A command about a trained run, whose settings are the defaults."""

    run_dir: RunPath = tyro.MISSING
    """The run directory."""
    planner: PlannerConfig = PlannerConfig()

    def settings(self) -> dict[str, Any]:
        """Settings by dotted name that differ from those of the run."""
        return self.changed(_config(self.run_dir))

    def with_defaults(self, names):
        """Take the settings of the run."""
        config = override(_config(names.words[0]), names.settings())
        return dataclasses.replace(self, **{name: getattr(config, name) for name in self.sections})


class Evaluate(_OfRun):
    """Test a trained run on training and unseen physics; nothing in its directory changes.

    It can be tested with another planner than it was trained with. The defaults shown are those
    of the run named before --help.
    """

    group: Annotated[tuple[str, ...], _unless_given("all of them")] = ()
    """Groups of physics: `train` or unseen groups."""
    episodes: Annotated[int | None, _unless_given("as in the run's own tests")] = None
    """Episodes per group; the same as --evaluation.num-episodes."""
    sim_params: Annotated[tuple[str, ...], _unless_given("none")] = ()
    """Physics that are in no group, for example length=2.0."""
    iteration: Iteration = None
    """The iteration whose model is tested, from 0, or `best` by training return."""
    evaluation: EvaluationConfig = EvaluationConfig()

    def run(self, words):
        """Test, print returns per physics, and what planning took."""
        settings = self.settings()
        from headway.lab import tables
        from headway.training import evaluate

        found = evaluate.evaluate(
            self.run_dir,
            groups=self.group or None,
            num_episodes=self.episodes,
            sim_params=_physics(self.sim_params, "--sim-params"),
            iteration=self.iteration,
            settings=settings,
            progress=self.progress(),
        )
        cost = found.cost
        tested, table = tables.evaluation(found, found.config, str(self.run_dir))
        facts = {
            "run_dir": str(self.run_dir),
            "settings": settings,
            "planning": dataclasses.asdict(cost),
            **tested,
        }
        took = f"{cost.evaluations_per_step:,.0f} candidates, {cost.flop_per_step / 1e9:.3g} GFLOP"
        if cost.seconds_per_step is not None:
            took += f", {1e3 * cost.seconds_per_step:.3g} ms"
        return self.show(facts, table, f"Planning took {took} per step.")


class Record(_OfRun):
    """Film an episode of a trained run, with the heads that it plans with; GIF or MP4.

    The defaults shown are those of the run named before --help.
    """

    output: Output = Path("episode.gif")
    """The file to write; .gif or .mp4."""
    sim_params: Annotated[tuple[str, ...], _unless_given("drawn from the training physics")] = ()
    """Physics, for example length=1.75."""
    schedule: Annotated[tuple[str, ...], _unless_given("physics stay")] = ()
    """Physics that change during the episode, for example 60:length=0.5 120:length=1."""
    seed: int = 0
    """Seeds the start and the planner."""
    steps: Annotated[int | None, _unless_given("a full episode")] = None
    """Steps to film."""
    iteration: Iteration = None
    """The iteration whose model acts, from 0, or `best` by training return."""

    def run(self, words):
        """Film, and print where the film is."""
        schedule: dict[int, dict[str, float]] = {}
        for word in self.schedule:
            found = re.fullmatch(r"(\d{1,9}):(.*)", word)
            if not found:
                raise ConfigError(
                    f"--schedule is {word!r}, allowed: a step and what changes then, as in"
                    " 60:length=0.5."
                )
            schedule.setdefault(int(found[1]), {}).update(_physics([found[2]], "--schedule"))
        from headway.lab.record import record

        film = record(
            self.run_dir,
            self.output,
            sim_params=_physics(self.sim_params, "--sim-params"),
            schedule=schedule,
            seed=self.seed,
            num_steps=self.steps,
            iteration=self.iteration,
            settings=self.settings(),
            progress=self.progress(),
        )
        facts = {"film": str(film.path), "env": film.env, "steps": film.steps}
        text = f"{film.path}: {film.steps} steps, return {film.episode_return:.1f}"
        return self.show({**facts, "return": film.episode_return}, text)


class Play(Command):
    """Watch a trained controller live in the browser, and change its physics while it acts."""

    run_dir: Annotated[
        Word[Path | None],
        tyro.conf.arg(metavar="[RUN]"),
        _unless_given("a pendulum that ships with Headway"),
    ] = None
    """The run directory."""
    host: str = "127.0.0.1"
    """The address to listen at; 0.0.0.0 lets everybody on the network watch and disturb."""
    port: int = 8080
    """The port, or the next one that is free."""

    def run(self, words):
        """Play until Ctrl-C."""
        from headway.play.page import play

        play(self.run_dir, host=self.host, port=self.port)
        return 0


class Diagnose(_OfRun):
    """Measure how well a trained run selects heads, and how well it knows its own error.

    It looks at the run's own last test episodes; nothing in its directory changes. With planner
    settings: how heads would be selected in these episodes. The defaults shown are those of the
    run named before --help.
    """

    group: Annotated[tuple[str, ...], _unless_given("all of them")] = ()
    """Groups of physics: `train` or unseen groups."""
    episodes: Annotated[int | None, _unless_given("the run's own tests, not run again")] = None
    """Run tests with so many episodes per group."""

    def run(self, words):
        """Diagnose, and print tables."""
        from headway.lab import diagnose as lab

        found = lab.diagnose(
            self.run_dir,
            groups=self.group or None,
            num_episodes=self.episodes,
            settings=self.settings(),
            progress=self.progress(),
        )
        return self.show(lab.facts(found), *lab.tables(found))


class Export(_OfRun):
    """Write a trained run's controller as one file that plans with JAX alone.

    The defaults shown are those of the run named before --help.
    """

    output: Annotated[Word[Path], tyro.conf.arg(metavar="FILE")] = tyro.MISSING
    """The file to write, such as controller.headway."""
    iteration: Iteration = None
    """The iteration whose model acts, from 0, or `best` by training return."""

    def run(self, words):
        """Export, and print where the file is."""
        from headway.service.export import export

        path = export(self.run_dir, self.output, iteration=self.iteration, settings=self.settings())
        return self.show({"file": str(path)}, f"{path}: {path.stat().st_size / 1e6:.2g} MB")


class Serve(_OfRun):
    """Answer observations with actions over a WebSocket, until Ctrl-C or SIGTERM.

    The defaults shown are those of the run named before --help.
    """

    deadline_ms: float = 100.0
    """Milliseconds from an observation to its action."""
    host: str = "127.0.0.1"
    """Address to listen on; any but loopback needs a token."""
    port: int = 8765
    """Port to listen on; 0 takes a free one."""
    token: Annotated[str | None, _unless_given("the environment variable HEADWAY_TOKEN")] = None
    """What clients must show as `Authorization: Bearer TOKEN`."""
    max_robots: int = 4
    """Sessions at once, each with a controller of its own."""
    silence_s: float = 60.0
    """Seconds without a message after which a session is closed."""
    iteration: Iteration = None
    """The iteration whose model acts, from 0, or `best` by training return."""

    def run(self, words):
        """Serve; print where once robots may connect, and who comes and goes."""
        from headway.service.serve import serve

        def ready(url: str) -> None:
            text = f"{self.run_dir} at {url}, {self.deadline_ms:g} ms per answer; Ctrl-C stops."
            self.show({"url": url}, text)
            sys.stdout.flush()

        names = ("deadline_ms", "host", "port", "max_robots", "silence_s", "iteration")
        serve(
            self.run_dir,
            token=self.token or os.environ.get("HEADWAY_TOKEN"),
            settings=self.settings(),
            ready=ready,
            say=self.progress().message,
            **{name: getattr(self, name) for name in names},
        )
        return 0


class Push(Command):
    """Copy a finished run, with a model card, to a folder or the Hugging Face Hub."""

    run_dir: RunPath = tyro.MISSING
    """The run directory."""
    target: Annotated[Word[str], tyro.conf.arg(metavar="TARGET")] = tyro.MISSING
    """A folder, or hf://user/name, which becomes a private model."""
    data: Flag = False
    """Also the episodes it was trained on; without them it cannot be trained further."""

    def run(self, words):
        """Push, and print where it is."""
        from headway.service.share import push

        target = push(self.run_dir, self.target, data=self.data)
        return self.show({"target": target}, f"headway pull {shlex.quote(target)} DIR")


class Pull(Command):
    """Copy a run that was pushed to a folder or the Hugging Face Hub, and check all of it."""

    source: Annotated[Word[str], tyro.conf.arg(metavar="SOURCE")] = tyro.MISSING
    """A folder, or hf://user/name."""
    run_dir: Annotated[Word[Path], tyro.conf.arg(metavar="DIR")] = tyro.MISSING
    """A new directory, or one with an earlier state of the same run."""

    def run(self, words):
        """Pull, and print where it is."""
        from headway.service.share import pull

        path = str(pull(self.source, self.run_dir))
        return self.show({"run_dir": path}, path)


class Report(Command):
    """Compare runs on one HTML page that needs nothing else: no network, no other file."""

    runs: Annotated[Word[tuple[Path, ...]], tyro.conf.arg(metavar="RUN [RUN ...]")] = tyro.MISSING
    """Run directories, or folders that hold some; any methods, environments and seeds."""
    output: Output = Path("report.html")
    """The HTML file to write."""

    def run(self, words):
        """Write the page, and print where it is."""
        from headway.lab.report import write_report

        path = str(write_report(self.runs, self.output))
        return self.show({"report": path}, path)


class _Runs(Command):
    """Options of the commands that make many runs."""

    envs: Annotated[tuple[str, ...], _unless_given("the paper's six")] = ()
    """Environments; `headway list envs` shows them."""
    seeds: Annotated[tuple[str, ...], tyro.conf.arg(metavar="SEED|FROM:TO")] = ("0:3",)
    """Seeds, or ranges without their end: 0:3 is 0 1 2."""
    preset: str = "paper"
    """At which scale; `headway list presets` shows the choice."""
    out: Path = Path("runs/reproduce")
    """Folder of runs and results; runs that are there already are used."""
    settings: Annotated[tuple[str, ...], _unless_given("none")] = ()
    """Settings as NAME=VALUE, for example collection.num_iterations=3; `headway sweep` takes
    several values, for example planner.horizon=10,20, and combines them all."""
    dry_run: Flag = False
    """List the runs and how far each is, and run nothing."""
    one_by_one: Flag = False
    """Let runs go one after another, even where Ray is installed."""
    address: Annotated[str | None, _unless_given("Ray on this machine")] = None
    """A Ray cluster, for example `auto`; it must see --out under the same path."""
    cpus_per_run: float = 1.0
    """Cores that one run reserves, and threads that it computes with."""
    gpus_per_run: Annotated[float | None, _unless_given("1 where there are GPUs")] = None
    """GPUs that one run reserves; a fraction lets several share one."""

    def compare(self, experiment: Any, settings: Mapping[str, Any], words: Sequence[str]) -> int:
        """Make the runs that are missing, and print what all of them found."""
        from headway.lab.comparison import reproduce, states
        from headway.lab.paper import PAPER_ENVS
        from headway.lab.sweep import Comparison, Workers

        envs, seeds = self.envs or PAPER_ENVS, read_seeds(self.seeds)
        comparison = Comparison(experiment, envs, seeds, self.preset, self.out, settings)
        if self.dry_run:
            entries, table = states(comparison)
            return self.show({"runs": entries}, table)
        from rich.markdown import Markdown

        done = reproduce(
            comparison,
            workers=Workers(self.one_by_one, self.address, self.cpus_per_run, self.gpus_per_run),
            quiet=self.quiet,
            command=shlex.join(["headway", *words]),
        )
        for path, reason in done.failures.items():
            print(f"failed: {path}: {reason}", file=sys.stderr)
        facts = {
            "experiment": comparison.experiment.name,
            "runs": len(comparison.jobs),
            "failures": {str(path): reason for path, reason in done.failures.items()},
            "returns": done.last.to_dict("records"),
            "files": [str(path) for path in done.files],
        }
        written = "\n  ".join(["Written:", *map(str, done.files)])
        self.show(facts, Markdown(done.files[-1].read_text()), written)
        return 1 if done.failures else 0


class Reproduce(_Runs):
    """Run what is missing of an experiment of the paper, and draw and tabulate it.

    The figure compares the runs; `headway report OUT/runs` shows what is inside each of them.
    """

    experiment: Annotated[Word[str], tyro.conf.arg(metavar="EXPERIMENT")] = tyro.MISSING
    """An experiment; `headway list experiments` shows them."""

    def run(self, words):
        """Reproduce, with one value of each setting."""
        from headway.lab.paper import experiment

        found = experiment(self.experiment)
        grid = read_settings(self.settings)
        for name, values in grid.items():
            if len(values) > 1:
                raise ConfigError(f"--settings {name} has {len(values)} values, allowed: one.")
        return self.compare(found, {name: values[0] for name, values in grid.items()}, words)


class Sweep(_Runs):
    """Run methods in environments with seeds and settings, all of them with each other.

    The figure compares the runs; `headway report OUT/runs` shows what is inside each of them.
    """

    methods: tuple[str, ...] = ("tmcl",)
    """Methods; `headway list methods` shows them."""
    name: str = "sweep"
    """Names the folder of results in --out."""

    def run(self, words):
        """Sweep; settings with several values make arms."""
        from headway.lab.paper import sweep_experiment

        asked = read_settings(self.settings)
        grid = {name: values for name, values in asked.items() if len(values) > 1}
        fixed = {name: values[0] for name, values in asked.items() if len(values) == 1}
        return self.compare(sweep_experiment(self.name, self.methods, grid), fixed, words)


class List(Command):
    """List what can be named on the command line."""

    what: Word[Literal["envs", "methods", "presets", "experiments"]] = tyro.MISSING
    """Names to list."""

    def run(self, words):
        """Print a table of names."""
        from headway.lab.paper import EXPERIMENTS
        from headway.lab.tables import axis_label, new_table, value_label, varying
        from headway.task import env_names, env_spec
        from headway.training.methods import METHODS, PRESETS

        entries: list[dict[str, Any]] = []
        if self.what == "envs":
            texts = ("name", "what varies", "training", "unseen", "options")
            table = new_table("Environments", *texts, numbers=("obs", "action", "steps"))
            table.columns[0].no_wrap = True
            for spec in map(env_spec, env_names()):
                task, sets = spec.task(spec.options), spec.sim_params
                groups = {name: list(map(dict, sets.group(name))) for name in sets.group_names}
                entry = {
                    "name": spec.name,
                    "id": str(spec.env_id),
                    "description": spec.description,
                    **{name: getattr(task, name, None) for name in ("obs_size", "action_size")},
                    "episode_length": spec.episode_length,
                    "sim_params": groups,
                    "options": dict(spec.options),
                }
                entries.append(entry)
                names = varying([physics for group in groups.values() for physics in group])
                train, *unseen = (
                    ", ".join(value_label(physics, names) for physics in group)
                    for group in groups.values()
                )
                cells = [spec.name, axis_label(names), train, "\n".join(unseen)]
                sizes = entry["obs_size"], entry["action_size"], spec.episode_length
                sizes = (str(size or "–") for size in sizes)
                table.add_row(*cells, "\n".join(spec.options) or "–", *sizes)
        elif self.what == "methods":
            table = new_table("Methods", "name", "description", "settings that differ from tmcl")
            usual = flatten(to_dict(Config(env="pendulum")))
            for method in METHODS.values():
                # What is the same in the paper's preset is set because another preset changes it.
                settings = flatten(method.settings).items()
                chosen = {name: value for name, value in settings if value != usual.get(name)}
                about = {"name": method.name, "description": method.description}
                entries.append({**about, "settings": chosen})
                changes = "\n".join(f"{name} {value}" for name, value in chosen.items())
                table.add_row(*about.values(), changes or "–")
        elif self.what == "presets":
            table = new_table("Presets", "name", "description")
            for preset in PRESETS.values():
                entries.append({"name": preset.name, "description": preset.description})
                table.add_row(preset.name, preset.description)
        else:
            table = new_table("Experiments", "name", "what is compared", "arms")
            for found in EXPERIMENTS.values():
                arms = [dataclasses.asdict(arm) for arm in found.arms]
                entries.append({"name": found.name, "title": found.title, "arms": arms})
                table.add_row(found.name, found.title, ", ".join(arm["label"] for arm in arms))
            table.caption = "headway reproduce NAME --envs pendulum --seeds 0:3 --preset quick"
        return self.show({self.what: entries}, table)


class Check(Command):
    """Compare an environment with its Task, within seconds; exit code 1 if there is a fault."""

    env: EnvName = tyro.MISSING
    """Short name or id of an environment; `module:name` for one of your own."""

    def run(self, words):
        """Check, and print a table of what was looked at."""
        from headway.lab.tables import new_table
        from headway.training.check import check

        found = check(self.env)
        table = new_table(f"{self.env} and its Task", "", "looked at", "found, and what to do")
        for row in found:
            table.add_row({"ok": "✓", "fault": "✗", "remark": "–"}[row.status], row.name, row.text)
        self.show([dataclasses.asdict(row) for row in found], table)
        return int(any(row.status == "fault" for row in found))


class PlotDynamics(Command):
    """Draw the next states of the same states and actions under each training physics."""

    env: EnvName = tyro.MISSING
    """Short name or id of an environment; `headway list envs` shows them."""
    output: Output = Path("dynamics.png")
    """The PNG file to write."""

    def run(self, words):
        """Draw, and print where the figure is."""
        from headway.lab import dynamics
        from headway.task import env_spec

        path = str(dynamics.plot_dynamics(self.env, self.output))
        return self.show({"env": env_spec(self.env).name, "figure": path}, path)


def parse(words: Sequence[str]) -> Command:
    """Parse a command line.

    The defaults of settings are those of what the line names (environment, method and preset, or
    a run), so tyro reads the names first, and then everything with these defaults.

    Raises:
        HeadwayError: There is no such environment, method, preset or run.
        SystemExit: The line is wrong (2), or asked for help (0); tyro has said what there is.
    """
    told = "Control that keeps making headway when the physics changes."
    config = (tyro.conf.DisallowNone,)
    if not words or words[0] not in COMMANDS:
        about = {name: f"{cls.__doc__}".split("\n")[0] for name, cls in COMMANDS.items()}
        made = {name: cls() for name, cls in COMMANDS.items()}
        commands: Any = tyro.extras.subcommand_type_from_defaults(made, about, prefix_names=False)
        return tyro.cli(commands, args=words, prog="headway", description=told, config=config)
    command, rest = COMMANDS[words[0]], words[1:]
    names, _ = tyro.cli(Names, args=rest, add_help=False, return_unknown_args=True)
    named = {Fit: names.task, Train: names.words or names.from_run}.get(command, names.words)
    default = command().with_defaults(names) if named else command()
    helped = {"-h", "--help", "--help-all"} & set(rest)
    if rest and default.sections and not (named or helped or command is Fit):
        raise ConfigError(f"{rest[0]} comes first, allowed: ENV or RUN, then options.")
    asked = functools.partial(tyro.cli, prog=f"headway {words[0]}", config=config)
    if {"-h", "--help"} & set(rest) and default.sections:
        default = dataclasses.replace(
            default,
            **{name: _brief(one, USUAL.get(name, ())) for name, one in default.sections.items()},
        )
        told = f"{inspect.cleandoc(command.__doc__ or '')}\n--help-all shows all settings."
        return asked(command, default=default, args=["--help"], description=told)
    rest = ["--help" if word == "--help-all" else word for word in rest]
    return asked(command, default=default, args=rest)


def _config(run_dir: str | Path) -> Config:
    """Read the settings of a run."""
    from headway.training.run import RunDir

    return RunDir(run_dir).config()


def _brief(section: Any, shown: Sequence[str]) -> Any:
    """The settings of a section as tyro shows them, most of them hidden."""
    cls = type(section)
    hints = typing.get_type_hints(cls, include_extras=True)
    hidden = [
        (name, tyro.conf.Suppress[hints[name]], dataclasses.field(default=value))
        for name, value in vars(section).items()
        if name not in shown
    ]
    made = dataclasses.make_dataclass(cls.__name__, hidden, bases=(cls,), frozen=True)
    return made(**vars(section))


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line.

    Args:
        argv: The arguments; those of the process by default.

    Returns:
        The exit code.

    Raises:
        SystemExit: As `parse`.
    """
    words = list(sys.argv[1:] if argv is None else argv)
    if words == ["--version"]:
        print(f"headway {__version__}")
        return 0
    stopped, code = "", 1
    warnings.formatwarning = lambda text, *_, **__: f"warning: {text}\n"
    if isinstance(sys.stdout, io.TextIOWrapper):  # not every terminal or pipe takes a ✓
        sys.stdout.reconfigure(errors="backslashreplace")
    try:
        command = parse(words)
        if not isinstance(command, List):
            from headway.models.compilation import prepare_jax

            prepare_jax()
        code = command.run(words)
        sys.stdout.flush()
        return code
    except HeadwayError as error:
        print(f"error: {one_line(error)}", file=sys.stderr)
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    except OSError as error:
        where = "" if error.filename is None else f"cannot use {error.filename}: "
        print(f"error: {where}{error.strerror or error}", file=sys.stderr)
    except KeyboardInterrupt:
        stopped, code = "interrupted", 130
    except Terminated:
        stopped, code = "terminated", 143  # as a shell reports SIGTERM
    if stopped:
        goes_on = words and words[0] in RESUMABLE
        advice = "; the same command goes on where this one stopped" if goes_on else ""
        print(f"{stopped}{advice}", file=sys.stderr)
        if argv is None:  # XLA's threads may still compute, and would crash a slow exit
            sys.stdout.flush()
            sys.stderr.flush()
            os._exit(code)
    return code


def read_seeds(words: Sequence[str]) -> tuple[int, ...]:
    """Read seeds and ranges, for example `0:3` or `0 4`.

    Raises:
        ConfigError: A word is neither.
    """
    seeds: list[int] = []
    for word in words:
        found = re.fullmatch(r"(\d{1,10})(?::(\d{1,10}))?", word)
        first, last = (int(found[1]), int(found[2] or int(found[1]) + 1)) if found else (0, 0)
        if not 0 < last - first <= MAX_SEEDS:
            raise ConfigError(
                f"--seeds is {word!r}, allowed: a whole number, or a range FIRST:LAST of up to"
                f" {MAX_SEEDS} seeds that leaves out its last, as 0:3."
            )
        seeds += range(first, last)
    return tuple(seeds)


def read_settings(words: Sequence[str]) -> dict[str, list[Any]]:
    """Read `NAME=VALUE` and `NAME=VALUE,VALUE`; values are JSON, or text where they are not.

    Raises:
        ConfigError: A word is not of that form.
    """
    grid: dict[str, list[Any]] = {}
    for word in words:
        name, _, text = word.partition("=")
        name = name.replace("-", "_")
        try:
            values = json.loads(f"[{text}]")
        except ValueError:
            values = [_json_or_text(part.strip()) for part in text.split(",")]
        if not name or not values or "" in values or name in grid:
            raise ConfigError(
                f"--settings is {word!r}, allowed: NAME=VALUE or NAME=VALUE,VALUE, each name once;"
                " lists and tables are JSON."
            )
        grid[name] = values
    return grid


def _json_or_text(word: str) -> Any:
    try:
        return json.loads(word)
    except ValueError:
        return "" if word[:1] in ("[", "{", '"') else word  # begins as JSON and is none


def _physics(words: Sequence[str], option: str) -> dict[str, float]:
    """Read `length=0.5` and `mass=2`; a name may hold blanks and further equals signs."""
    pairs = [word.rpartition("=") for word in words]
    if len({name for name, *_ in pairs}) < len(pairs):
        raise ConfigError(f"{option} is {' '.join(words)}, allowed: each name once.")
    try:
        return {name: float(value) for name, _, value in pairs}
    except ValueError as error:
        raise ConfigError(f"{option}: {error}, allowed: NAME=NUMBER, as in length=0.5.") from None
