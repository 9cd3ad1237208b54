"""Does a prior of any shape help? Errors on training physics never seen before.

    python results/adaptation/full_prior.py RUN --others OTHER_SEED ... --table NAME.csv

The prior covariance of a correction is σ² ρ I. Here it is σ² C with a C of any shape, by
expectation maximisation on the training episodes, which begins at ρ I. Its likelihood of episodes
that were left out, a third at a time, says after how many steps it overfits.

Held out are training episodes of other seeds. Nothing unseen is looked at.
"""

import argparse
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from second_layer import AHEAD, MOMENTS, RANKS, Eyes
from threadpoolctl import threadpool_limits

from headway.data import Trajectory
from headway.planning.last_layer.evidence import MIN_NOISE, Evidence
from headway.storage.records import write_csv
from headway.training.loading import load_learned, load_task
from headway.training.run import RunDir

STEPS = (0, 1, 2, 5, 10, 20)
"""Steps of expectation maximisation; 0 is the isotropic prior."""
FOLDS = 3
COLUMNS = (
    "run", "fitted_to", "em_steps", "left_out_log_likelihood", "rank", "learned_from", "rmse",
)  # fmt: skip


class View(NamedTuple):
    """An episode through one head: features [time, feature] and residuals [time, obs]."""

    features: np.ndarray
    residual: np.ndarray


class Prior(NamedTuple):
    """What an episode is expected to ask of one member."""

    shape: np.ndarray
    """C, [feature, feature]."""
    noise: np.ndarray
    """σ², [obs]."""


def views(eyes: Eyes, trajectory: Trajectory, moments: np.ndarray) -> list[list[View]]:
    """The episode through the best and the second-best head, [member][rank]."""
    seen = eyes.see(trajectory, moments, np.zeros(eyes.shape))
    features, residual = (np.asarray(x, np.float64) for x in (seen.features, seen.residual))
    best = np.square(residual).sum((0, 3)).argsort(-1, kind="stable")[:, : len(RANKS)]
    return [
        [View(features[:, member], residual[:, member, head]) for head in heads]
        for member, heads in enumerate(best)
    ]


def priors(seen: Sequence[View]) -> Iterator[Prior]:
    """The isotropic prior, and what it becomes step by step."""
    evidence = Evidence.of([(*view, np.ones(len(view.residual))) for view in seen])
    ratio = evidence.best_ratio()
    prior = Prior(ratio * np.eye(seen[0].features.shape[1]), evidence.noise(ratio))
    for _ in range(STEPS[-1] + 1):
        yield prior
        prior = more_likely(prior, seen)


def more_likely(prior: Prior, seen: Sequence[View]) -> Prior:
    """One step of expectation maximisation."""
    precision = np.linalg.inv(prior.shape)
    shape, squares, steps = np.zeros_like(precision), np.zeros_like(prior.noise), 0
    for features, residual in seen:
        gram = features.T @ features
        covariance = np.linalg.inv(precision + gram)
        mean = covariance @ features.T @ residual
        shape += covariance + (mean / prior.noise) @ mean.T / len(prior.noise)
        left = np.square(residual - features @ mean).sum(0)
        squares += left + prior.noise * (gram * covariance).sum()
        steps += len(residual)
    shape = (shape + shape.T) / (2 * len(seen))
    return Prior(shape, np.maximum(squares / steps, MIN_NOISE))


def log_likelihood(prior: Prior, view: View) -> float:
    """Of a whole episode, without constants."""
    gram = view.features @ prior.shape @ view.features.T
    root = np.linalg.cholesky(gram + np.eye(len(gram)))
    squares = np.square(np.linalg.solve(root, view.residual)).sum(0)
    dimensions, steps = len(prior.noise), len(gram)
    volume = dimensions * np.log(np.diag(root)).sum() + 0.5 * steps * np.log(prior.noise).sum()
    return float(-0.5 * (squares / prior.noise).sum() - volume)


def left_out(seen: Sequence[View], per_episode: int) -> np.ndarray:
    """Log-likelihood, after each step, of episodes that were left out; [step]."""
    fold = np.arange(len(seen)) // per_episode % FOLDS
    total = np.zeros(STEPS[-1] + 1)
    for one in range(FOLDS):
        rest = [view for view, of in zip(seen, fold, strict=True) if of != one]
        out = [view for view, of in zip(seen, fold, strict=True) if of == one]
        total += [sum(log_likelihood(prior, view) for view in out) for prior in priors(rest)]
    return total


def error(prior: Prior, view: View, steps: int) -> float:
    """Mean squared error of the next transitions, after the first ones were learned from."""
    features, residual = view.features[:steps], view.residual[:steps]
    gram = features @ prior.shape @ features.T + np.eye(steps)
    weight = prior.shape @ features.T @ np.linalg.solve(gram, residual)
    return float(np.square(view.residual - view.features @ weight)[steps : steps + AHEAD].mean())


def measure(eyes: Eyes, name: str, data: list[Trajectory], held_out: list[Trajectory]) -> list[Any]:
    """Fit priors to one or both ranks of heads; one row per step, rank and moment."""
    seen = [views(eyes, t, np.arange(len(t)) + 1) for t in data]
    after = {n: [views(eyes, t, moments_after(n, len(t))) for t in held_out] for n in MOMENTS}
    rows = []
    for fitted_to in (RANKS[:1], RANKS):
        taught = [
            [view for episode in seen for view in episode[member][: len(fitted_to)]]
            for member in range(eyes.shape[0])
        ]
        likelihood = sum(left_out(views, len(fitted_to)) for views in taught)
        found = [[*priors(views)] for views in taught]
        for step in STEPS:
            for rank, kind in enumerate(RANKS):
                for n in MOMENTS:
                    squared = [
                        error(of_member[step], episode[member][rank], n)
                        for episode in after[n]
                        for member, of_member in enumerate(found)
                    ]
                    place = name, " and ".join(fitted_to), step, likelihood[step], kind, n
                    rows.append(dict(zip(COLUMNS, (*place, np.mean(squared) ** 0.5), strict=True)))
                    print(*rows[-1].values(), flush=True)
    return rows


def moments_after(steps: int, length: int) -> np.ndarray:
    """For each transition, the moment whose context counts once some were learned from."""
    times = np.arange(length)
    return np.where(times < steps, times + 1, steps)


def main() -> None:
    """Fit priors to the training episodes of one run, and judge them by those of others."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("run", type=Path, help="directory of a finished run")
    parser.add_argument("--others", type=Path, nargs="+", required=True, help="runs of other seeds")
    parser.add_argument("--episodes", type=int, default=5, help="held out, of each other run")
    parser.add_argument("--table", type=Path, help="CSV file to write")
    asked = parser.parse_args()
    run = RunDir(asked.run)
    config = run.config()
    held_out = [
        trajectory
        for other in asked.others
        for trajectory in RunDir(other).load_data()[-asked.episodes :]
    ]
    eyes = Eyes(load_learned(run, config), load_task(config), config.model.history_length)
    name = f"{asked.run.parent.name}-{asked.run.name}"
    with threadpool_limits(1, user_api="blas"):
        rows = measure(eyes, name, run.load_data(), held_out)
    if asked.table:
        write_csv(asked.table, COLUMNS, rows)


if __name__ == "__main__":
    main()
