"""What an experiment found: raw numbers as CSV, a table as Markdown, beside the figure."""

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from headway.experiment import files, storage
from headway.experiment.runs import RunDir
from headway.experiment.tables import format_sim_params
from headway.report.tables import by_group
from headway.sweeps.board import first_status
from headway.sweeps.jobs import Cell, Comparison, Job

RAW_COLUMNS = (
    "experiment", "arm", "env", "method", "preset", "seed", "iteration", "timesteps", "group",
    "sim_params", "episode", "return", "run",
)  # fmt: skip
COLLECTED = "collected"
MIN_SEEDS = 3

Row = dict[str, Any]


class Point(NamedTuple):
    """The mean return of one run after one iteration."""

    env: str
    arm: str
    seed: int
    iteration: int
    timesteps: int
    value: float


@dataclasses.dataclass(frozen=True)
class Found:
    """What the finished runs of a comparison measured."""

    comparison: Comparison
    rows: list[Row]
    """Every episode, as in the CSV."""
    points: list[Point]
    """Mean return of every run and tested iteration, over the episodes that are measured."""
    missing: list[Cell]
    """Places of the table whose run is not finished."""

    def of(self, env: str, arm: str) -> list[Point]:
        """The points of one arm in one environment."""
        return [point for point in self.points if (point.env, point.arm) == (env, arm)]

    def last(self, env: str, arm: str) -> list[Point]:
        """The same after the last iteration: one per seed."""
        points = self.of(env, arm)
        final = max((point.iteration for point in points), default=0)
        return [point for point in points if point.iteration == final]

    @property
    def final_points(self) -> list[Point]:
        """The points after the last iteration, of every environment and arm."""
        comparison = self.comparison
        arms = comparison.experiment.arms
        return [p for env in comparison.envs for arm in arms for p in self.last(env, arm.label)]


def find(comparison: Comparison) -> Found:
    """Read the finished runs of a comparison; a damaged one counts as missing."""
    rows, points, missing = [], [], []
    for cell, job in comparison.cells.items():
        if first_status(job).state != "done":
            missing.append(cell)
            continue
        measured = _episodes(comparison, cell, job)
        rows += measured
        points += _points(comparison, cell, measured)
    return Found(comparison, rows, points, missing)


def _episodes(comparison: Comparison, cell: Cell, job: Job) -> list[Row]:
    """Every episode of a run that the experiment looks at."""
    run = RunDir(job.path)
    metrics = run.metrics()
    common = {
        "experiment": comparison.experiment.name,
        "arm": cell.arm,
        "env": cell.env,
        "method": job.config.method,
        "preset": job.config.preset,
        "seed": cell.seed,
        "run": job.path.relative_to(comparison.out).as_posix(),
    }
    if comparison.experiment.measure == COLLECTED:
        return [
            {
                **common,
                "iteration": line["iteration"],
                "timesteps": line["timesteps"],
                "group": COLLECTED,
                "sim_params": "",
                "episode": episode,
                "return": value,
            }
            for line in metrics
            for episode, value in enumerate(line["collection"]["returns"])
        ]
    return [
        {
            **common,
            "iteration": row.iteration,
            "timesteps": metrics[row.iteration]["timesteps"],
            "group": row.group,
            "sim_params": format_sim_params(row.sim_params),
            "episode": row.episode,
            "return": row.episode_return,
        }
        for row in run.evaluation()
    ]


def _points(comparison: Comparison, cell: Cell, rows: Sequence[Row]) -> list[Point]:
    """The mean of every iteration; training physics do not count as unseen ones."""
    measured = [row for row in rows if row["group"] != "train"]
    returns: dict[tuple[int, int], list[float]] = {}
    for row in measured:
        returns.setdefault((row["iteration"], row["timesteps"]), []).append(row["return"])
    return [Point(*cell[:2], cell.seed, *when, float(np.mean(r))) for when, r in returns.items()]


def write_raw(found: Found) -> Path:
    """Write every episode's return."""
    path = found.comparison.folder / f"{found.comparison.experiment.name}.csv"
    storage.write_csv(path, RAW_COLUMNS, found.rows)
    return path


def write_table(found: Found, command: str) -> Path:
    """Write the returns after the last iteration, and how they came about.

    Args:
        found: What the runs measured.
        command: The command that makes it all again.
    """
    comparison = found.comparison
    experiment = comparison.experiment
    lines = [f"# {experiment.name}: {experiment.title}", "", *_about(found), ""]
    for env in comparison.envs:
        lines += [f"## {env}", "", *_markdown(table_columns(found), table_rows(found, env)), ""]
    lines += ["The command, which resumes what was interrupted:", "", f"    {command}", ""]
    path = comparison.folder / f"{experiment.name}.md"
    files.write_bytes(path, "\n".join(lines).encode())
    return path


def table_columns(found: Found) -> list[str]:
    """The headings of the table."""
    if found.comparison.experiment.measure == COLLECTED:
        return ["arm", "seeds", "return while collecting"]
    return ["arm", "seeds", "return on unseen physics", "on training physics", "score, unseen"]


def table_rows(found: Found, env: str) -> list[list[str]]:
    """A line of cells for every arm in one environment."""
    collected = found.comparison.experiment.measure == COLLECTED
    lines = []
    for arm in found.comparison.experiment.arms:
        points = found.last(env, arm.label)
        line = [arm.label, str(len(points)), spread([point.value for point in points])]
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
    training, scores = [], []
    for cell, job in found.comparison.cells.items():
        if (cell.env, cell.arm) != (env, arm) or cell in found.missing:
            continue
        last = [r for r in RunDir(job.path).evaluation() if r.iteration == job.num_iterations - 1]
        groups = by_group(last)
        training += [g["return_mean"] for g in groups if g["group"] == "train"]
        unseen = [g["score"] for g in groups if g["group"] != "train"]
        scores += [] if None in unseen else [float(np.mean(unseen))]
    return [spread(training), "–" if not scores else f"{np.mean(scores):.2f}"]


def _about(found: Found) -> list[str]:
    comparison = found.comparison
    seeds = ", ".join(map(str, comparison.seeds))
    changed = "".join(f", {name} {value}" for name, value in comparison.settings.items())
    lines = [
        f"Preset `{comparison.preset}`{changed}, seeds {seeds}. Mean ± standard deviation over"
        " seeds after the last iteration; a score of 0 is random, 1 the planner on the true"
        " dynamics.",
    ]
    if len(comparison.seeds) < MIN_SEEDS:
        lines.append(f"Fewer than {MIN_SEEDS} seeds: no difference between arms can be claimed.")
    if found.missing:
        names = "; ".join(f"{cell.env}, {cell.arm}, seed {cell.seed}" for cell in found.missing)
        lines.append(f"Not finished: {names}.")
    return lines


def _markdown(columns: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    rule = ["---"] * len(columns)
    return [f"| {' | '.join(cells)} |" for cells in (columns, rule, *rows)]
