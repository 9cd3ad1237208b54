"""What one head of each member leaves unexplained in an episode."""

from collections.abc import Iterator, Sequence
from typing import Literal, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from headway.data import Episodes, Trajectory
from headway.models.multi_headed import MultiHeadDynamics, Statistics
from headway.planning.last_layer.regression import (
    Seen,
    heads_by_error,
    see_episode,
)
from headway.task import Task

Rank = Literal["owner", "runner-up"]


class Residuals(NamedTuple):
    """Transitions through one head of one member."""

    features: Float[np.ndarray, "time feature"]
    residual: Float[np.ndarray, "time obs"]
    head: int

    def part(self, steps: slice) -> "Residuals":
        """Some of the transitions."""
        return Residuals(self.features[steps], self.residual[steps], self.head)


class Onlooker(NamedTuple):
    """Looks at episodes through the heads of a rank, one of each member."""

    model: MultiHeadDynamics
    task: Task
    statistics: Statistics
    history_length: int
    rank: Rank = "owner"

    def episodes(self, trajectories: Sequence[Trajectory]) -> Iterator[list[Residuals]]:
        """One episode after the other, so that the features of no two are ever held."""
        for trajectory, padded in _padded(self.model, trajectories):
            yield self.episode(trajectory, padded)

    def episode(self, trajectory: Trajectory, padded: Episodes) -> list[Residuals]:
        """Each transition with the context of the moment after it, as in acting.

        The heads are those that explain the episode best, or second best.
        """
        moments = jnp.arange(padded.action.shape[1]) + 1
        seen = self._seen(trajectory, padded, moments)
        order = heads_by_error(jnp.asarray(seen.residual))
        place = min(int(self.rank == "runner-up"), order.shape[1] - 1)
        heads = np.asarray(order[:, place]).tolist()
        return [_of_head(seen, member, head) for member, head in enumerate(heads)]

    def from_moments(
        self, trajectories: Sequence[Trajectory], moments: Sequence[Sequence[int]]
    ) -> Iterator[tuple[list[Residuals], list[Residuals]]]:
        """Every moment of every episode, as a plan made then sees what comes after it.

        Yields:
            The transitions before the moment as in `episode`, and the later ones, all with the
            context of the moment; of every member.
        """
        for (trajectory, padded), chosen in zip(
            _padded(self.model, trajectories), moments, strict=True
        ):
            learned = self.episode(trajectory, padded)
            for moment in chosen:
                fixed = jnp.full(padded.action.shape[1], moment)
                seen = self._seen(trajectory, padded, fixed)
                later = [_of_head(seen, m, one.head) for m, one in enumerate(learned)]
                before = [one.part(slice(moment)) for one in learned]
                yield before, [one.part(slice(moment, None)) for one in later]

    def _seen(self, trajectory: Trajectory, padded: Episodes, moments: Array) -> Seen:
        found = _see(self.model, self.task, self.statistics, padded, moments, self.history_length)
        return jax.tree.map(lambda x: np.asarray(x[: len(trajectory)]), found)


def _padded(
    model: MultiHeadDynamics, trajectories: Sequence[Trajectory]
) -> Iterator[tuple[Trajectory, Episodes]]:
    """Each episode laid out alone, all of one length, so that one program serves them."""
    longest = max(map(len, trajectories))
    for trajectory in trajectories:
        yield trajectory, Episodes.pad([trajectory], 1, longest, model.sim_param_names)


def _of_head(seen: Seen, member: int, head: int) -> Residuals:
    features, residual = seen.features[:, member], seen.residual[:, member, head]
    return Residuals(np.asarray(features, np.float64), np.asarray(residual, np.float64), head)


@eqx.filter_jit
def _see(
    model: MultiHeadDynamics,
    task: Task,
    statistics: Statistics,
    padded: Episodes,
    moments: Int[Array, " time"],
    history_length: int,
) -> Seen:
    return see_episode(model, task, statistics, padded, 0, moments, history_length)
