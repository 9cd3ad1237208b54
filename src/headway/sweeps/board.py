"""The table of all runs of a sweep, told on stderr: live, as plain lines, or not at all."""

import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import Self, TextIO

from headway.errors import HeadwayError
from headway.sweeps.jobs import Job
from headway.sweeps.status import Status, reason


class Board:
    """Keeps the status of every job, and shows nothing. Use it as a context manager."""

    def __init__(self):
        self.jobs: dict[Path, Job] = {}
        self.statuses: dict[Path, Status] = {}

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Stop the display."""

    def begin(self, jobs: Sequence[Job]) -> None:
        """Take over the jobs; what is finished counts as done, what is damaged as failed."""
        self.jobs = {job.path: job for job in jobs}
        for job in jobs:
            self.statuses[job.path] = first_status(job)

    def tell(self, job: Job, status: Status) -> None:
        """Take over how a job stands; reports that come after its end are too late."""
        before = self.statuses[job.path]
        if not before.over:
            self.statuses[job.path] = status
            for text in status.messages[len(before.messages) :]:
                self.message(f"{describe(job)}: {text}")
            self.show(job, before, status)

    def show(self, job: Job, before: Status, status: Status) -> None:
        """Show what changed."""

    def message(self, text: str) -> None:
        """Say something that should stay readable."""

    @property
    def failures(self) -> Mapping[Path, str]:
        """Why jobs failed, by run directory."""
        return {path: s.note for path, s in self.statuses.items() if s.state == "failed"}


class PlainBoard(Board):
    """A line whenever a run begins, finishes an iteration or ends; for logs."""

    def __init__(self, stream: TextIO | None = None):
        super().__init__()
        self._stream = stream

    def begin(self, jobs: Sequence[Job]) -> None:
        """Say how much there is to do."""
        super().begin(jobs)
        states = [status.state for status in self.statuses.values()]
        self.message(f"{len(states)} runs, {states.count('done')} of them done already")

    def show(self, job: Job, before: Status, status: Status) -> None:
        """Print a line where something ended or began."""
        if (before.state, before.iteration) == (status.state, status.iteration):
            return
        done = sum(one.over for one in self.statuses.values())
        words = [status.state, f"{status.iteration}/{job.num_iterations}", status.returns]
        line = "  ".join(word for word in (*words, status.note) if word)
        self.message(f"[{done}/{len(self.jobs)}] {describe(job)}: {line}")

    def message(self, text: str) -> None:
        """Print a line."""
        print(text, file=self._stream or sys.stderr, flush=True)


def first_status(job: Job) -> Status:
    """How a job stands by its directory."""
    try:
        finished = job.finished_iterations
    except (HeadwayError, OSError) as error:
        return Status("failed", note=reason(error))
    return Status("done" if finished >= job.num_iterations else "waiting", finished)


def describe(job: Job) -> str:
    """Name a run in a few words, for example `pendulum tmcl-quick-0a1b2c3d4e seed0`."""
    return " ".join(job.path.parts[-3:])


def make_board(quiet: bool = False) -> Board:
    """Choose a display: none, a live table on a terminal, plain lines elsewhere.

    Args:
        quiet: Show nothing.
    """
    if quiet:
        return Board()
    if not sys.stderr.isatty():
        return PlainBoard()
    from headway.sweeps.live_board import LiveBoard

    return LiveBoard()
