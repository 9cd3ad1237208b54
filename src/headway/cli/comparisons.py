"""`headway reproduce` and `headway sweep`: what they take, and what they print."""

import dataclasses
import json
import shlex
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from headway.cli.arguments import Flag, default_text
from headway.cli.output import print_json, print_tables
from headway.cli.seeds import read_seeds
from headway.cli.usage import UsageError, parse

if TYPE_CHECKING:
    from headway.sweeps.jobs import Comparison

PAPER_ENVS = (
    "cartpole-swingup", "pendulum", "hopper", "slim-humanoid", "half-cheetah", "crippled-ant",
)  # fmt: skip


@dataclasses.dataclass(frozen=True)
class _Runs:
    """Options of both commands."""

    envs: Annotated[tuple[str, ...], default_text("the paper's six")] = PAPER_ENVS
    """Environments; `headway list envs` shows them."""
    seeds: Annotated[tuple[str, ...], tyro.conf.arg(metavar="SEED|FROM:TO")] = ("0:3",)
    """Seeds, or ranges without their end: 0:3 is 0 1 2."""
    preset: str = "paper"
    """At which scale; `headway list presets` shows the choice."""
    out: Path = Path("runs/reproduce")
    """Where runs and results go; runs that are there already are used."""
    dry_run: Flag = False
    """List what would be run and about how long it takes, and run nothing."""
    one_by_one: Flag = False
    """Let runs go one after another in this process, even where Ray is installed."""
    address: Annotated[str | None, default_text("Ray on this machine")] = None
    """A Ray cluster, for example `auto`; it must see --out under the same path."""
    cpus_per_run: float = 1.0
    """Cores that one run reserves, and threads that it computes with."""
    gpus_per_run: Annotated[float | None, default_text("1 where there are GPUs")] = None
    """GPUs that one run reserves; a fraction lets several share one."""
    json: Flag = False
    """Print one JSON line on stdout instead of tables."""
    quiet: Flag = False
    """Show no progress."""


@dataclasses.dataclass(frozen=True)
class _Experiment:
    """The argument of `headway reproduce`."""

    experiment: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="EXPERIMENT")]
    """An experiment; `headway list experiments` shows them."""


@dataclasses.dataclass(frozen=True)
class Reproduce(_Runs, _Experiment):
    """Run what is missing of an experiment of the paper, and draw and tabulate it.

    The figure compares the runs; `headway report OUT/runs` shows what is inside each of them.
    """

    settings: Annotated[
        tuple[str, ...],
        tyro.conf.arg(metavar="NAME=VALUE", help_behavior_hint="(default: none)"),
    ] = ()
    """Settings of every arm, for example collection.num_iterations=3."""


@dataclasses.dataclass(frozen=True)
class Sweep(_Runs):
    """Run methods in environments with seeds and settings, all of them with each other.

    The figure compares the runs; `headway report OUT/runs` shows what is inside each of them.
    """

    methods: tuple[str, ...] = ("tmcl",)
    """Methods; `headway list methods` shows them."""
    settings: Annotated[
        tuple[str, ...],
        tyro.conf.arg(metavar="NAME=VALUE[,VALUE...]", help_behavior_hint="(default: none)"),
    ] = ()
    """Settings with one or several values, for example planner.horizon=10,20."""
    name: str = "sweep"
    """Names the folder of results in --out."""


def reproduce(words: Sequence[str]) -> int:
    """`headway reproduce`."""
    default = Reproduce(experiment=tyro.MISSING)
    arguments = parse(Reproduce, default, words, "headway reproduce")
    from headway.sweeps.experiments import experiment

    chosen = {}
    for name, values in read_settings(arguments.settings).items():
        if len(values) > 1:
            raise UsageError(f"--settings {name} has {len(values)} values, allowed: one of each.")
        chosen[name] = values[0]
    found = experiment(arguments.experiment)
    return _compare(found, arguments, chosen, ["reproduce", *words])


