"""Episodes that break: noticed while they run, left out, and in the end too many."""

import contextlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Bool

from headway.errors import BadEnvironmentError, HeadwayError


class Watch:
    """Looks at what the environments return, and notes the episodes that break.

    Args:
        name: The environment's.
        physics: Simulator parameters of each environment of the batch.
    """

    def __init__(self, name: str, physics: Sequence[Mapping[str, float]]):
        self._name, self._physics = name, physics
        self.running = np.ones(len(physics), bool)
        self.reasons: dict[int, str] = {}

    @property
    def broken(self) -> Bool[np.ndarray, " env"]:
        """The environments whose episode broke."""
        return np.isin(np.arange(len(self._physics)), list(self.reasons))

    def among(self, wanted: int) -> dict[int, str]:
        """What was wrong with the episodes of the first `wanted` environments."""
        return {row: self.reasons[row] for row in sorted(self.reasons) if row < wanted}

    def note(self, info: Mapping[str, Any], step: int) -> None:
        """Note the episodes of which the environments themselves say that they broke."""
        for row, reason in info.get("broken", {}).items():
            if self.running[row]:
                where = f"{self._name} broke at step {step} under {self._physics[row]}"
                self.reasons.setdefault(row, f"{where}: {' '.join(reason.split())[:300]}")

    @contextlib.contextmanager
    def raising(self, when: str) -> Iterator[None]:
        """Turn whatever an environment raises into one line that says where.

        Raises:
            BadEnvironmentError: It raised.
        """
        try:
            yield
        except BadEnvironmentError as error:
            raise BadEnvironmentError(f"{self._name} at {when}: {error}") from error
        except HeadwayError:
            raise
        except Exception as error:
            reason = " ".join(str(error).split())[:300]
            raise BadEnvironmentError(
                f"{self._name} raised {type(error).__name__} at {when}: {reason};"
                " correct the environment, then the same command goes on."
            ) from error

    def finite(self, values: Any, what: str, step: int, instead: np.ndarray) -> np.ndarray:
        """What was returned, with `instead` where it is not finite; those episodes are broken.

        Raises:
            BadEnvironmentError: The values have another shape, or are no numbers.
        """
        values = np.asarray(values)
        if values.shape != instead.shape or values.dtype.kind not in "fiub":
            raise BadEnvironmentError(
                f"{self._name} returned {what} of shape {values.shape} and type {values.dtype} at"
                f" step {step}, allowed: numbers of shape {instead.shape}; correct the environment."
            )
        bad = ~np.isfinite(values.reshape(len(values), -1)).all(1)
        for row in np.flatnonzero(bad & self.running).tolist():
            self.reasons.setdefault(
                row,
                f"{self._name} returned a non-finite {what} at step {step} under"
                f" {self._physics[row]}",
            )
        if not bad.any():
            return values
        return np.where(bad.reshape(-1, *[1] * (values.ndim - 1)), instead, values)


class BadEpisodes:
    """Says which episodes are left out, until there are too many.

    Args:
        setting: The name of the limit.
        allowed: How many may be left out.
        say: Shows a line.
        forget: Called with the name of every part that they were in, once there are too many:
            when the environment is mended, those are run again.
    """

    def __init__(
        self,
        setting: str,
        allowed: int,
        say: Callable[[str], None],
        forget: Callable[[str], None],
    ):
        self._setting, self._allowed, self._say, self._forget = setting, allowed, say, forget
        self._reasons: list[str] = []
        self._parts: list[str] = []

    def leave_out(self, part: str, reasons: Sequence[str]) -> None:
        """Leave some episodes of a part out.

        Raises:
            BadEnvironmentError: There are too many.
        """
        if not reasons:
            return
        self._reasons += reasons
        self._parts.append(part)
        if len(self._reasons) > self._allowed:
            self._stop()
        for reason in reasons:
            self._say(f"{reason}; the episode is dropped.")

    def want_some(self, left: int) -> None:
        """Make sure that not all were left out.

        Raises:
            BadEnvironmentError: Nothing is left.
        """
        if not left:
            self._stop()

    def _stop(self) -> None:
        for part in self._parts:
            self._forget(part)
        raise BadEnvironmentError(
            f"{len(self._reasons)} episodes broke, allowed: {self._allowed} ({self._setting}), and"
            f" not all; the first: {self._reasons[0]}. Mend the environment under these physics, or"
            " allow more; then the same command goes on."
        )
