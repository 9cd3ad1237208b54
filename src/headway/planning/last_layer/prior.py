"""What heads should expect to learn in an episode, from the training data.

Each training episode is a task of its own. The prior of a correction is chosen by how well the
rest of an episode is foreseen once its beginning was learned from (`foresight`), or by empirical
Bayes, the likelihood of all episodes (`evidence`), all weights being equally uncertain then. The
noise σ² is the most likely one for that prior.
"""

from collections.abc import Iterable, Sequence
from typing import TypeVar

import jax.numpy as jnp
import numpy as np
from threadpoolctl import threadpool_limits

from headway.config import PlannerConfig
from headway.data import Trajectory
from headway.errors import ConfigError
from headway.models.dynamics import MultiHeadDynamics, Statistics
from headway.planning.last_layer import foresight
from headway.planning.last_layer.evidence import Evidence
from headway.planning.last_layer.regression import Prior, Shape
from headway.planning.last_layer.residuals import Onlooker, Rank, Residuals
from headway.tasks.base import Task

MAX_EPISODES = 100
"""Episodes that are looked at, evenly spread over those collected; the paper's are all."""

RANKS: tuple[Rank, ...] = ("owner", "runner-up")
References = Sequence[float | None]
Item = TypeVar("Item")


def fit_prior(
    model: MultiHeadDynamics,
    task: Task,
    statistics: Statistics,
    trajectories: Sequence[Trajectory],
    *,
    history_length: int,
    planner: PlannerConfig,
) -> Prior:
    """Choose the prior that suits the training episodes.

    Args:
        model: The dynamics model, as trained on these episodes.
        task: How observations enter and leave it.
        statistics: The normalisers in use.
        trajectories: Episodes under training physics; which physics is not looked at.
        history_length: Past transitions that the context is made of (K).
        planner: Says by what to choose (`adaptation_criterion`), whose residuals are likely
            (`adaptation_prior`), what the noise is like, and how far plans look ahead.

    Raises:
        ConfigError: There is no episode.
    """
    if not trajectories:
        raise ConfigError(
            "heads that keep learning got no training episodes, allowed: one or more, from which"
            " their prior is found; pass them, or set planner.adaptation to none."
        )
    onlooker = Onlooker(model, task, statistics, history_length, planner.adaptation_prior)
    chosen = _evenly_spread(trajectories, MAX_EPISODES)
    # Small matrices, one after the other: BLAS threads only wait for each other, and for long
    # where the cores have other work too.
    with threadpool_limits(1, user_api="blas"):
        relative: References = [None] * model.num_members
        if planner.adaptation_noise == "heads":
            relative = _mean_logvar(map(_claims, onlooker.episodes(chosen)))
        shape, ratio = None, None
        if planner.adaptation_criterion == "foresight":
            shape, ratio = _foreseen_best(onlooker, chosen, planner.horizon, relative)
        evidence, references = _reduced(onlooker.episodes(chosen), relative, shape)
        ratios = [of_member.best_ratio() if ratio is None else ratio for of_member in evidence]
    noise = [of_member.noise(r) for of_member, r in zip(evidence, ratios, strict=True)]
    columns = [jnp.asarray(np.asarray(x), jnp.float32) for x in (ratios, noise, references)]
    return Prior(columns[0], columns[1], columns[2], shape)


def _foreseen_best(
    onlooker: Onlooker, trajectories: Sequence[Trajectory], horizon: int, references: References
) -> tuple[Shape, float]:
    """The spread over the features of each member and the ratio that foresee most."""
    directions, errors = foreseen_errors(onlooker, trajectories, horizon, references)
    power, ratio = foresight.best([*errors.values()])
    roots = np.stack([one.root(power) for one in directions])
    inverses = np.stack([one.inverse(power) for one in directions])
    return Shape(*(jnp.asarray(x, jnp.float32) for x in (roots, inverses))), ratio


def foreseen_errors(
    onlooker: Onlooker, trajectories: Sequence[Trajectory], horizon: int, references: References
) -> tuple[list[foresight.Directions], dict[Rank, foresight.Errors]]:
    """How the features of each member vary, and the relative errors of the heads of each rank.

    Args:
        onlooker: Looks at the episodes.
        trajectories: Training episodes.
        horizon: Transitions ahead that count.
        references: As `foresight.relative_errors` wants them.
    """
    chosen = _evenly_spread(trajectories, foresight.MAX_EPISODES)
    moments = [foresight.moments_of(len(t), i) for i, t in enumerate(chosen)]
    directions = foresight.directions_of(onlooker.episodes(chosen))
    errors = {}
    for rank in RANKS[: onlooker.model.num_heads]:
        foreseen = onlooker._replace(rank=rank).from_moments(chosen, moments)
        errors[rank] = foresight.relative_errors(foreseen, directions, horizon, references)
    return directions, errors


def _reduced(
    episodes: Iterable[list[Residuals]], references: References, shape: Shape | None
) -> tuple[list[Evidence], list[float]]:
    """What each member's likelihood depends on, and what its heads claim, in one look."""
    roots = [None] * len(references) if shape is None else np.asarray(shape.root, np.float64)
    parts, claims = [], []
    for episode in episodes:
        rows = [
            (
                one.features if root is None else one.features @ root,
                one.residual,
                one.relative_noise(reference),
            )
            for one, reference, root in zip(episode, references, roots, strict=True)
        ]
        parts.append([Evidence.of([row]) for row in rows])
        claims.append(_claims(episode))
    return [Evidence.joined(column) for column in zip(*parts, strict=True)], _mean_logvar(claims)


def _claims(episode: list[Residuals]) -> list[tuple[float, int]]:
    """Sum and number of the log-variances that each member's head claims in an episode."""
    return [(one.logvar.sum(), len(one.logvar)) for one in episode]


def _mean_logvar(claims: Iterable[list[tuple[float, int]]]) -> list[float]:
    """What each member's heads claim on average over episodes, as a log-variance."""
    sums = np.asarray([*claims], np.float64).sum(0)
    return (sums[:, 0] / sums[:, 1]).tolist()


def _evenly_spread(items: Sequence[Item], most: int) -> list[Item]:
    """At most so many, evenly spread."""
    count = len(items)
    places = np.linspace(0, count - 1, min(count, most)).round().astype(int)
    return [items[i] for i in sorted({*places.tolist()})]
