"""Runs side by side as Ray tasks; loaded only where Ray is installed.

A task whose worker or node dies is submitted again, and its run goes on from what is saved. Ray
itself never repeats a task, so one driver has at most one task per run directory; the lock of
the directory keeps out what is left of a lost task, and other drivers.
"""

import contextlib
import dataclasses
import json
import logging
import math
import os
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import ray
from ray.exceptions import RayError, RayTaskError, RuntimeEnvSetupError, TaskUnschedulableError
from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

from headway.config import from_dict, to_dict
from headway.errors import ConfigError
from headway.sweeps.board import Board, first_status
from headway.sweeps.jobs import Job
from headway.sweeps.running import PATIENCE, Workers, make_run
from headway.sweeps.status import Status, reason
from headway.training.stopping import stop_requests

MAX_LOSSES = 5  # of one run's workers, without an iteration finished between them
POLL = 0.5  # seconds
FAREWELL = 15.0  # seconds that interrupted runs get to save
PRIVATE = "headway-private"  # a resource of a Ray that a sweep has started for itself
GPU_MEMORY = 0.9  # share that runs on one GPU take together


def run_on_ray(jobs: Sequence[Job], workers: Workers, board: Board) -> None:
    """Make runs as Ray tasks, as many side by side as the machine or cluster holds.

    Args:
        jobs: The runs, in the order in which they are begun.
        workers: The cluster and what a run reserves of it.
        board: Takes reports.

    Raises:
        ConfigError: No node is large enough for one run, or there is no such cluster.
    """
    with _connected(workers.address):
        task = ray.remote(**_task_options(workers))(_work)
        with _Dispatcher(jobs, board, task, _mailbox_here()) as dispatcher:
            dispatcher.run()


@contextlib.contextmanager
def _connected(address: str | None) -> Iterator[None]:
    """Connect to a cluster, or start Ray here; a connection that is open already is used."""
    if ray.is_initialized():
        yield
        return
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    alone: dict[str, Any] = {"include_dashboard": False, "resources": {PRIVATE: 1}}
    options = {} if address else alone
    try:
        ray.init(address or "local", logging_level=logging.ERROR, log_to_driver=False, **options)
    except (ConnectionError, ValueError) as error:
        raise ConfigError(
            f"there is no Ray cluster at address {address!r} ({reason(error)}); start one with `ray"
            " start --head`, or leave --address out."
        ) from None
    except RuntimeError as error:
        raise ConfigError(
            f"Ray at {address or 'this machine'} cannot be used ({reason(error)}); a cluster needs"
            " the same versions of Ray and Python everywhere, and --one-by-one needs no Ray."
        ) from None
    try:
        if address:
            _refuse_private(address)
        yield
    finally:
        ray.shutdown()


def _refuse_private(address: str) -> None:
    """Keep out of what another sweep has started for itself, and ends with itself.

    Raises:
        ConfigError: It is the Ray of another sweep.
    """
    if any(PRIVATE in node["Resources"] for node in ray.nodes() if node["Alive"]):
        raise ConfigError(
            f"the Ray at address {address!r} belongs to another sweep on that machine, and ends"
            " with it; leave --address out, or start a cluster with `ray start --head`."
        )


def _task_options(workers: Workers) -> dict[str, Any]:
    """What every task reserves, and the environment of its process."""
    nodes = [node["Resources"] for node in ray.nodes() if node["Alive"]]
    most_gpus = max((node.get("GPU", 0.0) for node in nodes), default=0.0)
    gpus = workers.gpus_per_run
    if gpus is None:
        gpus = 1.0 if most_gpus else 0.0
    cpus = workers.cpus_per_run
    if not any(node.get("CPU", 0) >= cpus and node.get("GPU", 0) >= gpus for node in nodes):
        most = max((node.get("CPU", 0) for node in nodes), default=0)
        raise ConfigError(
            f"a run reserves {cpus:g} cores and {gpus:g} GPUs, allowed: what one node has, at most"
            f" {most:g} cores and {most_gpus:g} GPUs; lower --cpus-per-run or --gpus-per-run."
        )
    # XLA takes NPROC for its number of threads.
    variables = {"NPROC": str(math.ceil(cpus))}
    if gpus == 0:
        variables["JAX_PLATFORMS"] = "cpu"
    elif gpus < 1:
        variables["XLA_PYTHON_CLIENT_MEM_FRACTION"] = f"{GPU_MEMORY * gpus:.3f}"
    return {
        "num_cpus": cpus,
        "num_gpus": gpus,
        "max_retries": 0,
        "max_calls": 1,  # a process per run, as if it were trained alone
        "runtime_env": {"env_vars": variables},
    }


