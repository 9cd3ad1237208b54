"""Recordings: trajectories that were logged elsewhere, cut into what a model is fitted to.

A recording is a table by name: `obs` and `action`, and perhaps more (docs/logged-data.md). Rows
with a missing number, and gaps in time, cut it; what nothing can be made of is named in one line.
"""

import dataclasses
import re
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager, suppress
from pathlib import Path
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from headway.config import Config
from headway.data import Trajectory, sim_params_row
from headway.errors import ConfigError, HeadwayError, check_names, needs, one_line
from headway.task import Task, env_action, episode_length, scaled_action, sim_param_sets, task_of
from headway.training.check import compared, method_findings
from headway.training.environments import Environments
from headway.training.files import new_folder
from headway.training.methods import told_sim_params
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
MINARI = ("minari", "h5py")  # h5py it looks for only as it reads or writes
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
    check_names("name of what a recording holds", names, ALIASES)
    task = _task(config)
    for found in method_findings(task):
        if found.status == "fault":
            raise ConfigError(f"{config.env}, {found.name}: {found.text}")
    tables: list[_Rows] = []
    physics: list[dict[str, float]] = []
    recordings: list[dict[str, Any]] = []
    cuts: Counter[str] = Counter()
    for where, table in _tables(data):
        rows, known = _read(_Table(where, table, names), task, config, cuts)
        tables.append(rows._replace(number=rows.number + len(physics)))
        physics += known
        for i in range(len(known)):
            file = f"{where}, {i}" if len(known) > 1 else where
            recordings.append({"file": file, "pieces": 0, "transitions": 0, "held_out": False})
    cut_at = " and ".join(f"{count} {what}" for what, count in cuts.items() if count)
    if not any(rows.valid.any() for rows in tables):
        raise ConfigError(
            f"{len(recordings)} recordings with {cut_at or 'no row'} have no transition, allowed:"
            " complete rows in a row."
        )
    rows = _Rows(*map(np.concatenate, zip(*tables, strict=True)))
    pieces = _pieces(rows, physics, task, episode_length(config))
    remarks = []
    if cut_at:
        remarks.append(f"cut at {cut_at}: {len(recordings)} recordings, {len(pieces)} pieces.")
    for found in compared(task, pieces):
        if found.text and (found.name != "terminated" or any(piece.terminated for piece in pieces)):
            remarks.append(f"{found.name}: {found.text}")
    units = [int(piece.sim_params[RECORDING]) for piece in pieces]
    alone = len({*units}) == 1  # then pieces of the only recording are held out
    units = range(len(pieces)) if alone else units
    order = np.random.default_rng(config.seed).permutation(np.unique(units))
    out = order[: min(max(round(held_out * len(order)), held_out > 0), len(order) - 1)]
    parts: tuple[list[Trajectory], list[Trajectory]] = [], []
    for unit, piece in zip(units, pieces, strict=True):
        sim_params_row(piece.sim_params, told_sim_params(config))  # none is missing
        parts[unit in out].append(piece)
        recording = recordings[int(piece.sim_params[RECORDING])]
        recording["pieces"] += 1
        recording["transitions"] += len(piece)
        recording["held_out"] = not alone and unit in out
    log = {
        "data": Path(data).name if isinstance(data, str | Path) else "arrays",
        "rounds": config.collection.num_iterations,
        "sha256": trajectories_digest(parts[0] + parts[1]),
    }
    told = dataclasses.replace(config, spaces=task.spaces, log=log)
    return Log(told, *parts, recordings, remarks)


def _task(config: Config) -> Task:
    """The Task, told the spaces of its environment, or those that it states where none is made."""
    try:
        with closing(Environments.make(config, single=True)) as environment:
            return environment.task
    except HeadwayError:
        with suppress(AttributeError):
            return task_of(dataclasses.replace(config, spaces=task_of(config).spaces))
        raise


@contextmanager
def _reading(where: Any) -> Iterator[None]:
    """Turn whatever a reader raises into one line."""
    try:
        yield
    except Exception as error:  # whatever the file of another program does to its reader
        raise ConfigError(f"{where} cannot be read: {one_line(error, 200)}.") from None


def _tables(data: Data) -> Iterator[tuple[str, Mapping[str, Any]]]:
    """Where each table stands, and its arrays."""
    if not isinstance(data, str | Path):
        yield from ((f"data[{i}]", table) for i, table in enumerate(data))
        return
    path = Path(data)
    if str(data).startswith("minari:") or (path / "data" / "metadata.json").exists():
        needs("data", *MINARI)
        with _reading(data):
            yield from _minari(str(data))
        return
    files = [one for one in (path, *sorted(path.rglob("*"))) if one.suffix in (".npz", ".parquet")]
    if not files:
        raise ConfigError(
            f"{data} holds no recordings, allowed: an .npz or .parquet file, a folder of them, a"
            " Minari data set, minari:ID; check the path."
        )
    if any(file.suffix == ".parquet" for file in files):
        needs("data", "pyarrow")
    for file in files:
        with _reading(file):
            # NumPy unpickles nothing unless it is told to.
            table = dict(np.load(file)) if file.suffix == ".npz" else _parquet(file)
        yield str(file), table


