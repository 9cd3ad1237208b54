"""The run directory, and what makes an iteration count.

    config.json                             settings, own environment, versions, device, commit
    metrics.jsonl                           one line per iteration
    evaluation.csv                          one row per test episode
    assignments.csv                         share of segments that each head owns, by physics
    prediction_error.csv                    error by imagined step
    data/iteration-000.safetensors          episodes that an iteration collected
    tests/iteration-000.safetensors         its test episodes; of the newest, and of the best
    checkpoints/iteration-000.safetensors   weights, optimiser, normalisers; likewise
    checksums/iteration-000.json            of all files it stands on; written last, makes it count
    partial/                                what is done of the unfinished iteration
    figures/                                made after training

Files are written beside and renamed. Tables only grow, and a checksum is of the rows that were
there, so whatever an interrupted iteration left behind is written again.
"""

import contextlib
import csv
import dataclasses
import errno
import hashlib
import importlib.metadata
import io
import json
import platform
import re
import shutil
import subprocess
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import filelock
import jax
import numpy as np

from headway.config import Config, differences, from_dict, override, to_dict, tolerating_as
from headway.data import Trajectory
from headway.errors import BusyError, RunError, shown
from headway.training.files import (
    UNFINISHED,
    Arrays,
    Tree,
    arrays_bytes,
    load_arrays,
    make_dir,
    reading,
    remove,
    tree_arrays,
    tree_from_arrays,
    write_bytes,
    write_json,
    writing,
)
from headway.training.identity import changes, identity

Iteration = int | Literal["best"] | None
"""An iteration, from 0; the one whose model collected the highest mean return; or the newest."""

SCHEMA = 4  # of a run directory
KEPT = 2  # newest iterations whose checkpoints and tests stay, unless settings say more
LOCK = ".lock"
VERSIONED = ("headway", "jax", "jaxlib", "equinox", "optax", "numpy", "gymnasium", "mujoco")
TABLES = {
    "evaluation.csv": (
        "method", "env", "seed", "iteration", "group", "sim_params", "episode", "return", "length",
    ),
    "assignments.csv": ("iteration", "member", "head", "sim_params", "share"),
    "prediction_error.csv": ("iteration", "group", "step", "error"),
}  # fmt: skip
_TYPES: dict[str, Callable[[str], Any]] = {
    **dict.fromkeys(("seed", "iteration", "episode", "length", "member", "head", "step"), int),
    **dict.fromkeys(("return", "share", "error"), float),
}
_FILE = re.compile(r"[a-z_]+\.(json|jsonl|csv)|(data|tests|checkpoints)/iteration-\d+\.safetensors")
_ARRAYS = ("obs", "action", "reward")  # of a trajectory
_PLAIN = re.compile(r'[^\s"=][^\s=]*')  # names that stand in a table as they are
_PAIR = re.compile(rf'("(?:\\.|[^"\\])*"|{_PLAIN.pattern})=(\S+)(?:\s+|$)')


@dataclasses.dataclass(frozen=True)
class EpisodeRow:
    """One test episode; a row of `evaluation.csv`."""

    method: str
    """Name of the method."""
    env: str
    """Short name of the environment."""
    seed: int
    """The run's seed."""
    iteration: int
    """The iteration after which it was tested, from 0."""
    group: str
    """`"train"` or the name of an unseen group."""
    sim_params: Mapping[str, float]
    """The physics of the episode."""
    episode: int
    """Number of the episode in its group, from 0."""
    episode_return: float
    """Undiscounted sum of rewards; `return` in the table."""
    length: int
    """Steps of the episode."""

    def to_csv(self) -> dict[str, Any]:
        """The row as it is written."""
        cells = dict(zip(TABLES["evaluation.csv"], vars(self).values(), strict=True))
        return cells | {"sim_params": format_sim_params(self.sim_params)}


def format_sim_params(sim_params: Mapping[str, float]) -> str:
    """Simulator parameters as one cell of a table, for example `length=0.5 "mass [kg]"=1`."""
    return " ".join(
        f"{name if _PLAIN.fullmatch(name) else json.dumps(name)}={value:.12g}"
        for name, value in sorted(sim_params.items())
    )


