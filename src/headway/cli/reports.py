"""The commands that look at finished runs: parse, call the library, print."""

from collections.abc import Sequence

import tyro

from headway.cli.arguments import Diagnose, Report
from headway.cli.output import print_json, print_tables
from headway.cli.usage import UsageError, parse


def report(words: Sequence[str]) -> int:
    """`headway report`."""
    arguments = parse(Report, Report(runs=tyro.MISSING), words, "headway report")
    if not arguments.runs:
        raise UsageError("missing argument RUN. `headway report --help` explains.")
    from headway.report.page.build import write_report

    path = write_report(arguments.runs, arguments.output, only=arguments.only)
    if arguments.json:
        return print_json({"report": str(path)})
    print(path)
    return 0


def diagnose(words: Sequence[str]) -> int:
    """`headway diagnose`."""
    arguments = parse(Diagnose, Diagnose(run=tyro.MISSING), words, "headway diagnose")
    from headway.experiment.progress import make_progress
    from headway.report import diagnosis

    found = diagnosis.diagnose(
        arguments.run,
        groups=arguments.group or None,
        num_episodes=arguments.episodes,
        collected=arguments.collected,
        progress=make_progress(arguments.quiet),
    )
    if arguments.json:
        return print_json(diagnosis.facts(found))
    print_tables(*diagnosis.tables(found))
    return 0
