"""Files that are whole or not there: bytes, JSON, arrays; read with one line where damaged."""

import contextlib
import errno
import json
import os
import shutil
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
import safetensors.numpy
from safetensors import SafetensorError, safe_open

from headway.errors import HeadwayError, LimitError, RunError, one_line

Tree = TypeVar("Tree")
Arrays = dict[str, np.ndarray]

UNFINISHED = ".writing"  # ends the name of a file that is not complete yet


def tree_arrays(tree: Any) -> Arrays:
    """The arrays of a pytree, named by their place in it."""
    return {name: np.asarray(leaf) for name, leaf in named_leaves(tree)}


def tree_from_arrays(template: Tree, arrays: Arrays, path: Path) -> Tree:
    """Build a pytree from what `tree_arrays` gave.

    Args:
        template: A pytree of arrays or shapes with the same structure.
        arrays: By name.
        path: Their file, for messages.

    Raises:
        RunError: An array is missing, too many, or has another shape or type.
    """
    wanted = dict(named_leaves(template))
    if set(wanted) != set(arrays):
        raise RunError(f"{path} holds other arrays than the run's model has; it is not its file.")
    for name, leaf in wanted.items():
        got = arrays[name]
        if (got.shape, got.dtype) != (leaf.shape, leaf.dtype):
            raise RunError(
                f"{path}: {name} is {got.dtype}{list(got.shape)}, allowed:"
                f" {leaf.dtype}{list(leaf.shape)}; the file belongs to another model."
            )
    leaves = [jnp.asarray(arrays[name]) for name in wanted]
    return jax.tree.unflatten(jax.tree.structure(template), leaves)


def named_leaves(tree: Any) -> list[tuple[str, Any]]:
    """The leaves of a pytree, with names by their place in it."""
    flat, _ = jax.tree_util.tree_flatten_with_path(tree)
    return [(jax.tree_util.keystr(path, simple=True, separator="."), leaf) for path, leaf in flat]


def arrays_bytes(arrays: Arrays, facts: Mapping[str, Any] | None = None) -> bytes:
    """Named arrays as safetensors, with facts for JSON in the header."""
    return safetensors.numpy.save(arrays, {"facts": json.dumps(facts or {})})


def load_arrays(path: Path) -> tuple[Arrays, dict[str, Any]]:
    """Read the arrays and the facts of `arrays_bytes`.

    Raises:
        RunError: The file is missing or damaged.
    """
    with reading(path), safe_open(path, "numpy") as file:
        arrays = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
        return arrays, json.loads((file.metadata() or {})["facts"])


def write_json(path: Path, value: Any) -> None:
    """Write one JSON document."""
    write_bytes(path, (json.dumps(value, indent=2, allow_nan=False) + "\n").encode())


def write_bytes(path: Path, content: bytes) -> None:
    """Write a whole file under a temporary name, then rename it into place.

    When this returns, the file survives a loss of power; until then the old one does.

    Raises:
        LimitError: The disk is full.
        RunError: Something else than a regular file has this name, or it cannot be written.
    """
    check_target(path)
    temporary = path.with_name(f".{path.name}.{os.getpid()}{UNFINISHED}")  # others may write it
    try:
        with writing(path):
            make_dir(path.parent)
            temporary.unlink(missing_ok=True)  # never written through somebody's link
            with temporary.open("xb") as file:
                file.write(content)
                file.flush()
                os.fsync(file.fileno())
            os.replace(temporary, path)  # noqa: PTH105
            _sync_dir(path.parent)
    except HeadwayError:
        with contextlib.suppress(OSError):
            temporary.unlink(missing_ok=True)
        raise


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


def remove(path: Path) -> None:
    """Delete a file, for good even if the power is lost."""
    with writing(path):
        path.unlink(missing_ok=True)
        _sync_dir(path.parent)


def make_dir(path: Path) -> None:
    """Make a folder and those above it, for good likewise."""
    if not path.is_dir():
        make_dir(path.parent)
        path.mkdir(exist_ok=True)
        _sync_dir(path.parent)


def _sync_dir(path: Path) -> None:
    """Make renames and deletions survive a loss of power, where a file system can promise it."""
    with contextlib.suppress(OSError):
        handle = os.open(path, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)


@contextlib.contextmanager
def writing(path: Path) -> Iterator[None]:
    """Turn what a file system refuses into one line."""
    try:
        yield
    except OSError as error:
        if error.errno in (errno.ENOSPC, errno.EDQUOT):
            raise LimitError(
                f"the disk is too full to write {path}; free some space, then the same command"
                " goes on."
            ) from None
        raise RunError(f"{path} cannot be written: {error.strerror}; check the path.") from None


@contextlib.contextmanager
def new_folder(path: Path) -> Iterator[Path]:
    """A folder to make and fill, which is renamed to `path` once it is whole."""
    unfinished = path.with_name(f".{path.name}{UNFINISHED}")
    shutil.rmtree(unfinished, ignore_errors=True)
    with writing(path):
        yield unfinished
        unfinished.rename(path)
        _sync_dir(path.parent)


@contextlib.contextmanager
def reading(path: Path) -> Iterator[None]:
    """Name a file that is missing, or not as it was written, in one line."""
    try:
        yield
    except FileNotFoundError:
        raise RunError(f"{path} is missing; check the path, or restore the file.") from None
    except OSError as error:
        raise RunError(f"{path} cannot be read: {error.strerror}; check the path.") from None
    except (SafetensorError, HeadwayError, ValueError, KeyError, TypeError) as error:
        raise RunError(f"{path} is damaged: {one_line(error, 300)}.") from None
