"""Comparisons in one call: make what is missing of an experiment, then draw and tabulate it."""

import dataclasses
from collections.abc import Mapping
from pathlib import Path

from headway.report.comparison.figure import draw_comparison
from headway.report.comparison.runs import Found, find
from headway.report.comparison.writing import write_raw, write_table
from headway.sweeps.board import Board
from headway.sweeps.jobs import Comparison
from headway.sweeps.results_folder import claim
from headway.sweeps.running import Workers, run_jobs


@dataclasses.dataclass(frozen=True)
class Reproduced:
    """A comparison as far as its runs got."""

    found: Found
    """What the finished runs measured."""
    files: list[Path]
    """Figure (PNG and SVG), raw numbers (CSV) and table (Markdown)."""
    failures: Mapping[Path, str]
    """Why runs failed, by run directory; the others are drawn all the same."""


def reproduce(
    comparison: Comparison,
    *,
    workers: Workers | None = None,
    board: Board | None = None,
    command: str = "",
) -> Reproduced:
    """Make every run of a comparison that is missing, and write figure, CSV and table.

    Begun runs go on where they stand, finished ones are used as they are, also by other
    experiments with the same `out`. Figure, CSV and table replace those of the same comparison
    with fewer environments, seeds or arms, and no others.

    Args:
        comparison: The experiment, environments, seeds and scale.
        workers: Where the runs are made; on Ray on this machine by default, where installed.
        board: Shows how the runs stand; silent by default.
        command: The command line that asked for this; it is written below the table.

    Raises:
        UnknownNameError: No such environment, method or preset.
        ConfigError: A setting is unknown, of the wrong type or out of range.
    """
    with board or Board() as shown:
        if comparison.folder != comparison.usual_folder:
            shown.message(
                f"{comparison.usual_folder} holds another comparison, which stays; this one goes to"
                f" {comparison.folder}"
            )
        run_jobs(comparison.jobs, workers or Workers(), shown)
        failures = dict(shown.failures)
    found = find(comparison)
    claim(comparison.folder, comparison.facts)
    files = [*draw_comparison(found), write_raw(found), write_table(found, command)]
    return Reproduced(found, files, failures)
