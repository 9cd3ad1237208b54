"""The run directory, and what makes an iteration count.

    config.json                             settings, versions, device, commit
    metrics.jsonl                           one line per iteration
    evaluation.csv                          one row per test episode
    assignments.csv                         share of segments that each head owns, by physics
    prediction_error.csv                    error by imagined step
    data/iteration-000.safetensors          episodes that an iteration collected
    tests/iteration-000.safetensors         its test episodes; kept for two iterations
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
import os
import platform
import subprocess
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

import filelock
import jax
import jax.numpy as jnp
import numpy as np
import safetensors.numpy
from safetensors import SafetensorError, safe_open

from headway.config import Config, differences, from_dict, to_dict, tolerating_as
from headway.data import Trajectory
from headway.errors import BusyError, HeadwayError, LimitError, RunError

Tree = TypeVar("Tree")
Arrays = dict[str, np.ndarray]

SCHEMA = 3  # of a run directory
KEPT = 2  # iterations whose checkpoints and tests stay, so that there is one to go back to
LOCK = ".lock"
UNFINISHED = ".writing"  # ends the name of a file that is not complete yet
VERSIONED = ("headway", "jax", "jaxlib", "equinox", "optax", "numpy", "gymnasium", "mujoco")
EVALUATION_COLUMNS = (
    "method", "env", "seed", "iteration", "group", "sim_params", "episode", "return", "length",
)  # fmt: skip
TABLES = {
    "evaluation.csv": EVALUATION_COLUMNS,
    "assignments.csv": ("iteration", "member", "head", "sim_params", "share"),
    "prediction_error.csv": ("iteration", "group", "step", "error"),
}
_TYPES = {
    **dict.fromkeys(("seed", "iteration", "episode", "length", "member", "head", "step"), int),
    **dict.fromkeys(("return", "share", "error"), float),
}
_ARRAYS = ("obs", "action", "reward")  # of a trajectory


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
        physics = format_sim_params(self.sim_params)
        return dict(
            zip(EVALUATION_COLUMNS, (*vars(self).values(),), strict=True), sim_params=physics
        )


def format_sim_params(sim_params: Mapping[str, float]) -> str:
    """Simulator parameters as one cell of a table, for example `length=0.5 mass=1`."""
    return " ".join(f"{name}={value:.12g}" for name, value in sorted(sim_params.items()))


def parse_sim_params(text: str) -> dict[str, float]:
    """Read what `format_sim_params` wrote.

    Raises:
        ValueError: The text is not of that form.
    """
    return {name: float(value) for name, value in (pair.split("=") for pair in text.split())}


class RunDir:
    """Reads and writes one run directory.

    Args:
        path: The directory; nothing is created before `locked`.
    """

    def __init__(self, path: str | Path):
        self.path = Path(path)

    @property
    def figures(self) -> Path:
        """Where figures go."""
        return self.path / "figures"

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
        with _writing(self.path):
            _make_dir(self.path)
            try:
                lock.acquire(timeout=0)
            except filelock.Timeout:
                raise BusyError(
                    f"{self.path} is being trained by another process, allowed: one at a time;"
                    " wait for it or choose another --run-dir."
                ) from None
        try:
            yield
        finally:
            lock.release()

    def begin(self, config: Config) -> None:
        """Begin a run here, or make sure that the run here is the same; call it when `locked`.

        What it tolerates of its environments may differ (`config.TOLERANCE`).

        Raises:
            RunError: The directory holds a run with other settings, or a damaged one; the
                message says how to go back.
        """
        if self._is_new():
            facts = {
                "schema": SCHEMA,
                "config": to_dict(config),
                "versions": {name: importlib.metadata.version(name) for name in VERSIONED}
                | {"python": platform.python_version()},
                "device": str(jax.devices()[0].device_kind),
                "commit": _commit(),
            }
            write_json(self.path / "config.json", facts)
        found = differences(tolerating_as(self.config(), config), config)
        if found:
            raise RunError(
                f"{self.path} holds a run with other settings ({'; '.join(found)}); choose"
                " another --run-dir, or the same settings to resume."
            )
        self.check()
        self._tidy()

    def metadata(self) -> dict[str, Any]:
        """The content of `config.json`: settings, versions, device, commit.

        Raises:
            RunError: There is no run here, its file is damaged, or of another version.
        """
        path = self.path / "config.json"
        if not self.path.is_dir():
            raise RunError(f"{self.path} is not a directory, allowed: a run directory.")
        with _reading(path):
            values = json.loads(path.read_bytes())
            if values["schema"] == SCHEMA:
                return values
        raise RunError(
            f"{path} has schema {str(values['schema'])[:20]}, allowed: {SCHEMA}; train the run"
            " again, or use the version of headway that made it."
        )

    def config(self) -> Config:
        """The settings of the run.

        Raises:
            RunError: As `metadata`.
        """
        values = self.metadata()
        with _reading(self.path / "config.json"):
            return from_dict(values["config"])

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

    def check(self) -> None:
        """Compare all files of the newest iteration with their checksums.

        Raises:
            RunError: A file is damaged or gone; the message says how to go back.
        """
        self._check(self.finished_iterations - 1)
        finished = self.finished_iterations
        beyond = [number for number in self._numbers("checkpoints") if number > finished]
        if beyond:
            raise RunError(
                f"{self.path / 'checksums'} holds {finished} iterations, but the checkpoint of"
                f" iteration {beyond[-1]} exists; restore checksums/ or delete the run."
            )

    def metrics(self) -> list[dict[str, Any]]:
        """One entry per finished iteration.

        Raises:
            RunError: The file is damaged.
        """
        text = self._table("metrics.jsonl")
        with _reading(self.path / "metrics.jsonl"):
            return [json.loads(line) for line in text.splitlines()]

    def evaluation(self) -> list[EpisodeRow]:
        """Every test episode of the finished iterations."""
        rows = self._rows("evaluation.csv")
        with _reading(self.path / "evaluation.csv"):
            return [
                EpisodeRow(*{**row, "sim_params": parse_sim_params(row["sim_params"])}.values())
                for row in rows
            ]

    def assignments(self) -> list[dict[str, Any]]:
        """Share of segments that each head owns, per iteration, member and physics."""
        return self._rows("assignments.csv")

    def prediction_errors(self) -> list[dict[str, Any]]:
        """Error by imagined step, per iteration and group."""
        return self._rows("prediction_error.csv")

    def load_checkpoint(self, template: Tree) -> Tree:
        """Read what was learned up to the newest iteration.

        Args:
            template: A pytree of arrays or shapes with the same structure.

        Raises:
            RunError: No iteration is finished, or the checkpoint is damaged or of another model.
        """
        path = self._file("checkpoints", self.last_iteration)
        if not path.parent.exists():
            raise RunError(
                f"{self.path} is a copy without checkpoints, allowed: a run with them; name the"
                " run itself."
            )
        for name in ("config.json", self._name(path)):
            self._checked(name)
        return tree_from_arrays(template, load_arrays(path)[0], path)

    def iteration_data(self, iteration: int) -> list[Trajectory]:
        """The trajectories that an iteration collected."""
        return load_trajectories(self._file("data", iteration))

    def load_data(self) -> list[Trajectory]:
        """All trajectories that the finished iterations collected."""
        return [t for i in range(self.finished_iterations) for t in self.iteration_data(i)]

    def tests(self) -> dict[str, list[Trajectory]]:
        """The test episodes of the newest iteration by group; empty if there were none.

        Raises:
            RunError: They are damaged; the message says how to go back.
        """
        path = self._file("tests", self.last_iteration)
        if self._name(path) not in self._checksums(self.last_iteration):
            return {}
        self._checked(self._name(path))
        found: dict[str, list[Trajectory]] = {}
        groups = load_arrays(path)[1]["groups"]
        for group, trajectory in zip(groups, load_trajectories(path), strict=True):
            found.setdefault(group, []).append(trajectory)
        return found

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
            RunError: A file cannot be written, or a metric is not finite.
        """
        iteration = metrics["iteration"]
        known = self._checksums(iteration - 1)
        save_arrays(self._file("checkpoints", iteration), tree_arrays(learned))
        written = ["config.json", self._name(self._file("checkpoints", iteration))]
        if collected:
            save_trajectories(self._file("data", iteration), collected)
            written.append(self._name(self._file("data", iteration)))
        if tests:
            groups = [group for group, episodes in tests.items() for _ in episodes]
            episodes = [episode for group in tests.values() for episode in group]
            save_trajectories(self._file("tests", iteration), episodes, groups=groups)
            written.append(self._name(self._file("tests", iteration)))
        try:
            lines = {"metrics.jsonl": json.dumps(metrics, allow_nan=False) + "\n"}
        except ValueError:
            raise RunError(
                f"{self.path / 'metrics.jsonl'} cannot take a number that is not finite; check the"
                " rewards of the environment."
            ) from None
        for name, columns in TABLES.items():
            lines[name] = csv_text(columns, tables.get(name, ()), header=iteration == 0)
        for name, text in lines.items():
            write_bytes(self.path / name, self._table(name) + text.encode())
            written.append(name)
        found = {name: digest for name, digest in known.items() if name.startswith("data/")}
        found |= {name: _digest((self.path / name).read_bytes()) for name in written}
        write_json(self._file("checksums", iteration), found)
        self._tidy()

    def last_good(self) -> int | None:
        """The newest finished iteration whose files are all as they were written."""
        for iteration in reversed(self._numbers("checksums")):
            with contextlib.suppress(RunError):
                self._check(iteration, advice=False)
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
        for iteration in reversed(numbers):
            if good is not None and iteration > good:
                _remove(self._file("checksums", iteration))
        return good

    def partial(self) -> "Partial":
        """What is done of the iteration after the last finished one."""
        origin = (self.path / "config.json").read_bytes()
        origin += importlib.metadata.version("headway").encode()
        if self.finished_iterations:
            origin += self._file("checksums", self.last_iteration).read_bytes()
        return Partial(self.path / "partial", hashlib.sha256(origin).hexdigest())

    def _is_new(self) -> bool:
        found = self.path.iterdir() if self.path.exists() else ()
        return all(path.name.endswith(UNFINISHED) or path.name == LOCK for path in found)

    def _file(self, folder: str, iteration: int) -> Path:
        suffix = "json" if folder == "checksums" else "safetensors"
        return self.path / folder / f"iteration-{iteration:03d}.{suffix}"

    def _name(self, path: Path) -> str:
        return path.relative_to(self.path).as_posix()

    def _numbers(self, folder: str) -> list[int]:
        stems = [path.stem for path in (self.path / folder).glob("iteration-*")]
        return sorted(int(stem[10:]) for stem in stems if stem[10:].isdigit())

    def _checksums(self, iteration: int) -> dict[str, Any]:
        if iteration < 0:
            return {}
        path = self._file("checksums", iteration)
        with _reading(path):
            return dict(json.loads(path.read_bytes()))

    def _check(self, iteration: int, *, advice: bool = True) -> None:
        with self._advice() if advice else contextlib.nullcontext():
            for name, digest in self._checksums(iteration).items():
                _checked(self.path / name, digest)

    def _checked(self, name: str) -> bytes:
        """The part of a file that counts for the newest iteration, as it was written."""
        with self._advice():
            known = self._checksums(self.finished_iterations - 1)
            if name not in known:
                raise RunError(f"{self.path / name} is not among the run's checksums.")
            return _checked(self.path / name, known[name])

    def _table(self, name: str) -> bytes:
        return self._checked(name) if self.finished_iterations else b""

    def _rows(self, name: str) -> list[dict[str, Any]]:
        text = self._table(name).decode()
        with _reading(self.path / name):
            return [
                {column: _TYPES.get(column, str)(cell) for column, cell in row.items()}
                for row in csv.DictReader(io.StringIO(text, newline=""))
            ]

    @contextlib.contextmanager
    def _advice(self) -> Iterator[None]:
        """Add to an error how to go back."""
        try:
            yield
        except RunError as error:
            good = self.last_good()
            advice = (
                "No earlier iteration is intact; restore the file, or start anew in another"
                " directory."
                if good is None
                else f"The last good iteration is {good}: the run's `headway train` command with"
                " --resume-from-last-good goes back to it."
            )
            raise RunError(f"{error} {advice}") from None

    def _tidy(self) -> None:
        """Delete what nobody goes back to, and files that were never complete."""
        last = self.finished_iterations - 1
        for folder in ("checksums", "checkpoints", "tests"):
            for iteration in self._numbers(folder):
                if last >= 0 and iteration not in range(last - KEPT + 1, last + 2):
                    _remove(self._file(folder, iteration))
        for path in self.path.rglob(f".*{UNFINISHED}"):
            _remove(path)


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

    def save(self, name: str, arrays: Arrays, facts: Mapping[str, Any]) -> None:
        """Write a part, in place of an earlier one of that name.

        Args:
            name: Of the part.
            arrays: By name.
            facts: Values for JSON.
        """
        digest = _part_digest(self._origin, arrays, facts)
        save_arrays(self.path(name), arrays, {"part": facts, "sha256": digest})

    def load(self, name: str) -> tuple[Arrays, dict[str, Any]] | None:
        """Arrays and facts of a part; None where there is none that counts."""
        with contextlib.suppress(RunError, KeyError):
            arrays, facts = load_arrays(self.path(name))
            if facts["sha256"] == _part_digest(self._origin, arrays, facts["part"]):
                return arrays, facts["part"]
        return None

    def remove(self, names: str = "*") -> None:
        """Delete parts; all of them, or those whose names match a pattern."""
        for path in self._folder.glob(f"{names}.safetensors"):
            _remove(path)
        with contextlib.suppress(OSError):  # somebody else's file stays, and so the folder
            self._folder.rmdir()

    def path(self, name: str) -> Path:
        """The file of a part."""
        return self._folder / f"{name}.safetensors"


