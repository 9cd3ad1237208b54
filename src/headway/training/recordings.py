"""Recordings: trajectories that were logged elsewhere, cut into what a model is fitted to.

A recording is a table by name: `obs` and `action`, and perhaps more (docs/logged-data.md). Rows
with a missing number, and gaps in time, cut it; what nothing can be made of is named in one line.
"""

import dataclasses
import re
import shutil
from collections.abc import Iterable, Iterator, Mapping
from contextlib import closing, contextmanager, suppress
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

from headway.config import Config, override
from headway.data import Trajectory
from headway.errors import ConfigError, HeadwayError, one_line, unknown_name
from headway.task import Task, env_action, episode_length, scaled_action, sim_param_sets, task_of
from headway.training.check import compared, method_findings
from headway.training.collect import Environments
from headway.training.files import UNFINISHED, writing
from headway.training.run import RunDir, trajectories_digest

Data = str | Path | Iterable[Mapping[str, Any]]

HELD_OUT, RECORDING = "held-out", "recording"
PHYSICS = "sim_params."
ALIASES = {
    "obs": "observation observations state states",
    "action": "actions",
    "reward": "rewards",
    "terminated": "terminations termination terminals terminal dones done",
    "truncated": "truncations truncation timeouts timeout",
    "time": "times timestamp timestamps t step steps",
    "episode": "episodes episode_id episode_index trajectory trajectory_id",
}
"""Names of what a recording may hold, and what others call it."""
ROUNDING = 1e-3  # share of an action's range by which a recorded one may be beyond it
JITTER = 0.5  # share of the usual period by which another one may be shorter or longer


@dataclasses.dataclass(frozen=True)
class Log:
    """Recordings, ready to be fitted."""

    config: Config
    """Settings of the run, which know the spaces and where the data came from."""
    fitted: list[Trajectory]
    """Pieces to fit; their `sim_params` have the number of the recording beside the physics."""
    held_out: list[Trajectory]
    """Pieces to measure errors on."""
    recordings: list[dict[str, Any]]
    """By number: file, pieces, transitions, held_out."""
    remarks: list[str]
    """How recordings were cut, and where the Task disagrees with them; one line each."""


def read_log(data: Data, config: Config, held_out: float, names: Mapping[str, str]) -> Log:
    """Read recordings and hold some out; no environment is stepped. Arguments as `headway.fit`.

    Raises:
        ConfigError: A recording cannot be read, or does not fit the environment.
    """
    if not (0 <= held_out < 1 and config.model.learns):
        raise ConfigError(
            f"held_out is {held_out} and the method {config.method}, allowed: a share from 0 to"
            " below 1, and a method that learns."
        )
    for name in names:
        if name not in ALIASES:
            raise unknown_name("name of what a recording holds", name, ALIASES)
    task = _task(config)
    for found in method_findings(task):
        if found.status == "fault":
            raise ConfigError(f"{config.env}, {found.name}: {found.text}")
    cutter = _Cutter(task, config)
    for where, table in _tables(data):
        cutter.cut(_Recording(where, table, names))
    pieces = cutter.trajectories()
    counts = {"gaps in time": cutter.gaps, "rows with missing numbers": cutter.missing}
    cuts = " and ".join(f"{count} {what}" for what, count in counts.items() if count)
    remarks = [f"cut at {cuts}: {len(cutter.files)} recordings, {len(pieces)} pieces."] * bool(cuts)
    for found in compared(task, pieces):
        if found.text and (found.name != "terminated" or any(piece.terminated for piece in pieces)):
            remarks.append(f"{found.name}: {found.text}")
    of_recording = [int(piece.sim_params[RECORDING]) for piece in pieces]
    several = len({*of_recording}) > 1  # else pieces of the only one are held out
    units = of_recording if several else list(range(len(pieces)))
    order = np.random.default_rng(config.seed).permutation(np.unique(units))
    out = order[: min(max(round(held_out * len(order)), held_out > 0), len(order) - 1)].tolist()
    recordings = [
        {"file": where, "pieces": 0, "transitions": 0, "held_out": several and number in out}
        for number, where in enumerate(cutter.files)
    ]
    parts: tuple[list[Trajectory], list[Trajectory]] = [], []
    for number, unit, piece in zip(of_recording, units, pieces, strict=True):
        parts[unit in out].append(piece)
        recordings[number]["pieces"] += 1
        recordings[number]["transitions"] += len(piece)
    log = {
        "data": Path(data).name if isinstance(data, str | Path) else "arrays",
        "rounds": config.collection.num_iterations,
        "sha256": trajectories_digest(parts[0] + parts[1]),
    }
    told = dataclasses.replace(config, spaces=task.spaces, log=log)
    return Log(told, *parts, recordings, remarks)


