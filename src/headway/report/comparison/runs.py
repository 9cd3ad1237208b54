"""What the finished runs of an experiment measured."""

import dataclasses
import functools
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from headway.sweeps.board import first_status
from headway.sweeps.jobs import Cell, Comparison, Job
from headway.task import env_options, episode_length, sim_param_sets
from headway.training.run import RunDir, format_sim_params

COLLECTED = "collected"

Row = dict[str, Any]
Protocol = tuple[dict[str, list[str]], int, dict[str, bool]]


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

    def run_returns(self, env: str, arm: str) -> dict[str, dict[int, float]]:
        """Return of each group after the last iteration, by seed; not of training.

        Every physics of a group counts once.
        """
        final = {(point.seed, point.iteration) for point in self.last(env, arm)}
        found: dict[str, dict[int, dict[str, list[float]]]] = {}
        for row in self._rows_by_arm.get((env, arm), []):
            if row["group"] != "train" and (row["seed"], row["iteration"]) in final:
                by_seed = found.setdefault(row["group"], {}).setdefault(row["seed"], {})
                by_seed.setdefault(row["sim_params"], []).append(row["return"])
        return {
            group: {seed: mean_of_physics(physics) for seed, physics in by_seed.items()}
            for group, by_seed in found.items()
        }

    @functools.cached_property
    def _rows_by_arm(self) -> dict[tuple[str, str], list[Row]]:
        found: dict[tuple[str, str], list[Row]] = {}
        for row in self.rows:
            found.setdefault((row["env"], row["arm"]), []).append(row)
        return found

    @functools.cached_property
    def cells(self) -> dict[Cell, Job]:
        """The places of the table with their jobs; to resolve all settings takes a while."""
        return self.comparison.cells

    def protocol(self, env: str, arm: str) -> Protocol:
        """How an arm was tested: physics by group, steps of an episode, options."""
        cell = Cell(env, arm, self.comparison.seeds[0])
        config = self.cells[cell].config
        physics = sim_param_sets(config)
        groups = {
            name: sorted(map(format_sim_params, physics.group(name)))
            for name in physics.group_names
            if name != "train"
        }
        return groups, episode_length(config), env_options(config)

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
            for episode, value in enumerate(line.get("collection", {}).get("returns", ()))
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
    returns: dict[tuple[int, int], dict[str, list[float]]] = {}
    for row in rows:
        if row["group"] != "train":
            physics = returns.setdefault((row["iteration"], row["timesteps"]), {})
            physics.setdefault(row["sim_params"], []).append(row["return"])
    return [
        Point(*cell[:2], cell.seed, *when, mean_of_physics(physics))
        for when, physics in returns.items()
    ]


def mean_of_physics(returns: Mapping[str, Sequence[float]]) -> float:
    """Mean return, every physics counting once however many episodes it had."""
    return float(np.mean([np.mean(values) for values in returns.values()]))
