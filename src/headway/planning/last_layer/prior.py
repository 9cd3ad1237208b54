"""What heads should expect to learn in an episode, from the training data.

Each training episode is a task of its own. The prior of a correction is chosen by how well the
rest of an episode is foreseen once its beginning was learned from (`foresight`). The noise σ² is
the most likely one for that prior (`evidence`).
"""

from collections.abc import Sequence
from typing import TypeVar

import jax.numpy as jnp
import numpy as np
from threadpoolctl import threadpool_limits

from headway.data import Trajectory
from headway.errors import ConfigError
from headway.models.multi_headed import MultiHeadDynamics, Statistics
from headway.planning.last_layer import foresight
from headway.planning.last_layer.evidence import Evidence
from headway.planning.last_layer.regression import Prior, Shape
from headway.planning.last_layer.residuals import Onlooker, Rank
from headway.task import Task

MAX_EPISODES = 100
"""Episodes that are looked at, evenly spread over those collected; the paper's are all."""

RANKS: tuple[Rank, ...] = ("owner", "runner-up")
Item = TypeVar("Item")


def fit_prior(
    model: MultiHeadDynamics,
    task: Task,
    statistics: Statistics,
    trajectories: Sequence[Trajectory],
    *,
    history_length: int,
    horizon: int,
) -> Prior:
    """Choose the prior that suits the training episodes.

    Args:
        model: The dynamics model, as trained on these episodes.
        task: How observations enter and leave it.
        statistics: The normalisers in use.
        trajectories: Episodes under training physics; which physics is not looked at.
        history_length: Past transitions that the context is made of (K).
        horizon: Transitions ahead that plans look.

    Raises:
        ConfigError: There is no episode.
    """
    if not trajectories:
        raise ConfigError(
            "heads that keep learning got no training episodes, allowed: one or more, from which"
            " their prior is found; pass them, or set planner.adaptation to none."
        )
    onlooker = Onlooker(model, task, statistics, history_length)
    chosen = _evenly_spread(trajectories, MAX_EPISODES)
    # Small matrices, one after the other: BLAS threads only wait for each other, and for long
    # where the cores have other work too.
    with threadpool_limits(1, user_api="blas"):
        shape, ratio = _foreseen_best(onlooker, chosen, horizon)
        roots = np.asarray(shape.root, np.float64)
        parts = [
            [
                Evidence.of([(one.features @ root, one.residual)])
                for one, root in zip(episode, roots, strict=True)
            ]
            for episode in onlooker.episodes(chosen)
        ]
        noise = [Evidence.joined(column).noise(ratio) for column in zip(*parts, strict=True)]
    ratios = jnp.full(model.num_members, ratio, jnp.float32)
    return Prior(ratios, jnp.asarray(np.asarray(noise), jnp.float32), shape)


def _foreseen_best(
    onlooker: Onlooker, trajectories: Sequence[Trajectory], horizon: int
) -> tuple[Shape, float]:
    """The spread over the features of each member and the ratio that foresee most."""
    directions, errors = foreseen_errors(onlooker, trajectories, horizon)
    power, ratio = foresight.best([*errors.values()])
    roots = np.stack([one.root(power) for one in directions])
    inverses = np.stack([one.inverse(power) for one in directions])
    return Shape(*(jnp.asarray(x, jnp.float32) for x in (roots, inverses))), ratio


def foreseen_errors(
    onlooker: Onlooker, trajectories: Sequence[Trajectory], horizon: int
) -> tuple[list[foresight.Directions], dict[Rank, foresight.Errors]]:
    """How the features of each member vary, and the relative errors of the heads of each rank.

    Args:
        onlooker: Looks at the episodes.
        trajectories: Training episodes.
        horizon: Transitions ahead that count.
    """
    chosen = _evenly_spread(trajectories, foresight.MAX_EPISODES)
    moments = [foresight.moments_of(len(t), i) for i, t in enumerate(chosen)]
    directions = foresight.directions_of(onlooker.episodes(chosen))
    errors = {}
    for rank in RANKS[: onlooker.model.num_heads]:
        foreseen = onlooker._replace(rank=rank).from_moments(chosen, moments)
        errors[rank] = foresight.relative_errors(foreseen, directions, horizon)
    return directions, errors


def _evenly_spread(items: Sequence[Item], most: int) -> list[Item]:
    """At most so many, evenly spread."""
    count = len(items)
    places = np.linspace(0, count - 1, min(count, most)).round().astype(int)
    return [items[i] for i in sorted({*places.tolist()})]