def _task(config: Config) -> Task:
    """The Task, told the spaces of its environment, or those that it states where none is made."""
    one = {"collection.num_episodes": 1, "collection.env_processes": False}
    try:
        with closing(Environments.make(override(config, one))) as environments:
            return environments.task
    except HeadwayError:
        with suppress(AttributeError):
            return task_of(dataclasses.replace(config, spaces=task_of(config).spaces))
        raise


@contextmanager
def _reading(where: Any) -> Iterator[None]:
    """Turn whatever a reader raises into one line."""
    try:
        yield
    except ImportError as error:
        raise ConfigError(
            f"{where} needs {error.name}, which is missing; pip install 'headway[data]'."
        ) from None
    except Exception as error:  # whatever the file of another program does to its reader
        raise ConfigError(f"{where} cannot be read: {one_line(error, 200)}.") from None


def _tables(data: Data) -> Iterator[tuple[str, Mapping[str, Any]]]:
    """Where each table stands, and its arrays."""
    if not isinstance(data, str | Path):
        yield from ((f"data[{i}]", table) for i, table in enumerate(data))
        return
    path = Path(data)
    if str(data).startswith("minari:") or (path / "data" / "metadata.json").exists():
        yield from _minari(str(data))
        return
    files = [file for file in (path, *sorted(path.rglob("*"))) if file.suffix in READERS]
    if not files:
        raise ConfigError(
            f"{data} holds no recordings, allowed: an .npz or .parquet file, a folder of them, a"
            " Minari data set, minari:ID; check the path."
        )
    for file in files:
        with _reading(file):
            table = READERS[file.suffix](file)
        yield str(file), table


def _npz(file: Path) -> Mapping[str, Any]:
    with np.load(file) as arrays:  # never unpickles
        return dict(arrays)


def _parquet(file: Path) -> Mapping[str, Any]:
    from pyarrow import parquet

    def array(column: Any) -> np.ndarray:
        """A column; what is missing is NaN."""
        if not hasattr(column.type, "value_type"):
            return column.to_numpy()
        rows = column.to_pylist()
        width = max((len(row) for row in rows if row), default=0)
        return np.array([row or [np.nan] * width for row in rows], np.float64)

    table = parquet.read_table(file)
    return {name: array(table[name]) for name in table.column_names}


READERS = {".npz": _npz, ".parquet": _parquet}


def _minari(data: str) -> Iterator[tuple[str, Mapping[str, Any]]]:
    with _reading(data):
        import h5py  # noqa: F401 (Minari looks for it only as it reads)
        import minari

        name = data.removeprefix("minari:")
        local = name == data
        found = minari.MinariDataset(Path(data) / "data") if local else minari.load_dataset(name)
        for episode in found.iterate_episodes():
            physics = episode.infos.get("sim_params", {})
            yield (
                f"{data}, episode {episode.id}",
                {
                    "obs": _flat(episode.observations, found.observation_space),
                    "action": episode.actions,
                    "reward": episode.rewards,
                    "terminated": episode.terminations,
                    "truncated": episode.truncations,
                    **{PHYSICS + name: values for name, values in physics.items()},
                },
            )


def _flat(values: Any, space: Any) -> Any:
    """Observations in one row each, in the order of `FlattenObservation`."""
    if not isinstance(values, Mapping):
        return values
    parts = [np.asarray(_flat(values[name], space[name])) for name in space]
    return np.concatenate([part.reshape(len(part), -1) for part in parts], axis=1)


@dataclasses.dataclass
class _Recording:
    """A table, where it stands, and what its user calls things."""

    where: str
    table: Mapping[str, Any]
    names: Mapping[str, str]

    def numbers(self, name: str) -> np.ndarray | None:
        """The numbers that it holds by one of our names [row, number]; None if there are none."""
        near = [one for one in (name, *ALIASES.get(name, "").split()) if one in self.table][:1]
        parts = near or [one for one in self.table if one.startswith(f"{name}.")]
        if name in self.names:
            parts = self.names[name].split(",")
        absent = [part for part in parts if part not in self.table]
        if absent or (not parts and name in ("obs", "action")):
            raise ConfigError(
                f"{self.where} has no {', '.join(absent) or name}, allowed:"
                f" {', '.join(self.table)}; choose by --names {name}=NAME or {name}=NAME,NAME."
            )
        if not parts:
            return None
        columns = [np.atleast_1d(np.asarray(self.table[part])) for part in parts]
        values = np.concatenate([column.reshape(len(column), -1) for column in columns], axis=1)
        if name == "episode":  # texts are fine
            values = np.unique(values.astype(str), return_inverse=True)[1].reshape(len(values), 1)
        if name == "time" and values.dtype.kind == "M":
            values = (values - values[0]) / np.timedelta64(1, "s")
        if values.dtype.kind not in "fiub":
            what = f"{', '.join(parts)} is of type {values.dtype}"
            raise ConfigError(f"{self.where}: {what}, allowed: numbers.")
        return values.astype(np.float64)

    def column(self, name: str, rows: int, default: float = 0.0) -> np.ndarray:
        """A number for each row, or one for all; of the last row nothing need be said.

        One that says how an episode ended is of the last action.
        """
        values = self.numbers(name)
        values = np.array([default]) if values is None else values[:, 0]
        if len(values) == 1:
            last = name in ("terminated", "truncated")
            return np.where(np.arange(rows) >= last * (rows - 2), values, 0.0)
        if len(values) == rows - 1:
            more = values[-1:] - values[-2:-1] if name == "time" else 0.0
            values = np.append(values, values[-1:] + more)
        if len(values) != rows:
            allowed = f"allowed: 1, {rows - 1} or {rows}"
            raise ConfigError(f"{self.where}: {name} has {len(values)} rows, {allowed}.")
        return values


