"""The rows of a run's tables: test episodes, head shares, prediction errors, metrics."""

import dataclasses
import math
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

from headway.errors import RunError
from headway.storage.files import damaged

TABLES = ("metrics.jsonl", "evaluation.csv", "assignments.csv", "prediction_error.csv")
EVALUATION_COLUMNS = (
    "method", "env", "seed", "iteration", "group", "sim_params", "episode", "return", "length",
)  # fmt: skip
ASSIGNMENT_COLUMNS = ("iteration", "member", "head", "sim_params", "share")
PREDICTION_COLUMNS = ("iteration", "group", "step", "error")

_TEXTS = ("group", "sim_params")
_WHOLES = ("iteration", "member", "head", "step")
_SUMMARY = {"returns", "return_mean", "return_std"}


@dataclasses.dataclass(frozen=True)
class EpisodeRow:
    """One test episode; a row of `evaluation.csv`."""

    method: str
    """What was trained."""
    env: str
    """Short name of the environment."""
    seed: int
    """The run's seed."""
    iteration: int
    """After which iteration it was tested, counted from 0."""
    group: str
    """`"train"` or the name of an unseen group."""
    sim_params: Mapping[str, float]
    """The physics of the episode."""
    episode: int
    """Which of the group's episodes, counted from 0."""
    episode_return: float
    """Undiscounted sum of rewards; `return` in the table."""
    length: int
    """Steps of the episode."""

    def to_csv(self) -> dict[str, Any]:
        """The row as it is written."""
        values = dataclasses.asdict(self)
        values["sim_params"] = format_sim_params(self.sim_params)
        values["return"] = values.pop("episode_return")
        return values

    @classmethod
    def from_csv(cls, row: Mapping[str, str]) -> "EpisodeRow":
        """The row as it was written.

        Raises:
            ValueError: A number is none, or not finite.
        """
        return cls(
            row["method"],
            row["env"],
            _whole(row["seed"]),
            _whole(row["iteration"]),
            row["group"],
            parse_sim_params(row["sim_params"]),
            _whole(row["episode"]),
            _finite(row["return"]),
            _whole(row["length"]),
        )


def format_sim_params(sim_params: Mapping[str, float]) -> str:
    """Write simulator parameters as one cell, for example `length=0.5 mass=1`."""
    return " ".join(f"{name}={value:.12g}" for name, value in sorted(sim_params.items()))


def parse_sim_params(text: str) -> dict[str, float]:
    """Read what `format_sim_params` wrote.

    Raises:
        ValueError: The text is not of that form.
    """
    pairs = [part.split("=") for part in text.split()]
    if any(len(pair) != 2 for pair in pairs):
        raise ValueError(f"{text[:80]!r} is not of the form name=value")
    return {name: _finite(value) for name, value in pairs}


def parse_rows(
    path: Path, rows: Iterable[Mapping[str, str]], parse: Callable[[Mapping[str, str]], Any]
) -> list[Any]:
    """Turn a table's texts into values.

    Raises:
        RunError: A cell holds something else than its column.
    """
    parsed = []
    try:
        for row in rows:
            parsed.append(parse(row))
    except ValueError as error:
        raise damaged(path, f"row {len(parsed) + 1}: {error}") from None
    return parsed


def typed_row(row: Mapping[str, str]) -> dict[str, Any]:
    """A row whose columns are numbers, but for `group` and `sim_params`.

    Raises:
        ValueError: A cell is no number.
    """
    return {
        column: value if column in _TEXTS else (_whole if column in _WHOLES else float)(value)
        for column, value in row.items()
    }


def check_metrics(path: Path, rows: list[Any]) -> list[dict[str, Any]]:
    """Make sure that lines of `metrics.jsonl` hold what reports read.

    Raises:
        RunError: A line is of another iteration, or lacks something.
    """
    for index, row in enumerate(rows):
        if not isinstance(row, dict) or row.get("iteration") != index:
            raise RunError(
                f"{path} is damaged in line {index + 1}, allowed: iteration {index}; restore it"
                " or delete the run."
            )
        evaluation = row.get("evaluation", {})
        learned = row.get("timesteps") != 0  # a run that learns nothing collects nothing
        tables = ("fitting", "seconds") if learned else ("seconds",)
        right = (
            _is_number(row.get("timesteps"))
            and (not learned or _is_summary(row.get("collection")))
            and isinstance(evaluation, dict)
            and all(map(_is_summary, evaluation.values()))
            and all(_are_numbers(row.get(name)) for name in tables)
        )
        if not right:
            raise damaged(path, f"line {index + 1} lacks numbers of an iteration")
    return rows


def _is_summary(table: Any) -> bool:
    return _are_numbers(table) and set(table) >= _SUMMARY and isinstance(table["returns"], list)


def _are_numbers(table: Any) -> bool:
    """Whether something is a table of numbers and lists of numbers."""
    return isinstance(table, dict) and all(
        all(map(_is_number, value)) if isinstance(value, list) else _is_number(value)
        for value in table.values()
    )


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _whole(text: str) -> int:
    value = int(text)
    if not -(2**63) <= value < 2**63:
        raise ValueError(f"a whole number has {len(text)} digits")
    return value


def _finite(text: str) -> float:
    value = float(text)
    if not math.isfinite(value):
        raise ValueError(f"{text[:80]!r} is no finite number")
    return value
