"""Mean and standard deviation of data that is read part by part."""

import dataclasses
from collections.abc import Iterable

import numpy as np
from jaxtyping import Float


@dataclasses.dataclass(frozen=True)
class Moments:
    """How many values were seen, their mean, and the sum of squared deviations from it.

    Everything is float64. Squares are of deviations, never of the values themselves, so a
    large mean costs no digits of the variance. Parts are merged as in Chan, Golub and
    LeVeque, "Algorithms for computing the sample variance" (1983).
    """

    count: int
    mean: Float[np.ndarray, " size"]
    squares: Float[np.ndarray, " size"]

    @classmethod
    def of(cls, values: Float[np.ndarray, "count size"]) -> "Moments":
        """Moments of one part."""
        values = np.asarray(values, np.float64)
        mean = values.mean(0)
        return cls(len(values), mean, np.square(values - mean).sum(0))

    def merge(self, other: "Moments") -> "Moments":
        """Moments of both parts together."""
        count = self.count + other.count
        shift = other.mean - self.mean
        return Moments(
            count,
            self.mean + shift * (other.count / count),
            self.squares + other.squares + shift**2 * (self.count * other.count / count),
        )

    @property
    def std(self) -> Float[np.ndarray, " size"]:
        """Population standard deviation."""
        return np.sqrt(self.squares / self.count)


def merge_columns(rows: Iterable[tuple[Moments, ...]]) -> list[Moments]:
    """Merge the moments of several quantities over parts; one row for each part, at least one."""
    first, *others = rows
    merged = list(first)
    for row in others:
        merged = [one.merge(other) for one, other in zip(merged, row, strict=True)]
    return merged
