"""One process at a time on one run directory."""

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path

from headway.errors import BusyError

try:
    import fcntl
except ImportError:  # pragma: no cover (no such locks outside of POSIX systems)
    fcntl = None

LOCK = ".lock"


@contextlib.contextmanager
def locked(path: Path) -> Iterator[None]:
    """Hold a run directory.

    The lock belongs to the open file, so it ends with the process however that ends. It is
    promised for local disks; network file systems may not tell other machines of it.

    Raises:
        BusyError: Another process holds the directory.
    """
    if fcntl is None:  # pragma: no cover
        yield
        return
    flags = os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW
    handle = os.open(path / LOCK, flags, 0o666)
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        os.close(handle)
        raise BusyError(
            f"{path} is being trained by another process, allowed: one at a time; wait for it or"
            " choose another --run-dir."
        ) from None
    try:
        yield
    finally:
        os.close(handle)
