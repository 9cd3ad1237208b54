"""Which prior lets a plan foresee most: errors ahead, after learning from an episode's beginning.

The likelihood of whole episodes asks whether corrections explain what was seen. A plan asks
whether they predict what comes. The two differ where residuals are not what `evidence` takes
them for, a linear function of the features and independent noise: contacts, heads that are wrong
in a curved way, contexts that move. There a prior that explains much predicts badly.

What is chosen is the ratio ρ, and how the prior is spread over the features. With Λ and V the
eigenvalues and eigenvectors of their second moment over the training episodes, the covariance of
a correction is σ² ρ V Λ^(-α) Vᵀ / c: for α = 0 all weights are equally uncertain, and what all
features share is learned first and trusted everywhere; for α = 1, Zellner's g-prior, all
directions count as much as they vary. c makes ρ the ratio of variances at an average transition.

Both the head that explains an episode best and the second best are judged, each in units of what
it errs without learning. The first is what acts on known physics and should lose nothing; the
second imitates physics that no head was made for, with no data but those of training.
"""

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from headway.planning.last_layer.evidence import MIN_NOISE
from headway.planning.last_layer.residuals import Residuals

RATIOS = np.geomspace(1e-5, 1e6, 45)
"""Ratios that are tried, four in each decade."""
POWERS = (0.0, 0.5, 1.0)
"""Values of α that are tried."""
MAX_EPISODES = 25
"""Training episodes that are looked at, evenly spread over those collected."""
MOMENTS = 4
"""Moments of each episode, from which the rest is foreseen."""
FLOOR = 1e-5
"""Least eigenvalue of the second moment, as a share of the largest."""
GOLDEN = (5**0.5 - 1) / 2

Errors = Float[np.ndarray, "power ratio"]
Foreseen = Iterable[tuple[list[Residuals], list[Residuals]]]
"""Transitions before a moment and after it, of each member (`Onlooker.from_moments`)."""


class Directions(NamedTuple):
    """How the features of one member vary: the eigenvectors V and eigenvalues Λ above."""

    vectors: Float[np.ndarray, "feature feature"]
    values: Float[np.ndarray, " feature"]

    @classmethod
    def of(cls, second_moment: Float[np.ndarray, "feature feature"]) -> "Directions":
        """Decompose the mean of φφᵀ."""
        values, vectors = np.linalg.eigh(second_moment)
        return cls(vectors, np.maximum(values, FLOOR * values.max()))

    def root(self, power: float) -> Float[np.ndarray, "feature feature"]:
        """R with R Rᵀ = V Λ^(-α) Vᵀ / c."""
        return self.vectors * np.sqrt(self._variances(power))

    def inverse(self, power: float) -> Float[np.ndarray, "feature feature"]:
        """R⁻¹."""
        return (self.vectors / np.sqrt(self._variances(power))).T

    def _variances(self, power: float) -> Float[np.ndarray, " feature"]:
        variances = self.values**-power
        return variances / (variances * self.values).sum()


def directions_of(episodes: Iterable[list[Residuals]]) -> list[Directions]:
    """How the features of each member vary over some episodes."""
    total, steps = np.zeros(()), 0
    for episode in episodes:
        total = total + np.stack([one.features.T @ one.features for one in episode])
        steps += len(episode[0].features)
    return [Directions.of(of_member) for of_member in total / steps]


def best(relative_errors: Sequence[Errors]) -> tuple[float, float]:
    """The power α and the ratio ρ of least error, averaged over the heads that are judged.

    Among equals the smallest ratio wins, which trusts the heads most.
    """
    mean = np.mean(relative_errors, axis=0)
    ratio, power = np.unravel_index(mean.T.argmin(), mean.T.shape)
    return POWERS[power], float(RATIOS[ratio])


def relative_errors(
    foreseen: Foreseen,
    directions: Sequence[Directions],
    horizon: int,
) -> Errors:
    """Mean squared error of what comes, over that without learning.

    Args:
        foreseen: Through which heads, from which moments.
        directions: How the features of each member vary.
        horizon: Transitions ahead that count.
    """
    roots = [[one.root(power) for power in POWERS] for one in directions]
    total, frozen = np.zeros((len(POWERS), len(RATIOS))), 0.0
    for before, after in foreseen:
        for learned, later, own in zip(before, after, roots, strict=True):
            ahead = later.part(slice(horizon))
            total += [errors_ahead(learned, ahead, root) for root in own]
            frozen += float(np.square(ahead.residual).mean())
    return total / max(frozen, MIN_NOISE)


def errors_ahead(
    learned: Residuals,
    later: Residuals,
    root: Float[np.ndarray, "feature feature"],
) -> Float[np.ndarray, " ratio"]:
    """Mean squared error of later transitions after learning, with each ratio of `RATIOS`.

    One decomposition serves all ratios: of ΦΦᵀ or of ΦᵀΦ, whichever is smaller.
    """
    features, target = learned.features @ root, learned.residual
    ahead = later.features @ root
    if len(features) > features.shape[1]:
        values, vectors = np.linalg.eigh(features.T @ features)
        told, seen = vectors.T @ (features.T @ target), ahead @ vectors
    else:
        values, vectors = np.linalg.eigh(features @ features.T)
        told, seen = vectors.T @ target, ahead @ features.T @ vectors
    shrunk = RATIOS[:, None] / (1.0 + RATIOS[:, None] * np.maximum(values, 0.0))
    return np.square(later.residual - (seen * shrunk[:, None]) @ told).mean((1, 2))


def moments_of(length: int, episode: int) -> list[int]:
    """Moments of an episode after the first transition and before the last, log-uniform.

    One lies in each of `MOMENTS` equal parts of the logarithm, elsewhere in each episode.
    """
    shift = (GOLDEN * (episode + 1)) % 1.0
    found = [int(length ** ((part + shift) / MOMENTS)) for part in range(MOMENTS)]
    return [min(max(moment, 1), length - 1) for moment in found if length > 1]