def _part_digest(origin: str, arrays: Arrays, facts: Mapping[str, Any]) -> str:
    found = hashlib.sha256(f"{origin} {json.dumps(facts)}".encode())
    for name, array in sorted(arrays.items()):
        found.update(f"{name} {array.dtype} {array.shape}".encode() + array.tobytes())
    return found.hexdigest()


def tree_arrays(tree: Any) -> Arrays:
    """The arrays of a pytree, named by their place in it; random keys become numbers."""
    return {name: np.asarray(_plain(leaf)) for name, leaf in _named_leaves(tree)}


def tree_from_arrays(template: Tree, arrays: Arrays, path: Path) -> Tree:
    """Build a pytree from what `tree_arrays` gave.

    Args:
        template: A pytree of arrays or shapes with the same structure.
        arrays: By name.
        path: Their file, for messages.

    Raises:
        RunError: An array is missing, too many, or has another shape or type.
    """
    wanted = {name: jax.eval_shape(_plain, leaf) for name, leaf in _named_leaves(template)}
    if set(wanted) != set(arrays):
        raise RunError(f"{path} holds other arrays than the run's model has; it is not its file.")
    for name, leaf in wanted.items():
        got = arrays[name]
        if (got.shape, got.dtype) != (leaf.shape, leaf.dtype):
            raise RunError(
                f"{path}: {name} is {got.dtype}{list(got.shape)}, allowed:"
                f" {leaf.dtype}{list(leaf.shape)}; the file belongs to another model."
            )
    leaves = [
        jax.random.wrap_key_data(jnp.asarray(arrays[name]))
        if jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)
        else jnp.asarray(arrays[name])
        for name, leaf in _named_leaves(template)
    ]
    return jax.tree.unflatten(jax.tree.structure(template), leaves)


