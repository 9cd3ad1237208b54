"""What can be said of the arms of an experiment, and what cannot."""

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

    Only runs that both arms have in an environment are compared; a task is an environment with
    one group of physics. The last line warns where intervals come from too few seeds.
    """
    arms = found.comparison.experiment.arms
    reference = found.comparison.experiment.reference_arm
    lines, counts = [], []
    for arm in arms:
        pairs = [
            (ours[group], theirs[group])
            for env in found.comparison.envs
            for ours, theirs in [
                (found.group_returns(env, reference.label), found.group_returns(env, arm.label))
            ]
            for group in ours
            if group in theirs
        ]
        if arm == reference or not pairs:
            continue
        improvement = statistics.probability_of_improvement(*zip(*pairs, strict=True))
        lines.append(statistics.verdict(reference.label, arm.label, improvement))
        counts += [improvement.num_runs] if improvement.interval else []
    warning = statistics.caution(min(counts)) if counts else ""
    return [*lines, warning] if warning else lines
