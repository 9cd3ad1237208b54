"""Observation and action space of an environment, as data, and the scaling of its actions."""

import dataclasses
from typing import Any, Literal

import numpy as np


@dataclasses.dataclass(frozen=True)
class Spaces:
    """Observation and action space of an environment; kept with a run.

    Models and planners see actions scaled to [-1, 1]: numbers of a Box as they are; an integer as
    the middle of its share, all shares being equal; a category as one-hot vector of -1 and 1.

    Functions take actions with any number of leading axes; `xp` is `numpy` or `jax.numpy`.
    """

    obs_size: int
    """Numbers of an observation."""
    action_kind: Literal["box", "integers", "categories"]
    """Categories have no order: those of Discrete, MultiDiscrete and MultiBinary."""
    action_low: tuple[float, ...]
    """Least number of each entry of an action; a category is a number too."""
    action_high: tuple[float, ...]
    """Largest number of each entry."""
    action_shape: tuple[int, ...]
    """Shape of an action as `env.step` takes it; () for Discrete."""
    action_dtype: str
    """Type of its numbers."""

    @property
    def action_size(self) -> int:
        """Width of a scaled action."""
        categories = self.action_kind == "categories"
        return int(self._counts.sum()) if categories else len(self.action_low)

    def scale(self, action: Any, xp: Any) -> Any:
        """Map actions from [-1, 1] to the environment's units; the largest category is taken."""
        low, high = self._ends(xp)
        if self.action_kind == "categories":
            entries = xp.split(action, np.cumsum(self._counts)[:-1], axis=-1)
            return low + xp.stack([entry.argmax(-1) for entry in entries], -1)
        return low + 0.5 * (action + 1.0) * (high - low)

    def unscale(self, action: Any, xp: Any) -> Any:
        """Map actions from the environment's units to [-1, 1]."""
        low, high = self._ends(xp)
        if self.action_kind == "categories":
            counts = self._counts
            number = xp.round(xp.clip(action, low, high) - low)
            taken = number[..., np.repeat(np.arange(len(counts)), counts)]
            is_taken = taken == np.concatenate([np.arange(count) for count in counts])
            return xp.where(is_taken, np.float32(1.0), np.float32(-1.0))
        return 2.0 * (action - low) / (high - low) - 1.0

    def project(self, action: Any, xp: Any) -> Any:
        """The nearest scaled actions that the environment can take; in a Box as they are."""
        if self.action_kind == "box":
            return action
        low, high = xp.asarray(self.action_low), xp.asarray(self.action_high)
        return self.unscale(xp.round(xp.clip(self.scale(action, xp), low, high)), xp)

    @property
    def _counts(self) -> np.ndarray:
        """Categories of each entry."""
        return (np.array(self.action_high) - self.action_low).astype(int) + 1

    def _ends(self, xp: Any) -> tuple[Any, Any]:
        """Numbers of -1 and 1; half beyond the outer integers, which so get a whole share."""
        low, high = xp.asarray(self.action_low), xp.asarray(self.action_high)
        return (low - 0.5, high + 0.5) if self.action_kind == "integers" else (low, high)
