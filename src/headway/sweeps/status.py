"""How a run of a sweep stands, as one small value that travels well."""

import dataclasses
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Literal, Self

from headway.errors import HeadwayError
from headway.experiment.progress import Clock, Estimate, Phase, Progress, summarise_returns

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
    left: float | None = None
    """Seconds left, None while not known."""
    note: str = ""
    """Why it failed."""
    messages: tuple[str, ...] = ()
    """What it said that should stay readable, since it was begun or resumed."""

    @property
    def over(self) -> bool:
        """Whether nothing more will happen."""
        return self.state in ("done", "failed")


Tell = Callable[[Status], None]


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

    def __init__(self, tell: Tell, iteration: int = 0, *, clock: Clock = time.monotonic):
        self._tell, self._clock = tell, clock
        self._estimate = Estimate(clock)
        self._status = Status("running", iteration, "preparing")
        self._name, self._total = "", 1
        self._told = clock()

    def __enter__(self) -> Self:
        """Say that the run has begun."""
        self._tell(self._status)
        return self

    def schedule(self, phases: Sequence[Phase]) -> None:
        """Take over the announced phases."""
        self._estimate.schedule(phases)

    def phase(self, iteration: int, num_iterations: int, name: str, total: int) -> None:
        """Start a phase."""
        self._estimate.start(iteration, num_iterations, name, total)
        self._name, self._total = name, max(total, 1)
        self._report(iteration=iteration)

    def advance(self, amount: int = 1, **values: float) -> None:
        """Count finished work."""
        self._estimate.advance(amount)
        if self._clock() - self._told >= EVERY:
            self._report()

    def iteration_done(self, metrics: Mapping[str, Any]) -> None:
        """Take over the iteration's returns."""
        self._estimate.finish()
        returns = "  ".join(summarise_returns(metrics))
        self._report(iteration=metrics["iteration"] + 1, returns=returns)

    def message(self, text: str) -> None:
        """Report it at once, and with every later report; reports may be lost on their way."""
        self._report(messages=(*self._status.messages, text))

    def _report(self, **changes: Any) -> None:
        self._told = self._clock()
        done = min(self._estimate.done / self._total, 1.0)
        phase = f"{self._name} {done:.0%}" if self._name else self._status.phase
        self._status = dataclasses.replace(
            self._status, phase=phase, left=self._estimate.left, **changes
        )
        self._tell(self._status)
