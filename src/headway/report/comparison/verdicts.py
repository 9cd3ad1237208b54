"""What can be said of the arms of an experiment, and what cannot."""

from collections.abc import Sequence

import numpy as np

from headway.report import statistics
from headway.report.comparison.runs import Found


def interquartile(found: Found, env: str, arm: str) -> str:
    """Word the interquartile mean over runs and its 95 % interval, from enough seeds."""
    values = [point.value for point in found.last(env, arm)]
    if len(values) < statistics.MIN_RUNS:
        return "–"
    estimate = statistics.estimate([values])
    low, high = estimate.interval or (np.nan, np.nan)
    return f"{estimate.value:,.1f} ({low:,.1f} to {high:,.1f})"


def verdicts(found: Found) -> list[str]:
    """Compare the reference of the experiment with every other arm, over all environments.

    A task is an environment with one group of physics. An environment counts where both arms were
    tested alike, and a group where all of their finished runs were. The last lines name what is
    left out, and warn of intervals that come from too few seeds.
    """
    reference = found.comparison.experiment.reference_arm.label
    lines, counts, unlike = [], [], []
    for arm in found.comparison.experiment.arms:
        if arm.label == reference:
            continue
        alike = [
            env
            for env in found.comparison.envs
            if found.protocol(env, reference) == found.protocol(env, arm.label)
        ]
        unlike += [f"{arm.label} on {env}" for env in found.comparison.envs if env not in alike]
        improvement = _improvement(found, alike, reference, arm.label)
        if improvement is not None:
            lines.append(statistics.verdict(reference, arm.label, improvement))
            counts += [improvement.num_runs] if improvement.interval else []
    if unlike:
        lines.append(
            f"Not compared with {reference}, because physics, episode lengths or options of the"
            f" environment differ: {'; '.join(unlike)}."
        )
    warning = statistics.caution(min(counts)) if counts else ""
    return [*lines, warning] if warning else lines


def _improvement(
    found: Found, envs: Sequence[str], first: str, second: str
) -> statistics.Improvement | None:
    """The probability that one arm improves on another; None where nothing is common to them."""
    pairs, places = [], []
    for env in envs:
        both = [found.run_returns(env, arm) for arm in (first, second)]
        seeds = [{seed for of in groups.values() for seed in of} for groups in both]
        for group in both[0]:
            returns = [groups.get(group, {}) for groups in both]
            if [set(of) for of in returns] == seeds:
                pairs.append([[of[seed] for seed in sorted(of)] for of in returns])
                places.append(env)
    if not pairs:
        return None
    return statistics.probability_of_improvement(*zip(*pairs, strict=True), envs=places)
