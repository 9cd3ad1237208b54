"""How a run of a sweep stands, as one small value that travels well."""

import dataclasses
import time
from collections.abc import Callable, Mapping
from typing import Any, Literal, Self

from headway.errors import HeadwayError
from headway.training.progress import Progress

State = Literal["waiting", "running", "busy", "lost", "done", "failed"]

EVERY = 0.5  # seconds between two reports of one run
MAX_REASON = 500  # characters of an error that Headway has not worded


@dataclasses.dataclass(frozen=True)
class Status:
    """How one run stands."""

    state: State = "waiting"
    """`busy` means that another process trains it, `lost` that its worker died."""
    iteration: int = 0
    """Finished iterations."""
    phase: str = ""
    """What is being done, and how much of it."""
    returns: str = ""
    """The newest returns."""
    note: str = ""
    """Why it failed."""
    messages: tuple[str, ...] = ()
    """What it said that should stay readable, since it was begun or resumed."""

    @property
    def over(self) -> bool:
        """Whether nothing more will happen."""
        return self.state in ("done", "failed")


Tell = Callable[[Status], None]


def duration(seconds: float) -> str:
    """Word a duration, for example `3 min 20 s`."""
    whole = round(seconds)
    if whole < 60:
        return f"{whole} s"
    if whole < 3600:
        return f"{whole // 60} min {whole % 60} s"
    return f"{whole // 3600} h {whole % 3600 // 60} min"


def reason(error: BaseException) -> str:
    """Word in one line why a run failed."""
    text = " ".join(str(error).split())
    if isinstance(error, HeadwayError):
        return text
    return f"{type(error).__name__}: {text[:MAX_REASON]}{'...' * (len(text) > MAX_REASON)}"


class StatusProgress(Progress):
    """Turns what a run does into reports of its status, a few a second at most.

    Args:
        tell: Takes the reports.
        iteration: Iterations that are finished already.
        clock: Seconds, for tests.
    """

    def __init__(self, tell: Tell, iteration: int = 0, *, clock: Any = time.monotonic):
        self._tell, self._clock = tell, clock
        self._status = Status("running", iteration, "preparing")
        self._name, self._total, self._done = "", 1, 0
        self._told = clock()

    def __enter__(self) -> Self:
        """Say that the run has begun."""
        self._tell(self._status)
        return self

    def phase(self, name: str, total: int) -> None:
        """Start a phase."""
        self._name, self._total, self._done = name, max(total, 1), 0
        self._report()

    def advance(self, amount: int = 1, **values: float) -> None:
        """Count finished work."""
        self._done += amount
        if self._clock() - self._told >= EVERY:
            self._report()

    def iteration_done(self, metrics: Mapping[str, Any]) -> None:
        """Take over the iteration's returns."""
        found = {"collected": metrics["collection"], **metrics.get("evaluation", {})}
        returns = "  ".join(
            f"{name} {one['return_mean']:.4g}" for name, one in found.items() if one
        )
        self._report(iteration=metrics["iteration"] + 1, returns=returns)

    def message(self, text: str) -> None:
        """Report it at once, and with every later report; reports may be lost on their way."""
        self._report(messages=(*self._status.messages, text))

    def _report(self, **changes: Any) -> None:
        self._told = self._clock()
        done = min(self._done / self._total, 1.0)
        phase = f"{self._name} {done:.0%}" if self._name else self._status.phase
        self._status = dataclasses.replace(self._status, phase=phase, **changes)
        self._tell(self._status)
