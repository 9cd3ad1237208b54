"""What an experiment found: raw numbers as CSV, a table as Markdown, beside the figure."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from headway.report.comparison.runs import COLLECTED, Found
from headway.report.comparison.scores import last_tests, unseen_scores
from headway.report.comparison.verdicts import interquartile, verdicts
from headway.report.statistics import MIN_RUNS
from headway.training.run import csv_text, write_bytes

RAW_COLUMNS = (
    "experiment", "arm", "env", "method", "preset", "seed", "iteration", "timesteps", "group",
    "sim_params", "episode", "return", "run",
)  # fmt: skip
IQM = "interquartile mean (95 %)"


def write_raw(found: Found) -> Path:
    """Write every episode's return."""
    path = found.comparison.folder / f"{found.comparison.experiment.name}.csv"
    write_bytes(path, csv_text(RAW_COLUMNS, found.rows).encode())
    return path


def write_table(found: Found, command: str) -> Path:
    """Write the returns after the last iteration, and how they came about.

    Args:
        found: What the runs measured.
        command: The command that makes it all again; may be empty.
    """
    comparison = found.comparison
    experiment = comparison.experiment
    lines = [f"# {experiment.name}: {experiment.title}", "", *_about(found), ""]
    for env in comparison.envs:
        lines += [f"## {env}", "", *_markdown(table_columns(found), table_rows(found, env)), ""]
    if len(comparison.seeds) >= MIN_RUNS:
        lines += ["## What can be claimed", "", *(f"- {line}" for line in verdicts(found)), ""]
    if command:
        lines += ["The command, which resumes what was interrupted:", "", f"    {command}", ""]
    path = comparison.folder / f"{experiment.name}.md"
    write_bytes(path, "\n".join(lines).encode())
    return path


def table_columns(found: Found) -> list[str]:
    """The headings of the table."""
    if found.comparison.experiment.measure == COLLECTED:
        return ["arm", "seeds", "return while collecting", IQM]
    return ["arm", "seeds", "return on unseen physics", IQM, "on training physics", "score"]


def table_rows(found: Found, env: str) -> list[list[str]]:
    """A line of cells for every arm in one environment."""
    collected = found.comparison.experiment.measure == COLLECTED
    lines = []
    for arm in found.comparison.experiment.arms:
        points = found.last(env, arm.label)
        line = [arm.label, str(len(points)), spread([point.value for point in points])]
        line.append(interquartile(found, env, arm.label))
        if not collected:
            line += _training_and_score(found, env, arm.label)
        lines.append(line)
    return lines


def spread(values: Sequence[float]) -> str:
    """Word the mean and the standard deviation over seeds."""
    if not values:
        return "–"
    if len(values) == 1:
        return f"{values[0]:,.1f}"
    return f"{np.mean(values):,.1f} ± {np.std(values, ddof=1):,.1f}"


def _training_and_score(found: Found, env: str, arm: str) -> list[str]:
    """The last return on training physics, and the mean score of the unseen groups."""
    tests = last_tests(found, env, arm)
    training = [one["return_mean"] for run in tests for one in run if one["group"] == "train"]
    scores = unseen_scores(tests)
    return [spread(training), "–" if not scores else f"{np.mean(scores):.2f}"]


def _about(found: Found) -> list[str]:
    comparison = found.comparison
    seeds = ", ".join(map(str, comparison.seeds))
    changed = "".join(f", {name} {value}" for name, value in comparison.settings.items())
    lines = [
        f"Preset `{comparison.preset}`{changed}, seeds {seeds}. Mean ± standard deviation over"
        " seeds after the last iteration; interquartile mean with its 95 % stratified bootstrap"
        " interval. Every physics of a group counts once. The score is that on unseen physics: 0"
        " is random, 1 the paper's planner on the"
        " true dynamics.",
    ]
    if len(comparison.seeds) < MIN_RUNS:
        lines.append(f"Fewer than {MIN_RUNS} seeds: no difference between arms can be claimed.")
    if found.missing:
        names = "; ".join(f"{cell.env}, {cell.arm}, seed {cell.seed}" for cell in found.missing)
        lines.append(f"Not finished: {names}.")
    return lines


def _markdown(columns: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    rule = ["---"] * len(columns)
    return [f"| {' | '.join(cells)} |" for cells in (columns, rule, *rows)]
