"""Recordings: trajectories that were logged elsewhere, read and cut into what a model is fitted to.

A recording is a table by name: `obs` and `action`, and perhaps more (docs/logged-data.md). Rows
with a missing number, and gaps in time, cut it; what nothing can be made of is named in one line.
"""

import dataclasses
import hashlib
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
from headway.errors import ConfigError, HeadwayError, RunError, one_line, shown, unknown_name
from headway.task import Task, env_action, episode_length, scaled_action, sim_param_sets, task_of
from headway.training.check import compared, method_findings
from headway.training.collect import Environments
from headway.training.files import UNFINISHED, writing
from headway.training.run import RunDir, trajectory_arrays

Table = Mapping[str, Any]
"""Arrays by name."""
Data = str | Path | Iterable[Table]

HELD_OUT, RECORDING = "held-out", "recording"
PHYSICS = "sim_params."
ALIASES = {
    "obs": ("observation", "observations", "state", "states"),
    "action": ("actions",),
    "next_obs": ("next_observation", "next_observations", "next_state", "next_states"),
    "reward": ("rewards",),
    "terminated": ("terminations", "termination", "terminals", "terminal", "dones", "done"),
    "truncated": ("truncations", "truncation", "timeouts", "timeout"),
    "time": ("times", "timestamp", "timestamps", "t", "step", "steps"),
    "episode": ("episodes", "episode_id", "episode_index", "trajectory", "trajectory_id"),
}
"""Names of what a recording may hold, and what others call it."""
ROUNDING = 1e-3  # share of an action's range by which a recorded one may be beyond it
JITTER = 0.5  # share of the usual period by which a step may be shorter or longer


@dataclasses.dataclass(frozen=True)
class Log:
    """Recordings, ready to be fitted."""

    config: Config
    """Settings of the run, which know the spaces and where the data came from."""
    fitted: list[Trajectory]
    """Pieces that are fitted; `sim_params` has the number of the `recording` beside the physics."""
    held_out: list[Trajectory]
    """Pieces of recordings that are held out, to measure errors on."""
    recordings: list[dict[str, Any]]
    """By number: file, transitions, pieces, held_out."""
    remarks: list[str]
    """One line each: how recordings were cut, and how their rewards differ from the Task's."""


def read_log(
    data: Data, config: Config, held_out: float = 0.2, names: Mapping[str, str] | None = None
) -> Log:
    """Read recordings and hold some out; no environment is stepped.

    Args:
        data: As `headway.fit`.
        config: Settings of the run.
        held_out: Share of the recordings to hold out; of one recording, of its pieces.
        names: As `headway.fit`.

    Raises:
        ConfigError: A recording cannot be read, or does not fit the environment.
    """
    if not 0 <= held_out < 1:
        raise ConfigError(f"held_out is {shown(held_out)}, allowed: from 0 to below 1.")
    if not config.model.learns:
        raise ConfigError(f"method {config.method} learns nothing from data; choose another one.")
    task = _task(config)
    for found in method_findings(task):
        if found.status == "fault":
            raise ConfigError(f"{config.env}, {found.name}: {found.text}")
    cutter = _Cutter(config, task, names or {})
    for where, table in _tables(data):
        cutter.add(where, table)
    pieces = cutter.trajectories()
    of_recording = [int(piece.sim_params[RECORDING]) for piece in pieces]
    several = len({*of_recording}) > 1
    units = of_recording if several else list(range(len(pieces)))
    order = np.random.default_rng(config.seed).permutation(np.unique(units))
    count = min(max(round(held_out * len(order)), held_out > 0), len(order) - 1)
    out = set(order[:count].tolist())
    fitted = [piece for unit, piece in zip(units, pieces, strict=True) if unit not in out]
    kept_back = [piece for unit, piece in zip(units, pieces, strict=True) if unit in out]
    recordings = [
        {"file": where, "pieces": 0, "transitions": 0, "held_out": several and number in out}
        for number, where in enumerate(cutter.files)
    ]
    for number, piece in zip(of_recording, pieces, strict=True):
        recordings[number]["pieces"] += 1
        recordings[number]["transitions"] += len(piece)
    digest = hashlib.sha256()
    for array in trajectory_arrays(fitted + kept_back)[0].values():
        digest.update(array.tobytes())
    log = {
        "data": str(data) if isinstance(data, str | Path) else "arrays",
        "rounds": config.collection.num_iterations,
        "sha256": digest.hexdigest(),
    }
    remarks = cutter.remarks + [
        f"{found.name}: {found.text}"
        for found in compared(task, pieces)
        if found.text and (found.name != "terminated" or any(t.terminated for t in pieces))
    ]
    told = dataclasses.replace(config, spaces=task.spaces, log=log)
    return Log(told, fitted, kept_back, recordings, remarks)


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
def _needing(library: str) -> Iterator[None]:
    try:
        yield
    except ImportError as error:
        raise ConfigError(
            f"{library} is missing ({one_line(error, 100)}); pip install 'headway[data]'."
        ) from None