@dataclasses.dataclass
class _Cutter:
    """Cuts recordings into pieces that have no gap and are no longer than an episode."""

    task: Task
    config: Config
    pieces: list[dict[str, Any]] = dataclasses.field(default_factory=list)
    """Fields of a `Trajectory` each; rewards that are missing are NaN."""
    files: list[str] = dataclasses.field(default_factory=list)
    """Of each recording."""
    gaps: int = 0
    missing: int = 0
    """Rows that lack a number."""

    def trajectories(self) -> list[Trajectory]:
        """All pieces; rewards that are missing are the Task's."""
        if not self.pieces:
            raise ConfigError(
                f"{len(self.files)} recordings with {self.missing} rows that lack a number and"
                f" {self.gaps} gaps in time have no transition, allowed: complete rows in a row."
            )
        rows = [(one["obs"][:-1], one["action"], one["obs"][1:]) for one in self.pieces]
        obs, action, after = (jnp.concatenate(column) for column in zip(*rows, strict=True))
        own = self.task.reward(obs, self.task.scale_action(action), after)
        ends = np.cumsum([len(one["action"]) for one in self.pieces])[:-1]
        for piece, due in zip(self.pieces, np.split(np.asarray(own), ends), strict=True):
            piece["reward"] = np.where(np.isnan(piece["reward"]), due, piece["reward"])
        return [Trajectory(**piece) for piece in self.pieces]

    def cut(self, recording: _Recording) -> None:
        """Cut a table, which may hold several recordings one after the other."""
        obs, action = self.rows(recording)
        rows = len(obs)
        last_known = len(action) == rows - 1  # else a row that ends says not what followed
        action = action[: rows - 1]
        physics = self.physics(recording, rows)
        other = np.zeros(rows - 1, bool)
        for values in (recording.column("episode", rows), *physics.values()):
            other |= np.diff(np.nan_to_num(values)) != 0
        gap = np.zeros(rows - 1, bool)
        if recording.numbers("time") is not None:
            period = np.diff(recording.column("time", rows))
            other |= period <= 0
            usual = np.median(period[period > 0]) if (period > 0).any() else np.nan
            gap = ~other & ~(np.abs(period / usual - 1) <= JITTER)
        terminated, truncated = (
            np.nan_to_num(recording.column(name, rows))[:-1].astype(bool)
            for name in ("terminated", "truncated")
        )
        ends = terminated | truncated
        known, taken = (np.all(np.isfinite(values), axis=1) for values in (obs, action))
        self.gaps += int(gap.sum())
        self.missing += int((~known).sum() + (~taken).sum())
        valid = known[:-1] & known[1:] & taken & ~other & ~gap & (last_known | ~ends)
        number = len(self.files) + np.cumsum(np.append(0, other | ends))
        reward = recording.column("reward", rows, np.nan)
        action = self.scaled(recording, action, valid)
        cuts = np.flatnonzero(~valid[1:] | ~valid[:-1] | ends[:-1]) + 1
        longest = episode_length(self.config)
        for run in np.split(np.arange(rows - 1), cuts):
            for part in (
                np.split(run, range(longest, len(run), longest)) if valid[run].all() else ()
            ):
                told = {name: float(values[part[0]]) for name, values in physics.items()}
                self.pieces.append(
                    {
                        "obs": obs[part[0] : part[-1] + 2],
                        "action": action[part],
                        "reward": reward[part],
                        "sim_params": {**told, RECORDING: float(number[part[0]])},
                        "terminated": bool(terminated[part[-1]]),
                    }
                )
        found = 1 + number[-2] - len(self.files)
        several = [f"{recording.where}, {i}" for i in range(found)]
        self.files += several if found > 1 else [recording.where]

    def rows(self, recording: _Recording) -> tuple[np.ndarray, np.ndarray]:
        """Observations and actions by row, of the right sizes."""
        read = {}
        spaces = self.task.spaces
        for name, size in (("obs", spaces.obs_size), ("action", len(spaces.action_low))):
            read[name] = np.asarray(recording.numbers(name))
            if read[name].shape[1] != size:
                raise ConfigError(
                    f"{recording.where}: a row of {name} has {read[name].shape[1]} numbers,"
                    f" allowed: {size}, as {self.config.env} has; choose by --names {name}=NAME,..."
                )
        obs, action = read.values()
        if len(obs) < 2 or len(obs) - len(action) not in (0, 1):
            raise ConfigError(
                f"{recording.where} has {len(obs)} obs and {len(action)} actions, allowed: as many"
                " of both, or one obs more; at least 2 obs."
            )
        with np.errstate(over="ignore"):  # what becomes infinite is missing
            return obs.astype(np.float32), action

    def physics(self, recording: _Recording, rows: int) -> dict[str, np.ndarray]:
        """The physics that a recording names, by row."""
        named = [name for name in recording.table if name.startswith(PHYSICS)]
        known = sim_param_sets(self.config).names
        for name in named:
            if name.removeprefix(PHYSICS) not in known:
                what = f"simulator parameter in {recording.where},"
                raise unknown_name(what, name, [PHYSICS + one for one in known])
        columns = {name.removeprefix(PHYSICS): recording.column(name, rows) for name in named}
        return {name: values for name, values in columns.items() if np.isfinite(values).all()}

    def scaled(self, recording: _Recording, action: np.ndarray, valid: np.ndarray) -> np.ndarray:
        """Actions in [-1, 1]; those that the environment cannot take are refused."""
        spaces = self.task.spaces
        low, high = np.array(spaces.action_low), np.array(spaces.action_high)
        within = np.clip(action, low, high)
        if spaces.action_kind != "box":
            within = np.rint(within)
        off = valid[:, None] & (np.abs(action - within) > ROUNDING * (high - low))
        for row, entry in np.argwhere(off)[:1]:
            raise ConfigError(
                f"{recording.where}: action[{entry}] is {action[row, entry]:g} in row {row},"
                f" allowed: {low[entry]:g} to {high[entry]:g}, as {self.config.env} takes it; mend"
                " the recording, or the bounds."
            )
        return scaled_action(self.task, within)


