"""Statistics over seeds: few runs, several tasks (Agarwal et al., 2021, arXiv 2108.13264).

Definitions are those of the library rliable. Scores come as one array per task, with one number
per run; a task is an environment with one group of physics, a run is one seed. Runs of a task are
resampled among themselves, so every resample holds as many runs of each task as there are.
"""

import dataclasses
from collections.abc import Callable, Sequence

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike
from scipy import stats

from headway.errors import ConfigError

Scores = Sequence[ArrayLike]
Statistic = Callable[[Sequence[np.ndarray]], np.ndarray]

MIN_RUNS = 3  # from fewer seeds nothing is claimed
ENOUGH_RUNS = 10  # bootstrap intervals of fewer seeds are too narrow
CONFIDENCE = 0.95
NUM_RESAMPLES = 10_000


@dataclasses.dataclass(frozen=True)
class Estimate:
    """A statistic and what is known of its error."""

    value: float
    interval: tuple[float, float] | None
    """Its 95 % interval; None from fewer than `MIN_RUNS` runs."""
    num_runs: int
    """Runs of the task that has the fewest."""

    @property
    def complement(self) -> "Estimate":
        """One minus this: of a probability of improvement, that the other method improves."""
        ends = self.interval and (1 - self.interval[1], 1 - self.interval[0])
        return Estimate(1 - self.value, ends, self.num_runs)


def mean(scores: Scores) -> np.ndarray:
    """Mean over tasks of the mean over runs.

    Args:
        scores: For every task, the scores of its runs, [..., run]; leading axes are kept.

    Raises:
        ConfigError: There is no task, or one without runs.
    """
    return np.mean([task.mean(-1) for task in _tasks(scores)], axis=0)


def standard_deviation(scores: Scores) -> np.ndarray | None:
    """Standard deviation between the runs of a task, pooled over tasks; None from one run each.

    Args:
        scores: For every task, the scores of its runs, [..., run]; leading axes are kept.

    Raises:
        ConfigError: There is no task, or one without runs.
    """
    tasks = _tasks(scores)
    freedom = sum(task.shape[-1] - 1 for task in tasks)
    if not freedom:
        return None
    squares = [task.var(-1) * task.shape[-1] for task in tasks]
    return np.sqrt(np.sum(squares, axis=0) / freedom)


def interquartile_mean(scores: Scores) -> np.ndarray:
    """Mean of the middle half of all runs of all tasks: robust as a median, steadier.

    A quarter of the runs, rounded down, is left out at either end; of three runs of one task
    that is none.

    Args:
        scores: For every task, the scores of its runs, [..., run]; leading axes are kept.

    Raises:
        ConfigError: There is no task, or one without runs.
    """
    return stats.trim_mean(np.concatenate(_tasks(scores), axis=-1), 0.25, axis=-1)


def interval(
    scores: Scores,
    statistic: Statistic = interquartile_mean,
    *,
    confidence: float = CONFIDENCE,
    num_resamples: int = NUM_RESAMPLES,
    seed: int = 0,
) -> tuple[float, float] | None:
    """Stratified bootstrap interval of a statistic, by percentiles.

    Args:
        scores: For every task, the scores of its runs.
        statistic: Maps tasks, each [..., run], to [...].
        confidence: Share of resamples inside.
        num_resamples: How often the runs are drawn anew.
        seed: Seeds the draws.

    Returns:
        Both ends, or None where a task has fewer than `MIN_RUNS` runs: from so few, nothing
        can be claimed.

    Raises:
        ConfigError: There is no task, or one without runs.
    """
    tasks = _tasks(scores)
    if _fewest(tasks) < MIN_RUNS:
        return None
    found = stats.bootstrap(
        tasks,
        lambda *resampled, axis: statistic(resampled),
        n_resamples=num_resamples,
        vectorized=True,
        axis=-1,
        confidence_level=confidence,
        method="percentile",
        rng=np.random.default_rng(seed),
    ).confidence_interval
    return float(found.low), float(found.high)


def estimate(scores: Scores, statistic: Statistic = interquartile_mean) -> Estimate:
    """A statistic with its 95 % interval.

    Args:
        scores: For every task, the scores of its runs.
        statistic: Maps tasks, each [..., run], to [...].

    Raises:
        ConfigError: There is no task, or one without runs.
    """
    tasks = _tasks(scores)
    return Estimate(float(statistic(tasks)), interval(tasks, statistic), _fewest(tasks))


def probability_of_improvement(a: Scores, b: Scores) -> Estimate:
    """How likely a run of one method beats a run of another, averaged over tasks.

    A tie counts half. 0.5 means that neither is better.

    Args:
        a: For every task, the scores of the first method's runs.
        b: The same for the second method, in the same order of tasks.

    Raises:
        ConfigError: The tasks are not as many, or one has no runs.
    """
    first, second = _tasks(a), _tasks(b)
    if len(first) != len(second):
        raise ConfigError(
            f"there are {len(first)} and {len(second)} tasks to compare, allowed: the same ones;"
            " leave out what only one method was run on."
        )

    def wins(tasks: Sequence[np.ndarray]) -> np.ndarray:
        pairs = zip(tasks[: len(first)], tasks[len(first) :], strict=True)
        return np.mean([_share_of_wins(x, y) for x, y in pairs], axis=0)

    return estimate([*first, *second], wins)


def _share_of_wins(
    x: Float[np.ndarray, "*batch x"], y: Float[np.ndarray, "*batch y"]
) -> Float[np.ndarray, "*batch"]:
    """Share of pairs in which x is greater: Mann and Whitney's U over the number of pairs."""
    sign = np.sign(x[..., :, None] - y[..., None, :])
    return 0.5 + 0.5 * sign.mean((-2, -1))


def verdict(first: str, second: str, improvement: Estimate) -> str:
    """Word what a comparison shows; nothing is claimed from fewer than `MIN_RUNS` seeds.

    Say `caution` beside it.

    Args:
        first: Name of the first method.
        second: Name of the second method.
        improvement: The probability that the first improves on the second.
    """
    if improvement.interval is None:
        return (
            f"{_seeds(improvement.num_runs)}: too few to claim that {first} and {second} differ;"
            f" at least {MIN_RUNS} of each are needed."
        )
    low, high = improvement.interval
    if low > 0.5:
        claim = f"{first} is better than {second}"
    elif high < 0.5:
        claim = f"{second} is better than {first}"
    else:
        claim = f"no difference between {first} and {second} is shown"
    numbers = f"probability of improvement {improvement.value:.2f}, {low:.2f} to {high:.2f}"
    return f"{claim} ({numbers}; {_seeds(improvement.num_runs)})."


def caution(num_runs: int) -> str:
    """Warn of intervals that are too narrow; nothing where there are runs enough."""
    if num_runs >= ENOUGH_RUNS:
        return ""
    return (
        f"Intervals from fewer than {ENOUGH_RUNS} seeds are too narrow: take what they show as a"
        " hint."
    )


def _seeds(num_runs: int) -> str:
    return f"{num_runs} seed{'s' * (num_runs != 1)}"


def _tasks(scores: Scores) -> list[np.ndarray]:
    tasks = [np.asarray(task, np.float64) for task in scores]
    if not tasks or any(task.ndim < 1 or not task.shape[-1] for task in tasks):
        raise ConfigError(
            "scores have no task or a task without runs, allowed: one array per task, with one"
            " number per run; leave out tasks that were not run."
        )
    return tasks


def _fewest(tasks: Sequence[np.ndarray]) -> int:
    return min(task.shape[-1] for task in tasks)
