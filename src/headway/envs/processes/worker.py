"""A process that holds one environment, as its parent sees it."""

import builtins
import contextlib
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable
from multiprocessing.connection import Connection
from pathlib import Path
from types import ModuleType
from typing import Any

import gymnasium
from gymnasium.vector.utils import CloudpickleWrapper

from headway import errors
from headway.errors import BadEnvironmentError, BrokenEpisodeError

PROGRAM = Path(__file__).with_name("service.py")
START_TIMEOUT_S = 120.0
"""For starting Python, importing what the environment needs, and making it."""


class Worker:
    """Starts the process; `spaces` waits until the environment is made.

    The process is in a group of its own, so that Ctrl-C in a terminal reaches only the parent,
    and what the environment starts ends with it.

    Args:
        make: Makes the environment, in the process.
    """

    def __init__(self, make: Callable[[], gymnasium.Env]):
        ours, theirs = socket.socketpair()
        command = [sys.executable, "-P", str(PROGRAM), str(theirs.fileno())]
        with theirs:
            self._process = subprocess.Popen(
                command, pass_fds=[theirs.fileno()], stdin=subprocess.DEVNULL, process_group=0
            )
        self._connection = Connection(ours.detach())
        self._spaces: tuple[gymnasium.Space, gymnasium.Space] | None = None
        self._calls = 0
        self._send(sys.path)
        self._send(CloudpickleWrapper(make))

    @property
    def pid(self) -> int:
        """Number of the process, and of its group."""
        return self._process.pid

    def spaces(self) -> tuple[gymnasium.Space, gymnasium.Space]:
        """The environment's spaces of observations and actions when it was made.

        Raises:
            BadEnvironmentError: It could not be made.
        """
        if self._spaces is not None:
            return self._spaces
        try:
            self._spaces = spaces = self.receive("start", START_TIMEOUT_S, time.monotonic())
        except BrokenEpisodeError as error:
            raise BadEnvironmentError(
                f"an environment {error}; see to it that it can be made in a new process."
            ) from None
        return spaces

    def send(self, method: str, given: tuple[Any, ...]) -> None:
        """Call a method of `Service`."""
        self._calls += 1
        self._send((self._calls, method, given))

    def _send(self, message: Any) -> None:
        with contextlib.suppress(BrokenPipeError, ConnectionResetError):  # `receive` will tell
            self._connection.send(message)

    def receive(self, method: str, timeout_s: float, since: float) -> Any:
        """Wait for what the method returned.

        Args:
            method: What was called.
            timeout_s: How long it may take.
            since: When it was called, by `time.monotonic`.

        Raises:
            BrokenEpisodeError: It took longer, or the process died, or the environment raised
                this itself. The process is of no use any more, but for the last case.
            Exception: What else the environment raised.
        """
        while True:
            if not self._connection.poll(max(0.0, since + timeout_s - time.monotonic())):
                raise LostWorkerError(f"did not answer to {method} within {timeout_s:g} s")
            try:
                call, kind, *found = self._connection.recv()
            except (EOFError, OSError):  # before its answer, or in the middle of it
                raise LostWorkerError(f"{self._fate()} during {method}") from None
            if call == self._calls:  # else nobody waited for this answer
                break
        if kind == "raised":
            raise _raised(*found)
        return found[0]

    def _fate(self) -> str:
        """How the process ended."""
        found = os.waitid(os.P_PID, self.pid, os.WEXITED | os.WNOWAIT)
        assert found is not None
        code = found.si_status if found.si_code == os.CLD_EXITED else 128 + found.si_status
        if code <= 128:
            return f"ended its process with exit code {code}"
        name = signal.Signals(code - 128).name if code - 128 in set(signal.Signals) else code
        return f"had its process killed by {name}"

    def kill(self) -> None:
        """End the process and all that it started."""
        self._connection.close()
        if self._process.returncode is None:
            with contextlib.suppress(ProcessLookupError, PermissionError):
                os.killpg(self.pid, signal.SIGKILL)
            self._process.wait()


class LostWorkerError(BrokenEpisodeError):
    """The process does not answer any more, and must be replaced."""


def _raised(kinds: list[str], text: str, trace: str) -> Exception:
    """What the environment raised: as it was, if the class is Python's or Headway's."""
    error: Exception = RuntimeError(f"{kinds[0].rpartition('.')[2]}: {text}")
    known = _class(builtins, kinds[0]) or next(
        filter(None, (_class(errors, k) for k in kinds)), None
    )
    if known is not None:
        with contextlib.suppress(TypeError):  # it takes more than a text
            error = known(text)
    error.add_note(f"in the process of the environment:\n{trace}")
    return error


def _class(module: ModuleType, kind: str) -> type[Exception] | None:
    """The exception of that full name, if the module has it."""
    home, _, name = kind.rpartition(".")
    found = getattr(module, name, None) if home == module.__name__ else None
    return found if isinstance(found, type) and issubclass(found, Exception) else None