def export_data(run_dir: str | Path, out: str | Path) -> int:
    """Write the trajectories that a run collected as a Minari data set.

    Args:
        run_dir: The run directory.
        out: The folder to make. Its name is that of the data set and ends with its version, for
            example `pendulum-v0`.

    Returns:
        The number of episodes.

    Raises:
        RunError: There is no run, or the folder cannot be written.
        ConfigError: Minari is missing, the run has no data, or `out` has no version or exists.
    """
    with _reading("export-data"):
        import h5py  # noqa: F401 (Minari asks for it as it writes)
        import minari
        from minari.data_collector import EpisodeBuffer
        from minari.dataset.minari_storage import MinariStorage
    run, out = RunDir(run_dir), Path(out).absolute()  # Minari misreads relative paths
    config, episodes = run.config(), run.load_data()
    if not episodes or out.exists() or not re.fullmatch(r"[-\w]+-v\d+", out.name):
        raise ConfigError(
            f"{run_dir} has {len(episodes)} episodes and is exported to {out}, allowed: some, and a"
            " folder that is not there yet, with a version at its end, as pendulum-v0."
        )
    one = override(config, {"collection.num_episodes": 1, "collection.env_processes": False})
    with closing(Environments.make(one)) as environments:
        task, vector = environments.task, environments.vector
    buffers = []
    for episode in episodes:
        last = np.arange(len(episode)) == len(episode) - 1
        physics = {name: value for name, value in episode.sim_params.items() if name != RECORDING}
        told = {name: np.full(len(episode) + 1, value) for name, value in physics.items()}
        fields: dict[str, Any] = {
            "observations": episode.obs,
            "actions": env_action(task, episode.action),
            "rewards": episode.reward,
            "terminations": last & episode.terminated,
            "truncations": last & (not episode.terminated),
            "infos": {"sim_params": told} if told else {},
        }
        buffers.append(EpisodeBuffer(**fields))
    made = out.with_name(f".{out.name}{UNFINISHED}")
    shutil.rmtree(made, ignore_errors=True)
    with writing(out):
        made.mkdir(parents=True)
        spaces = vector.single_observation_space, vector.single_action_space
        storage = MinariStorage.new(made / "data", *spaces)
        text = f"Collected by headway: {config.method} on {config.env}, seed {config.seed}."
        facts = {"dataset_id": out.name, "minari_version": minari.__version__, "description": text}
        storage.update_metadata(facts | {"algorithm_name": config.method})
        storage.update_episodes(buffers)
        made.rename(out)
    return len(episodes)
