"""The commands that look at finished runs: parse, call the library, print."""

from collections.abc import Sequence

import tyro

from headway.cli.arguments import Report
from headway.cli.output import print_json
from headway.cli.usage import parse


def report(words: Sequence[str]) -> int:
    """`headway report`."""
    arguments = parse(Report, Report(runs=tyro.MISSING), words, "headway report")
    from headway.report.page.build import write_report

    path = write_report(arguments.runs, arguments.output, only=arguments.only)
    if arguments.json:
        return print_json({"report": str(path)})
    print(path)
    return 0
