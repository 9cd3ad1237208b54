"""Sweeps: the runs that an experiment needs, which of them are missing, and making these.

One run per arm, environment and seed, each in a directory that is named by every setting that its
results depend on: whoever needs the same run finds it, and two different ones never meet. Runs go
one after another in processes of their own, or side by side on Ray. The run directories are the
only record of what is done, so a worker or the driver may be killed at any moment: a lost run is
submitted again, and goes on from what it has saved.
"""

import contextlib
import dataclasses
import functools
import hashlib
import itertools
import json
import logging
import math
import os
import signal
import subprocess
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NamedTuple, Self

from headway.config import Config, differences, flatten, from_dict, to_dict, tolerating_as
from headway.errors import BusyError, ConfigError, HeadwayError, RunError, one_line
from headway.lab.paper import Experiment
from headway.task import env_spec
from headway.training.files import reading
from headway.training.methods import Settings, make_config
from headway.training.progress import make_progress
from headway.training.run import RunDir
from headway.training.stopping import stop_requests
from headway.training.train import train_run

NOTE = "comparison.json"  # in a folder of results: the comparison that it holds
GROWING = ("envs", "seeds", "arms")  # what the same comparison may have more of
POLL = 0.5  # seconds
PATIENCE = 5.0  # seconds before a run is tried again that was lost or that another process holds
MAX_LOSSES = 5  # of one run's workers, without an iteration finished between them
FAREWELL = 15.0  # seconds that interrupted runs on Ray get to save
GPU_MEMORY = 0.9  # share of a GPU's memory for all runs on it


Cell = tuple[str, str, int]  # a place in the table of an experiment: environment, arm, seed


class State(NamedTuple):
    """Progress of a run, by its directory."""

    name: str
    """`missing`, `begun`, `done` or `failed`."""
    iterations: int
    """Finished iterations."""
    note: str = ""
    """Why the directory cannot be used."""


@dataclasses.dataclass(frozen=True)
class Job:
    """A run to be made: its settings, and the directory that is its alone."""

    config: Config
    path: Path

    @classmethod
    def of(cls, config: Config, out: Path) -> Self:
        """Give a configuration its directory under that of all results."""
        named = f"{config.method}-{config.preset}-{fingerprint(config)}"
        return cls(config, out / "runs" / config.env / named / f"seed{config.seed}")

    @property
    def name(self) -> str:
        """The run in a few words, for example `pendulum tmcl-quick-0a1b2c3d4e seed0`."""
        return " ".join(self.path.parts[-3:])

    @property
    def state(self) -> State:
        """Progress; `failed` where its directory is damaged or holds another run."""
        if not (self.path / "config.json").exists():
            return State("missing", 0)
        run, total = RunDir(self.path), self.config.collection.num_iterations
        try:
            begun_with = tolerating_as(run.config(), self.config)
            if found := differences(begun_with, self.config):
                raise RunError(
                    f"{self.path} holds a run with other settings ({'; '.join(found)}), perhaps of"
                    " an older version; choose another --out, or move it away."
                )
            if self.config.collection.check:
                run.refuse_changed()
            finished = len(run.metrics())
        except (HeadwayError, OSError) as error:
            return State("failed", 0, reason(error))
        return State("done" if finished >= total else "begun", finished)


