"""Progress of a run on stderr: a bar on a terminal, plain lines elsewhere, or nothing.

Nothing is ever written to stdout, which belongs to results.
"""

import sys
import time
from collections.abc import Mapping
from typing import Any, Self

SILENCE = 30.0  # seconds after which plain lines give a sign of life


class Progress:
    """The silent display, and the interface of the others; a context manager."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        """Stop the display."""

    def phase(self, name: str, total: int) -> None:
        """Start a phase; the one before it is over.

        Args:
            name: What is done, for example `"[1/10] collect"`.
            total: Amount of work, in the units of `advance`.
        """

    def advance(self, amount: int = 1, **numbers: float) -> None:
        """Count finished work.

        Args:
            amount: Units done since the last call.
            numbers: Worth showing, for example `loss=0.3`.
        """

    def iteration_done(self, metrics: Mapping[str, Any]) -> None:
        """Finish an iteration.

        Args:
            metrics: The iteration's line of `metrics.jsonl`.
        """

    def message(self, text: str) -> None:
        """Say something that should stay readable."""


class Lines(Progress):
    """Plain lines for logs: one when a phase ends, and a sign of life during a long one."""

    def __init__(self):
        self._name, self._total, self._done = "", 1, 0
        self._begun = self._printed = time.monotonic()

    def __exit__(self, kind, *_) -> None:
        """Say how the last phase went, unless it was cut short."""
        if kind is None:
            self._end_phase()

    def phase(self, name: str, total: int) -> None:
        """Start a phase; report the one before it."""
        self._end_phase()
        self._name, self._total, self._done = name, max(total, 1), 0
        self._begun = self._printed = time.monotonic()

    def advance(self, amount: int = 1, **numbers: float) -> None:
        """Count finished work; print only when nothing was printed for a while."""
        self._done += amount
        if time.monotonic() - self._printed >= SILENCE:
            self.message(f"{self._name} {self._done / self._total:.0%}{_words(numbers)}")

    def iteration_done(self, metrics: Mapping[str, Any]) -> None:
        """Report the phase that ended and the iteration's returns."""
        self._end_phase()
        self.message(_returns(metrics))

    def message(self, text: str) -> None:
        """Print a line."""
        self._printed = time.monotonic()
        print(text, file=sys.stderr, flush=True)

    def _end_phase(self) -> None:
        if self._name:
            seconds = time.monotonic() - self._begun
            rate = f" ({self._done / seconds:,.3g} per second)" if self._done else ""
            self.message(f"{self._name} took {seconds:.1f} s{rate}")
            self._name = ""


class Bar(Progress):
    """A bar that is redrawn in place; messages stay above it."""

    def __init__(self):
        from rich import console, progress

        self._bar = progress.Progress(
            progress.TextColumn("{task.description}", markup=False),
            progress.BarColumn(),
            progress.MofNCompleteColumn(),
            progress.TextColumn("{task.fields[words]}", markup=False),
            progress.TimeElapsedColumn(),
            progress.TimeRemainingColumn(),
            console=console.Console(stderr=True),
            redirect_stdout=False,
            transient=True,
        )
        self._task = self._bar.add_task("preparing", total=None, words="")

    def __enter__(self) -> Self:
        self._bar.start()
        return self

    def __exit__(self, kind, *_) -> None:
        """Remove the bar; what was said stays."""
        self._bar.stop()

    def phase(self, name: str, total: int) -> None:
        """Start a phase with a new bar."""
        self._bar.remove_task(self._task)
        self._task = self._bar.add_task(name, total=max(total, 1), words="")

    def advance(self, amount: int = 1, **numbers: float) -> None:
        """Count finished work."""
        self._bar.update(self._task, advance=amount, words=_words(numbers))

    def iteration_done(self, metrics: Mapping[str, Any]) -> None:
        """Print the iteration's returns, which stay."""
        self.message(_returns(metrics))

    def message(self, text: str) -> None:
        """Print a line above the bar."""
        self._bar.console.print(text, markup=False, highlight=False)


def make_progress(quiet: bool = False) -> Progress:
    """Choose a display: none, a bar on a terminal, plain lines elsewhere."""
    if quiet:
        return Progress()
    return Bar() if sys.stderr.isatty() else Lines()


def _words(numbers: Mapping[str, float]) -> str:
    return "".join(f" {name} {value:.4g}" for name, value in numbers.items())


def _returns(metrics: Mapping[str, Any]) -> str:
    returns = {"collected": metrics.get("collection"), **metrics.get("evaluation", {})}
    words = [
        f"{name} {found['return_mean']:.4g} ± {found['return_std']:.2g}"
        for name, found in returns.items()
        if found
    ]
    errors = metrics.get("held_out_error") or []
    for step in sorted({1, len(errors)} if errors else {}):
        words.append(f"held-out error {errors[step - 1]:.3g} at imagined step {step}")
    return f"iteration {metrics['iteration'] + 1} done: {'; '.join(words)}"
