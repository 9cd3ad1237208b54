"""The commands that look at finished runs: parse, call the library, print."""

from collections.abc import Sequence

import tyro

from headway.cli.arguments import Diagnose, Record, Report
from headway.cli.defaults import parse_for_run
from headway.cli.output import print_json, print_tables
from headway.cli.usage import UsageError, parse


def report(words: Sequence[str]) -> int:
    """`headway report`."""
    arguments = parse(Report, Report(runs=tyro.MISSING), words, "headway report")
    if not arguments.runs:
        raise UsageError("missing argument RUN. `headway report --help` explains.")
    from headway.report.page.build import write_report
    from headway.storage.files import check_target

    check_target(arguments.output)
    path = write_report(arguments.runs, arguments.output, only=arguments.only)
    if arguments.json:
        return print_json({"report": str(path)})
    print(path)
    return 0


def diagnose(words: Sequence[str]) -> int:
    """`headway diagnose`."""
    arguments, settings = parse_for_run(Diagnose(run=tyro.MISSING), words, "headway diagnose")
    from headway.report import diagnosis
    from headway.training.progress import make_progress

    found = diagnosis.diagnose(
        arguments.run,
        groups=arguments.group or None,
        num_episodes=arguments.episodes,
        collected=arguments.collected,
        settings=settings,
        progress=make_progress(arguments.quiet),
    )
    if arguments.json:
        return print_json(diagnosis.facts(found))
    print_tables(*diagnosis.tables(found))
    return 0


def record(words: Sequence[str]) -> int:
    """`headway record`."""
    arguments, settings = parse_for_run(Record(run=tyro.MISSING), words, "headway record")
    from headway.report import recording
    from headway.storage.files import check_target
    from headway.training.progress import make_progress

    check_target(arguments.output)
    found = recording.record(
        arguments.run,
        arguments.output,
        sim_params=_physics(arguments.sim_params, "--sim-params"),
        schedule=_schedule(arguments.schedule),
        seed=arguments.seed,
        num_steps=arguments.steps,
        settings=settings,
        progress=make_progress(arguments.quiet),
    )
    if arguments.json:
        facts = {"film": str(found.path), "env": found.env, "steps": found.steps}
        return print_json({**facts, "return": found.episode_return})
    print(f"{found.path}: {found.steps} steps, return {found.episode_return:.1f}")
    return 0


def _physics(words: Sequence[str], option: str) -> dict[str, float]:
    """Read `length=0.5 mass=2`."""
    from headway.storage.tables import parse_sim_params

    try:
        return parse_sim_params(" ".join(words))
    except ValueError as error:
        raise UsageError(f"{option}: {error}.") from None


def _schedule(words: Sequence[str]) -> dict[int, dict[str, float]]:
    """Read `60:length=0.5 120:length=1`."""
    found: dict[int, dict[str, float]] = {}
    for word in words:
        step, colon, change = word.partition(":")
        if not colon or not step.isdecimal():
            raise UsageError(
                f"--schedule is {word!r}, allowed: a step and what changes then, as in"
                " 60:length=0.5."
            )
        found.setdefault(int(step), {}).update(_physics([change], "--schedule"))
    return found