@dataclasses.dataclass(frozen=True)
class Comparison:
    """An experiment in some environments, with some seeds, at a scale, in a directory."""

    experiment: Experiment
    envs: tuple[str, ...]
    seeds: tuple[int, ...]
    preset: str
    out: Path
    """Runs go to `runs/` in it, the figure, CSV and table to a folder of their own."""
    settings: Settings = dataclasses.field(default_factory=dict)
    """Changes of every arm by dotted name; what an arm itself sets wins."""

    def __post_init__(self):
        object.__setattr__(self, "envs", tuple(env_spec(env).name for env in self.envs))
        for name in ("envs", "seeds"):
            values = getattr(self, name)
            if not values or len(set(values)) < len(values):
                raise ConfigError(f"{name} is {values}, allowed: one or more, each once.")

    @functools.cached_property
    def cells(self) -> dict[Cell, Job]:
        """Every place of the table with the job that fills it; several may share one.

        The order is that in which the jobs are best done: all arms with the first seed first.

        Raises:
            UnknownNameError: No such environment, method or preset.
            ConfigError: A setting is unknown, of the wrong type or out of range.
        """
        found = {}
        for seed, env, arm in itertools.product(self.seeds, self.envs, self.experiment.arms):
            names = {"method": arm.method, "preset": self.preset, "seed": seed}
            changes = {**self.settings, **arm.settings}
            config = make_config(env, **names, settings=changes)
            found[env, arm.label, seed] = Job.of(config, self.out)
        return found

    @property
    def jobs(self) -> list[Job]:
        """Every job once; a job is known by its directory."""
        return list({job.path: job for job in self.cells.values()}.values())

    @property
    def facts(self) -> dict[str, Any]:
        """All that is compared, as JSON has it."""
        facts = dataclasses.asdict(dataclasses.replace(self, out=Path()))
        facts["arms"] = facts["experiment"].pop("arms")
        return json.loads(json.dumps(facts, default=str))

    @property
    def folder(self) -> Path:
        """Folder of results: those of a comparison that this one contains are replaced."""
        facts, usual = self.facts, self.out / f"{self.experiment.name}-{self.preset}"
        before: dict[str, Any] = facts
        if (usual / NOTE).exists():
            with reading(usual / NOTE):
                before = dict(json.loads((usual / NOTE).read_bytes()))
        grown = (
            before.get(name) == value
            or (name in GROWING and all(one in value for one in before.get(name, [None])))
            for name, value in facts.items()
        )
        digest = hashlib.sha256(json.dumps(facts, sort_keys=True).encode()).hexdigest()[:10]
        return usual if all(grown) else usual.with_name(f"{usual.name}-{digest}")


def fingerprint(config: Config) -> str:
    """Ten letters that stand for all settings that a run's results depend on, but the seed.

    Only what differs from the defaults counts, so a setting that a later version adds does not
    give the same run another name. What the run only tolerates
    (`config.TOLERANCE`) counts as its method and preset have it, whatever it is here.
    """
    names = {"method": config.method, "preset": config.preset, "seed": config.seed}
    usual = make_config(config.env, **names)
    plain = flatten(to_dict(Config(env=config.env, **names)))
    own = flatten(to_dict(tolerating_as(config, usual)))
    lines = [{f"{name}={json.dumps(v)}" for name, v in flat.items()} for flat in (own, plain)]
    return hashlib.sha256("\n".join(sorted(lines[0] - lines[1])).encode()).hexdigest()[:10]


@dataclasses.dataclass(frozen=True)
class Workers:
    """Machines on which runs are made, and the share of them that a run takes."""

    one_by_one: bool = False
    """Runs go one after another on this machine, without Ray."""
    address: str | None = None
    """The Ray cluster, for example `auto`; None starts Ray on this machine."""
    cpus_per_run: float = 1.0
    """Cores that one run reserves, and threads that it computes with."""
    gpus_per_run: float | None = None
    """GPUs, or a fraction of one, that one run reserves; None takes one where there are any."""

    def __post_init__(self):
        gpus = self.gpus_per_run or 0.0
        if self.cpus_per_run <= 0 or gpus < 0 or (gpus > 1 and gpus % 1):
            raise ConfigError(
                f"cpus_per_run is {self.cpus_per_run:g} and gpus_per_run {gpus:g}, allowed: more"
                " than 0 cores; 0 GPUs, a share of one, or whole ones."
            )
        of_ray = self.address, self.cpus_per_run, self.gpus_per_run
        if self.one_by_one and of_ray != (None, 1.0, None):
            raise ConfigError(
                "one_by_one makes runs without Ray, which alone heeds address, cpus_per_run and"
                " gpus_per_run; leave one out."
            )


