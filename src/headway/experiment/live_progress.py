"""The live display of a run on a terminal; needs rich, and is loaded only when shown."""

import time
from collections.abc import Mapping, Sequence
from typing import Any

from rich.console import Console, Group, RenderableType
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text

from headway.experiment.live_display import LiveDisplay
from headway.experiment.progress import (
    Clock,
    Estimate,
    Phase,
    Progress,
    duration,
    speed,
    summarise_returns,
)

BAR_WIDTH = 32


class RichProgress(LiveDisplay, Progress):
    """A few lines that are redrawn in place: where the run is, how fast, how good, how long.

    Args:
        console: Where to draw; stderr by default.
        clock: Seconds, for tests.
    """

    def __init__(self, console: Console | None = None, *, clock: Clock = time.monotonic):
        super().__init__(console)
        self._estimate = Estimate(clock)
        self._iteration = self._num_iterations = self._total = 0
        self._name = ""
        self._values: dict[str, float] = {}

    def schedule(self, phases: Sequence[Phase]) -> None:
        """Take over the announced phases."""
        self._estimate.schedule(phases)

    def phase(self, iteration: int, num_iterations: int, name: str, total: int) -> None:
        """Start a phase."""
        self._estimate.start(iteration, num_iterations, name, total)
        self._iteration, self._num_iterations = iteration, num_iterations
        self._name, self._total, self._values = name, total, {}

    def advance(self, amount: int = 1, **values: float) -> None:
        """Count finished work."""
        self._estimate.advance(amount)
        self._values.update(values)

    def iteration_done(self, metrics: Mapping[str, Any]) -> None:
        """Print the iteration's returns above the display, where they stay."""
        self._estimate.finish()
        number = f"iteration {metrics['iteration'] + 1:>2}  "
        returns = "   ".join(summarise_returns(metrics))
        self._console.print(Text.assemble((number, "bold"), returns), highlight=False)

    def _render(self) -> RenderableType:
        if not self._name:
            return Text("preparing ...", style="dim")
        rate = speed(self._estimate.done, self._estimate.phase_elapsed, self._name)
        done = min(self._estimate.done, self._total)
        grid = Table.grid(padding=(0, 1))
        grid.add_row(
            Text(f"iteration {self._iteration + 1}/{self._num_iterations}", style="bold"),
            Text(self._name, style="cyan"),
            ProgressBar(total=max(self._total, 1), completed=done, width=BAR_WIDTH),
            Text(f"{done}/{self._total}  {rate}"),
            Text(" ".join(f"{name} {value:.4g}" for name, value in self._values.items())),
        )
        return Group(grid, Text(self._times(), style="dim"))

    def _times(self) -> str:
        left = self._estimate.left
        rest = "estimating the time left" if left is None else f"about {duration(left)} left"
        return f"{duration(self._estimate.elapsed)} so far, {rest}"
