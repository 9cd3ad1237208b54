"""The live table of a sweep on a terminal; needs rich, and is loaded only when shown."""

from collections.abc import Sequence

from rich.console import Console, Group, RenderableType
from rich.table import Table
from rich.text import Text

from headway.experiment.live_display import LiveDisplay
from headway.sweeps.board import Board, describe
from headway.sweeps.jobs import Job
from headway.sweeps.status import Status

_COLORS = {"running": "cyan", "busy": "yellow", "lost": "yellow", "done": "green", "failed": "red"}
_ORDER = ("running", "lost", "busy", "failed", "waiting", "done")
_OTHER_LINES = 5  # of the terminal, for headings and the prompt


class LiveBoard(LiveDisplay, Board):
    """Runs, iterations, returns and time left, redrawn in place; the busiest come first.

    Args:
        console: Where to draw; stderr by default.
    """

    refresh_per_second = 2

    def __init__(self, console: Console | None = None):
        LiveDisplay.__init__(self, console)
        Board.__init__(self)

    def show(self, job: Job, before: Status, status: Status) -> None:
        """Say what ended above the table, where it stays."""
        if status.over:
            text = f"{describe(job)}: {status.state}  {status.note or status.returns}"
            self.message(text)

    def _render(self) -> RenderableType:
        if not self.jobs:
            return Text("preparing ...", style="dim")
        shown = self._busiest(max(self._console.height - _OTHER_LINES, 3))
        table = Table("run", "state", "iteration", "doing", "returns", box=None)
        for job in shown:
            status = self.statuses[job.path]
            table.add_row(
                describe(job),
                Text(status.state, style=_COLORS.get(status.state, "dim")),
                f"{status.iteration}/{job.num_iterations}",
                status.phase if status.state == "running" else "",
                status.returns,
            )
        return Group(table, Text(self._summary(len(shown)), style="dim"))

    def _busiest(self, number: int) -> Sequence[Job]:
        """The jobs to show when there is no room for all."""
        states = {path: _ORDER.index(status.state) for path, status in self.statuses.items()}
        return sorted(self.jobs.values(), key=lambda job: states[job.path])[:number]

    def _summary(self, num_shown: int) -> str:
        states = [status.state for status in self.statuses.values()]
        counts = ", ".join(f"{states.count(s)} {s}" for s in _ORDER if s in states)
        hidden = len(states) - num_shown
        return f"{len(states)} runs: {counts}" + f"; {hidden} not shown" * bool(hidden)