def run_jobs(jobs: Sequence[Job], workers: Workers, *, quiet: bool = True) -> dict[Path, str]:
    """Make every run that is missing; begun ones go on where they stand.

    A run that fails does not stop the others. One whose worker dies is submitted again, as is one
    that another process holds.

    Args:
        jobs: The runs, in the order in which they are begun.
        workers: Where they are made.
        quiet: Say nothing on stderr.

    Returns:
        Why runs failed, by run directory.

    Raises:
        ConfigError: There is no such cluster, or no node of it is large enough for one run.
    """

    def say(text: str) -> None:
        if not quiet:
            print(f"[{over}/{len(jobs)}] {text}", file=sys.stderr, flush=True)

    states = {job.path: job.state for job in jobs}
    failures = {path: state.note for path, state in states.items() if state.name == "failed"}
    waiting = [(0.0, job) for job in jobs if states[job.path].name in ("missing", "begun")]
    over = len(jobs) - len(waiting)
    say(f"{len(waiting)} runs are missing")
    if not waiting:
        return failures
    here = workers.one_by_one or not (find_spec("ray") or workers.address)
    running: dict[Any, Job] = {}
    losses: Counter[tuple[Path, int]] = Counter()
    pool = _processes(running, quiet) if here else _ray_tasks(running, workers)
    with pool as (submit, wait), stop_requests() as stop:
        while waiting or running:
            now = time.monotonic()
            for one in [one for one in waiting if one[0] <= now]:
                if here and running:
                    break
                waiting.remove(one)
                say(f"{one[1].name}: running")
                running[submit(one[1])] = one[1]
            if not running:
                time.sleep(POLL)
            for task, *ended in wait():
                job, (outcome, note) = running.pop(task), ended
                if outcome == "lost":
                    place = job.path, job.state.iterations
                    losses[place] += 1
                    if losses[place] == MAX_LOSSES:
                        outcome = "failed"
                        note += f"; {MAX_LOSSES} times without finishing an iteration"
                if outcome in ("lost", "busy"):
                    waiting.append((time.monotonic() + PATIENCE, job))
                else:
                    over += 1
                if outcome == "failed":
                    failures[job.path] = note
                say(f"{job.name}: {outcome} {note}".rstrip())
            stop.answer()
    return failures


def make_run(config: str, path: str, quiet: bool = True) -> tuple[str, str]:
    """Train a run to its end, in a worker's process.

    Args:
        config: All settings, as JSON.
        path: The run directory.
        quiet: Show no progress.

    Returns:
        `done`, `failed`, or `busy` where another process trains it; and why.
    """
    try:
        train_run(from_dict(json.loads(config)), Path(path), make_progress(quiet))
    except BusyError as error:
        return "busy", reason(error)
    except Exception as error:  # the others go on, whatever it is
        return "failed", reason(error)
    return "done", ""


def reason(error: BaseException) -> str:
    """Word in one line why a run failed."""
    own = isinstance(error, HeadwayError)
    return one_line(error) if own else f"{type(error).__name__}: {one_line(error, 500)}"


# Begins a task; waits for a while and yields tasks that ended, with `done`, `failed`, `busy` or
# `lost`, and why.
Pool = tuple[Callable[[Job], Any], Callable[[], Iterator[Any]]]


@contextlib.contextmanager
def _processes(running: Mapping[Any, Job], quiet: bool) -> Iterator[Pool]:
    """Runs in processes of their own; those that still go on at the end save what they have."""

    def submit(job: Job) -> subprocess.Popen[str]:
        process = subprocess.Popen(
            [sys.executable, "-c", "from headway.lab import sweep; sweep.child()"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            env={**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))},
            start_new_session=True,  # Ctrl-C reaches the driver alone, which passes it on once
        )
        work = json.dumps(to_dict(job.config)), str(job.path), quiet
        print(json.dumps(work), file=process.stdin, flush=True)
        return process

    def wait() -> Iterator[Any]:
        for process in list(running):
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(POLL)
                said, _ = process.communicate()
                lost = "lost", f"its process ended with {process.returncode}"
                yield process, *(json.loads(said) if said else lost)

    try:
        yield submit, wait
    finally:
        for process in running:
            process.terminate()
            process.communicate()


