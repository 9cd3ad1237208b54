"""Making the runs that are missing: one after another here, or side by side on Ray."""

import dataclasses
import functools
import time
from collections.abc import Sequence
from importlib.util import find_spec

from headway.errors import BusyError, ConfigError
from headway.models.compilation import prepare_jax
from headway.sweeps.board import Board, first_status
from headway.sweeps.jobs import Job
from headway.sweeps.status import Status, StatusProgress, Tell, reason
from headway.training.train import train_run

PATIENCE = 5.0  # seconds before a run is tried again that another process holds
INSTALL_RAY = "`pip install '.[ray]'` in the clone of Headway"


@dataclasses.dataclass(frozen=True)
class Workers:
    """Where runs are made, and with what."""

    one_by_one: bool = False
    """Whether runs go one after another in this process, without Ray."""
    address: str | None = None
    """The Ray cluster, for example `auto`; None starts Ray on this machine."""
    cpus_per_run: float = 1.0
    """Cores that one run reserves, and threads that it computes with."""
    gpus_per_run: float | None = None
    """GPUs, or a fraction of one, that one run reserves; None takes one where there are any."""

    def __post_init__(self):
        gpus = 0.0 if self.gpus_per_run is None else self.gpus_per_run
        if not (self.cpus_per_run > 0 and gpus >= 0):
            raise ConfigError(
                f"cpus_per_run is {self.cpus_per_run} and gpus_per_run {self.gpus_per_run},"
                " allowed: more than 0 cores, and 0 or more GPUs."
            )
        if gpus > 1 and gpus != int(gpus):
            raise ConfigError(
                f"gpus_per_run is {gpus:g}, allowed: a share of one GPU, or whole ones."
            )
        of_ray = {
            "address": self.address or None,
            "cpus_per_run": None if self.cpus_per_run == 1 else self.cpus_per_run,
            "gpus_per_run": self.gpus_per_run,
        }
        for other, value in of_ray.items():
            if self.one_by_one and value is not None:
                raise ConfigError(
                    f"one_by_one makes runs without Ray, got {other} {value!r}, which only Ray"
                    " heeds; leave one out."
                )


def run_jobs(jobs: Sequence[Job], workers: Workers, board: Board) -> None:
    """Make every run that is missing; begun ones go on where they stand.

    A run that fails is noted on the board, and the others go on.

    Raises:
        ConfigError: A cluster is named, and Ray is not installed.
    """
    board.begin(jobs)
    missing = [job for job in jobs if not board.statuses[job.path].over]
    if not missing:
        return
    if workers.one_by_one or not ray_is_installed():
        if workers.address:
            raise ConfigError(
                f"a Ray cluster needs Ray, which is missing; {INSTALL_RAY} installs it."
            )
        if not workers.one_by_one and len(missing) > 1:
            board.message(f"runs go one after another; {INSTALL_RAY} lets them go side by side")
        run_here(missing, board)
    else:
        from headway.sweeps.on_ray import run_on_ray

        run_on_ray(missing, workers, board)


def ray_is_installed() -> bool:
    """Whether runs can go side by side."""
    return find_spec("ray") is not None


def run_here(jobs: Sequence[Job], board: Board) -> None:
    """Make runs in this process, in their order; those that another process holds come last.

    Args:
        jobs: The runs.
        board: Takes reports.
    """
    waiting = list(jobs)
    while waiting:
        for job in waiting:
            ended = make_run(job, functools.partial(board.tell, job))
            returns = ended.returns or board.statuses[job.path].returns
            board.tell(job, dataclasses.replace(ended, returns=returns))
        waiting = [job for job in waiting if not board.statuses[job.path].over]
        if waiting:
            time.sleep(PATIENCE)


def make_run(job: Job, tell: Tell) -> Status:
    """Train a run to its end.

    Args:
        job: The run.
        tell: Takes reports of how it goes.

    Returns:
        How it stands in the end: `done`, `failed`, or `busy` where another process trains it.
    """
    reached = first_status(job)

    def note(status: Status) -> None:
        nonlocal reached
        reached = status
        tell(status)

    try:
        prepare_jax()
        if not job.finished:
            train_run(job.config, job.path, StatusProgress(note, job.finished_iterations))
        done = Status("done", job.num_iterations, returns=reached.returns)
    except Exception as error:  # on Ray, too, the others go on whatever it is
        done = _stopped(error, reached.iteration)
    return dataclasses.replace(done, messages=reached.messages)


def _stopped(error: Exception, iteration: int) -> Status:
    """How a run stands that an error ended: another process may be at it, or it has failed."""
    state = "busy" if isinstance(error, BusyError) else "failed"
    return Status(state, iteration, note=reason(error))
