"""A fit that diverges: noticed after an epoch, rolled back, and in the end explained."""

from collections.abc import Iterable, Sequence

import numpy as np

from headway.data import Trajectory
from headway.errors import DivergenceError
from headway.models.updates import EpochStats

MAX_SKIPPED = 0.5
"""Share of an epoch's updates that may be skipped because their loss or gradient is not finite."""
EXPLODED = 100.0
"""A loss has exploded when it is above the iteration's best by this many times its size, or 1."""
SLOWER = 0.25
"""Factor on the step size with every roll-back."""


def divergence(stats: EpochStats, before: Sequence[EpochStats]) -> str | None:
    """Word what is wrong with an epoch, if anything is.

    Args:
        stats: Of the epoch.
        before: Of the good epochs before it in the same iteration.
    """
    skipped, updates, loss = int(stats.skipped), int(stats.updates), float(stats.loss)
    if skipped > MAX_SKIPPED * updates:
        return f"{skipped} of {updates} updates had no finite loss and gradient"
    best = min((float(epoch.loss) for epoch in before), default=loss)
    if not np.isfinite(loss) or loss - best > EXPLODED * max(1.0, abs(best)):
        return f"the loss rose from {best:.3g} to {loss:.3g}"
    return None


def first_non_finite(trajectories: Sequence[Trajectory], losses: Iterable[np.ndarray]) -> str:
    """Name the first member, head and physics whose loss is not finite; or say there is none.

    Args:
        trajectories: What was fitted.
        losses: Of each of them, [member, head, time].
    """
    for trajectory, loss in zip(trajectories, losses, strict=False):
        bad = np.argwhere(~np.isfinite(loss))
        if len(bad):
            member, head, time = bad[0]
            physics = dict(trajectory.sim_params)
            return f"member {member}, head {head}, at step {time} under sim_params {physics}"
    return "every member and head has a finite loss before the epoch"


def diverged(epoch: str, rollbacks: int, problem: str, where: str) -> DivergenceError:
    """Word the error for a fit that no roll-back has mended."""
    return DivergenceError(
        f"{epoch} diverged {rollbacks} times: {problem} ({where}), allowed:"
        f" fitting.max_rollbacks ({rollbacks - 1}); try a smaller fitting.learning_rate in another"
        " directory."
    )
