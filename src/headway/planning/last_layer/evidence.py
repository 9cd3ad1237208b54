"""The most likely noise of training episodes under a prior of the heads' corrections.

Every collected episode is a task of its own, in which the correction of `regression` is drawn
from the prior. Its residuals are then jointly Gaussian, for each dimension o

    r_o ~ N(0, σ_o² (I + ρ Φ Φᵀ)),

with Φ the features of all transitions. The σ² of the highest likelihood has a closed form (type-II
maximum likelihood; MacKay, 1992).
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

MIN_NOISE = 1e-10
"""Least variance of the noise, in normalised units."""


class Evidence(NamedTuple):
    """What the likelihood of some episodes depends on, one row per episode (member fixed).

    From the eigenvalues of ΦᵀΦ and the projections of Φᵀr on its eigenvectors.
    """

    eigenvalues: Float[np.ndarray, "episode feature"]
    projected: Float[np.ndarray, "episode feature obs"]
    squares: Float[np.ndarray, "episode obs"]
    """Sum of squared residuals."""
    steps: Int[np.ndarray, " episode"]

    @classmethod
    def of(cls, rows: Sequence[tuple[np.ndarray, np.ndarray]]) -> "Evidence":
        """Reduce episodes to what their likelihood depends on.

        Args:
            rows: Features [time, feature] and residuals [time, obs] of each episode, in float64.
        """
        parts = []
        for features, residual in rows:
            values, vectors = np.linalg.eigh(features.T @ features)
            projected = vectors.T @ (features.T @ residual)
            squares = np.square(residual).sum(0)
            parts.append((np.maximum(values, 0), projected, squares, len(residual)))
        return cls(*(np.stack(column) for column in zip(*parts, strict=True)))

    @classmethod
    def joined(cls, parts: Sequence["Evidence"]) -> "Evidence":
        """The same of all their episodes."""
        return cls(*(np.concatenate(column) for column in zip(*parts, strict=True)))

    def noise(self, ratio: float) -> Float[np.ndarray, " obs"]:
        """The most likely variance of the noise under a ratio."""
        shrunk = ratio / (1.0 + ratio * self.eigenvalues)
        explained = (np.square(self.projected) * shrunk[..., None]).sum((0, 1))
        return np.maximum((self.squares.sum(0) - explained) / self.steps.sum(), MIN_NOISE)
