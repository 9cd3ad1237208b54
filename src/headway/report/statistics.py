"""Statistics over seeds: few runs, several tasks (Agarwal et al., 2021, arXiv 2108.13264).

Definitions are those of the library rliable. Scores come as one array per task, with one number
per run; a task is an environment with one group of physics, a run is one seed. Runs of a task are
resampled among themselves, so every resample holds as many runs of each task as there are. Groups
of one environment come from the same trained models: `envs` has them drawn together.
"""

import dataclasses
import itertools
import math
from collections.abc import Callable, Hashable, Sequence

import numpy as np
from jaxtyping import Float, Int
from numpy.typing import ArrayLike
from scipy import stats

from headway.errors import ConfigError

Scores = Sequence[ArrayLike]
Statistic = Callable[[Sequence[np.ndarray]], np.ndarray]

MIN_RUNS = 3  # from fewer seeds nothing is claimed
ENOUGH_RUNS = 10  # bootstrap intervals of fewer seeds are too narrow
CONFIDENCE = 0.95
NUM_RESAMPLES = 10_000
SIGNIFICANCE = 0.05


@dataclasses.dataclass(frozen=True)
class Estimate:
    """A statistic and what is known of its error."""

    value: float
    interval: tuple[float, float] | None
    """Its 95 % interval; None from fewer than `MIN_RUNS` runs."""
    num_runs: int
    """Runs of the task that has the fewest."""


@dataclasses.dataclass(frozen=True)
class Improvement(Estimate):
    """A probability of improvement, and how easily chance alone makes one as far from 0.5."""

    p_value: float
    """Two-sided p-value of a permutation test: runs change places between both methods."""
    lowest_p: float
    """The p-value of the clearest result that so many runs can have."""

    @property
    def complement(self) -> "Improvement":
        """The probability that the other method improves."""
        ends = self.interval and (1 - self.interval[1], 1 - self.interval[0])
        return dataclasses.replace(self, value=1 - self.value, interval=ends)


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
    envs: Sequence[Hashable] | None = None,
    confidence: float = CONFIDENCE,
    num_resamples: int = NUM_RESAMPLES,
    seed: int = 0,
) -> tuple[float, float] | None:
    """Stratified bootstrap interval of a statistic, by percentiles.

    Args:
        scores: For every task, the scores of its runs.
        statistic: Maps tasks, each [..., run], to [...].
        envs: The environment of each task. Tasks of one environment are of the same runs, in the
            same order, which are drawn as a whole; by default every task is drawn by itself.
        confidence: Share of resamples inside.
        num_resamples: How often the runs are drawn anew.
        seed: Seeds the draws.

    Returns:
        Both ends, or None where a task has fewer than `MIN_RUNS` runs: from so few, nothing
        can be claimed.

    Raises:
        ConfigError: There is no task, or one without runs, or tasks of one environment have
            different numbers of runs.
    """
    tasks = _tasks(scores)
    places = list(range(len(tasks)) if envs is None else envs)
    counts = _run_counts(tasks, places)
    if _fewest(tasks) < MIN_RUNS:
        return None

    def of_runs(*drawn: np.ndarray, axis: int) -> np.ndarray:
        chosen = dict(zip(counts, drawn, strict=True))
        resampled = zip(tasks, places, strict=True)
        return statistic([task[chosen[place].astype(int)] for task, place in resampled])

    found = stats.bootstrap(
        [np.arange(count) for count in counts.values()],
        of_runs,
        n_resamples=num_resamples,
        vectorized=True,
        axis=-1,
        confidence_level=confidence,
        method="percentile",
        rng=np.random.default_rng(seed),
    ).confidence_interval
    return float(found.low), float(found.high)


def estimate(
    scores: Scores,
    statistic: Statistic = interquartile_mean,
    *,
    envs: Sequence[Hashable] | None = None,
) -> Estimate:
    """A statistic with its 95 % interval.

    Args:
        scores: For every task, the scores of its runs.
        statistic: Maps tasks, each [..., run], to [...].
        envs: The environment of each task, as `interval` takes it.

    Raises:
        ConfigError: There is no task, or one without runs, or tasks of one environment have
            different numbers of runs.
    """
    tasks = _tasks(scores)
    ends = interval(tasks, statistic, envs=envs)
    return Estimate(float(statistic(tasks)), ends, _fewest(tasks))


def probability_of_improvement(
    a: Scores, b: Scores, *, envs: Sequence[Hashable] | None = None
) -> Improvement:
    """How likely a run of one method beats a run of another, averaged over tasks.

    A tie counts half. 0.5 means that neither is better.

    Args:
        a: For every task, the scores of the first method's runs.
        b: The same for the second method, in the same order of tasks.
        envs: The environment of each task, as `interval` takes it.

    Raises:
        ConfigError: The tasks are not as many, or one has no runs, or tasks of one environment
            have different numbers of runs.
    """
    first, second = _tasks(a), _tasks(b)
    if len(first) != len(second):
        raise ConfigError(
            f"there are {len(first)} and {len(second)} tasks to compare, allowed: the same ones;"
            " leave out what only one method was run on."
        )
    places = list(range(len(first)) if envs is None else envs)

    def wins(tasks: Sequence[np.ndarray]) -> np.ndarray:
        pairs = zip(tasks[: len(first)], tasks[len(first) :], strict=True)
        return np.mean([_share_of_wins(x, y) for x, y in pairs], axis=0)

    both = [(method, place) for method in (0, 1) for place in places]
    found = estimate([*first, *second], wins, envs=both)
    p_value, lowest_p = _permutation_test(first, second, places)
    return Improvement(found.value, found.interval, found.num_runs, p_value, lowest_p)


