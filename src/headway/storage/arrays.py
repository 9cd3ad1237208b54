"""Arrays of a run as safetensors: named arrays, and pytrees of them; nothing is pickled."""

import io
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
import safetensors.numpy
from safetensors import SafetensorError

from headway.errors import RunError
from headway.storage import files
from headway.storage.files import damaged

Tree = TypeVar("Tree")
Arrays = dict[str, np.ndarray]

MAX_HEADER_BYTES = 8 * 2**20  # of a safetensors file
_DTYPES = {"F32": "<f4", "F64": "<f8", "I32": "<i4", "I64": "<i8", "U32": "<u4", "BOOL": "?"}


class ArraySpec(NamedTuple):
    """What the header of a safetensors file says of one array."""

    dtype: np.dtype
    shape: tuple[int, ...]
    offset: int = 0
    """Where its bytes begin in the file."""


def read_header(path: Path) -> dict[str, ArraySpec]:
    """Read the header of a safetensors file, and make sure that the file is as large as it says.

    Nothing else is read, so a header may claim what it likes.

    Raises:
        RunError: The file is missing or damaged.
    """
    with files.open_file(path) as file:
        size = file.seek(0, io.SEEK_END)
        file.seek(0)
        length = int.from_bytes(file.read(8), "little")
        if size < 8 or length > min(size - 8, MAX_HEADER_BYTES):
            raise damaged(path, f"its header claims {length:,} bytes of {size:,}")
        text = file.read(length)
    try:
        return _parse_header(files.parse_json(text), 8 + length, size - 8 - length)
    except (ValueError, TypeError) as error:
        raise damaged(path, f"its header is wrong: {error}") from None


def _parse_header(header: Any, start: int, num_bytes: int) -> dict[str, ArraySpec]:
    """Check that the arrays cover the rest of the file without gap or overlap."""
    if not isinstance(header, dict):
        raise ValueError("no table")
    header.pop("__metadata__", None)
    specs, ranges = {}, []
    for name, entry in header.items():
        if not isinstance(entry, dict) or set(entry) != {"dtype", "shape", "data_offsets"}:
            raise ValueError(f"{name[:80]!r} is no array")
        shape, offsets = entry["shape"], entry["data_offsets"]
        if entry["dtype"] not in _DTYPES or not (_sizes(shape) and _sizes(offsets)):
            raise ValueError(f"{name[:80]!r} has an unknown type or no sizes")
        begin, end = offsets
        spec = ArraySpec(np.dtype(_DTYPES[entry["dtype"]]), tuple(shape), start + begin)
        if end - begin != _num_bytes(spec, num_bytes):
            raise ValueError(f"{name[:80]!r} has another size than its shape")
        specs[name] = spec
        ranges.append((begin, end))
    place = 0
    for begin, end in sorted(ranges):
        if begin != place:
            raise ValueError(f"arrays overlap or leave a gap at byte {place}")
        place = end
    if place != num_bytes:
        raise ValueError(f"arrays have {place:,} bytes, the file holds {num_bytes:,}")
    return specs


def _sizes(values: Any) -> bool:
    """Whether something is a short list of whole numbers from 0."""
    short = isinstance(values, list) and len(values) <= 8
    return short and all(type(value) is int and value >= 0 for value in values)


def _num_bytes(spec: ArraySpec, at_most: int) -> int:
    if 0 in spec.shape:
        return 0
    size = spec.dtype.itemsize
    for length in spec.shape:
        size *= length
        if size > at_most:
            raise ValueError("an array is larger than the file")
    return size


def save_arrays(path: Path, arrays: Arrays) -> None:
    """Write named arrays."""
    files.write_bytes(path, safetensors.numpy.save(arrays))


def load_arrays(path: Path) -> Arrays:
    """Read what `save_arrays` wrote; takes no more memory than the file is large.

    Raises:
        RunError: The file is missing or damaged.
    """
    read_header(path)
    with files.open_file(path) as file:
        content = file.read()
    try:
        return safetensors.numpy.load(content)
    except (SafetensorError, ValueError, KeyError) as error:
        raise damaged(path, error) from None


def tree_arrays(tree: Any, prefix: str = "") -> Arrays:
    """The arrays of a pytree, named by their place in it; random keys become numbers."""
    return {prefix + name: np.asarray(_plain(leaf)) for name, leaf in _named_leaves(tree)}


def tree_from_arrays(template: Tree, arrays: Arrays, path: Path, prefix: str = "") -> Tree:
    """Build a pytree from what `tree_arrays` gave.

    Args:
        template: A pytree of arrays or shapes with the same structure.
        arrays: By name; those without the prefix are left alone.
        path: Their file, for messages.
        prefix: Begins the names.

    Raises:
        RunError: An array is missing, too many, or has another shape or type.
    """
    own = {name: array for name, array in arrays.items() if name.startswith(prefix)}
    check_arrays(template, _specs(own), path, prefix)
    leaves = [
        _wrap(leaf, jnp.asarray(own[prefix + name])) for name, leaf in _named_leaves(template)
    ]
    return jax.tree.unflatten(jax.tree.structure(template), leaves)


def check_arrays(
    template: Any, found: Mapping[str, ArraySpec], path: Path, prefix: str = ""
) -> None:
    """Make sure that a file holds the arrays of a pytree and no others.

    Raises:
        RunError: It does not.
    """
    wanted = {prefix + name: _plain_shape(leaf) for name, leaf in _named_leaves(template)}
    if set(wanted) != set(found):
        raise RunError(f"{path} holds other arrays than the run's model has; it is not its file.")
    for name, leaf in wanted.items():
        got = found[name]
        if (got.shape, got.dtype) != (leaf.shape, leaf.dtype):
            raise RunError(
                f"{path}: {name} is {got.dtype}{list(got.shape)}, allowed:"
                f" {leaf.dtype}{list(leaf.shape)}; the file belongs to another model."
            )


def save_tree(path: Path, tree: Any) -> None:
    """Write the arrays of a pytree, named by their place in it."""
    save_arrays(path, tree_arrays(tree))


def load_tree(path: Path, template: Tree) -> Tree:
    """Read a pytree that `save_tree` wrote; its shapes are checked before its arrays are read.

    Args:
        path: The file.
        template: A pytree of arrays or shapes with the same structure.

    Raises:
        RunError: The file is missing, damaged, or holds other arrays.
    """
    check_arrays(template, read_header(path), path)
    return tree_from_arrays(template, load_arrays(path), path)


def _named_leaves(tree: Any) -> list[tuple[str, Any]]:
    flat, _ = jax.tree_util.tree_flatten_with_path(tree)
    return [(jax.tree_util.keystr(path, simple=True, separator="."), leaf) for path, leaf in flat]


def _specs(arrays: Arrays) -> dict[str, ArraySpec]:
    return {name: ArraySpec(array.dtype, array.shape) for name, array in arrays.items()}


def _is_key(leaf: Any) -> bool:
    return jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)


def _plain(leaf: Any) -> Any:
    return jax.random.key_data(leaf) if _is_key(leaf) else leaf


def _plain_shape(leaf: Any) -> Any:
    return jax.eval_shape(_plain, leaf) if _is_key(leaf) else leaf


def _wrap(template: Any, array: jax.Array) -> jax.Array:
    return jax.random.wrap_key_data(array) if _is_key(template) else array