def parse_sim_params(text: str) -> dict[str, float]:
    """Read what `format_sim_params` wrote.

    Raises:
        ValueError: The text is not of that form.
    """
    if _PAIR.sub("", text.strip()):
        raise ValueError(f"{text!r} is not of the form name=value")
    found = _PAIR.findall(text)
    return {json.loads(n) if n[0] == '"' else n: float(value) for n, value in found}


class RunDir:
    """Reads and writes one run directory.

    Args:
        path: The directory; nothing is created before `locked`.
    """

    def __init__(self, path: str | Path):
        self.path = Path(path)
        self._num_checkpoints = KEPT

    @contextlib.contextmanager
    def locked(self) -> Iterator[None]:
        """Keep every other process from writing here; the directory is made if need be.

        The lock ends with the process, however that ends.

        Raises:
            BusyError: Another process trains this run.
            RunError: There is something else here, or the directory cannot be written.
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
        lock = filelock.FileLock(self.path / LOCK)
        with writing(self.path):
            make_dir(self.path)
            try:
                lock.acquire(timeout=0)
            except filelock.Timeout:
                raise BusyError(
                    f"{self.path} is being trained by another process, allowed: one at a time;"
                    " wait for it or choose another --run-dir."
                ) from None
            except NotImplementedError as error:  # in place of OSError in some versions
                raise OSError(errno.ENOSYS, f"{error}") from None
        try:
            yield
        finally:
            lock.release()

    def begin(self, config: Config) -> None:
        """Begin a run here, or make sure that the run here is the same; call it when `locked`.

        What does not change its numbers may differ (`config.TOLERANCE`), and it may become longer.

        Raises:
            RunError: The directory holds a run with other settings, or a damaged one; the
                message says how to go back.
        """
        if self._is_new():
            versions = {name: importlib.metadata.version(name) for name in VERSIONED}
            values = {
                "schema": SCHEMA,
                "config": to_dict(config),
                "environment": identity(config),
                "versions": {"python": platform.python_version(), **versions},
                "device": str(jax.devices()[0].device_kind),
                "commit": _commit(),
            }
            write_json(self.path / "config.json", values)
        if found := self.changes(config):
            raise RunError(
                f"{self.path} holds a run with other settings ({'; '.join(found)}); choose another"
                " --run-dir, or the same settings to resume, perhaps with more iterations."
            )
        if config.collection.num_iterations > self.config().collection.num_iterations:
            self._lengthen(config.collection.num_iterations)
        self.check()
        settings = self.config(), config  # what the run was begun to keep is not deleted later
        self._num_checkpoints = max(each.collection.num_checkpoints for each in settings)
        self._tidy()

    def changes(self, config: Config) -> list[str]:
        """Return one line per setting that would make it another run; more iterations do not."""
        begun, wanted = tolerating_as(self.config(), config), config.collection.num_iterations
        if wanted > begun.collection.num_iterations:
            begun = override(begun, {"collection.num_iterations": wanted})
        return differences(begun, config)

    def config(self) -> Config:
        """The settings of the run.

        Raises:
            RunError: There is no run here, its file is damaged, or of another version.
        """
        path = self.path / "config.json"
        if not self.path.is_dir():
            raise RunError(f"{self.path} is not a directory, allowed: a run directory.")
        with reading(path):
            values = json.loads(path.read_bytes())
            if values["schema"] == SCHEMA:
                return from_dict(values["config"])
        raise RunError(
            f"{path} has schema {str(values['schema'])[:20]}, allowed: {SCHEMA}; train the run"
            " again, or use the version of headway that made it."
        )

    def finished_config(self) -> Config:
        """The settings of a run that has all of its iterations.

        Raises:
            RunError: As `config`, or it has not.
        """
        config, finished = self.config(), self.finished_iterations
        planned = config.collection.num_iterations
        if finished < planned:
            raise RunError(
                f"{self.path} has {finished} of {planned} iterations, allowed: a finished run;"
                " finish it first with the command that began it."
            )
        return config

    def environment_changes(self) -> list[str]:
        """One line per difference of an own environment to what it was when the run was begun."""
        with reading(self.path / "config.json"):
            begun = json.loads((self.path / "config.json").read_bytes()).get("environment")
        return changes(begun or {}, self.config())

    def refuse_changed(self) -> None:
        """Make sure that an own environment is what it was when the run was begun, if it was.

        Raises:
            RunError: It is not.
        """
        found = self.environment_changes() if (self.path / "config.json").exists() else []
        if found:
            raise RunError(
                f"{self.path} holds a run of its environment before that changed"
                f" ({'; '.join(found)}); choose another --run-dir, undo the change, or go on with"
                " both in one run by --collection.no-check."
            )

    @property
    def finished_iterations(self) -> int:
        """The number of iterations that count."""
        return max(self._numbers("checksums"), default=-1) + 1

    @property
    def last_iteration(self) -> int:
        """The newest iteration that counts.

        Raises:
            RunError: None does yet, or the run is damaged.
        """
        finished = self.finished_iterations
        if finished == 0:
            self.config()
            self.check()
            raise RunError(
                f"{self.path} has no finished iteration yet, because nothing is in checksums/; go"
                " on training it with the same `headway train` command, or complete the copy."
            )
        return finished - 1

    def kept_iteration(self, wanted: Iteration = None) -> int:
        """The number of an iteration that can be loaded.

        Args:
            wanted: Its number from 0; `"best"`, the one whose model earned the highest mean return
                when it collected, which the newest has not done yet; or None, the newest.

        Raises:
            RunError: It is not kept, or nothing is.
        """
        last, kept = self.last_iteration, self._kept()
        if wanted is None:
            return last
        found = self._best() if wanted == "best" else wanted
        if found not in kept:
            raise RunError(
                f"{self.path} keeps no iteration {shown(wanted)}, allowed:"
                f" {', '.join(map(str, kept))}; collection.num_checkpoints keeps more in training."
            )
        return kept[kept.index(found)]

    def check(self) -> None:
        """Compare all files of the newest iteration with their checksums.

        Raises:
            RunError: A file is damaged or gone; the message says how to go back.
        """
        finished = self.finished_iterations
        self._read()
        newest = max(self._numbers("checkpoints"), default=0)
        if newest > finished:
            raise RunError(
                f"{self.path / 'checksums'} holds {finished} iterations, but the checkpoint of"
                f" iteration {newest} exists; restore checksums/ or delete the run."
            )

    def metrics(self) -> list[dict[str, Any]]:
        """One entry per finished iteration.

        Raises:
            RunError: The file is damaged.
        """
        text = self._table("metrics.jsonl")
        with reading(self.path / "metrics.jsonl"):
            return [json.loads(line) for line in text.splitlines()]

    def evaluation(self) -> list[EpisodeRow]:
        """Every test episode of the finished iterations."""
        rows = self._rows("evaluation.csv", sim_params=parse_sim_params)
        return [EpisodeRow(*row.values()) for row in rows]

    def assignments(self) -> list[dict[str, Any]]:
        """Share of segments that each head owns, per iteration, member and physics."""
        return self._rows("assignments.csv")

    def load_checkpoint(self, template: Tree, iteration: Iteration = None) -> Tree:
        """Read what was learned up to an iteration.

        Args:
            template: A pytree of arrays or shapes with the same structure.
            iteration: As `kept_iteration`.

        Raises:
            RunError: It is not kept, or the checkpoint is damaged or of another model.
        """
        number = self.kept_iteration(iteration)
        name = _name("checkpoints", number)
        self._read(["config.json", name], number)
        return tree_from_arrays(template, load_arrays(self.path / name)[0], self.path / name)

    def load_data(self, until: int | None = None) -> list[Trajectory]:
        """All trajectories that were collected up to an iteration, the newest by default.

        Raises:
            RunError: A file of them is missing or damaged.
        """
        finished = self.finished_iterations if until is None else until + 1
        known = self._checksums(self.finished_iterations - 1)  # fits of recordings collect nothing
        found: list[Trajectory] = []
        for name in [_name("data", i) for i in range(finished) if _name("data", i) in known]:
            found += self._episodes(name)[0]
        return found

    def tests(self) -> dict[str, list[Trajectory]]:
        """The test episodes of the newest iteration by group; empty if there were none.

        Raises:
            RunError: They are damaged; the message says how to go back.
        """
        name, found = _name("tests", self.last_iteration), {}
        if name in self._checksums(self.last_iteration):
            episodes, facts = self._episodes(name)
            for group, episode in zip(facts["groups"], episodes, strict=True):
                found.setdefault(group, []).append(episode)
        return found

    def _episodes(self, name: str) -> tuple[list[Trajectory], dict[str, Any]]:
        self._read([name])
        arrays, facts = load_arrays(self.path / name)
        with reading(self.path / name):
            return trajectories_from(arrays, facts), facts

    def files(self, *, data: bool | None = None) -> dict[str, bytes]:
        """The files of the newest iteration as they were written, by name, for a copy.

        Args:
            data: Also what was collected; a copy without it cannot be trained further. None takes
                it if the newest of it is here.

        Raises:
            RunError: One is damaged or gone, or no file that a run has.
        """
        newest = self.last_iteration
        checksums = _name("checksums", newest)
        names = self._checksums(newest)
        for name in names:
            if not _FILE.fullmatch(name):
                raise RunError(f"{self.path / checksums} names {shown(name)}, no file of a run.")
        collected = {name for name in names if name.startswith("data/")}
        if data is None and collected:
            data = (self.path / max(collected)).exists()
        wanted = [name for name in names if data or name not in collected]
        return {**self._read(wanted), checksums: (self.path / checksums).read_bytes()}

    def save_iteration(
        self,
        metrics: Mapping[str, Any],
        learned: Any,
        collected: Sequence[Trajectory],
        tests: Mapping[str, Sequence[Trajectory]],
        tables: Mapping[str, Sequence[Mapping[str, Any]]],
    ) -> None:
        """Write everything of an iteration; its checksums come last and make it count.

        Args:
            metrics: Its line of `metrics.jsonl`; `iteration` numbers the iteration.
            learned: Pytree of the checkpoint.
            collected: What it collected; nothing where a run only tests.
            tests: Its test episodes by group, perhaps none.
            tables: New rows of the tables in `TABLES`.

        Raises:
            LimitError: The disk is full; nothing counts that is not complete.
            RunError: A file cannot be written.
        """
        iteration = metrics["iteration"]
        files = {_name("checkpoints", iteration): arrays_bytes(tree_arrays(learned))}
        if collected:
            files[_name("data", iteration)] = arrays_bytes(*trajectory_arrays(collected))
        if tests:
            groups = [group for group, episodes in tests.items() for _ in episodes]
            arrays, facts = trajectory_arrays([t for found in tests.values() for t in found])
            files[_name("tests", iteration)] = arrays_bytes(arrays, {**facts, "groups": groups})
        lines = {"metrics.jsonl": json.dumps(metrics, allow_nan=False) + "\n"}
        for name, columns in TABLES.items():
            text = io.StringIO()
            writer = csv.DictWriter(text, columns, lineterminator="\n")
            if iteration == 0:
                writer.writeheader()
            writer.writerows(tables.get(name, ()))
            lines[name] = text.getvalue()
        files |= {name: self._table(name) + new.encode() for name, new in lines.items()}
        known = self._checksums(iteration - 1)
        for name, content in files.items():
            write_bytes(self.path / name, content)
        files["config.json"] = (self.path / "config.json").read_bytes()
        data = {name: digest for name, digest in known.items() if name.startswith("data/")}
        checksums = data | {name: _digest(content) for name, content in files.items()}
        write_json(self.path / _name("checksums", iteration), checksums)
        self._tidy()

    def last_good(self) -> int | None:
        """The newest finished iteration whose files are all as they were written."""
        for iteration in reversed(self._numbers("checksums")):
            with contextlib.suppress(RunError):
                for name, digest in self._checksums(iteration).items():
                    _checked(self.path / name, digest)
                return iteration
        return None

    def go_back(self) -> int | None:
        """Forget the iterations after the last good one; call it when `locked`.

        Returns:
            The last good iteration; None when none was finished yet.

        Raises:
            RunError: No finished iteration is intact.
        """
        good, numbers = self.last_good(), self._numbers("checksums")
        if numbers and good is None:
            raise RunError(
                f"{self.path} has no intact iteration to go back to; restore it from a copy, or"
                " start anew in another directory."
            )
        for folder in ("checksums", "checkpoints"):
            for iteration in reversed(self._numbers(folder)):
                if good is not None and iteration > good:
                    remove(self.path / _name(folder, iteration))
        return good

    def partial(self) -> "Partial":
        """Finished parts of the iteration after the last one that counts."""
        origin = (self.path / "config.json").read_bytes()
        origin += importlib.metadata.version("headway").encode()
        if self.finished_iterations:
            origin += (self.path / _name("checksums", self.last_iteration)).read_bytes()
        return Partial(self.path / "partial", hashlib.sha256(origin).hexdigest())

    def _is_new(self) -> bool:
        found = self.path.iterdir() if self.path.exists() else ()
        return all(path.name.endswith(UNFINISHED) or path.name == LOCK for path in found)

    def _numbers(self, folder: str) -> list[int]:
        """The iterations that have a file in a folder."""
        stems = [path.stem for path in (self.path / folder).glob("iteration-*")]
        return sorted(int(stem[10:]) for stem in stems if stem[10:].isdigit())

    def _lengthen(self, num_iterations: int) -> None:
        """Change `collection.num_iterations`; `begin` does it again if it was interrupted."""
        values = json.loads((self.path / "config.json").read_bytes())
        values["config"]["collection"]["num_iterations"] = num_iterations
        content = json.dumps(values, indent=2).encode()
        for iteration in self._numbers("checksums"):  # first, since `begin` looks at the settings
            checksums = self._checksums(iteration)
            if checksums["config.json"] != _digest(content):
                self._read(["config.json"], iteration)
            checksums["config.json"] = _digest(content)
            write_json(self.path / _name("checksums", iteration), checksums)
        write_bytes(self.path / "config.json", content)

    def _kept(self) -> list[int]:
        return sorted({*self._numbers("checkpoints")} & {*self._numbers("checksums")})

    def _best(self) -> int | None:
        """The kept iteration that earned most; None where none has collected."""
        # An iteration collects with what the one before it has learned.
        collected = {row["iteration"] - 1: row.get("collection") for row in self.metrics()}
        judged = [iteration for iteration in self._kept() if collected.get(iteration)]
        return max(judged, key=lambda i: collected[i]["return_mean"], default=None)

    def _checksums(self, iteration: int) -> dict[str, Any]:
        if iteration < 0:
            return {}
        path = self.path / _name("checksums", iteration)
        with reading(path):
            return dict(json.loads(path.read_bytes()))

    def _read(self, names: Sequence[str] = (), iteration: int | None = None) -> dict[str, bytes]:
        """The parts of files that count for an iteration, as they were written.

        Args:
            names: Of the files; all that there are by default.
            iteration: The newest by default.

        Raises:
            RunError: One is damaged or gone; the message says how to go back.
        """
        try:
            newest = self.finished_iterations - 1
            known = self._checksums(newest if iteration is None else iteration)
            for name in names:
                if name not in known:
                    raise RunError(f"{self.path / name} is not among the run's checksums.")
            return {name: _checked(self.path / name, known[name]) for name in names or known}
        except RunError as error:
            good = self.last_good()
            advice = f"The last good iteration is {good}: the run's `headway train` command with"
            advice += " --resume-from-last-good goes back to it."
            if good is None:
                advice = "No earlier iteration is intact; restore the file, or start anew in"
                advice += " another directory."
            raise RunError(f"{error} {advice}") from None

    def _table(self, name: str) -> bytes:
        return self._read([name])[name] if self.finished_iterations else b""

    def _rows(self, name: str, **types: Callable[[str], Any]) -> list[dict[str, Any]]:
        text, types = self._table(name).decode(), _TYPES | types
        with reading(self.path / name):
            return [
                {column: types.get(column, str)(cell) for column, cell in row.items()}
                for row in csv.DictReader(io.StringIO(text, newline=""))
            ]

    def _tidy(self) -> None:
        """Delete what nobody goes back to, and files that were never complete."""
        last = self.finished_iterations - 1
        kept = {self._best(), *range(last + 1 - self._num_checkpoints, last + 2)}
        for folder in ("checksums", "checkpoints", "tests"):
            for iteration in self._numbers(folder):
                if last >= 0 and iteration not in kept:
                    remove(self.path / _name(folder, iteration))
        for path in list(self.path.rglob(f".*{UNFINISHED}")):
            if path.is_dir():  # of a command that wrote a folder into the run's
                shutil.rmtree(path, ignore_errors=True)
            else:
                remove(path)


class Partial:
    """Parts of the unfinished iteration: finished episodes, and a fit after some epochs.

    A part counts only for the run and the iteration that it was made in, and if every bit of it
    is as it was written; else it is made again.

    Args:
        folder: Where; the folder holds nothing else.
        origin: Names what the iteration goes on from.
    """

    def __init__(self, folder: Path, origin: str):
        self._folder, self._origin = folder, origin

    def path(self, name: str) -> Path:
        """The file of a part."""
        return self._folder / f"{name}.safetensors"

    def save(self, name: str, arrays: Arrays, facts: Mapping[str, Any]) -> None:
        """Write a part, in place of an earlier one of that name.

        Args:
            name: Of the part.
            arrays: By name.
            facts: Values for JSON.
        """
        sealed = {"part": facts, "sha256": self._digest(arrays, facts)}
        write_bytes(self.path(name), arrays_bytes(arrays, sealed))

    def load(self, name: str) -> tuple[Arrays, dict[str, Any]] | None:
        """Arrays and facts of a part; None where there is none that counts."""
        with contextlib.suppress(RunError, KeyError):
            arrays, facts = load_arrays(self.path(name))
            if facts["sha256"] == self._digest(arrays, facts["part"]):
                return arrays, facts["part"]
        return None

    def remove(self, names: str = "*") -> None:
        """Delete parts; all of them, or those whose names match a pattern."""
        for path in self._folder.glob(f"{names}.safetensors"):
            remove(path)
        with contextlib.suppress(OSError):  # other parts stay, and so the folder
            self._folder.rmdir()

    def _digest(self, arrays: Arrays, facts: Mapping[str, Any]) -> str:
        found = hashlib.sha256(f"{self._origin} {json.dumps(facts)}".encode())
        for name, array in sorted(arrays.items()):
            found.update(f"{name} {array.dtype} {array.shape}".encode() + array.tobytes())
        return found.hexdigest()


def trajectory_arrays(trajectories: Sequence[Trajectory]) -> tuple[Arrays, dict[str, Any]]:
    """The arrays of trajectories by number and name, and what else they hold, for JSON."""
    arrays = {
        f"{i}.{name}": np.ascontiguousarray(getattr(trajectory, name))
        for i, trajectory in enumerate(trajectories)
        for name in _ARRAYS
    }
    episodes = [
        {"sim_params": dict(t.sim_params), "terminated": bool(t.terminated)} for t in trajectories
    ]
    return arrays, {"episodes": episodes}


def trajectories_digest(trajectories: Sequence[Trajectory]) -> str:
    """SHA-256 of all that they hold."""
    arrays, facts = trajectory_arrays(trajectories)
    parts = [array.tobytes() for array in arrays.values()]
    return hashlib.sha256(b"".join([json.dumps(facts).encode(), *parts])).hexdigest()


def trajectories_from(arrays: Arrays, facts: Mapping[str, Any]) -> list[Trajectory]:
    """Build what `trajectory_arrays` took apart."""
    return [
        Trajectory(**{name: arrays[f"{i}.{name}"] for name in _ARRAYS}, **episode)
        for i, episode in enumerate(facts["episodes"])
    ]


def _name(folder: str, iteration: int) -> str:
    suffix = "json" if folder == "checksums" else "safetensors"
    return f"{folder}/iteration-{iteration:03d}.{suffix}"


def _checked(path: Path, digest: Mapping[str, Any]) -> bytes:
    """The first bytes of a file, which have the checksum that they should have."""
    with reading(path):
        content = path.read_bytes()[: digest["bytes"]]
        if _digest(content) != digest:
            raise ValueError("its bytes are not the ones that were written")
        return content


def _digest(content: bytes) -> dict[str, Any]:
    return {"bytes": len(content), "sha256": hashlib.sha256(content).hexdigest()}


def _commit() -> str | None:
    """The commit of the checkout that Headway is imported from; None where there is none."""
    root = Path(__file__).parents[3]
    words = ["git", "-C", str(root), "rev-parse", "HEAD"]
    if (root / ".git").exists():
        with contextlib.suppress(OSError, subprocess.CalledProcessError):
            return subprocess.run(words, capture_output=True, text=True, check=True).stdout.strip()
    return None
