"""Which prior lets a plan foresee most: errors ahead, after learning from an episode's beginning.

The likelihood of whole episodes asks whether corrections explain what was seen. A plan asks
whether they predict what comes. The two differ where residuals are not what `evidence` takes
them for, a linear function of the features and independent noise: contacts, heads that are wrong
in a curved way, contexts that move. There a prior that explains much predicts badly.
"""

from collections.abc import Iterable, Sequence

import numpy as np
from jaxtyping import Float

from headway.planning.last_layer.evidence import RATIOS
from headway.planning.last_layer.residuals import Residuals

TRIED = RATIOS[::5]
"""Ratios that are tried, four in each decade."""
MOMENTS = 4
"""Moments of each episode, from which the rest is foreseen."""
GOLDEN = (5**0.5 - 1) / 2


def best_ratio(
    foreseen: Iterable[tuple[list[Residuals], list[Residuals]]],
    horizon: int,
    references: Sequence[float | None],
) -> float:
    """The ratio with which what comes is foreseen best, the same for all members.

    Best is the least mean squared error over the horizon, in normalised units, averaged over all
    moments. Among equals the smallest wins, which trusts the heads most.

    Args:
        foreseen: Transitions before a moment and after it, of each member
            (`residuals.Onlooker.from_moments`).
        horizon: Transitions ahead that count.
        references: What each member's heads claim of their error on average, a log-variance, if
            the noise is relative to it.
    """
    total = np.zeros(len(TRIED))
    for before, after in foreseen:
        for learned, later, reference in zip(before, after, references, strict=True):
            total += errors_ahead(learned, later.part(slice(horizon)), reference)
    return float(TRIED[total.argmin()])


def moments_of(length: int, episode: int) -> list[int]:
    """Moments of an episode after the first transition and before the last, log-uniform.

    One lies in each of `MOMENTS` equal parts of the logarithm, elsewhere in each episode.
    """
    shift = (GOLDEN * (episode + 1)) % 1.0
    found = [int(length ** ((part + shift) / MOMENTS)) for part in range(MOMENTS)]
    return [min(max(moment, 1), length - 1) for moment in found if length > 1]


def errors_ahead(
    learned: Residuals, later: Residuals, reference: float | None = None
) -> Float[np.ndarray, " ratio"]:
    """Mean squared error of later transitions after learning, with each ratio of `TRIED`."""
    scale = learned.relative_noise(reference)[:, None] ** -0.5
    left, values, right = np.linalg.svd(learned.features * scale, full_matrices=False)
    told = left.T @ (learned.residual * scale)
    shrunk = values / (np.square(values) + 1.0 / TRIED[:, None])
    foreseen = ((later.features @ right.T) * shrunk[:, None, :]) @ told
    return np.square(later.residual - foreseen).mean((1, 2))
