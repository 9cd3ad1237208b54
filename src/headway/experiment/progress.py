"""What a run is doing, told live on stderr: a rich display, plain lines, or nothing.

Nothing here is ever written to stdout, which belongs to results.
"""

import sys
import time
from collections.abc import Callable, Mapping, Sequence
from types import TracebackType
from typing import Any, Self, TextIO

Phase = tuple[int, str, int]
"""An iteration (from 0), the name of what is done in it, and its amount of work."""

Clock = Callable[[], float]


class Progress:
    """The interface, and the silent display. Use it as a context manager."""

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Stop the display."""

    def schedule(self, phases: Sequence[Phase]) -> None:
        """Announce the phases of the whole run that are still to come.

        Optional: it makes the estimate of the time left better. Without it, later iterations
        are taken to repeat the phases of the earlier ones.

        Args:
            phases: In the order in which they will run.
        """

    def phase(self, iteration: int, num_iterations: int, name: str, total: int) -> None:
        """Start a phase; the one before it is over.

        Args:
            iteration: Number of the iteration, from 0.
            num_iterations: Iterations of the whole run.
            name: What is done, for example `"collect"`.
            total: Amount of work, in the units of `advance`.
        """

    def advance(self, amount: int = 1, **values: float) -> None:
        """Count finished work.

        Args:
            amount: Units done since the last call.
            values: Numbers worth showing, for example `loss=0.3`.
        """

    def iteration_done(self, metrics: Mapping[str, Any]) -> None:
        """Finish an iteration.

        Args:
            metrics: The iteration's line of `metrics.jsonl`.
        """

    def message(self, text: str) -> None:
        """Say something that should stay readable."""


class Estimate:
    """Time left, from the speed of the phases done so far.

    The speed of a phase is the newest one measured. Three facts of the loop enter: the very
    first collection acts at random, far faster than a planned one, so it is not used for the
    others; evaluating costs per step what a planned collection does; and an epoch of fitting
    takes longer the more iterations have added data.
    """

    def __init__(self, clock: Clock = time.monotonic):
        self._clock = clock
        self._seconds_per_unit: dict[str, float] = {}
        self._schedule: list[Phase] = []
        self._announced = False
        self._current: Phase | None = None
        self._num_iterations = 0
        self._done = 0
        self._started = self._phase_started = clock()

    def schedule(self, phases: Sequence[Phase]) -> None:
        """Take over the announced phases."""
        self._schedule, self._announced = list(phases), True

    def start(self, iteration: int, num_iterations: int, name: str, total: int) -> None:
        """Begin a phase."""
        self.finish()
        self._current, self._num_iterations = (iteration, name, total), num_iterations
        self._done, self._phase_started = 0, self._clock()
        if self._announced:
            self._schedule = [p for p in self._schedule if p[:2] != (iteration, name)]
        else:
            self._schedule.append(self._current)

    def finish(self) -> None:
        """End the phase that runs, if any, and learn from its speed."""
        speed = self._measured()
        if self._current is not None and speed is not None:
            self._seconds_per_unit[_kind(*self._current[:2])] = speed / _growth(self._current)
        self._current = None

    def advance(self, amount: int) -> None:
        """Count finished work."""
        self._done += amount

    @property
    def elapsed(self) -> float:
        """Seconds since the start."""
        return self._clock() - self._started

    @property
    def phase_elapsed(self) -> float:
        """Seconds since the phase began."""
        return self._clock() - self._phase_started

    @property
    def done(self) -> int:
        """Units done in the phase that runs."""
        return self._done

    @property
    def left(self) -> float | None:
        """Seconds left for the whole run, or None while nothing comparable has been timed."""
        speeds = dict(self._seconds_per_unit)
        phases = self._to_come()
        if self._current is not None:
            iteration, name, total = self._current
            measured = self._measured()
            if measured is not None:
                speeds[_kind(iteration, name)] = measured / _growth(self._current)
            phases.append((iteration, name, max(total - self._done, 0)))
        seconds = 0.0
        for phase in phases:
            kind = _kind(*phase[:2])
            speed = speeds.get(kind, speeds.get(_LIKE.get(kind, "")))
            if speed is None:
                return None
            seconds += speed * _growth(phase) * phase[2]
        return seconds

    def _measured(self) -> float | None:
        """Seconds per unit of the phase that runs."""
        if self._current is None or self._done == 0:
            return None
        return self.phase_elapsed / self._done

    def _to_come(self) -> list[Phase]:
        if self._announced:
            return list(self._schedule)
        if self._current is None or not self._schedule:
            return []
        now = self._current[0]
        latest = {name: (iteration, total) for iteration, name, total in self._schedule}
        seen_now = {name for iteration, name, _ in self._schedule if iteration == now}
        phases = []
        for iteration in range(now, self._num_iterations):
            for name, (_, total) in latest.items():
                if iteration > now or name not in seen_now:
                    phases.append((iteration, name, total))
        return phases


_LIKE = {"evaluate": "collect"}


def _kind(iteration: int, name: str) -> str:
    return "collect at random" if (iteration, name) == (0, "collect") else name


def _growth(phase: Phase) -> int:
    """How much longer a unit takes than in iteration 0."""
    iteration, name, _ = phase
    return iteration + 1 if name == "fit" else 1


class PlainProgress(Progress):
    """Plain lines for logs: one per phase, one per iteration, and a sign of life between."""

    def __init__(
        self,
        stream: TextIO | None = None,
        *,
        every: float = 30.0,
        clock: Clock = time.monotonic,
    ):
        self._stream = stream
        self._every = every
        self._clock = clock
        self._estimate = Estimate(clock)
        self._label = ""
        self._total = 0
        self._printed = clock()

    def __exit__(self, kind, error, trace) -> None:
        """Say how the last phase went, unless it was cut short."""
        if kind is None:
            self._close_phase()

    def schedule(self, phases: Sequence[Phase]) -> None:
        """Take over the announced phases."""
        self._estimate.schedule(phases)

    def phase(self, iteration: int, num_iterations: int, name: str, total: int) -> None:
        """Start a phase; report the one before it."""
        self._close_phase()
        self._label = f"[{iteration + 1}/{num_iterations}] {name}"
        self._total = total
        self._printed = self._clock()
        self._estimate.start(iteration, num_iterations, name, total)

    def advance(self, amount: int = 1, **values: float) -> None:
        """Count finished work; print only when nothing was printed for a while."""
        self._estimate.advance(amount)
        now = self._clock()
        if now - self._printed >= self._every:
            self._printed = now
            percent = 100 * self._estimate.done // max(self._total, 1)
            self._write(f"{self._label} {percent}%{_numbers(values)}{self._time_left()}")

    def iteration_done(self, metrics: Mapping[str, Any]) -> None:
        """Report the phase that ended and the iteration's returns."""
        self._close_phase()
        returns = summarise_returns(metrics)
        line = f"iteration {metrics['iteration'] + 1} done: {'; '.join(returns)}"
        self._write(f"{line}; {metrics['timesteps']} steps in all{self._time_left()}")

    def message(self, text: str) -> None:
        """Print a line."""
        self._write(text)

    def _close_phase(self) -> None:
        if self._label:
            seconds = self._estimate.phase_elapsed
            rate = speed(self._estimate.done, seconds, self._label)
            self._write(f"{self._label} took {seconds:.1f} s" + f" ({rate})" * bool(rate))
            self._estimate.finish()
            self._label = ""

    def _time_left(self) -> str:
        left = self._estimate.left
        return f"; about {duration(left)} left" if left else ""

    def _write(self, text: str) -> None:
        print(text, file=self._stream or sys.stderr, flush=True)


