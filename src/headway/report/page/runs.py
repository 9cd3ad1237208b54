"""Reading the runs that a report is made of; whatever is damaged costs one line, not the report."""

import dataclasses
import json
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any, TypeVar

from headway.config import TOLERANCE, Config, flatten, to_dict
from headway.errors import HeadwayError, RunError
from headway.training.methods import make_config
from headway.training.run import EpisodeRow, RunDir

PHYSICS_FILE = "sim_params.json"

Row = dict[str, Any]
Content = TypeVar("Content")


@dataclasses.dataclass(frozen=True)
class LoadedRun:
    """What a run directory holds, as far as it can be read."""

    path: Path
    config: Config
    device: str
    """Kind of device it was trained on."""
    metrics: list[Row]
    """One entry per finished iteration."""
    tests: list[EpisodeRow]
    """Test episodes after the last iteration; none before the run is finished."""
    head_shares: list[Row]
    """Rows of `assignments.csv` after the newest iteration."""
    prediction_errors: list[Row]
    """Rows of `prediction_error.csv` after the newest tested iteration."""

    @property
    def is_finished(self) -> bool:
        """Whether every iteration is there."""
        return len(self.metrics) >= self.config.collection.num_iterations


@dataclasses.dataclass(frozen=True)
class Note:
    """Something about a run that a reader must know, in one line."""

    run: Path
    text: str


def load_runs(paths: Iterable[str | Path]) -> tuple[list[LoadedRun], list[Note]]:
    """Read runs.

    Args:
        paths: Run directories, or folders that hold some at any depth.

    Returns:
        The runs in the order of environment, method and seed, and what is to be said of them.

    Raises:
        RunError: A path is no directory, or nothing there is a run that can be read.
    """
    runs, notes = [], []
    found = list(dict.fromkeys(run for path in paths for run in find_runs(Path(path))))
    for path in found:
        run = _load_run(path, notes)
        if run is not None:
            runs.append(run)
    if not runs:
        reason = f": {notes[0].text}" if notes else "."
        raise RunError(f"none of {len(found)} runs can be read{reason}")
    # Of two copies the one that got further stands first, and is kept.
    runs.sort(
        key=lambda run: (
            run.config.env, run.config.method, run.config.seed, -len(run.metrics), str(run.path)
        )
    )  # fmt: skip
    return _without_copies(runs, notes), notes


def find_runs(path: Path) -> list[Path]:
    """The run directories at or below a path.

    Raises:
        RunError: There is no such directory, or no run in it.
    """
    if not path.is_dir():
        raise RunError(f"{path} is not a directory, allowed: run directories or folders of them.")
    if (path / "config.json").exists():
        return [path]
    found = sorted(file.parent for file in path.rglob("config.json"))
    if not found:
        raise RunError(f"{path} holds no run, allowed: run directories or folders of them.")
    return found


def _load_run(path: Path, notes: list[Note]) -> LoadedRun | None:
    """Read one run section by section; without its settings nothing can be said of it."""

    def attempt(read: Callable[[], Content], instead: Content, lost: str) -> Content:
        try:
            return read()
        except (HeadwayError, OSError) as error:
            notes.append(Note(path, f"{lost}: {error}"))
            return instead

    run = RunDir(path)
    config = attempt(run.config, None, "left out")
    if config is None:
        return None
    facts = run.metadata()
    metrics = attempt(run.metrics, [], "no learning curve, run time or final result")
    wanted = config.collection.num_iterations
    if len(metrics) < wanted:
        notes.append(
            Note(
                path,
                f"{len(metrics)} of {wanted} iterations are finished: it is in the learning"
                " curves, not in the final results.",
            )
        )
    tests = attempt(run.evaluation, [], "no final result")
    tests = [row for row in tests if len(metrics) == wanted and row.iteration == wanted - 1]
    if len(metrics) == wanted and not tests:
        notes.append(Note(path, "no test episodes after the last iteration: no final result."))
    shares = attempt(run.assignments, [], "no head shares")
    errors = attempt(run.prediction_errors, [], "no prediction errors")
    return LoadedRun(
        path, config, str(facts.get("device", "?")), metrics, tests, _newest(shares),
        _newest(errors),
    )  # fmt: skip


def _newest(rows: list[Row]) -> list[Row]:
    last = max((row["iteration"] for row in rows), default=None)
    return [row for row in rows if row["iteration"] == last]


def _without_copies(runs: Sequence[LoadedRun], notes: list[Note]) -> list[LoadedRun]:
    """Leave out runs of the same settings and seed: they would count one seed twice.

    What is tolerated of an environment (`config.TOLERANCE`) makes no other run.
    """
    kept: dict[str, LoadedRun] = {}
    for run in runs:
        relevant = flatten(to_dict(run.config))
        used = {n: value for n, value in relevant.items() if n not in TOLERANCE}
        same = kept.setdefault(json.dumps(used, sort_keys=True), run)
        if same is not run:
            notes.append(Note(run.path, f"left out: same settings and seed as {same.path}."))
    return list(kept.values())


def train_command(run: LoadedRun) -> list[str]:
    """The words of the command that makes a run, or resumes it; settings that differ are named.

    Physics of its own are in a file (`physics_file`).
    """
    config = run.config
    words = ["headway", "train", config.env, "--method", config.method, "--preset", config.preset]
    words += ["--seed", str(config.seed), "--run-dir", str(run.path)]
    default = _default(config)
    if default is None:
        return words
    usual = flatten(to_dict(default))
    for name, value in flatten(to_dict(config)).items():
        if value == usual.get(name) or name.startswith(("sim_params", "env_options")):
            continue
        words += _option(name, value)
    changed = {n: v for n, v in config.env_options.items() if v != default.env_options.get(n)}
    if changed:
        words += ["--env-options", *(f"{n}={'on' if v else 'off'}" for n, v in changed.items())]
    if config.sim_params != default.sim_params:
        words += ["--sim-params", PHYSICS_FILE]
    return words


def physics_file(run: LoadedRun) -> str | None:
    """What the file of physics holds that `train_command` names; None if it names none."""
    default, own = _default(run.config), run.config.sim_params
    return json.dumps(own.to_dict()) if own and default and own != default.sim_params else None


def _default(config: Config) -> Config | None:
    """What a method and a preset make of an environment; None where one is not registered here."""
    names = {"method": config.method, "preset": config.preset, "seed": config.seed}
    try:
        return make_config(config.env, **names)
    except HeadwayError:
        return None


def _option(name: str, value: Any) -> list[str]:
    option = f"--{name.replace('_', '-')}"
    if isinstance(value, bool):
        section, _, field = option.rpartition(".")
        return [option] if value else [f"{section}.no-{field}"]
    if isinstance(value, list):
        return [option, *map(str, value)]
    return [option, str(value)]