@ray.remote(num_cpus=0)
class _Mailbox:
    """Keeps the newest report of every run until the driver takes them."""

    def __init__(self):
        self._reports: dict[str, dict[str, Any]] = {}

    def put(self, path: str, report: dict[str, Any]) -> None:
        """Leave a report."""
        self._reports[path] = report

    def take(self) -> dict[str, dict[str, Any]]:
        """Hand out all reports."""
        found, self._reports = self._reports, {}
        return found


def _mailbox_here() -> Any:
    """A mailbox on the driver's own node, so that no other node's end loses reports."""
    here = ray.get_runtime_context().get_node_id()
    stays = NodeAffinitySchedulingStrategy(here, soft=False)
    return _Mailbox.options(scheduling_strategy=stays).remote()  # pyright: ignore


def _work(config: str, path: str, mailbox: Any) -> dict[str, Any]:
    """Train a run in a worker's process; a task takes and returns plain values only."""
    job = Job(from_dict(json.loads(config)), Path(path))
    status = make_run(job, lambda status: mailbox.put.remote(path, dataclasses.asdict(status)))
    return dataclasses.asdict(status)


class _Dispatcher:
    """Submits tasks, reads their reports, and submits those again that were lost."""

    def __init__(self, jobs: Sequence[Job], board: Board, task: Any, mailbox: Any):
        self._board, self._task, self._mailbox = board, task, mailbox
        self._waiting = [(0.0, job) for job in jobs]
        self._running: dict[Any, Job] = {}
        self._losses = {job.path: (0, 0) for job in jobs}

    def __enter__(self) -> "_Dispatcher":
        return self

    def __exit__(self, kind: Any, error: Any, trace: Any) -> None:
        """Let runs that still go on save what they have."""
        for task in self._running:
            ray.cancel(task)
        if self._running:
            ray.wait(list(self._running), num_returns=len(self._running), timeout=FAREWELL)
        ray.kill(self._mailbox)

    def run(self) -> None:
        """Go on until every job is over, or a signal asks to stop."""
        with stop_requests() as stop:
            while self._waiting or self._running:
                self._submit()
                for task in self._ended():
                    self._settle(task)
                stop.answer()

    def _ended(self) -> Sequence[Any]:
        """Wait a moment, read the reports, and say which tasks are over."""
        ended: Sequence[Any] = []
        if self._running:
            ended, _ = ray.wait(list(self._running), timeout=POLL)
        else:
            time.sleep(POLL)
        self._read_reports()
        return ended

    def _submit(self) -> None:
        now = time.monotonic()
        for _, job in [one for one in self._waiting if one[0] <= now]:
            config = json.dumps(to_dict(job.config))
            path = str(job.path.absolute())
            self._running[self._task.remote(config, path, self._mailbox)] = job
        self._waiting = [one for one in self._waiting if one[0] > now]

    def _read_reports(self) -> None:
        by_path = {str(job.path.absolute()): job for job in self._running.values()}
        reports: Any = ray.get(self._mailbox.take.remote())
        for path, report in reports.items():
            if path in by_path:
                self._board.tell(by_path[path], Status(**report))

    def _settle(self, task: Any) -> None:
        """Take over how a task ended; submit it again where the run is not over."""
        job = self._running.pop(task)
        status = self._end_of(task, job)
        self._board.tell(job, status)
        if not status.over:
            self._waiting.append((time.monotonic() + PATIENCE, job))

    def _end_of(self, task: Any, job: Job) -> Status:
        reached = first_status(job).iteration
        try:
            ended: Any = ray.get(task)
            return Status(**ended)
        except RayTaskError as error:
            cause = error.cause if isinstance(error.cause, Exception) else error
            return Status("failed", reached, note=reason(cause))
        except (TaskUnschedulableError, RuntimeEnvSetupError) as error:
            return Status("failed", reached, note=str(error))
        except RayError as error:
            return self._lost(job, reached, type(error).__name__)

    def _lost(self, job: Job, reached: int, reason: str) -> Status:
        """Count what was lost since the run's last progress."""
        before, losses = self._losses[job.path]
        losses = 1 if reached > before else losses + 1
        self._losses[job.path] = (reached, losses)
        if losses < MAX_LOSSES:
            return Status("lost", reached, note=f"its worker died ({reason}); it is begun again")
        return Status(
            "failed",
            reached,
            note=f"its worker died {losses} times without finishing an iteration ({reason});"
            " the machine may lack memory for so many runs at once: raise --cpus-per-run.",
        )