def make_progress(quiet: bool = False) -> Progress:
    """Choose a display: none, a live one on a terminal, plain lines elsewhere.

    Args:
        quiet: Show nothing.
    """
    if quiet:
        return Progress()
    if not sys.stderr.isatty():
        return PlainProgress()
    from headway.experiment.live_progress import RichProgress

    return RichProgress()


def summarise_returns(metrics: Mapping[str, Any]) -> list[str]:
    """Word an iteration's returns, for example `collected -310 ± 55`."""
    lines = []
    collection = metrics.get("collection") or {}
    if "return_mean" in collection:
        lines.append(f"collected {_mean_std(collection)}")
    for group, values in (metrics.get("evaluation") or {}).items():
        lines.append(f"{group} {_mean_std(values)}")
    return lines


def duration(seconds: float) -> str:
    """Word a duration, for example `3 min 20 s`."""
    whole = round(seconds)
    if whole < 60:
        return f"{whole} s"
    if whole < 3600:
        return f"{whole // 60} min {whole % 60} s"
    hours = whole // 3600
    if hours < 48:
        return f"{hours} h {whole % 3600 // 60} min"
    return f"{hours // 24} d {hours % 24} h"


def speed(done: int, seconds: float, label: str) -> str:
    """Word a speed, for example `1,960 steps/s`; nothing while it is not known."""
    if not done or seconds <= 0:
        return ""
    per_second = done / seconds
    number = f"{per_second:,.0f}" if per_second >= 100 else f"{per_second:.3g}"
    return f"{number} {_unit(label)}/s"


def _unit(label: str) -> str:
    """What a phase counts: passes over the data when fitting, environment steps otherwise."""
    return "epochs" if label.endswith("fit") else "steps"


def _mean_std(values: Mapping[str, float]) -> str:
    return f"{values['return_mean']:.4g} ± {values.get('return_std', 0.0):.2g}"


def _numbers(values: Mapping[str, float]) -> str:
    return "".join(f", {name} {value:.4g}" for name, value in values.items())
