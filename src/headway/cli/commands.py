"""One function per command: parse, call the library, print."""

import dataclasses
import shlex
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import tyro

from headway.cli.arguments import (
    Evaluate,
    List,
    PlotDynamics,
    Train,
)
from headway.cli.comparisons import reproduce, sweep
from headway.cli.defaults import parse_for_run, parse_twice
from headway.cli.output import print_json as _print_json
from headway.cli.output import print_tables as _print_tables
from headway.cli.reports import diagnose, record, report
from headway.cli.usage import UsageError, parse
from headway.config import Config
from headway.errors import ConfigError, unknown_name

if TYPE_CHECKING:
    from headway.api import Run
    from headway.experiment.evaluation import PlanningCost
    from headway.storage.tables import EpisodeRow
    from headway.tasks.catalog import EnvSpec

MAX_SIM_PARAMS_BYTES = 2**20


def train(words: Sequence[str]) -> int:
    """`headway train`."""
    arguments, settings = parse_train(words)
    from headway import api
    from headway.training.progress import make_progress

    run = api.train(
        arguments.env,
        method=arguments.method,
        preset=arguments.preset,
        seed=arguments.seed,
        run_dir=arguments.run_dir,
        settings=settings,
        progress=make_progress(arguments.quiet),
        resume_from_last_good=arguments.resume_from_last_good,
        ignore_limits=arguments.ignore_limits,
    )
    if arguments.json:
        return _print_json(_facts(run))
    config = run.config
    title = f"{config.env}, {config.method} after {len(run.metrics)} iterations"
    _print_evaluation(_last_rows(run), config, title)
    print("Figures:", *run.figures, sep="\n  ")
    print("Test it again:", shlex.join(["headway", "evaluate", str(run.path)]), sep="\n  ")
    again = shlex.join(["headway", "train", *words])
    print("The command, which resumes what was interrupted:", again, sep="\n  ")
    return 0


def _last_rows(run: "Run") -> "list[EpisodeRow]":
    """The test episodes of a run's last iteration."""
    last = max((row.iteration for row in run.evaluation), default=0)
    return [row for row in run.evaluation if row.iteration == last]


def _facts(run: "Run") -> dict[str, Any]:
    return {
        "run_dir": str(run.path),
        "env": run.config.env,
        "method": run.config.method,
        "preset": run.config.preset,
        "seed": run.config.seed,
        "iterations": len(run.metrics),
        "timesteps": run.metrics[-1]["timesteps"],
        **_results(_last_rows(run), run.config),
        "figures": [str(path) for path in run.figures],
    }


def evaluate(words: Sequence[str]) -> int:
    """`headway evaluate`."""
    arguments, settings = parse_for_run(Evaluate(run=tyro.MISSING), words, "headway evaluate")
    from headway import api
    from headway.training.progress import make_progress

    found = api.evaluate(
        arguments.run,
        groups=arguments.group or None,
        num_episodes=arguments.episodes,
        settings=settings,
        progress=make_progress(arguments.quiet),
    )
    if arguments.json:
        cost = dataclasses.asdict(found.cost)
        facts = {"run_dir": str(arguments.run), "settings": settings, "planning": cost}
        return _print_json({**facts, **_results(found, found.config)})
    _print_evaluation(found, found.config, f"{arguments.run}")
    _print_cost(found.cost)
    return 0


def list_names(words: Sequence[str]) -> int:
    """`headway list`."""
    arguments = parse(List, List(what=tyro.MISSING), words, "headway list")
    from headway.report import tables
    from headway.report.comparison import terminal

    found = {"envs": tables.envs, "methods": tables.methods, "presets": tables.presets}
    found["experiments"] = terminal.experiments
    entries, table = found[arguments.what]()
    if arguments.json:
        return _print_json({arguments.what: entries})
    _print_tables(table)
    return 0


def plot_dynamics(words: Sequence[str]) -> int:
    """`headway plot-dynamics`."""
    default = PlotDynamics(env=tyro.MISSING)
    arguments = parse(PlotDynamics, default, words, "headway plot-dynamics")
    if arguments.num_states < 1:
        raise UsageError(f"--num-states is {arguments.num_states}, allowed: at least 1.")
    from headway.report import dynamics
    from headway.storage.files import check_target
    from headway.tasks.catalog import env_spec

    name = env_spec(arguments.env).name
    out = arguments.output or Path(f"{name}-dynamics.png")
    check_target(out)
    path = dynamics.plot_dynamics(name, out, num_states=arguments.num_states, seed=arguments.seed)
    if arguments.json:
        return _print_json({"env": name, "figure": str(path)})
    print(path)
    return 0


COMMANDS: dict[str, Callable[[Sequence[str]], int]] = {
    "train": train,
    "evaluate": evaluate,
    "record": record,
    "reproduce": reproduce,
    "sweep": sweep,
    "list": list_names,
    "plot-dynamics": plot_dynamics,
    "diagnose": diagnose,
    "report": report,
}


def parse_train(words: Sequence[str]) -> tuple[Train, dict[str, Any]]:
    """Parse `headway train`, whose defaults depend on environment, method and preset.

    Returns:
        The arguments, and every setting that differs from the preset's and method's.
    """

    def asked(first: Train) -> Config:
        from headway.experiment.methods import make_config

        return make_config(first.env, method=first.method, preset=first.preset)

    plain = Train(env=tyro.MISSING)
    arguments, config, settings = parse_twice(plain, asked, words, "headway train")
    if arguments.env_options:
        chosen = _env_options(arguments.env, arguments.env_options)
        settings["env_options"] = {**config.env_options, **chosen}
    if arguments.sim_params is not None:
        settings["sim_params"] = _read_sim_params(arguments.sim_params)
    return arguments, settings


def _env_options(env: str, words: Sequence[str]) -> dict[str, bool]:
    """Read `NAME`, `NAME=on` and `NAME=off`."""
    from headway.tasks.catalog import env_spec

    spec: EnvSpec = env_spec(env)
    values = {"": True, "on": True, "true": True, "off": False, "false": False}
    options = {}
    for word in words:
        name, _, value = word.partition("=")
        name = name.replace("-", "_")
        if name not in spec.options:
            raise unknown_name(f"{spec.name} option", name, spec.options)
        if value not in values:
            raise UsageError(f"--env-options {name} is {value!r}, allowed: on or off.")
        options[name] = values[value]
    return options


def _read_sim_params(path: Path) -> dict[str, Any]:
    """Read a file of training and unseen physics; the library checks what it holds."""
    from headway.storage import files

    try:
        return files.parse_json(files.read_bytes(path, MAX_SIM_PARAMS_BYTES))
    except ValueError as error:
        raise ConfigError(
            f"{path} is not JSON ({error}); write training and unseen sets."
        ) from None


def _results(rows: "Sequence[EpisodeRow]", config: Config) -> dict[str, Any]:
    from headway.report.tables import by_group, by_physics

    return {"groups": by_group(rows, config), "physics": by_physics(rows, config)}


def _print_evaluation(rows: "Sequence[EpisodeRow]", config: Config, title: str) -> None:
    from headway.report.tables import evaluation

    _print_tables(evaluation(rows, config, title))


def _print_cost(cost: "PlanningCost") -> None:
    time = "" if cost.seconds_per_step is None else f", {1e3 * cost.seconds_per_step:.3g} ms"
    candidates = f"{cost.evaluations_per_step:,.0f} candidates"
    print(f"Planning took {candidates}, {cost.flop_per_step / 1e9:.3g} GFLOP{time} per step.")