def _parquet(file: Path) -> Mapping[str, Any]:
    from pyarrow import parquet

    def array(column: Any) -> np.ndarray:
        """A column; what is missing is NaN."""
        if not hasattr(column.type, "value_field"):  # no list
            return column.to_numpy()
        rows = column.to_pylist()
        width = max((len(row) for row in rows if row), default=0)
        return np.array([row or [np.nan] * width for row in rows], np.float64)

    table = parquet.read_table(file)
    return {name: array(table[name]) for name in table.column_names}


def _minari(data: str) -> Iterator[tuple[str, Mapping[str, Any]]]:
    import minari
    from gymnasium.spaces import flatten
    from gymnasium.vector.utils import batch_space, iterate

    name = data.removeprefix("minari:")
    local = name == data
    found = minari.MinariDataset(Path(data) / "data") if local else minari.load_dataset(name)
    space = found.observation_space
    for episode in found.iterate_episodes():
        rows = iterate(batch_space(space, len(episode.rewards) + 1), episode.observations)
        table = {**vars(episode), "obs": [flatten(space, row) for row in rows]}
        physics = episode.infos.get("sim_params", {})
        table |= {PHYSICS + name: values for name, values in physics.items()}
        yield f"{data}, episode {episode.id}", table


@dataclasses.dataclass
class _Table:
    """Arrays, where they stand, and what their user calls them."""

    where: str
    arrays: Mapping[str, Any]
    names: Mapping[str, str]

    def numbers(self, name: str, size: int = 1) -> np.ndarray:
        """The numbers by one of our names [row, size]; no rows where it holds none."""
        usual = (name, *ALIASES.get(name, "").split())
        parts = [one for one in usual if one in self.arrays][:1]
        if name in self.names:
            parts = self.names[name].split(",")
        absent = [part for part in parts if part not in self.arrays]
        if absent or (not parts and name in ("obs", "action")):
            raise ConfigError(
                f"{self.where} has no {', '.join(absent) or name}, allowed:"
                f" {', '.join(self.arrays)}; choose by --names {name}=NAME or {name}=NAME,NAME."
            )
        if not parts:
            return np.zeros((0, size))
        with _reading(f"{self.where}: {name}"):
            columns = [np.atleast_1d(self.arrays[part]) for part in parts]
            values = np.concatenate([column.reshape(len(column), -1) for column in columns], axis=1)
            if name == "episode":  # texts are fine
                values = np.unique(values.astype(str), return_inverse=True)[1].reshape(-1, 1)
            if values.dtype.kind == "M":
                values = (values - values[0]) / np.timedelta64(1, "s")
            values = values.astype(np.float64)
        if values.shape[1] != size:
            raise ConfigError(
                f"{self.where}: a row of {name} has {values.shape[1]} numbers, allowed: {size};"
                f" choose by --names {name}=NAME or {name}=NAME,NAME."
            )
        return values

    def column(self, name: str, rows: int, default: Any = 0.0, first: int = 0) -> np.ndarray:
        """A number for each row, or one for all from the first; the last row's may be missing."""
        found = self.numbers(name)
        values = found[:, 0] if len(found) else np.atleast_1d(default)
        if len(values) == 1:
            return np.where(np.arange(rows) >= first, values, 0.0)
        if len(values) == rows - 1:
            more = values[-1:] - values[-2:-1] if name == "time" else 0.0
            values = np.append(values, values[-1:] + more)
        if len(values) != rows:
            allowed = f"allowed: 1, {rows - 1} or {rows}"
            raise ConfigError(f"{self.where}: {name} has {len(values)} rows, {allowed}.")
        return values


class _Rows(NamedTuple):
    """Rows of tables, one below the other; the last one of each table begins no transition."""

    obs: np.ndarray
    action: np.ndarray
    """In [-1, 1]."""
    reward: np.ndarray
    """Not finite where it is missing."""
    terminated: np.ndarray
    valid: np.ndarray
    """A transition begins here."""
    number: np.ndarray
    """Of the recording; a table may hold several."""