def _tables(data: Data) -> Iterator[tuple[str, Table]]:
    """Where each table stands, and its arrays."""
    if not isinstance(data, str | Path):
        yield from ((f"data[{i}]", table) for i, table in enumerate(data))
        return
    path = Path(data)
    if str(data).startswith("minari:") or (path / "data" / "metadata.json").exists():
        yield from _minari(str(data))
        return
    files = [file for file in ([path, *sorted(path.rglob("*"))]) if file.suffix in READERS]
    if not files:
        raise ConfigError(
            f"{data} holds no recordings, allowed: an .npz or .parquet file, a folder of them, a"
            " Minari data set, minari:ID; check the path."
        )
    for file in files:
        with _reading(file):
            table = READERS[file.suffix](file)
        yield str(file), table


@contextmanager
def _reading(where: str | Path) -> Iterator[None]:
    try:
        yield
    except HeadwayError:
        raise
    except Exception as error:  # whatever the file of another program does to its reader
        raise ConfigError(f"{where} cannot be read: {one_line(error, 200)}.") from None


def _npz(file: Path) -> Table:
    with np.load(file, allow_pickle=False) as arrays:
        return dict(arrays)


def _parquet(file: Path) -> Table:
    with _needing("pyarrow"):
        from pyarrow import parquet
    table = parquet.read_table(file)
    return {name: _column(table[name]) for name in table.column_names}


def _column(column: Any) -> np.ndarray:
    """A column of Parquet; what is missing in one of numbers is NaN."""
    values = column.to_numpy()
    if values.dtype != object or not hasattr(column.type, "value_type"):
        return values
    rows = column.to_pylist()
    width = max((len(row) for row in rows if row), default=0)
    return np.array([row or [np.nan] * width for row in rows], np.float64)


READERS = {".npz": _npz, ".parquet": _parquet}


def _minari(data: str) -> Iterator[tuple[str, Table]]:
    with _needing("minari"):
        import h5py  # noqa: F401 (Minari looks for it only as it reads)
        import minari
    with _reading(data):
        name = data.removeprefix("minari:")
        found = (
            minari.load_dataset(name)
            if name != data
            else minari.MinariDataset(Path(data) / "data")
        )
        for episode in found.iterate_episodes():
            obs = _flat(episode.observations, found.observation_space)
            table = {"obs": obs, "action": episode.actions, "reward": episode.rewards}
            physics = episode.infos.get("sim_params", {})
            table |= {"terminated": episode.terminations, "truncated": episode.truncations}
            table |= {PHYSICS + name: values for name, values in physics.items()}
            yield f"{data}, episode {episode.id}", table


def _flat(values: Any, space: Any) -> Any:
    """Observations in one row each, in the order of `FlattenObservation`."""
    if not isinstance(values, Mapping):
        return values
    parts = [np.asarray(_flat(values[name], space[name])) for name in space]
    return np.concatenate([part.reshape(len(part), -1) for part in parts], axis=1)


