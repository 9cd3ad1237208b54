"""What is compared: one number per run and group of physics, and curves over iterations."""

import dataclasses
import itertools
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from headway.report import statistics
from headway.report.page.runs import LoadedRun, Row
from headway.report.page.scoring import Outcome, by_physics, outcome
from headway.report.page.series import Comparison, Series

TRAIN = "train"
COLLECTED = "collected"

RAW_COLUMNS = (
    "env", "method", "seed", "group", "sim_params", "episodes", "return_mean", "return_std",
    "score", "run",
)  # fmt: skip


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
    runs = comparison.outcomes.get((env, series.label), [])
    return [run[group] for run in runs if group in run]


def has_scores(comparison: Comparison, env: str) -> bool:
    """Whether every finished run of an environment has a score on every group."""
    runs = [run for place, found in comparison.outcomes.items() if place[0] == env for run in found]
    found = [one for run in runs for one in run.values()]
    return bool(found) and all(one.score is not None for one in found)


def values(comparison: Comparison, env: str, series: Series, group: str) -> list[float]:
    """What is compared in an environment: scores where all are known, else returns."""
    with_score = has_scores(comparison, env)
    return [
        one.score if with_score and one.score is not None else one.episode_return
        for one in outcomes(comparison, env, series, group)
    ]


def unlike(comparison: Comparison) -> list[tuple[str, str]]:
    """Environments and groups in which methods were not tested alike (`Comparison.tasks`)."""
    found: dict[tuple[str, str], set[frozenset]] = {}
    for (env, _, group), places in comparison.tasks.items():
        found.setdefault((env, group), set()).add(places)
    return [name for name, tasks in found.items() if len(tasks) > 1]


def improvement(
    comparison: Comparison, first: Series, second: Series
) -> statistics.Improvement | None:
    """Probability that one series beats another on the unseen groups that both were tested on.

    A group counts where both were tested alike (`unlike`), and all of their runs were.
    """
    pairs, envs = [], []
    for env in comparison.envs:
        for group in groups(comparison, env):
            if group != TRAIN and _compared(comparison, env, first, second, group):
                pairs.append([values(comparison, env, one, group) for one in (first, second)])
                envs.append(env)
    if not pairs:
        return None
    return statistics.probability_of_improvement(*zip(*pairs, strict=True), envs=envs)


def _compared(comparison: Comparison, env: str, first: Series, second: Series, group: str) -> bool:
    names = [(env, one.label) for one in (first, second)]
    runs = [run for name in names for run in comparison.outcomes.get(name, [])]
    everywhere = bool(runs) and all(group in run for run in runs)
    one, other = (comparison.tasks.get((*name, group)) for name in names)
    return everywhere and one is not None and one == other


def improvements_of(comparison: Comparison) -> dict[tuple[str, str], statistics.Improvement]:
    """The same for all pairs of series that can be compared, by their labels, both ways round."""
    pairs = itertools.combinations(comparison.series, 2)
    found = {(a.label, b.label): improvement(comparison, a, b) for a, b in pairs}
    known = {pair: estimate for pair, estimate in found.items() if estimate is not None}
    return {**known, **{(b, a): estimate.complement for (a, b), estimate in known.items()}}


def aggregate(comparison: Comparison, series: Series) -> statistics.Estimate | None:
    """Interquartile mean score over all unseen groups; None unless it was tested on each."""
    tasks, envs = [], []
    for env in comparison.envs:
        if not has_scores(comparison, env):
            return None
        for group in groups(comparison, env):
            if group != TRAIN:
                tasks.append(values(comparison, env, series, group))
                envs.append(env)
    complete = all(_is_complete(comparison, env, series) for env in comparison.envs)
    return statistics.estimate(tasks, envs=envs) if tasks and complete else None


def _is_complete(comparison: Comparison, env: str, series: Series) -> bool:
    """Whether every finished run of a series was tested on all unseen groups."""
    wanted = [group for group in groups(comparison, env) if group != TRAIN]
    runs = comparison.outcomes.get((env, series.label), [])
    return bool(runs) and all(group in run for run in runs for group in wanted)


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
        tables = row if group == COLLECTED else row.get("evaluation", {})
        summary = tables.get("collection" if group == COLLECTED else group)
        if summary is not None:
            found[row["iteration"]] = row["timesteps"], summary["return_mean"]
    return found


def raw_rows(comparison: Comparison) -> list[Row]:
    """Every finished run's returns for each physics, those of references last."""
    rows = []
    for env in comparison.envs:
        for series in comparison.series_of(env):
            for run in comparison.runs_of(env, series):
                rows += _raw(comparison, run, series.label)
    for run, label in zip(comparison.reference_runs, comparison.reference_labels, strict=True):
        rows += _raw(comparison, run, label)
    return rows


def _raw(comparison: Comparison, run: LoadedRun, label: str) -> list[Row]:
    rows = []
    for group in dict.fromkeys(row.group for row in run.tests):
        for physics, same in by_physics([r for r in run.tests if r.group == group]).items():
            returns = np.array([row.episode_return for row in same])
            score = outcome(same, comparison.references, run.config).score
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
