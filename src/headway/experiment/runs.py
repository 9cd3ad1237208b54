"""The run directory: configuration, metrics, tables, checkpoints, data, figures.

An iteration is finished once its line stands in `metrics.jsonl`, which is written last.
Whatever an interrupted iteration left behind is written again when the run goes on.
"""

import dataclasses
import importlib.metadata
import platform
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import jax

from headway import settings
from headway.config import Config
from headway.data import Trajectory
from headway.errors import ConfigError, RunError
from headway.experiment import storage

SCHEMA = 1
VERSIONED = ("headway", "jax", "jaxlib", "equinox", "optax", "numpy", "gymnasium", "mujoco")
EVALUATION_COLUMNS = (
    "method", "env", "seed", "iteration", "group", "sim_params", "episode", "return", "length",
)  # fmt: skip
ASSIGNMENT_COLUMNS = ("iteration", "member", "head", "sim_params", "share")
PREDICTION_COLUMNS = ("iteration", "group", "step", "error")


@dataclasses.dataclass(frozen=True)
class EpisodeRow:
    """One test episode; a row of `evaluation.csv`."""

    method: str
    env: str
    seed: int
    iteration: int
    group: str
    sim_params: Mapping[str, float]
    episode: int
    episode_return: float
    length: int

    def to_csv(self) -> dict[str, Any]:
        """The row as it is written."""
        values = dataclasses.asdict(self)
        values["sim_params"] = format_sim_params(self.sim_params)
        values["return"] = values.pop("episode_return")
        return values

    @classmethod
    def from_csv(cls, row: Mapping[str, str]) -> "EpisodeRow":
        """The row as it was written."""
        return cls(
            row["method"],
            row["env"],
            int(row["seed"]),
            int(row["iteration"]),
            row["group"],
            parse_sim_params(row["sim_params"]),
            int(row["episode"]),
            float(row["return"]),
            int(row["length"]),
        )


