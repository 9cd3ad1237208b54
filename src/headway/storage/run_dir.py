"""The run directory: configuration, metrics, tables, checkpoints, data, figures.

An iteration is finished once its manifest stands in `manifests/`, which is written last and
holds the checksum of every file the iteration stands on. Tables only grow; a manifest knows how
much of them counts. Whatever an interrupted iteration left behind is written again.
"""

import contextlib
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from headway import settings
from headway.config import Config
from headway.data import Trajectory
from headway.errors import ConfigError, RunError
from headway.storage import config_file, files, records
from headway.storage.config_file import SCHEMA, UNCHECKED
from headway.storage.interrupts import StopRequest
from headway.storage.iterations import (
    Iterations,
    checkpoint_name,
    manifest_name,
    number,
    tests_name,
)
from headway.storage.manifest import Digest, Manifest, inside
from headway.storage.progress_store import ProgressStore
from headway.storage.run_lock import LOCK, locked
from headway.storage.tables import (
    ASSIGNMENT_COLUMNS,
    EVALUATION_COLUMNS,
    PREDICTION_COLUMNS,
    EpisodeRow,
    check_metrics,
    parse_rows,
    typed_row,
)

PARTIAL = "partial"
FOLDERS = ("checkpoints", "data", "tests", "manifests", PARTIAL, "figures", "tensorboard")