def _named_leaves(tree: Any) -> list[tuple[str, Any]]:
    flat, _ = jax.tree_util.tree_flatten_with_path(tree)
    return [(jax.tree_util.keystr(path, simple=True, separator="."), leaf) for path, leaf in flat]


def _plain(leaf: Any) -> Any:
    is_key = jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)
    return jax.random.key_data(leaf) if is_key else leaf


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


def trajectories_from(arrays: Arrays, facts: Mapping[str, Any]) -> list[Trajectory]:
    """Build what `trajectory_arrays` took apart."""
    return [
        Trajectory(**{name: arrays[f"{i}.{name}"] for name in _ARRAYS}, **episode)
        for i, episode in enumerate(facts["episodes"])
    ]


def save_trajectories(path: Path, trajectories: Sequence[Trajectory], **facts: Any) -> None:
    """Write trajectories, and facts for JSON."""
    arrays, more = trajectory_arrays(trajectories)
    save_arrays(path, arrays, {**more, **facts})


def load_trajectories(path: Path) -> list[Trajectory]:
    """Read what `save_trajectories` wrote.

    Raises:
        RunError: The file is missing or damaged.
    """
    arrays, facts = load_arrays(path)
    with _reading(path):
        return trajectories_from(arrays, facts)


def save_arrays(path: Path, arrays: Arrays, facts: Mapping[str, Any] | None = None) -> None:
    """Write named arrays as safetensors, with facts for JSON in the file's header."""
    write_bytes(path, safetensors.numpy.save(arrays, {"facts": json.dumps(facts or {})}))


