"""A few lines of the terminal that are redrawn in place; needs rich."""

import abc
from typing import ClassVar

from rich.console import Console, RenderableType
from rich.live import Live


class LiveDisplay(abc.ABC):
    """Draws itself again and again until it is left; messages stay above it.

    Args:
        console: Where to draw; stderr by default.
    """

    refresh_per_second: ClassVar[float] = 4

    def __init__(self, console: Console | None = None):
        self._console = console or Console(stderr=True)
        self._live: Live | None = None

    def __enter__(self):
        self._live = Live(
            console=self._console,
            get_renderable=self._render,
            refresh_per_second=self.refresh_per_second,
            redirect_stdout=False,
            transient=True,
        )
        self._live.start()
        return self

    def __exit__(self, kind, error, trace) -> None:
        """Remove the display; what it said stays in the log above."""
        if self._live is not None:
            self._live.stop()

    def message(self, text: str) -> None:
        """Print a line above the display."""
        self._console.print(text, markup=False, highlight=False)

    @abc.abstractmethod
    def _render(self) -> RenderableType:
        """What to draw now."""