@dataclasses.dataclass
class _Cutter:
    """Cuts tables into pieces without gaps."""

    config: Config
    task: Task
    names: Mapping[str, str]
    pieces: list[dict[str, Any]] = dataclasses.field(default_factory=list)
    """Fields of a `Trajectory` each; rewards may be missing."""
    files: list[str] = dataclasses.field(default_factory=list)
    """Of each recording."""
    gaps: int = 0
    missing: int = 0
    """Rows that lack a number."""

    def __post_init__(self):
        for name in self.names:
            if name not in ALIASES:
                raise unknown_name("name of recorded numbers", name, ALIASES)

    @property
    def remarks(self) -> list[str]:
        """Say how recordings were cut, if they were."""
        counts = {"gaps in time": self.gaps, "rows with missing numbers": self.missing}
        found = " and ".join(f"{count} {what}" for what, count in counts.items() if count)
        made = f"{len(self.files)} recordings, {len(self.pieces)} pieces"
        return [f"cut at {found}: {made}."] if found else []

    def trajectories(self) -> list[Trajectory]:
        """All pieces; rewards that are missing are the Task's.

        Raises:
            ConfigError: There is none.
        """
        if not self.pieces:
            text = "; ".join(self.remarks) or f"{len(self.files)} recordings"
            raise ConfigError(f"no two rows in a row are complete ({text}); nothing can be fitted.")
        rows = [(one["obs"][:-1], one["action"], one["obs"][1:]) for one in self.pieces]
        obs, action, next_obs = map(np.concatenate, zip(*rows, strict=True))
        due = np.asarray(self.task.reward(obs, self.task.scale_action(jnp.asarray(action)), next_obs))
        ends = np.cumsum([len(one["action"]) for one in self.pieces])[:-1]
        return [
            Trajectory(**piece | {"reward": np.where(np.isnan(paid := piece["reward"]), own, paid)})
            for piece, own in zip(self.pieces, np.split(due, ends), strict=True)
        ]

    def numbers(self, where: str, name: str, table: Table) -> np.ndarray | None:
        """The numbers that a table holds by a name of ours, or None; `obs` and `action` must be."""
        near = [one for one in (name, *ALIASES.get(name, ())) if one in table][:1]
        parts = near or [one for one in table if one.startswith(f"{name}.")]
        if name in self.names:
            parts = self.names[name].split(",")
        absent = [part for part in parts if part not in table]
        if absent or (not parts and name in ("obs", "action")):
            raise ConfigError(
                f"{where} has no {', '.join(absent) or name}, allowed: {', '.join(table)}; say what"
                f" {name} is called, as in --names {name}=NAME or {name}=NAME,NAME."
            )
        if not parts:
            return None
        arrays = [np.atleast_1d(np.asarray(table[part])) for part in parts]
        values = arrays[0] if len(arrays) == 1 else np.column_stack(arrays)
        if name == "episode":
            return np.unique(values.astype(str), return_inverse=True)[1].astype(np.float64)
        if name == "time" and values.dtype.kind == "M":
            values = (values - values[0]) / np.timedelta64(1, "s")
        if values.dtype.kind not in "fiub":
            raise ConfigError(f"{where}: {', '.join(parts)} is {values.dtype}, allowed: numbers.")
        return values.astype(np.float64)

    def add(self, where: str, table: Table) -> None:
        """Cut a table, which holds one recording or several, one after the other or stacked."""
        obs, action = self.numbers(where, "obs", table), self.numbers(where, "action", table)
        assert obs is not None
        assert action is not None
        if obs.ndim == 3:
            for i in range(len(obs)):
                one = {n: v[i] if np.shape(v)[:1] == obs.shape[:1] else v for n, v in table.items()}
                self.add(f"{where}[{i}]", one)
            return
        spaces, later = self.task.spaces, self.numbers(where, "next_obs", table)
        low, high = np.array(spaces.action_low), np.array(spaces.action_high)
        rows = {"obs": (obs, spaces.obs_size), "action": (action, len(low))}
        for name, (values, size) in rows.items():
            if values[:1].size != size:
                raise ConfigError(
                    f"{where}: a row of {name} has {values[:1].size} numbers, allowed: {size}, as in"
                    f" {self.config.env}."
                )
        with np.errstate(over="ignore"):  # what becomes infinite is missing
            obs = obs.reshape(len(obs), -1).astype(np.float32)
            later = None if later is None else later.reshape(len(later), -1).astype(np.float32)
        steps = len(action)
        if not (len(obs) - steps in (0, 1) if later is None else len(obs) == len(later) == steps):
            more = "" if later is None else f" and {len(later)} next_obs"
            raise ConfigError(
                f"{where} has {len(obs)} obs, {steps} actions{more}, allowed: as many of each, or"
                " without next_obs one more obs than actions."
            )
        count = steps if later is not None else len(obs) - 1
        action = action.reshape(steps, -1)[:count]
        before, after = obs[:count], obs[1:] if later is None else later

        def column(name: str) -> np.ndarray | None:
            """Numbers of the rows, the last one perhaps left out."""
            values = self.numbers(where, name, table)
            if values is None or len(values) in (steps, len(obs)):
                return None if values is None else values.reshape(len(values), -1)[:, 0]
            if len(values) == 1:
                return np.repeat(values, len(obs))
            raise ConfigError(
                f"{where}: {name} has {len(values)} rows, allowed: 1, {steps} or {len(obs)}."
            )

        def between(found: np.ndarray) -> np.ndarray:
            """What is found between two rows, for each transition; nothing after the last one."""
            return np.append(found, False)[:count].astype(bool)

        physics = {}
        for name in table:
            if name.startswith(PHYSICS):
                physics[name[len(PHYSICS) :]] = column(name)
        known = sim_param_sets(self.config).names
        for name in physics:
            if name not in known:
                raise unknown_name("simulator parameter of a recording", name, known)
        other, gap = np.zeros((2, count), bool)
        for values in (column("episode"), *physics.values()):
            if values is not None:
                other |= between(np.diff(np.nan_to_num(values)) != 0)
        if (time := column("time")) is not None:
            period = np.diff(time)
            usual = np.median(period[period > 0]) if (period > 0).any() else 1.0
            other |= between(period <= 0)
            gap |= between(~(np.abs(period / usual - 1) <= JITTER)) & ~other
        flags = {name: column(name) for name in ("terminated", "truncated")}
        terminated, truncated = (
            np.zeros(count, bool) if values is None else np.nan_to_num(values[:count]) != 0
            for values in flags.values()
        )
        ends = terminated | truncated
        whole = [np.isfinite(values).all(1) for values in (before, action, after)]
        complete = whole[0] & whole[1] & whole[2]
        valid = complete.copy()
        if later is None:  # what follows is another recording's, or comes after the gap
            valid &= ~(other | gap | (ends & (len(obs) == steps)))
        else:
            near = np.isclose(after[:-1], before[1:], rtol=1e-4, atol=1e-5).all(1)
            other |= between(~near & whole[2][:-1] & whole[0][1:])
        self.gaps += int(gap.sum())
        self.missing += int((~np.isfinite(obs).all(1)).sum() + (~whole[1]).sum())
        room = ROUNDING * (high - low)
        bad = valid[:, None] & ((action < low - room) | (action > high + room))
        if spaces.action_kind != "box":
            bad |= valid[:, None] & (action != np.rint(action))
        for row, entry in np.argwhere(bad)[:1]:
            raise ConfigError(
                f"{where}: action[{entry}] is {action[row, entry]:g} in row {row}, allowed: from"
                f" {low[entry]:g} to {high[entry]:g}, as {self.config.env} takes it; mend the"
                " recording, or the bounds of the environment."
            )
        scaled = scaled_action(self.task, np.clip(action, low, high))
        reward = column("reward")
        reward = np.full(count, np.nan) if reward is None else reward[:count]
        number = np.cumsum(np.append(False, (other | ends)[:-1])) if count else np.zeros(0, int)
        cuts = np.flatnonzero(~valid[1:] | ~valid[:-1] | (other | gap | ends)[:-1]) + 1
        longest = episode_length(self.config)
        for run in np.split(np.arange(count), cuts):
            for start in range(0, len(run) if valid[run].all() else 0, longest):
                part = run[start : start + longest]
                told = {n: float(v[part[0]]) for n, v in physics.items() if np.isfinite(v[part[0]])}
                piece = {
                    "obs": np.concatenate([before[part], after[part[-1:]]]),
                    "action": scaled[part],
                    "reward": reward[part],
                    "sim_params": {**told, RECORDING: float(len(self.files) + number[part[0]])},
                    "terminated": bool(terminated[part[-1]]),
                }
                self.pieces.append(piece)
        found = int(number.max(initial=0)) + 1
        self.files += [where] if found == 1 else [f"{where}, {i}" for i in range(found)]


