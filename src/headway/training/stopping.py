"""Ctrl-C and SIGTERM while a run trains: stop where everything that is finished is saved."""

import contextlib
import os
import signal
import threading
from collections.abc import Iterator
from typing import Any

_NOTICE = b"\nstopping after this step or epoch; once more stops at once\n"


class Terminated(SystemExit):
    """SIGTERM asked the process to end, and what was finished is saved."""


class StopRequest:
    """Set by a signal, answered where everything that is finished is saved."""

    def __init__(self):
        self.signal: int | None = None

    def __bool__(self) -> bool:
        return self.signal is not None

    def answer(self) -> None:
        """Stop, if asked to.

        Raises:
            KeyboardInterrupt: Ctrl-C was pressed.
            Terminated: SIGTERM was sent; the exit code is 143.
        """
        if self.signal == signal.SIGINT:
            raise KeyboardInterrupt
        if self.signal is not None:
            raise Terminated(128 + self.signal)


@contextlib.contextmanager
def stop_requests() -> Iterator[StopRequest]:
    """Collect signals instead of being torn out of the work; a second one acts at once.

    Outside of the main thread, where signals do not arrive, nothing is ever requested.
    """
    request = StopRequest()
    if threading.current_thread() is not threading.main_thread():
        yield request
        return

    def note(number: int, _frame: object) -> None:
        if request:
            signal.signal(number, before[number])
            signal.raise_signal(number)
        request.signal = number
        os.write(2, _NOTICE)  # a signal may come while something else is being printed

    numbers = (signal.SIGINT, signal.SIGTERM)
    before: dict[int, Any] = {n: signal.getsignal(n) or signal.SIG_DFL for n in numbers}
    for number in before:
        signal.signal(number, note)
    try:
        yield request
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
    request.answer()
