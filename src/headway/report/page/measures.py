"""What is compared: one number per run and group of physics, and curves over iterations."""

import dataclasses
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from headway.experiment.tables import EpisodeRow, format_sim_params
from headway.report import statistics
from headway.report.page.runs import LoadedRun, Row
from headway.report.page.scoring import References
from headway.report.page.series import Comparison, Series

TRAIN = "train"
COLLECTED = "collected"

RAW_COLUMNS = (
    "env", "method", "seed", "group", "sim_params", "episodes", "return_mean", "return_std",
    "score", "run",
)  # fmt: skip


@dataclasses.dataclass(frozen=True)
class Outcome:
    """How one run did on one group after its last iteration."""

    episode_return: float
    """Mean over the group's physics, each counting once."""
    score: float | None
    """The same of scores; None unless references are known for all of them."""


@dataclasses.dataclass(frozen=True)
class Curve:
    """Return of a series over its iterations."""

    steps: Float[np.ndarray, " iteration"]
    """Environment steps collected, mean over seeds."""
    runs: Float[np.ndarray, "seed iteration"]
    """Mean return of every seed."""
    low: Float[np.ndarray, " iteration"] | None
    """Lower end of the 95 % interval of the mean; None from fewer than three seeds."""
    high: Float[np.ndarray, " iteration"] | None
    unfinished: list[tuple[Float[np.ndarray, " iteration"], Float[np.ndarray, " iteration"]]]
    """Steps and returns of runs that are still on their way; no part of the mean."""


def outcome(rows: Sequence[EpisodeRow], references: References) -> Outcome:
    """Summarise one run's test episodes of one group."""
    returns, scores = [], []
    for same in by_physics(rows).values():
        returns.append(np.mean([row.episode_return for row in same]))
        known = [references.score(row) for row in same]
        scores.append(None if None in known else float(np.mean(known)))
    whole = None if None in scores else float(np.mean(scores))
    return Outcome(float(np.mean(returns)), whole)


def by_physics(rows: Sequence[EpisodeRow]) -> dict[str, list[EpisodeRow]]:
    """Episodes by their simulator parameters."""
    found: dict[str, list[EpisodeRow]] = {}
    for row in rows:
        found.setdefault(format_sim_params(row.sim_params), []).append(row)
    return found


def groups(comparison: Comparison, env: str) -> list[str]:
    """The groups that were tested in an environment, training first."""
    found = dict.fromkeys(row.group for run in comparison.runs_of(env) for row in run.tests)
    return sorted(found, key=lambda group: group != TRAIN)


def curve_groups(comparison: Comparison, env: str) -> list[str]:
    """The groups that any iteration of an environment's runs was tested on, and `collected`."""
    rows = [row for run in comparison.runs_of(env) for row in run.metrics]
    found = dict.fromkeys(group for row in rows for group in row.get("evaluation", {}))
    return [COLLECTED, *sorted(found, key=lambda group: group != TRAIN)]


def outcomes(comparison: Comparison, env: str, series: Series, group: str) -> list[Outcome]:
    """One outcome per finished run of a series, in the order of seeds."""
    found = []
    for run in comparison.runs_of(env, series):
        rows = [row for row in run.tests if row.group == group]
        if rows:
            found.append(outcome(rows, comparison.references))
    return found


def has_scores(comparison: Comparison, env: str) -> bool:
    """Whether every finished run of an environment has a score on every group."""
    found = [
        one
        for series in comparison.series_of(env)
        for group in groups(comparison, env)
        for one in outcomes(comparison, env, series, group)
    ]
    return bool(found) and all(one.score is not None for one in found)


def values(comparison: Comparison, env: str, series: Series, group: str) -> list[float]:
    """What is compared in an environment: scores where all are known, else returns."""
    with_score = has_scores(comparison, env)
    return [
        one.score if with_score and one.score is not None else one.episode_return
        for one in outcomes(comparison, env, series, group)
    ]


def improvement(
    comparison: Comparison, first: Series, second: Series
) -> statistics.Estimate | None:
    """Probability that one series beats another on the unseen groups that both were tested on."""
    tasks = [
        (values(comparison, env, first, group), values(comparison, env, second, group))
        for env in comparison.envs
        for group in groups(comparison, env)
        if group != TRAIN
    ]
    tasks = [(a, b) for a, b in tasks if a and b]
    if not tasks:
        return None
    return statistics.probability_of_improvement(*zip(*tasks, strict=True))


def aggregate(comparison: Comparison, series: Series) -> statistics.Estimate | None:
    """Interquartile mean score over all unseen groups; None unless it was tested on each."""
    tasks = []
    for env in comparison.envs:
        if not has_scores(comparison, env):
            return None
        tasks += [
            values(comparison, env, series, group)
            for group in groups(comparison, env)
            if group != TRAIN
        ]
    return statistics.estimate(tasks) if tasks and all(tasks) else None


def curve(runs: Sequence[LoadedRun], group: str) -> Curve | None:
    """Return over iterations; None where nothing was measured.

    Where some runs are finished, the mean is theirs; else it goes as far as all of them go.

    Args:
        runs: The runs of one series in one environment.
        group: A tested group, or `collected` for the training episodes.
    """
    measured = [(run.is_finished, found) for run in runs if (found := _returns(run, group))]
    if not measured:
        return None
    finished = [found for is_finished, found in measured if is_finished]
    tables = finished or [found for _, found in measured]
    common = sorted(set.intersection(*(set(table) for table in tables)))
    points = np.array([[table[i] for i in common] for table in tables]).reshape(len(tables), -1, 2)
    others = [found for is_finished, found in measured if finished and not is_finished]
    unfinished = [tuple(np.array(list(found.values())).T) for found in others]
    steps, returns = points[..., 0].mean(0), points[..., 1]
    ends = [statistics.interval([column], statistics.mean) for column in returns.T]
    if None in ends or not ends:
        return Curve(steps, returns, None, None, unfinished)
    low, high = np.array(ends).T
    return Curve(steps, returns, low, high, unfinished)


def _returns(run: LoadedRun, group: str) -> dict[int, tuple[float, float]]:
    """Steps and mean return by iteration."""
    found = {}
    for row in run.metrics:
        summary = row["collection"] if group == COLLECTED else row.get("evaluation", {}).get(group)
        if summary is not None:
            found[row["iteration"]] = row["timesteps"], summary["return_mean"]
    return found


def raw_rows(comparison: Comparison) -> list[Row]:
    """Every finished run's returns for each physics."""
    rows = []
    for env in comparison.envs:
        for series in comparison.series_of(env):
            for run in comparison.runs_of(env, series):
                rows += _raw(comparison, run, series.label)
    return rows


def _raw(comparison: Comparison, run: LoadedRun, label: str) -> list[Row]:
    rows = []
    for group in dict.fromkeys(row.group for row in run.tests):
        for physics, same in by_physics([r for r in run.tests if r.group == group]).items():
            returns = np.array([row.episode_return for row in same])
            score = outcome(same, comparison.references).score
            rows.append(
                {
                    "env": run.config.env,
                    "method": label,
                    "seed": run.config.seed,
                    "group": group,
                    "sim_params": physics,
                    "episodes": len(same),
                    "return_mean": round(float(returns.mean()), 4),
                    "return_std": round(float(returns.std()), 4),
                    "score": "" if score is None else round(score, 4),
                    "run": str(run.path),
                }
            )
    return rows