def child() -> None:
    """Make the run that stdin describes, and say on stdout how it ended.

    The parent keeps stdin open; where that ends, the parent has died, and the run saves and stops.
    """

    def end_with_parent() -> None:
        os.read(0, 1)
        os.kill(os.getpid(), signal.SIGTERM)

    said = os.dup(1)
    os.dup2(2, 1)  # what an environment prints says nothing of the run
    config, path, quiet = json.loads(sys.stdin.readline())
    threading.Thread(target=end_with_parent, daemon=True).start()
    os.write(said, json.dumps(make_run(config, path, quiet)).encode())


@contextlib.contextmanager
def _ray_tasks(running: Mapping[Any, Job], workers: Workers) -> Iterator[Pool]:
    """Runs as Ray tasks, as many side by side as the machine or cluster holds.

    Ray itself never repeats a task, so a driver has at most one task per run directory.
    """
    try:
        import ray.exceptions

        ours = not ray.is_initialized()  # a connection that is open already is used
        if ours:
            os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
            quietly: dict[str, Any] = {"logging_level": logging.ERROR, "log_to_driver": False}
            if workers.address is None:
                quietly["include_dashboard"] = False
            ray.init(workers.address or "local", **quietly)
    except (ImportError, ConnectionError, ValueError, RuntimeError) as error:
        raise ConfigError(
            f"Ray at {workers.address or 'this machine'} cannot be used ({reason(error)}); install"
            " headway[ray], start a cluster with `ray start --head` and the same versions"
            " everywhere, or choose --one-by-one."
        ) from None
    of_ray = ray.exceptions

    def wait() -> Iterator[Any]:
        for task in ray.wait(list(running), timeout=POLL)[0] if running else ():
            try:
                yield task, *ray.get(task)
            except (of_ray.TaskUnschedulableError, of_ray.RuntimeEnvSetupError) as error:
                yield task, "failed", reason(error)
            except of_ray.RayError as error:
                lost = not isinstance(error, of_ray.RayTaskError)
                yield task, "lost" if lost else "failed", f"its worker died ({reason(error)})"

    try:
        cpus, gpus = workers.cpus_per_run, workers.gpus_per_run
        nodes = [node["Resources"] for node in ray.nodes() if node["Alive"]]
        if gpus is None:
            gpus = float(any(node.get("GPU") for node in nodes))
        if not any(node.get("CPU", 0) >= cpus and node.get("GPU", 0) >= gpus for node in nodes):
            have = "; ".join(f"{n.get('CPU', 0):g} and {n.get('GPU', 0):g}" for n in nodes)
            raise ConfigError(
                f"a run reserves {cpus:g} cores and {gpus:g} GPUs, allowed: what one node has"
                f" ({have}); lower --cpus-per-run or --gpus-per-run."
            )
        variables = {"NPROC": str(math.ceil(cpus))}  # XLA's number of threads
        if gpus == 0:
            variables["JAX_PLATFORMS"] = "cpu"
        elif gpus < 1:
            variables["XLA_PYTHON_CLIENT_MEM_FRACTION"] = f"{GPU_MEMORY * gpus:.3f}"
        # A process per run, as if it were trained alone.
        once = {"max_retries": 0, "max_calls": 1, "runtime_env": {"env_vars": variables}}
        make: Any = ray.remote(num_cpus=cpus, num_gpus=gpus, **once)(make_run)

        def submit(job: Job) -> Any:
            return make.remote(json.dumps(to_dict(job.config)), str(job.path.absolute()))

        yield submit, wait
    finally:
        for task in running:  # each saves what it has
            ray.cancel(task)
        if running:
            ray.wait(list(running), num_returns=len(running), timeout=FAREWELL)
        if ours:
            ray.shutdown()