def export_data(run_dir: str | Path, out: str | Path) -> int:
    """Write the trajectories that a run collected as a Minari data set.

    Args:
        run_dir: The run directory.
        out: The folder to make; its name is that of the data set, and ends with its version,
            for example `pendulum-v0`.

    Returns:
        The number of episodes.

    Raises:
        RunError: There is no run with data, or `out` is there already.
        ConfigError: Minari is missing, or the name has no version.
    """
    with _needing("minari"):
        import h5py  # noqa: F401 (Minari asks for it when it writes)
        import minari
        from gymnasium import spaces
        from minari.data_collector import EpisodeBuffer
        from minari.dataset.minari_storage import MinariStorage
    run, out = RunDir(run_dir), Path(out)
    config = run.config()
    episodes, task = run.load_data(), task_of(config)
    if not episodes:
        raise RunError(f"{run_dir} has collected nothing, allowed: a run of a method that learns.")
    if out.exists() or not re.fullmatch(r"[-\w]+-v\d+", out.name):
        raise ConfigError(
            f"{out} is no name for a new data set, allowed: a folder that is not there yet, with a"
            " version at its end, as pendulum-v0."
        )
    known, own = sim_param_sets(config).names, task.spaces
    low, high = (np.reshape(ends, own.action_shape) for ends in (own.action_low, own.action_high))
    if own.action_kind != "categories":
        taken = spaces.Box(low, high, dtype=np.dtype(own.action_dtype).type)
    elif own.action_shape:
        taken = spaces.MultiDiscrete((high - low + 1).astype(int), start=low.astype(int))
    else:
        taken = spaces.Discrete(int(high - low) + 1, start=int(low))
    buffers = []
    for episode in episodes:
        last = np.arange(len(episode)) == len(episode) - 1
        physics = {n: v for n, v in episode.sim_params.items() if n in known}
        told = {name: np.full(len(episode) + 1, value) for name, value in physics.items()}
        buffer = EpisodeBuffer(
            observations=episode.obs,
            actions=env_action(task, episode.action),
            rewards=episode.reward,
            terminations=last & episode.terminated,
            truncations=last & (not episode.terminated),
            infos={"sim_params": told} if told else {},
        )
        buffers.append(buffer)
    made = out.with_name(f".{out.name}{UNFINISHED}")
    shutil.rmtree(made, ignore_errors=True)
    with writing(out):
        made.mkdir(parents=True)
        storage = MinariStorage.new(
            made / "data", spaces.Box(-np.inf, np.inf, (own.obs_size,)), taken
        )
        text = f"Collected by headway: {config.method} on {config.env}, seed {config.seed}."
        facts = {"dataset_id": out.name, "minari_version": minari.__version__, "description": text}
        storage.update_metadata(facts | {"algorithm_name": config.method})
        storage.update_episodes(buffers)
        made.rename(out)
    return len(episodes)