def load_arrays(path: Path) -> tuple[Arrays, dict[str, Any]]:
    """Read the arrays and the facts that `save_arrays` wrote.

    Raises:
        RunError: The file is missing or damaged.
    """
    with _reading(path), safe_open(path, "numpy") as file:
        arrays = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
        return arrays, json.loads((file.metadata() or {})["facts"])


def csv_text(
    columns: Sequence[str], rows: Iterable[Mapping[str, Any]], *, header: bool = True
) -> str:
    """Rows of a table."""
    text = io.StringIO()
    writer = csv.DictWriter(text, columns, lineterminator="\n")
    if header:
        writer.writeheader()
    writer.writerows(rows)
    return text.getvalue()


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
    temporary = path.with_name(f".{path.name}{UNFINISHED}")
    try:
        with _writing(path):
            _make_dir(path.parent)
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


def _remove(path: Path) -> None:
    with _writing(path):
        path.unlink(missing_ok=True)
        _sync_dir(path.parent)


def _make_dir(path: Path) -> None:
    if not path.is_dir():
        _make_dir(path.parent)
        path.mkdir(exist_ok=True)
        _sync_dir(path.parent)


def _sync_dir(path: Path) -> None:
    """Make renames and deletions survive a loss of power, where a file system can promise it."""
    if os.name == "posix":
        handle = os.open(path, os.O_RDONLY)
        try:
            with contextlib.suppress(OSError):
                os.fsync(handle)
        finally:
            os.close(handle)