def _read(
    table: _Table, task: Task, config: Config, cuts: Counter[str]
) -> tuple[_Rows, list[dict[str, float]]]:
    """The rows of a table, and the physics of each recording in it; counts why it is cut."""
    low, high = np.array(task.spaces.action_low), np.array(task.spaces.action_high)
    obs, action = table.numbers("obs", task.spaces.obs_size), table.numbers("action", len(low))
    rows, more = len(obs), len(obs) - len(action)
    if rows < 2 or more not in (0, 1):
        raise ConfigError(
            f"{table.where} has {rows} obs and {len(action)} actions, allowed: as many of both, or"
            " one obs more; at least 2 obs."
        )
    last = len(action) - 1  # one number that says how it ended is of the last action
    with np.errstate(over="ignore"):  # what becomes infinite is missing
        obs = obs.astype(np.float32)
    action = np.append(action[: rows - 1], low[None], axis=0)
    known = [PHYSICS + name for name in sim_param_sets(config).names]
    columns = {name: table.column(name, rows) for name in table.arrays if name.startswith(PHYSICS)}
    check_names(f"simulator parameter in {table.where},", columns, known)
    period = np.diff(table.column("time", rows, np.arange(rows)), append=np.nan)
    other = period <= 0  # the next row is of another recording, as after the last one
    for values in (table.column("episode", rows), *columns.values()):
        other |= np.diff(np.nan_to_num(values), append=np.nan) != 0
    usual = np.median(period[period > 0]) if (period > 0).any() else np.nan
    gap = ~other & ~(np.abs(period / usual - 1) <= JITTER)
    terminated, truncated = (
        np.nan_to_num(table.column(name, rows, first=last)).astype(bool)
        for name in ("terminated", "truncated")
    )
    ends = terminated | truncated
    seen = np.isfinite(obs).all(1)
    lacking = ~(seen & np.isfinite(action).all(1))
    cuts.update({"gaps in time": int(gap.sum()), "rows with missing numbers": int(lacking.sum())})
    valid = ~(lacking | other | gap) & np.roll(seen, -1)
    if not more:  # nothing says what followed an end
        valid &= ~ends
    action = np.where(valid[:, None], action, low)
    taken = env_action(task, scaled_action(task, action)).reshape(action.shape)
    for row, entry in np.argwhere(np.abs(action - taken) > ROUNDING * (high - low))[:1]:
        raise ConfigError(
            f"{table.where}: action[{entry}] is {action[row, entry]:g} in row {row}, allowed:"
            f" {low[entry]:g} to {high[entry]:g}, as {config.env} takes it; mend the recording, or"
            " the bounds."
        )
    number = np.cumsum(np.append(False, (other | ends)[:-1]))
    starts = np.searchsorted(number, np.arange(1 + number[-2]))
    finite = {name: values for name, values in columns.items() if np.isfinite(values).all()}
    physics = [
        {name.removeprefix(PHYSICS): float(values[start]) for name, values in finite.items()}
        for start in starts
    ]
    action = scaled_action(task, taken.astype(np.float64))
    reward = table.column("reward", rows, np.nan)
    return _Rows(obs, action, reward, terminated, valid, number), physics


def _pieces(
    rows: _Rows, physics: Sequence[Mapping[str, float]], task: Task, longest: int
) -> list[Trajectory]:
    """Cut rows into trajectories without a gap; rewards that are missing are the Task's."""
    obs = jnp.asarray(rows.obs)
    reward, unknown = rows.reward[:-1], ~np.isfinite(rows.reward[:-1])
    if unknown.any():
        action = task.scale_action(jnp.asarray(rows.action[:-1]))
        reward = np.where(unknown, task.reward(obs[:-1], action, obs[1:]), reward)
    pieces = []
    cuts = np.flatnonzero(np.diff(rows.valid) | (np.diff(rows.number) != 0)) + 1
    for run in np.split(np.arange(len(obs)), cuts):
        for part in np.split(run, range(longest, len(run), longest)):
            if rows.valid[part[0]]:
                number = int(rows.number[part[0]])
                piece = Trajectory(
                    obs=rows.obs[part[0] : part[-1] + 2],
                    action=rows.action[part],
                    reward=reward[part],
                    sim_params={**physics[number], RECORDING: float(number)},
                    terminated=bool(rows.terminated[part[-1]]),
                )
                pieces.append(piece)
    return pieces


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
    needs("data", *MINARI)
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
    with closing(Environments.make(config, single=True)) as environment:
        task, vector = environment.task, environment.vector
    buffers = []
    for episode in episodes:
        last = np.arange(len(episode)) == len(episode) - 1
        told = {name: np.full(len(episode) + 1, one) for name, one in episode.sim_params.items()}
        told.pop(RECORDING, None)
        fields: dict[str, Any] = {
            "observations": episode.obs,
            "actions": env_action(task, episode.action),
            "rewards": episode.reward,
            "terminations": last & episode.terminated,
            "truncations": last & (not episode.terminated),
            "infos": {"sim_params": told} if told else {},
        }
        buffers.append(EpisodeBuffer(**fields))
    with new_folder(out) as folder:
        folder.mkdir(parents=True)
        spaces = vector.single_observation_space, vector.single_action_space
        storage = MinariStorage.new(folder / "data", *spaces)
        text = f"Collected by headway: {config.method} on {config.env}, seed {config.seed}."
        facts = {"dataset_id": out.name, "minari_version": minari.__version__, "description": text}
        storage.update_metadata(facts | {"algorithm_name": config.method})
        storage.update_episodes(buffers)
    return len(episodes)
