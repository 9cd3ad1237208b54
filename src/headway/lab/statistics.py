"""Statistics over few seeds and several tasks (Agarwal et al., 2021, arXiv 2108.13264).

Scores come as one array `[run, task]` per environment: a run is one seed, a task a group of
physics. Runs of an environment are resampled as a whole, because its groups are tests of the same
trained models. From fewer than `MIN_RUNS` runs there is no interval, and nothing is claimed.
"""

import dataclasses
import math
from collections.abc import Callable, Sequence

import numpy as np
import pandas as pd
from scipy import stats

Scores = Sequence[np.ndarray]
Statistic = Callable[[Scores], np.ndarray]

MIN_RUNS = 3
ENOUGH_RUNS = 10  # bootstrap intervals of fewer seeds are too narrow
SIGNIFICANCE = 0.05
NUM_RESAMPLES = 10_000


@dataclasses.dataclass(frozen=True)
class Estimate:
    """A statistic with its 95 % interval, which is None from fewer than `MIN_RUNS` runs."""

    value: float
    interval: tuple[float, float] | None
    num_runs: int
    """Runs of the environment that has the fewest."""
    p_value: float = 1.0
    """Of a probability of improvement: two-sided, by permutation of runs within environments."""
    lowest_p: float = 1.0
    """The p-value of the clearest result that so many runs can have."""


def mean(scores: Scores) -> np.ndarray:
    """Mean over tasks of the mean over runs; leading axes are kept."""
    return np.concatenate([env.mean(-2) for env in scores], axis=-1).mean(-1)


def interquartile_mean(scores: Scores) -> np.ndarray:
    """Mean of the middle half of all runs of all tasks; leading axes are kept."""
    flat = [env.reshape(*env.shape[:-2], -1) for env in scores]
    return stats.trim_mean(np.concatenate(flat, axis=-1), 0.25, axis=-1)


def improvement_share(first: Scores, second: Scores) -> np.ndarray:
    """Share of pairs of runs in which the first wins (Mann-Whitney), mean over tasks; ties half."""
    wins = [
        0.5 + 0.5 * np.sign(x[..., :, None, :] - y[..., None, :, :]).mean((-3, -2))
        for x, y in zip(first, second, strict=True)
    ]
    return np.concatenate(wins, axis=-1).mean(-1)


def estimate(scores: Scores, statistic: Statistic = interquartile_mean) -> Estimate:
    """A statistic with its stratified percentile bootstrap interval.

    Args:
        scores: `[run, task]` per environment.
        statistic: Maps arrays `[..., run, task]` to `[...]`.
    """
    arrays = [np.asarray(env, float) for env in scores]
    value, fewest = float(statistic(arrays)), min(map(len, arrays))
    if fewest < MIN_RUNS:
        return Estimate(value, None, fewest)

    def of_runs(*drawn: np.ndarray, axis: int) -> np.ndarray:
        return statistic([env[d.astype(int)] for env, d in zip(arrays, drawn, strict=True)])

    ends = stats.bootstrap(
        [np.arange(len(env)) for env in arrays],
        of_runs,
        n_resamples=NUM_RESAMPLES,
        vectorized=True,
        method="percentile",
        rng=np.random.default_rng(0),
    ).confidence_interval
    return Estimate(value, (float(ends.low), float(ends.high)), fewest)


def improvement(first: Scores, second: Scores) -> Estimate:
    """Probability that a run of one method beats a run of another, averaged over tasks.

    Its p-value is that of a stratified permutation test: runs of both methods change places within
    every environment. SciPy's test has no strata.
    """
    both, half = [*first, *second], len(first)
    found = estimate(both, lambda runs: improvement_share(runs[:half], runs[half:]))
    rng = np.random.default_rng(0)
    shuffled, ways = [], 1
    for x, y in zip(first, second, strict=True):
        pooled = np.concatenate([x, y])
        orders = rng.permuted(np.tile(np.arange(len(pooled)), (NUM_RESAMPLES, 1)), axis=1)
        shuffled.append(np.split(pooled[orders], [len(x)], axis=1))
        ways *= math.comb(len(pooled), len(x))
    distances = np.abs(improvement_share(*zip(*shuffled, strict=True)) - 0.5)
    as_far = (distances >= abs(found.value - 0.5) - 1e-12).sum()
    p_value = (as_far + 1) / (NUM_RESAMPLES + 1)
    return dataclasses.replace(found, p_value=float(p_value), lowest_p=2 / ways)


def verdict(first: str, second: str, found: Estimate) -> str:
    """Word what a probability of improvement shows; `caution` belongs beside it.

    One method is better only where the interval leaves out 0.5 and the p-value is below
    `SIGNIFICANCE`. Where no result of so few runs could be, what is seen is said, nothing claimed.
    """
    seeds = f"{found.num_runs} seed{'s' * (found.num_runs != 1)}"
    if found.interval is None or found.lowest_p >= SIGNIFICANCE:
        needed = f"the clearest result has p = {found.lowest_p:.2g}"
        if found.interval is None:
            needed = f"at least {MIN_RUNS} of each are needed"
        share = f"{first} is above {second} in {found.value:.0%} of the pairs of runs and groups"
        if found.value in (0, 1):
            above, below = (first, second) if found.value else (second, first)
            share = f"{above} is above {below} in every pair of runs"
        return f"{seeds}: too few to show that {first} and {second} differ ({needed}); {share}."
    low, high = found.interval
    claim = f"no difference between {first} and {second} is shown"
    if found.p_value < SIGNIFICANCE and low > 0.5:
        claim = f"{first} is better than {second}"
    if found.p_value < SIGNIFICANCE and high < 0.5:
        claim = f"{second} is better than {first}"
    numbers = f"probability of improvement {found.value:.2f}, {low:.2f} to {high:.2f}"
    return f"{claim} ({numbers}; p = {found.p_value:.2g}; {seeds})."


def caution(num_runs: int) -> str:
    """Warn of intervals that are too narrow; nothing where there are runs enough."""
    few = f"Intervals from fewer than {ENOUGH_RUNS} seeds are too narrow: take them as a hint."
    return few if num_runs < ENOUGH_RUNS else ""


def compare(parts: pd.DataFrame, first: str, second: str, value: str) -> Estimate | None:
    """Probability that one label improves on another; None where nothing is common to them.

    A task is a group of physics in one environment; it counts where all runs of both were tested
    on it, and alike (`mismatches`).

    Args:
        parts: Lines of `tables.by_physics` after the last iteration.
        first: A label.
        second: The label it is compared with.
        value: The column that is compared.
    """
    both = parts[parts.label.isin([first, second])]
    apart = mismatches(both)
    pairs = []
    for env, tests in both.groupby("env"):
        groups = tests.groupby(["label", "run", "group"])[value].mean().unstack("group")
        groups = groups[[g for g in groups if (env, g) not in apart and groups[g].notna().all()]]
        if groups.shape[1] and set(groups.index.get_level_values("label")) == {first, second}:
            pairs.append([groups.loc[label].to_numpy() for label in (first, second)])
    return improvement(*zip(*pairs, strict=True)) if pairs else None


def mismatches(parts: pd.DataFrame) -> list[tuple[str, str]]:
    """Environments and groups in which labels were tested with other physics or protocols."""
    places = (parts.protocol + " " + parts.sim_params).groupby(
        [parts.env, parts.group, parts.label], sort=False
    )
    tasks = places.agg(lambda texts: "; ".join(sorted(set(texts))))
    different = tasks.groupby(["env", "group"], sort=False).nunique() > 1
    return list(different[different].index)
