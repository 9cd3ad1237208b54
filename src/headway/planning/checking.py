"""Whether what a controller is told is something that a model can know anything of."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from headway.errors import ConfigError, shown
from headway.models.networks import Normalizer
from headway.task import Task

CONSTANT = 0.01
"""How far a feature that never varied in training may be off, relative to its value or to 1."""

MARGIN = 0.1
"""How far an action that was measured may lie outside of its bounds, relative to their distance."""


class RangeCheck:
    """Compares observations with the training data, by the mean and spread of each feature.

    Only these are kept of the training data, not the least and the largest value. A feature is
    what `Task.preprocess` makes of an observation, mostly an entry of it.

    Args:
        task: Makes features of observations.
        features: Mean and standard deviation of the features in the training data.
        max_deviations: Standard deviations from the mean that are still taken as known.
    """

    def __init__(self, task: Task, features: Normalizer, max_deviations: float):
        self._mean, self._std = np.asarray(features.mean), np.asarray(features.std)
        self._max_deviations = max_deviations
        self._preprocess = eqx.filter_jit(task.preprocess)

    def __call__(self, obs: Float[np.ndarray, " obs"]) -> tuple[str, ...]:
        """Word what is off; nothing where all is as in training."""
        off = np.abs(jax.device_get(self._preprocess(jnp.asarray(obs))) - self._mean)
        constant = self._std == 0
        allowed = np.where(
            constant,
            CONSTANT * np.maximum(np.abs(self._mean), 1.0),
            self._max_deviations * self._std,
        )
        return tuple(self._word(int(i), float(off[i])) for i in np.flatnonzero(~(off <= allowed)))

    def _word(self, index: int, off: float) -> str:
        if self._std[index] == 0:
            found = f"off by {off:.3g} from {self._mean[index]:.3g}, its only value in training"
            return f"feature {index} is {found}"
        return (
            f"feature {index} is {off / self._std[index]:.3g} standard deviations from its mean in"
            f" training, allowed: {self._max_deviations:g}"
        )


def not_finite(obs: Float[np.ndarray, " obs"]) -> str | None:
    """Word the first entry that is no number; None where all are."""
    finite = np.isfinite(obs)
    if finite.all():
        return None
    entry = int(np.argmin(finite))
    return f"obs[{entry}] is {obs[entry]}, allowed: finite numbers"


def one_row(name: str, given: Any, size: int, advice: str) -> Float[np.ndarray, " size"]:
    """What was given as one row of float32.

    Args:
        name: What it is called.
        given: Anything.
        size: Entries that it must have.
        advice: What to do if it is something else.

    Raises:
        ConfigError: It has another shape, or is no numbers.
    """
    try:
        with np.errstate(over="ignore"):  # what is too large becomes infinite
            entries = np.asarray(given).astype(np.float32)
    except (TypeError, ValueError):
        raise ConfigError(f"{name} is {shown(given)}, allowed: {size} numbers; {advice}.") from None
    if entries.shape != (size,):
        raise ConfigError(f"{name} has shape {entries.shape}, allowed: ({size},); {advice}.")
    return entries


def in_bounds(name: str, action: Float[np.ndarray, " action"], task: Task) -> None:
    """Refuse an action that cannot be in the environment's own units.

    Raises:
        ConfigError: An entry lies outside of its bounds by more than `MARGIN`.
    """
    low, high = np.asarray(task.action_low), np.asarray(task.action_high)
    margin = MARGIN * (high - low)
    outside = (action < low - margin) | (action > high + margin)
    if outside.any():
        entry = int(np.argmax(outside))
        raise ConfigError(
            f"{name}[{entry}] is {action[entry]:g}, allowed: from {low[entry]:g} to"
            f" {high[entry]:g}, and {margin[entry]:g} beyond for what was measured; pass it in the"
            " environment's units, as `act` returns it."
        )
