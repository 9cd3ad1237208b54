"""Bytes and JSON on disk: written beside and renamed; read with limits, because they may lie.

A file may be cut short, have a flipped bit, or come from a stranger. Whatever it holds, reading
it ends soon, takes little memory, runs nothing, and says in one line what is wrong.
"""

import contextlib
import errno
import hashlib
import json
import math
import os
import shutil
import stat
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, BinaryIO

from headway.errors import LimitError, RunError

UNFINISHED = ".writing"  # ends the name of a file that is not complete yet
SPARE_BYTES = 16 * 2**20  # stays free on the disk after every write
MAX_TEXT_BYTES = 64 * 2**20  # of a JSON or CSV file
MAX_CONTAINERS = 1_000_000  # lists and tables in one JSON document
MAX_DIGITS = 20  # of a whole number in JSON
_FULL = (errno.ENOSPC, errno.EDQUOT)
_CHUNK = 2**20
_HUGE = 2**30  # a file from here on that is nearly all holes is not ours


def write_bytes(path: Path, content: bytes) -> None:
    """Write a whole file under a temporary name, then rename it into place.

    When this returns, the file survives a loss of power; until then the old one does.

    Raises:
        LimitError: The disk is full, or would be nearly full.
        RunError: Something else than a regular file has this name.
    """
    check_target(path)
    make_dir(path.parent)
    if free_space(path) < len(content) + SPARE_BYTES:
        raise _full(path, len(content))
    temporary = path.with_name(f".{path.name}{UNFINISHED}")
    remove([temporary])  # never written through a link that somebody left there
    flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL | getattr(os, "O_BINARY", 0)
    try:
        handle = os.open(temporary, flags, 0o666)
        with os.fdopen(handle, "wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)  # noqa: PTH105 (one name for tests to interrupt)
        sync_dir(path.parent)
    except OSError as error:
        if error.errno not in _FULL:
            raise
        with contextlib.suppress(OSError):  # on such a disk even that may fail
            temporary.unlink(missing_ok=True)
        raise _full(path, len(content)) from None


def check_target(path: Path) -> None:
    """Refuse to write where no file can be, or where a device or a directory would be replaced.

    Raises:
        RunError: The path ends with no name, or with that of something else than a regular file.
    """
    if not path.name or (path.exists() and not path.is_file()):
        raise RunError(
            f"{path} is no regular file, allowed: the name of a new file or of one to replace;"
            " choose another name."
        )


def make_dir(path: Path) -> None:
    """Make a directory that survives a loss of power, and those above it.

    Raises:
        LimitError: The disk is full.
    """
    if path.is_dir():
        return
    make_dir(path.parent)
    try:
        path.mkdir(exist_ok=True)
        sync_dir(path.parent)
    except OSError as error:
        if error.errno not in _FULL:
            raise
        raise _full(path, 0) from None


def remove(paths: Iterable[Path]) -> None:
    """Delete files, in this order; missing ones are no error.

    Raises:
        LimitError: The disk is so full that nothing can be deleted, as some file systems are.
    """
    for path in paths:
        if not (path.is_symlink() or path.exists()):
            continue
        try:
            os.unlink(path)  # noqa: PTH108 (one name for tests to interrupt)
            sync_dir(path.parent)
        except OSError as error:
            if error.errno not in _FULL:
                raise
            raise LimitError(
                f"the disk is too full to delete {path}; free some space, then the same command"
                " goes on."
            ) from None


def sync_dir(path: Path) -> None:
    """Make renames and deletions in a directory survive a loss of power."""
    if os.name != "posix":
        return  # elsewhere a directory cannot be opened
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def free_space(path: Path) -> int:
    """Bytes that are free on the disk where a file is, or will be."""
    return shutil.disk_usage(next(folder for folder in path.parents if folder.exists())).free


def _full(path: Path, num_bytes: int) -> LimitError:
    return LimitError(
        f"the disk is too full to write {path}: {num_bytes + SPARE_BYTES:,} bytes needed with a"
        f" margin, {free_space(path):,} free; free some space, then the same command goes on."
    )


def open_file(path: Path, max_bytes: int | None = None) -> BinaryIO:
    """Open a regular file for reading, and nothing that could block or never end.

    Raises:
        RunError: The file is missing, no regular file, or too large.
    """
    try:
        flags = os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0)
        handle = os.open(path, flags)
    except FileNotFoundError:
        raise RunError(f"{path} is missing; check the path, or restore the file.") from None
    except OSError as error:
        raise RunError(f"{path} cannot be read: {error.strerror}; check the path.") from None
    file = os.fdopen(handle, "rb") if stat.S_ISREG(os.fstat(handle).st_mode) else None
    if file is None:
        os.close(handle)
        raise RunError(f"{path} is no regular file, allowed: a file written by headway.")
    facts = os.fstat(handle)
    if max_bytes is not None and facts.st_size > max_bytes:
        file.close()
        raise RunError(f"{path} has {facts.st_size:,} bytes, allowed: at most {max_bytes:,}.")
    if facts.st_size > _HUGE and 0 <= getattr(facts, "st_blocks", -1) * 512 < facts.st_size // 64:
        file.close()
        raise RunError(f"{path} claims {facts.st_size:,} bytes but is almost empty; restore it.")
    return file