class RunDir:
    """Reads and writes one run directory.

    Args:
        path: The directory; nothing is created before `create`.
    """

    def __init__(self, path: str | Path):
        self.path = Path(path)

    @property
    def figures(self) -> Path:
        """Where figures go."""
        return self.path / "figures"

    def create_or_resume(self, config: Config) -> None:
        """Begin a run here, or make sure that the run here is the same.

        Raises:
            RunError: The directory holds something else, or a run with other settings.
        """
        if self.path.exists() and not self.path.is_dir():
            raise RunError(
                f"{self.path} is a file, allowed: a directory; choose another --run-dir."
            )
        found = self.path.iterdir() if self.path.exists() else ()
        if all(path.name.endswith(storage.UNFINISHED) for path in found):
            storage.write_json(self.path / "config.json", _config_file(config))
            return
        if not (self.path / "config.json").exists():
            raise RunError(
                f"{self.path} is not empty and holds no run, allowed: a new directory or one"
                " made by `headway train`; choose another --run-dir."
            )
        found = settings.differences(self.config(), config)
        if found:
            raise RunError(
                f"{self.path} holds a run with other settings ({'; '.join(found)}); choose"
                " another --run-dir, or the same settings to resume."
            )

    def config(self) -> Config:
        """The settings of the run here.

        Raises:
            RunError: There is no run here, or its configuration is damaged.
        """
        if not self.path.is_dir():
            raise RunError(f"{self.path} is not a directory, allowed: a run directory.")
        values = storage.read_json(self.path / "config.json")
        if not isinstance(values, dict) or values.get("schema") != SCHEMA:
            raise RunError(
                f"{self.path / 'config.json'} has no schema {SCHEMA}, allowed: a file written by"
                " this version of headway; train the run again."
            )
        try:
            return settings.from_dict(values["config"])
        except (ConfigError, KeyError) as error:
            raise RunError(f"{self.path / 'config.json'} is damaged: {error}") from None

    @property
    def finished_iterations(self) -> int:
        """Iterations that are complete."""
        return len(self.metrics())

    def check(self) -> None:
        """Read every table once, so that damage is found before work is done.

        Raises:
            RunError: A table is damaged, or the metrics of finished iterations are gone.
        """
        self.evaluation()
        self.assignments()
        self.prediction_errors()
        beyond = self.checkpoint(self.finished_iterations + 1)
        if beyond.exists():
            raise RunError(
                f"{self.path / 'metrics.jsonl'} holds {self.finished_iterations} iterations, but"
                f" {beyond.name} exists; restore the metrics or delete the run."
            )

    def metrics(self) -> list[dict[str, Any]]:
        """One entry per finished iteration."""
        path = self.path / "metrics.jsonl"
        rows = storage.read_json_lines(path)
        for index, row in enumerate(rows):
            if not isinstance(row, dict) or row.get("iteration") != index:
                raise RunError(
                    f"{path} is damaged in line {index + 1}, allowed: iteration {index}; restore it"
                    " or delete the run."
                )
        return rows

    def evaluation(self) -> list[EpisodeRow]:
        """Every test episode of the finished iterations."""
        path = self.path / "evaluation.csv"
        try:
            rows = [EpisodeRow.from_csv(row) for row in storage.read_csv(path, EVALUATION_COLUMNS)]
        except ValueError as error:
            raise RunError(f"{path} is damaged ({error}); restore it or delete the run.") from None
        finished = self.finished_iterations
        return [row for row in rows if row.iteration < finished]

    def assignments(self) -> list[dict[str, Any]]:
        """Share of segments that each head owns, per iteration, member and physics."""
        return self._table("assignments.csv", ASSIGNMENT_COLUMNS)

    def prediction_errors(self) -> list[dict[str, Any]]:
        """Error by imagined step, per iteration and group."""
        return self._table("prediction_error.csv", PREDICTION_COLUMNS)

    def write_evaluation(self, rows: Iterable[EpisodeRow]) -> None:
        """Replace the table of test episodes."""
        table = (row.to_csv() for row in rows)
        storage.write_csv(self.path / "evaluation.csv", EVALUATION_COLUMNS, table)

    def write_assignments(self, rows: Iterable[Mapping[str, Any]]) -> None:
        """Replace the table of head shares."""
        storage.write_csv(self.path / "assignments.csv", ASSIGNMENT_COLUMNS, rows)

    def write_prediction_errors(self, rows: Iterable[Mapping[str, Any]]) -> None:
        """Replace the table of prediction errors."""
        storage.write_csv(self.path / "prediction_error.csv", PREDICTION_COLUMNS, rows)

    def write_metrics(self, rows: Iterable[Mapping[str, Any]]) -> None:
        """Replace the metrics; what they hold counts as finished."""
        storage.write_json_lines(self.path / "metrics.jsonl", rows)

    def checkpoint(self, iteration: int) -> Path:
        """The file with the networks, optimiser and statistics after an iteration."""
        return self.path / "checkpoints" / f"iteration-{iteration:03d}.safetensors"

    def save_data(self, iteration: int, trajectories: list[Trajectory]) -> None:
        """Keep what an iteration collected."""
        storage.save_trajectories(self._data(iteration), trajectories)

    def iteration_data(self, iteration: int) -> list[Trajectory]:
        """The trajectories that an iteration collected, memory-mapped."""
        return storage.load_trajectories(self._data(iteration))

    def load_data(self) -> list[Trajectory]:
        """All trajectories of the finished iterations, memory-mapped."""
        return [t for i in range(self.finished_iterations) for t in self.iteration_data(i)]

    def _data(self, iteration: int) -> Path:
        return self.path / "data" / f"iteration-{iteration:03d}"

    def _table(self, name: str, columns: tuple[str, ...]) -> list[dict[str, Any]]:
        """Read a table whose columns are numbers, but for `group` and `sim_params`."""
        texts = ("group", "sim_params")
        wholes = ("iteration", "member", "head", "step")
        rows = storage.read_csv(self.path / name, columns)
        try:
            typed = [
                {
                    column: value
                    if column in texts
                    else (int if column in wholes else float)(value)
                    for column, value in row.items()
                }
                for row in rows
            ]
        except ValueError as error:
            raise RunError(f"{self.path / name} is damaged ({error}); delete it.") from None
        finished = self.finished_iterations
        return [row for row in typed if int(row["iteration"]) < finished]


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
        raise ValueError(f"{text!r} is not of the form name=value")
    return {name: float(value) for name, value in pairs}


def _config_file(config: Config) -> dict[str, Any]:
    return {
        "schema": SCHEMA,
        "config": settings.to_dict(config),
        "versions": {
            "python": platform.python_version(),
            **{name: importlib.metadata.version(name) for name in VERSIONED},
        },
        "device": str(jax.devices()[0].device_kind),
    }