@contextlib.contextmanager
def _writing(path: Path) -> Iterator[None]:
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
def _reading(path: Path) -> Iterator[None]:
    """Name a file that is missing, or not as it was written, in one line."""
    try:
        yield
    except FileNotFoundError:
        raise RunError(f"{path} is missing; check the path, or restore the file.") from None
    except OSError as error:
        raise RunError(f"{path} cannot be read: {error.strerror}; check the path.") from None
    except (SafetensorError, HeadwayError, ValueError, KeyError, TypeError) as error:
        reason = " ".join(str(error).split())[:300]
        raise RunError(f"{path} is damaged: {reason}.") from None


def _checked(path: Path, digest: Mapping[str, Any]) -> bytes:
    with _reading(path):
        content = path.read_bytes()[: digest["bytes"]]
        if _digest(content) != digest:
            raise ValueError("its bytes are not the ones that were written")
        return content


def _digest(content: bytes) -> dict[str, Any]:
    return {"bytes": len(content), "sha256": hashlib.sha256(content).hexdigest()}


def _commit() -> str | None:
    """The commit of the checkout that Headway is imported from; None where there is none."""
    root = Path(__file__).parents[3]
    if not (root / ".git").exists():
        return None
    words = ["git", "-C", str(root), "rev-parse", "HEAD"]
    try:
        return subprocess.run(words, capture_output=True, text=True, check=True).stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        return None
