"""How likely training episodes are under a prior of the heads' corrections.

Every collected episode is a task of its own, in which the correction of `regression` is drawn
from the prior. Its residuals are then jointly Gaussian, for each dimension o

    r_o ~ N(0, σ_o² (N + ρ Φ Φᵀ)),

with Φ the features of all transitions and N the relative noise. σ² has a closed form for every ρ
(type-II maximum likelihood; MacKay, 1992).
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

RATIOS = np.geomspace(1e-7, 1e7, 281)
"""Ratios of prior to noise variance that are tried."""
MIN_NOISE = 1e-10
"""Least variance of the noise, in normalised units."""


class Evidence(NamedTuple):
    """What the likelihood of some episodes depends on, one row per episode (member fixed).

    From the eigenvalues of ΦᵀN⁻¹Φ and the projections of ΦᵀN⁻¹r on its eigenvectors.
    """

    eigenvalues: Float[np.ndarray, "episode feature"]
    projected: Float[np.ndarray, "episode feature obs"]
    squares: Float[np.ndarray, "episode obs"]
    """Sum of squared residuals over the relative noise."""
    log_noise: Float[np.ndarray, " episode"]
    """Sum of the logarithms of the relative noise."""
    steps: Int[np.ndarray, " episode"]

    @classmethod
    def of(cls, rows: Sequence[tuple[np.ndarray, np.ndarray, np.ndarray]]) -> "Evidence":
        """Reduce episodes to what their likelihood depends on.

        Args:
            rows: Features [time, feature], residuals [time, obs] and relative noise [time] of
                each episode, in float64.
        """
        parts = []
        for features, residual, noise in rows:
            whitened = features / noise[:, None]
            values, vectors = np.linalg.eigh(features.T @ whitened)
            projected = vectors.T @ (whitened.T @ residual)
            squares = (np.square(residual) / noise[:, None]).sum(0)
            parts.append(
                (np.maximum(values, 0), projected, squares, np.log(noise).sum(), len(noise))
            )
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

    def log_likelihood(self, ratio: float) -> float:
        """Log-density of all residuals under a ratio and its most likely noise."""
        noise, steps = self.noise(ratio), self.steps.sum()
        log_volume = np.log1p(ratio * self.eigenvalues).sum() + self.log_noise.sum()
        per_dimension = steps * (np.log(2.0 * np.pi * noise) + 1.0) + log_volume
        return float(-0.5 * per_dimension.sum())

    def best_ratio(self) -> float:
        """The ratio, among `RATIOS`, of the highest likelihood."""
        return float(max(RATIOS, key=self.log_likelihood))