def _permutation_test(
    first: Sequence[np.ndarray], second: Sequence[np.ndarray], envs: Sequence[Hashable]
) -> tuple[float, float]:
    """Test whether runs of both methods could change places within every environment.

    SciPy's test has no strata. All ways of changing places are gone through where they are no more
    than `NUM_RESAMPLES`; else that many are drawn.

    Returns:
        The two-sided p-value, and the lowest one that so many runs can have.
    """
    rng = np.random.default_rng(0)
    tables = []
    for env in dict.fromkeys(envs):
        tasks = [i for i, place in enumerate(envs) if place == env]
        pooled = [np.concatenate([first[i], second[i]]) for i in tasks]
        wins = np.sum([0.5 + 0.5 * np.sign(x[:, None] - x[None, :]) for x in pooled], axis=0)
        tables.append((wins, len(first[tasks[0]])))
    ways = math.prod(math.comb(len(wins), count) for wins, count in tables)
    if ways <= NUM_RESAMPLES:
        parts = [_every_way(wins, count) for wins, count in tables]
        sums = np.array([sum(chosen) for chosen in itertools.product(*parts)])
    else:
        sums = np.sum([_random_ways(wins, count, rng) for wins, count in tables], axis=0)
    distances = np.abs(sums / len(envs) - 0.5)
    as_far = int((distances >= distances[0] - 1e-12).sum())
    return as_far / len(distances), 2 / ways


def _every_way(wins: Float[np.ndarray, "run run"], count: int) -> Float[np.ndarray, " way"]:
    """The sum over tasks of the share of wins, whichever `count` runs are the first method's."""
    ways = list(itertools.combinations(range(len(wins)), count))
    return _share(
        wins, np.array([[*way, *(set(range(len(wins))) - {*way})] for way in ways]), count
    )


def _random_ways(
    wins: Float[np.ndarray, "run run"], count: int, rng: np.random.Generator
) -> Float[np.ndarray, " way"]:
    """The same for the runs as they are, and for `NUM_RESAMPLES` random orders of them."""
    orders = rng.permuted(np.tile(np.arange(len(wins)), (NUM_RESAMPLES, 1)), axis=1)
    return _share(wins, np.vstack([np.arange(len(wins)), orders]), count)


def _share(
    wins: Float[np.ndarray, "run run"], orders: Int[np.ndarray, "way run"], count: int
) -> Float[np.ndarray, " way"]:
    first, second = orders[:, :count, None], orders[:, None, count:]
    return wins[first, second].mean((1, 2))


def _share_of_wins(
    x: Float[np.ndarray, "*batch x"], y: Float[np.ndarray, "*batch y"]
) -> Float[np.ndarray, "*batch"]:
    """Share of pairs in which x is greater: Mann and Whitney's U over the number of pairs."""
    sign = np.sign(x[..., :, None] - y[..., None, :])
    return 0.5 + 0.5 * sign.mean((-2, -1))


def verdict(first: str, second: str, improvement: Improvement) -> str:
    """Word what a comparison shows.

    One method is better only where the interval leaves out 0.5 and the permutation test has a
    p-value below `SIGNIFICANCE`. Where no result of so few runs could have that, what is seen is
    said, and nothing claimed. Say `caution` beside it.

    Args:
        first: Name of the first method.
        second: Name of the second method.
        improvement: The probability that the first improves on the second.
    """
    seeds = _seeds(improvement.num_runs)
    if improvement.interval is None or improvement.lowest_p >= SIGNIFICANCE:
        return (
            f"{seeds}: too few to show that {first} and {second} differ"
            f" ({_needed(improvement)}); {_seen(first, second, improvement.value)}."
        )
    low, high = improvement.interval
    clear = improvement.p_value < SIGNIFICANCE
    if clear and low > 0.5:
        claim = f"{first} is better than {second}"
    elif clear and high < 0.5:
        claim = f"{second} is better than {first}"
    else:
        claim = f"no difference between {first} and {second} is shown"
    numbers = f"probability of improvement {improvement.value:.2f}, {low:.2f} to {high:.2f}"
    return f"{claim} ({numbers}; p = {improvement.p_value:.2g}; {seeds})."


def _needed(improvement: Improvement) -> str:
    if improvement.interval is None:
        return f"at least {MIN_RUNS} of each are needed"
    return f"the clearest result has p = {improvement.lowest_p:.2g}"


def _seen(first: str, second: str, share: float) -> str:
    """Word how often the first method's runs are above the second's."""
    if share in (0, 1):
        above, below = (first, second) if share else (second, first)
        return f"{above} is above {below} in every pair of runs"
    return f"{first} is above {second} in {100 * share:.0f} % of the pairs of runs and groups"


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


def _run_counts(tasks: Sequence[np.ndarray], envs: Sequence[Hashable]) -> dict[Hashable, int]:
    """Runs of every environment."""
    counts: dict[Hashable, int] = {}
    for task, env in zip(tasks, envs, strict=True):
        if counts.setdefault(env, task.shape[-1]) != task.shape[-1]:
            raise ConfigError(
                f"tasks of one environment have {counts[env]} and {task.shape[-1]} runs, allowed:"
                " the same runs in all of them; leave out runs that lack a task."
            )
    return counts


def _fewest(tasks: Sequence[np.ndarray]) -> int:
    return min(task.shape[-1] for task in tasks)
