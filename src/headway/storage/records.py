"""Tables and trajectories of a run: CSV, JSON lines, safetensors."""

import csv
import io
import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from headway.data import Trajectory
from headway.errors import HeadwayError, RunError
from headway.storage import files
from headway.storage.arrays import Arrays, load_arrays, save_arrays
from headway.storage.files import damaged

Facts = list[dict[str, Any]]

MAX_ROWS = 500_000  # of a table
_TRAJECTORY = {"obs": (np.float32, 2), "action": (np.float32, 2), "reward": (np.float64, 1)}


def json_lines(path: Path, rows: Iterable[Mapping[str, Any]]) -> str:
    """One JSON document per line, to be appended to a file.

    Raises:
        RunError: A row holds a number that is not finite.
    """
    try:
        return "".join(json.dumps(row, allow_nan=False) + "\n" for row in rows)
    except ValueError:
        raise RunError(
            f"{path} cannot take a number that is not finite; check the rewards of the environment."
        ) from None


def parse_json_lines(path: Path, content: bytes) -> list[Any]:
    """Read what `json_lines` made.

    Raises:
        RunError: A line is damaged.
    """
    rows = []
    for number, line in enumerate(io.BytesIO(content), start=1):
        try:
            rows.append(files.parse_json(line))
        except ValueError as error:
            raise damaged(path, f"line {number}: {error}") from None
    return rows


def csv_lines(columns: Sequence[str], rows: Iterable[Mapping[str, Any]], *, header: bool) -> str:
    """Rows of a table, to be appended to a file."""
    text = io.StringIO()
    writer = csv.DictWriter(text, columns, lineterminator="\n")
    if header:
        writer.writeheader()
    writer.writerows(rows)
    return text.getvalue()


def parse_csv(path: Path, content: bytes, columns: Sequence[str]) -> Iterator[dict[str, str]]:
    """Read a table row by row; nothing at all has no rows.

    Raises:
        RunError: The header or a row is not as written by `csv_lines`, or there are too many.
    """
    if not content:
        return
    try:
        reader = csv.reader(io.StringIO(content.decode(), newline=""), strict=True)
        for number, row in enumerate(reader):
            if len(row) != len(columns) or (number == 0 and row != list(columns)):
                raise damaged(path, f"line {number + 1} is no row of {', '.join(columns)}")
            if number > MAX_ROWS:
                raise damaged(path, f"it has more than {MAX_ROWS:,} rows")
            if number:
                yield dict(zip(columns, row, strict=True))
    except (UnicodeDecodeError, csv.Error) as error:
        raise damaged(path, error) from None


def read_csv(path: Path, columns: Sequence[str]) -> list[dict[str, str]]:
    """Read a table from a file; a missing file has no rows.

    Raises:
        RunError: The file is damaged.
    """
    return list(parse_csv(path, files.read_bytes(path), columns)) if path.exists() else []


def write_csv(path: Path, columns: Sequence[str], rows: Iterable[Mapping[str, Any]]) -> None:
    """Write a whole table, beside and renamed."""
    files.write_bytes(path, csv_lines(columns, rows, header=True).encode())


def trajectory_arrays(trajectories: Sequence[Trajectory]) -> Arrays:
    """The arrays of some trajectories, by number and name."""
    return {
        f"{index}.{name}": np.ascontiguousarray(getattr(trajectory, name))
        for index, trajectory in enumerate(trajectories)
        for name in _TRAJECTORY
    }


def trajectory_facts(trajectories: Sequence[Trajectory]) -> Facts:
    """What trajectories hold beside arrays, ready for JSON."""
    return [{"sim_params": dict(t.sim_params), "terminated": t.terminated} for t in trajectories]


def trajectories_from(arrays: Arrays, facts: Any, path: Path) -> list[Trajectory]:
    """Build what `trajectory_arrays` and `trajectory_facts` took apart.

    Raises:
        RunError: Arrays and facts do not fit together, or are no trajectories.
    """
    if not isinstance(facts, list) or len(arrays) != len(_TRAJECTORY) * len(facts):
        raise RunError(f"{path}.json and its .safetensors do not fit together; restore both.")
    try:
        return [_trajectory(arrays, fact, f"{i}.") for i, fact in enumerate(facts)]
    except (KeyError, TypeError, ValueError, HeadwayError) as error:
        raise damaged(path, f"it holds no trajectories: {error}") from None


def _trajectory(arrays: Arrays, fact: dict[str, Any], prefix: str) -> Trajectory:
    for name, (dtype, ndim) in _TRAJECTORY.items():
        got = arrays[prefix + name]
        if (got.dtype, got.ndim) != (dtype, ndim):
            raise ValueError(f"{prefix}{name} is {got.dtype} with {got.ndim} axes")
    sim_params, terminated = fact["sim_params"], fact["terminated"]
    plain = isinstance(sim_params, dict) and all(
        isinstance(value, int | float) and not isinstance(value, bool)
        for value in sim_params.values()
    )
    if not plain or not isinstance(terminated, bool):
        raise ValueError("sim_params are no numbers by name, or terminated is no truth value")
    named = {name: arrays[prefix + name] for name in _TRAJECTORY}
    return Trajectory(**named, sim_params=sim_params, terminated=terminated)


def save_trajectories(path: Path, trajectories: Sequence[Trajectory]) -> None:
    """Write trajectories: arrays in one safetensors file, physics in a JSON beside it."""
    save_arrays(path.with_suffix(".safetensors"), trajectory_arrays(trajectories))
    files.write_json(path.with_suffix(".json"), trajectory_facts(trajectories))


def load_trajectories(path: Path) -> list[Trajectory]:
    """Read what `save_trajectories` wrote.

    Raises:
        RunError: A file is missing or damaged.
    """
    arrays = load_arrays(path.with_suffix(".safetensors"))
    facts = files.read_json(path.with_suffix(".json"))
    return trajectories_from(arrays, facts, path)