def read_bytes(path: Path, max_bytes: int = MAX_TEXT_BYTES) -> bytes:
    """Read a whole file.

    Raises:
        RunError: The file is missing, no regular file, or too large.
    """
    with open_file(path, max_bytes) as file:
        return file.read(max_bytes)


def damaged(path: Path, reason: object) -> RunError:
    """Word the error for a file that is not as it was written."""
    text = " ".join(str(reason).split())
    return RunError(f"{path} is damaged: {text[:300]}{'...' * (len(text) > 300)}.")


def parse_json(content: bytes) -> Any:
    """Parse strict JSON: finite numbers, no key twice, nothing that takes much memory.

    Raises:
        ValueError: The content is something else; the text says what.
    """
    if content.count(b"[") + content.count(b"{") > MAX_CONTAINERS:
        raise ValueError(f"it holds more than {MAX_CONTAINERS:,} lists and tables")
    try:
        return json.loads(
            content.decode(),
            object_pairs_hook=_unique,
            parse_constant=_refuse_constant,
            parse_float=_finite,
            parse_int=_whole,
        )
    except RecursionError:
        raise ValueError("lists or tables are nested too deeply") from None


def _unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    table = dict(pairs)
    if len(table) < len(pairs):
        raise ValueError("a table holds a key twice")
    return table


def _refuse_constant(name: str) -> float:
    raise ValueError(f"{name} is no finite number")


def _finite(text: str) -> float:
    value = float(text)
    if not math.isfinite(value):
        raise ValueError(f"{text[:MAX_DIGITS]} is too large for a number")
    return value


def _whole(text: str) -> int:
    if len(text) > MAX_DIGITS:
        raise ValueError(f"a whole number has {len(text)} digits")
    return int(text)


def write_json(path: Path, value: Any) -> None:
    """Write one JSON document."""
    write_bytes(path, format_json(value))


def read_json(path: Path, max_bytes: int = MAX_TEXT_BYTES) -> Any:
    """Read one JSON document.

    Raises:
        RunError: The file is missing, too large or damaged.
    """
    content = read_bytes(path, max_bytes)
    try:
        return parse_json(content)
    except ValueError as error:
        raise damaged(path, error) from None


def format_json(value: Any) -> bytes:
    """The bytes of a JSON document."""
    return (json.dumps(value, indent=2, allow_nan=False) + "\n").encode()


def seal(values: dict[str, Any]) -> bytes:
    """The bytes of a JSON document that ends with a checksum of what it says."""
    checksum = hashlib.sha256(format_json(values)).hexdigest()
    return format_json({**values, "checksum": checksum})


def is_sealed(content: bytes, values: dict[str, Any]) -> bool:
    """Whether a document has exactly the bytes that `seal` gave it."""
    return content == seal({name: value for name, value in values.items() if name != "checksum"})


def read_sealed(path: Path) -> dict[str, Any]:
    """Read a document that `seal` made.

    Raises:
        RunError: The file is missing, or any bit of it has changed.
    """
    content = read_bytes(path)
    try:
        values = parse_json(content)
    except ValueError as error:
        raise damaged(path, error) from None
    if not isinstance(values, dict) or not is_sealed(content, values):
        raise damaged(path, "its checksum does not fit its content")
    return {name: value for name, value in values.items() if name != "checksum"}


def chunks(file: BinaryIO, num_bytes: int) -> Iterator[bytes]:
    """The first bytes of a file, piece by piece."""
    while num_bytes > 0 and (piece := file.read(min(_CHUNK, num_bytes))):
        num_bytes -= len(piece)
        yield piece