def sweep(words: Sequence[str]) -> int:
    """`headway sweep`."""
    arguments = parse(Sweep, Sweep(), words, "headway sweep")
    from headway.sweeps.experiments import sweep_experiment

    asked = read_settings(arguments.settings)
    grid = {name: values for name, values in asked.items() if len(values) > 1}
    fixed = {name: values[0] for name, values in asked.items() if len(values) == 1}
    found = sweep_experiment(arguments.name, arguments.methods, grid)
    return _compare(found, arguments, fixed, ["sweep", *words])


def _compare(
    experiment: Any, arguments: Reproduce | Sweep, settings: dict[str, Any], words: list[str]
) -> int:
    from headway.sweeps.jobs import Comparison

    comparison = Comparison(
        experiment,
        arguments.envs,
        read_seeds(arguments.seeds),
        arguments.preset,
        arguments.out,
        settings,
    )
    if arguments.dry_run:
        return _print_plan(comparison, arguments.json)
    from headway import compare
    from headway.sweeps.board import make_board
    from headway.sweeps.running import Workers

    command = shlex.join(["headway", *words])
    workers = Workers(
        arguments.one_by_one,
        arguments.address,
        arguments.cpus_per_run,
        arguments.gpus_per_run,
    )
    board = make_board(arguments.quiet)
    done = compare.reproduce(comparison, workers=workers, board=board, command=command)
    for path, reason in done.failures.items():
        print(f"failed: {path}: {reason}", file=sys.stderr)
    if arguments.json:
        print_json(_facts(done))
    else:
        from headway.report.comparison.terminal import results

        print_tables(*results(done.found))
        print("Written:", *done.files, sep="\n  ")
        print("The command, which resumes what was interrupted:", command, sep="\n  ")
    return 1 if done.failures else 0


def _facts(done: Any) -> dict[str, Any]:
    comparison = done.found.comparison
    return {
        "experiment": comparison.experiment.name,
        "runs": len(comparison.jobs),
        "failures": {str(path): reason for path, reason in done.failures.items()},
        "returns": [point._asdict() for point in done.found.final_points],
        "files": [str(path) for path in done.files],
    }


def _print_plan(comparison: "Comparison", as_json: bool) -> int:
    from headway.report.comparison.terminal import plan
    from headway.sweeps.cost import make_plan

    planned = make_plan(comparison.jobs)
    entries, table = plan(comparison, planned)
    if as_json:
        return print_json({**entries, "note": planned.note})
    print_tables(table, *[planned.note] * bool(planned.note))
    return 0


def read_settings(words: Sequence[str]) -> dict[str, list[Any]]:
    """Read `NAME=VALUE` and `NAME=VALUE,VALUE`; values are JSON, or text where they are not.

    Raises:
        UsageError: A word is not of that form.
    """
    grid: dict[str, list[Any]] = {}
    for word in words:
        name, equals, text = word.partition("=")
        name = name.lstrip("-").replace("-", "_")
        values = _values(text)
        if not (name and equals and values) or name in grid:
            raise UsageError(
                f"--settings is {word!r}, allowed: NAME=VALUE or NAME=VALUE,VALUE, each name once;"
                " lists and tables are JSON."
            )
        grid[name] = values
    return grid


def _values(text: str) -> list[Any] | None:
    """Values between commas; None where one is empty, or begins as JSON and is none."""
    values: list[Any] = []
    while True:
        text = text.strip()
        try:
            value, end = json.JSONDecoder().raw_decode(text)
        except ValueError:
            value, end = None, -1
        rest = text[end:].lstrip() if end >= 0 else "?"
        if rest and not rest.startswith(","):  # it is a word
            value, comma, rest = text.partition(",")
            value, rest = value.rstrip(), comma + rest
            if not value or value[0] in '[{"':
                return None
        values.append(value)
        if not rest:
            return values
        text = rest[1:]
