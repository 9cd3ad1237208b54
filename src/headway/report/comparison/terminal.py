"""Experiments, what is to be done for one, and what it found, as tables on a terminal."""

from typing import Any

from rich.table import Table

from headway.report.comparison.runs import Found
from headway.report.comparison.writing import table_columns, table_rows
from headway.report.tables import new_table
from headway.sweeps.cost import Plan
from headway.sweeps.experiments import EXPERIMENTS
from headway.sweeps.jobs import Comparison
from headway.sweeps.status import duration

Facts = dict[str, Any]


def experiments() -> tuple[list[Facts], Table]:
    """Describe every experiment."""
    table = new_table("Experiments", "name", "what is compared", "arms")
    entries = []
    for found in EXPERIMENTS.values():
        arms = [
            {"label": arm.label, "method": arm.method, "settings": dict(arm.settings)}
            for arm in found.arms
        ]
        entries.append({"name": found.name, "title": found.title, "arms": arms})
        table.add_row(found.name, found.title, ", ".join(arm.label for arm in found.arms))
    table.caption = "headway reproduce NAME --envs pendulum --seeds 0:3 --preset quick"
    return entries, table


def plan(comparison: Comparison, planned: Plan) -> tuple[Facts, Table]:
    """Describe every run of a comparison, and what the missing ones take."""
    labels: dict[Any, list[str]] = {}
    for cell, job in comparison.cells.items():
        labels.setdefault(job.path, []).append(cell.arm)
    table = new_table(f"Runs of {comparison.experiment.name}", "run", "arms", "state")
    for name in ("iterations", "TFLOP", "about"):
        table.add_column(name, justify="right")
    entries = []
    for one in planned.jobs:
        job, seconds = one.job, planned.seconds([one])
        place = job.path.relative_to(comparison.out / "runs").as_posix()
        state = "begun" if one.state == "waiting" and one.finished_iterations else one.state
        entries.append(
            {
                "run_dir": str(job.path),
                "arms": labels[job.path],
                "state": state,
                "finished_iterations": one.finished_iterations,
                "iterations": job.num_iterations,
                "flop": one.flop,
                "seconds": seconds,
            }
        )
        table.add_row(
            place,
            ", ".join(labels[job.path]),
            state,
            f"{one.finished_iterations}/{job.num_iterations}",
            f"{one.flop / 1e12:,.3g}",
            duration(seconds) if seconds else "–",
        )
    total = planned.seconds()
    missing = sum(one.state == "waiting" for one in planned.jobs)
    table.caption = (
        f"{missing} of {len(planned.jobs)} runs are missing: about {duration(total)} one after"
        f" another at {planned.flop_per_second / 1e9:,.3g} GFLOP/s ({planned.source};"
        " compiling and simulating come on top)"
    )
    facts = {"runs": entries, "seconds": total, "speed_from": planned.source}
    return facts, table


def results(found: Found) -> list[Table]:
    """Lay out what was found: a table per environment."""
    tables = []
    for env in found.comparison.envs:
        table = new_table(f"{found.comparison.experiment.name}, {env}")
        for column in table_columns(found):
            table.add_column(column, justify="left" if column == "arm" else "right")
        for cells in table_rows(found, env):
            table.add_row(*cells)
        tables.append(table)
    return tables