class RunDir:
    """Reads and writes one run directory.

    Args:
        path: The directory; nothing is created before `create_or_resume`.
    """

    def __init__(self, path: str | Path):
        self.path = Path(path)
        self._iterations = Iterations(self.path)

    @property
    def figures(self) -> Path:
        """Where figures go."""
        return inside(self.path, "figures")

    def partial(self, stop: StopRequest) -> ProgressStore:
        """The finished parts of the iteration after the last finished one."""
        numbers = self._iterations.numbers
        next_iteration = numbers[-1] + 1 if numbers else 0
        names = ["config.json", *map(manifest_name, numbers[-1:])]
        origin = " ".join(Digest.of(inside(self.path, name)).sha256 for name in names)
        return ProgressStore(inside(self.path, PARTIAL), next_iteration, origin, stop)

    def locked(self) -> contextlib.AbstractContextManager[None]:
        """Keep every other process from writing here; the directory is made if need be.

        Raises:
            RunError: Another process trains this run, or there is something else here.
        """
        if self.path.exists() and not self.path.is_dir():
            raise RunError(
                f"{self.path} is a file, allowed: a directory; choose another --run-dir."
            )
        if not (self._is_new() or (self.path / "config.json").exists()):
            raise RunError(
                f"{self.path} is not empty and holds no run, allowed: a new directory or one"
                " made by `headway train`; choose another --run-dir."
            )
        files.make_dir(self.path)
        return locked(self.path)

    def create_or_resume(self, config: Config) -> None:
        """Begin a run here, or make sure that the run here is the same; call it when `locked`.

        What it tolerates of its environments may differ (`settings.TOLERANCE`).

        Raises:
            RunError: The directory holds something else, or a run with other settings.
        """
        if self._is_new():
            files.write_bytes(self.path / "config.json", config_file.content(config))
            return
        begun_with = settings.tolerating_as(self.config(), config)
        found = settings.differences(begun_with, config)
        if found:
            raise RunError(
                f"{self.path} holds a run with other settings ({'; '.join(found)}); choose"
                " another --run-dir, or the same settings to resume."
            )
        if self._schema == UNCHECKED:
            self._migrate()

    def config(self) -> Config:
        """The settings of the run here.

        Raises:
            RunError: There is no run here, or its configuration is damaged.
        """
        values = self._config_values()
        try:
            return settings.from_dict(values["config"])
        except (ConfigError, KeyError) as error:
            raise files.damaged(self.path / "config.json", error) from None

    @property
    def finished_iterations(self) -> int:
        """Iterations that are complete; but for schema 1, no table is read for that."""
        manifest = self.manifest()
        return len(self.metrics()) if manifest is None else manifest.iteration + 1

    def check(self) -> None:
        """Read everything once, so that damage is found before work is done.

        Raises:
            RunError: A file is damaged or gone; the message says how to go back.
        """
        manifest = self.manifest()
        if manifest is not None:
            with self._iterations.advice():
                manifest.check(self.path)
        self._evaluation(manifest)
        self._table("assignments.csv", ASSIGNMENT_COLUMNS, typed_row, manifest)
        self._table("prediction_error.csv", PREDICTION_COLUMNS, typed_row, manifest)
        finished = len(self._metrics(manifest))
        beyond = [path for path in self._iterations.files("checkpoints") if number(path) > finished]
        if beyond:
            place = "manifests" if self._schema == SCHEMA else "metrics.jsonl"
            raise RunError(
                f"{self.path / place} holds {finished} iterations, but {beyond[-1].name} exists;"
                f" restore {place} or delete the run."
            )

    def metrics(self) -> list[dict[str, Any]]:
        """One entry per finished iteration.

        Raises:
            RunError: The file is damaged.
        """
        return self._metrics(self.manifest())

    def evaluation(self) -> list[EpisodeRow]:
        """Every test episode of the finished iterations."""
        return self._evaluation(self.manifest())

    def assignments(self) -> list[dict[str, Any]]:
        """Share of segments that each head owns, per iteration, member and physics."""
        return self._table("assignments.csv", ASSIGNMENT_COLUMNS, typed_row, self.manifest())

    def prediction_errors(self) -> list[dict[str, Any]]:
        """Error by imagined step, per iteration and group."""
        manifest = self.manifest()
        return self._table("prediction_error.csv", PREDICTION_COLUMNS, typed_row, manifest)

    def append_evaluation(self, rows: Iterable[EpisodeRow]) -> None:
        """Add test episodes behind those of the finished iterations."""
        self._append("evaluation.csv", EVALUATION_COLUMNS, [row.to_csv() for row in rows])

    def append_assignments(self, rows: Iterable[Mapping[str, Any]]) -> None:
        """Add head shares behind those of the finished iterations."""
        self._append("assignments.csv", ASSIGNMENT_COLUMNS, rows)

    def append_prediction_errors(self, rows: Iterable[Mapping[str, Any]]) -> None:
        """Add prediction errors behind those of the finished iterations."""
        self._append("prediction_error.csv", PREDICTION_COLUMNS, rows)

    def append_metrics(self, rows: Iterable[Mapping[str, Any]]) -> None:
        """Add metrics behind those of the finished iterations."""
        path = inside(self.path, "metrics.jsonl")
        lines = records.json_lines(path, rows)
        before = self._text("metrics.jsonl", self.manifest())
        files.write_bytes(path, before + lines.encode())

    def checkpoint(self, iteration: int) -> Path:
        """The file with the networks, optimiser and statistics after an iteration."""
        return inside(self.path, checkpoint_name(iteration))

    def checked_checkpoint(self, iteration: int) -> Path:
        """The same file, which is as it was written.

        Raises:
            RunError: It is not; the message says how to go back.
        """
        manifest = self.manifest()
        if manifest is not None:
            if not inside(self.path, "checkpoints").exists():
                raise RunError(
                    f"{self.path} is a copy without checkpoints, allowed: a run with them; name the"
                    " run itself."
                )
            with self._iterations.advice():
                manifest.check(self.path, ["config.json", checkpoint_name(iteration)])
        return self.checkpoint(iteration)

    def save_data(self, iteration: int, trajectories: list[Trajectory]) -> None:
        """Keep what an iteration collected."""
        records.save_trajectories(self._data(iteration), trajectories)

    def iteration_data(self, iteration: int) -> list[Trajectory]:
        """The trajectories that an iteration collected, memory-mapped."""
        return records.load_trajectories(self._data(iteration))

    def load_data(self) -> list[Trajectory]:
        """All trajectories of the finished iterations, memory-mapped."""
        return [t for i in range(self.finished_iterations) for t in self.iteration_data(i)]

    def save_tests(self, iteration: int, tested: Mapping[str, list[Trajectory]]) -> None:
        """Keep the test episodes of an iteration, until some iterations later."""
        episodes = [trajectory for found in tested.values() for trajectory in found]
        if episodes:
            records.save_trajectories(inside(self.path, tests_name(iteration)), episodes)

    def tests(self) -> dict[str, list[Trajectory]]:
        """The test episodes of the last finished iteration, memory-mapped, by group.

        Empty if there were none, or if the run was trained before they were kept.

        Raises:
            RunError: They are damaged; the message says how to go back.
        """
        manifest, found = self.manifest(), {}
        name = "" if manifest is None else tests_name(manifest.iteration)
        names = [f"{name}.json", f"{name}.safetensors"]
        if manifest is None or not manifest.files.keys() & names:
            return {}
        with self._iterations.advice():
            manifest.check(self.path, names)
        episodes = records.load_trajectories(inside(self.path, name))
        rows = [row for row in self._evaluation(manifest) if row.iteration == manifest.iteration]
        for row, trajectory in zip(rows, episodes, strict=True):
            found.setdefault(row.group, []).append(trajectory)
        return found

    def finish(self, iteration: int) -> None:
        """Make an iteration count, once all its files are written."""
        self._iterations.finish(iteration)
        self.tidy()

    def manifest(self) -> Manifest | None:
        """What the newest finished iteration stands on; None before the first, and in schema 1.

        Raises:
            RunError: It is damaged; the message says how to go back.
        """
        if not self._iterations.numbers or self._schema == UNCHECKED:
            return None
        return self._iterations.newest()

    def last_good(self) -> int | None:
        """The newest finished iteration whose files are all as they were written."""
        return self._iterations.last_good()

    def go_back(self) -> int | None:
        """Forget the iterations after the last good one; call it when `locked`.

        Returns:
            The last good iteration; None when none was finished yet.

        Raises:
            RunError: No finished iteration is intact.
        """
        return self._iterations.go_back()

    def tidy(self) -> None:
        """Delete what is of no use any more: older checkpoints, unfinished files."""
        self._iterations.drop_old()
        for folder in [self.path, *(inside(self.path, name) for name in FOLDERS)]:
            files.remove(list(folder.glob(f".*{files.UNFINISHED}")))

    def _is_new(self) -> bool:
        found = self.path.iterdir() if self.path.exists() else ()
        return all(path.name.endswith(files.UNFINISHED) or path.name == LOCK for path in found)

    def _config_values(self) -> dict[str, Any]:
        if not self.path.is_dir():
            raise RunError(f"{self.path} is not a directory, allowed: a run directory.")
        return config_file.read(inside(self.path, "config.json"))

    @property
    def _schema(self) -> int:
        return self._config_values()["schema"]

    def _migrate(self) -> None:
        """Give a run of schema 1 a manifest, then the present schema."""
        self.check()
        finished = self.finished_iterations
        content = files.seal({**self._config_values(), "schema": SCHEMA})
        if finished:
            # Rows of an unfinished iteration are left behind.
            episodes = [row.to_csv() for row in self.evaluation()]
            self._write_table("evaluation.csv", EVALUATION_COLUMNS, episodes)
            self._write_table("assignments.csv", ASSIGNMENT_COLUMNS, self.assignments())
            self._write_table("prediction_error.csv", PREDICTION_COLUMNS, self.prediction_errors())
            self._iterations.finish_all(finished, content)
        files.write_bytes(self.path / "config.json", content)

    def _metrics(self, manifest: Manifest | None) -> list[dict[str, Any]]:
        path = self.path / "metrics.jsonl"
        lines = records.parse_json_lines(path, self._text("metrics.jsonl", manifest))
        rows = check_metrics(path, lines)
        if manifest is not None and manifest.iteration + 1 != len(rows):
            raise files.damaged(path, f"the manifest ends with iteration {manifest.iteration}")
        return rows

    def _evaluation(self, manifest: Manifest | None) -> list[EpisodeRow]:
        return self._table("evaluation.csv", EVALUATION_COLUMNS, EpisodeRow.from_csv, manifest)

    def _text(self, name: str, manifest: Manifest | None) -> bytes:
        """The part of a table that belongs to finished iterations; all of it in schema 1.

        Args:
            name: The table.
            manifest: What the newest finished iteration stands on. Whoever looks at it twice
                reads it once: while a run is trained, another one may stand there a moment later.
        """
        if manifest is not None:
            with self._iterations.advice():
                return manifest.read_text(self.path, name)
        path = inside(self.path, name)
        return files.read_bytes(path) if self._schema == UNCHECKED and path.exists() else b""

    def _table(
        self, name: str, columns: tuple[str, ...], parse: Any, manifest: Manifest | None
    ) -> list[Any]:
        rows = records.parse_csv(self.path / name, self._text(name, manifest), columns)
        if self._schema == UNCHECKED:
            finished = self.finished_iterations
            rows = (row for row in rows if int(row["iteration"]) < finished)
        return parse_rows(self.path / name, rows, parse)

    def _append(
        self, name: str, columns: tuple[str, ...], rows: Iterable[Mapping[str, Any]]
    ) -> None:
        before = self._text(name, self.manifest())
        lines = records.csv_lines(columns, rows, header=not before)
        files.write_bytes(inside(self.path, name), before + lines.encode())

    def _write_table(
        self, name: str, columns: tuple[str, ...], rows: Iterable[Mapping[str, Any]]
    ) -> None:
        lines = records.csv_lines(columns, rows, header=True)
        files.write_bytes(inside(self.path, name), lines.encode())

    def _data(self, iteration: int) -> Path:
        return inside(self.path, f"data/iteration-{iteration:03d}")
