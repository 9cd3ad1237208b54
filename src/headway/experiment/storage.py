"""Files of a run: written beside and renamed; arrays as safetensors, the rest as JSON or CSV."""

import csv
import io
import json
import os
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
import safetensors.numpy
from safetensors import SafetensorError

from headway.data import Trajectory
from headway.errors import RunError
from headway.experiment.mapped import map_arrays

Tree = TypeVar("Tree")

UNFINISHED = ".writing"  # ends the name of a file that is not complete yet


def write_bytes(path: Path, content: bytes) -> None:
    """Write a whole file under a temporary name, then rename it into place."""
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}{UNFINISHED}")
    with temporary.open("wb") as file:
        file.write(content)
        file.flush()
        os.fsync(file.fileno())
    temporary.replace(path)


def write_json(path: Path, value: Any) -> None:
    """Write one JSON document."""
    write_bytes(path, (json.dumps(value, indent=2) + "\n").encode())


def read_json(path: Path) -> Any:
    """Read one JSON document.

    Raises:
        RunError: The file is missing or damaged.
    """
    try:
        return json.loads(path.read_text())
    except FileNotFoundError:
        raise RunError(f"{path} is missing; is {path.parent} a run directory?") from None
    except (UnicodeDecodeError, json.JSONDecodeError) as error:
        raise RunError(
            f"{path} is damaged ({error}), allowed: JSON; restore the file or start anew in"
            " another directory."
        ) from None


def write_json_lines(path: Path, rows: Iterable[Mapping[str, Any]]) -> None:
    """Write one JSON document per line."""
    write_bytes(path, "".join(json.dumps(row) + "\n" for row in rows).encode())


def read_json_lines(path: Path) -> list[dict[str, Any]]:
    """Read a file of JSON lines; a missing file has none.

    Raises:
        RunError: A line is damaged.
    """
    if not path.exists():
        return []
    try:
        return [json.loads(line) for line in path.read_text().splitlines()]
    except (UnicodeDecodeError, json.JSONDecodeError) as error:
        raise RunError(f"{path} is damaged ({error}); restore it or delete the run.") from None


def write_csv(path: Path, columns: Sequence[str], rows: Iterable[Mapping[str, Any]]) -> None:
    """Write a table with a header."""
    text = io.StringIO()
    writer = csv.DictWriter(text, columns, lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    write_bytes(path, text.getvalue().encode())


def read_csv(path: Path, columns: Sequence[str]) -> list[dict[str, str]]:
    """Read a table; a missing file has no rows.

    Raises:
        RunError: The header or a row is not as written by `write_csv`.
    """
    if not path.exists():
        return []
    try:
        reader = csv.DictReader(io.StringIO(path.read_text()))
        rows = list(reader)
    except (UnicodeDecodeError, csv.Error) as error:
        raise RunError(f"{path} is damaged ({error}); restore it or delete the run.") from None
    bad_row = any(None in row or None in row.values() for row in rows)
    if bad_row or list(reader.fieldnames or ()) != list(columns):
        raise RunError(
            f"{path} is damaged, allowed: rows of {', '.join(columns)}; restore it or delete"
            " the run."
        )
    return rows


def save_tree(path: Path, tree: Any) -> None:
    """Write the arrays of a pytree, named by their place in it."""
    arrays = {name: np.asarray(leaf) for name, leaf in _named_leaves(tree)}
    write_bytes(path, safetensors.numpy.save(arrays))


def load_tree(path: Path, template: Tree) -> Tree:
    """Read a pytree that `save_tree` wrote.

    Args:
        path: The file.
        template: A pytree of arrays or shapes with the same structure.

    Raises:
        RunError: The file is missing, damaged, or holds other arrays.
    """
    arrays = _read_arrays(path)
    wanted = _named_leaves(template)
    if {name for name, _ in wanted} != set(arrays):
        raise RunError(f"{path} holds other arrays than the run's model has; it is not its file.")
    leaves = []
    for name, leaf in wanted:
        array = arrays[name]
        if (array.shape, array.dtype) != (leaf.shape, leaf.dtype):
            raise RunError(
                f"{path}: {name} is {array.dtype}{list(array.shape)}, allowed:"
                f" {leaf.dtype}{list(leaf.shape)}; the file belongs to another model."
            )
        leaves.append(jnp.asarray(array))
    return jax.tree.unflatten(jax.tree.structure(template), leaves)


def save_trajectories(path: Path, trajectories: Sequence[Trajectory]) -> None:
    """Write trajectories: arrays in one safetensors file, physics in a JSON beside it."""
    arrays = {
        f"{index}.{name}": np.ascontiguousarray(getattr(trajectory, name))
        for index, trajectory in enumerate(trajectories)
        for name in ("obs", "action", "reward")
    }
    write_bytes(path.with_suffix(".safetensors"), safetensors.numpy.save(arrays))
    facts = [{"sim_params": dict(t.sim_params), "terminated": t.terminated} for t in trajectories]
    write_json(path.with_suffix(".json"), facts)


def load_trajectories(path: Path) -> list[Trajectory]:
    """Open what `save_trajectories` wrote; the arrays are read-only views of the mapped file.

    Raises:
        RunError: A file is missing or damaged.
    """
    arrays = map_arrays(path.with_suffix(".safetensors"))
    facts = read_json(path.with_suffix(".json"))
    try:
        return [
            Trajectory(
                **{name: arrays[f"{index}.{name}"] for name in ("obs", "action", "reward")},
                sim_params=fact["sim_params"],
                terminated=fact["terminated"],
            )
            for index, fact in enumerate(facts)
        ]
    except (KeyError, TypeError) as error:
        raise RunError(f"{path}: .safetensors and .json do not fit together ({error!r}).") from None


def _named_leaves(tree: Any) -> list[tuple[str, Any]]:
    flat, _ = jax.tree_util.tree_flatten_with_path(tree)
    return [(jax.tree_util.keystr(path, simple=True, separator="."), leaf) for path, leaf in flat]


def _read_arrays(path: Path) -> dict[str, np.ndarray]:
    try:
        return safetensors.numpy.load(path.read_bytes())
    except FileNotFoundError:
        raise RunError(f"{path} is missing; the run is not complete.") from None
    except (SafetensorError, ValueError) as error:
        raise RunError(
            f"{path} is damaged ({error}), allowed: safetensors; restore the file or start anew"
            " in another directory."
        ) from None
