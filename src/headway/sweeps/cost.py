"""What runs will take, before they are made: arithmetic from settings, speed from finished runs."""

import dataclasses
import time
from collections.abc import Sequence

import equinox as eqx
import jax
import numpy as np

from headway.config import Config
from headway.planning.flop import plan_flop
from headway.sweeps.board import first_status
from headway.sweeps.jobs import Job
from headway.sweeps.status import State
from headway.task import episode_length, sim_param_sets
from headway.training.loading import initial, load_task
from headway.training.run import RunDir

PER_PRODUCT = 3.0  # a run takes about so much longer than its matrix products alone
_SIZE, _PRODUCTS = 768, 12  # matrices that are multiplied to time this machine


@dataclasses.dataclass(frozen=True)
class PlannedJob:
    """What is to be done for one run."""

    job: Job
    state: State
    """`done`, `waiting`, or `failed` where its directory cannot be used."""
    finished_iterations: int
    flop: float
    """Operations of the matrix products that are still to come."""


@dataclasses.dataclass(frozen=True)
class Plan:
    """What is to be done for a comparison."""

    jobs: list[PlannedJob]
    flop_per_second: float
    """Speed of one run at a time on this machine."""
    source: str
    """Where the speed comes from."""

    def seconds(self, jobs: Sequence[PlannedJob] | None = None) -> float:
        """Time for some jobs, one after another; for all of them by default."""
        return sum(job.flop for job in (self.jobs if jobs is None else jobs)) / self.flop_per_second

    @property
    def note(self) -> str:
        """What the estimate leaves out among the missing runs; empty where that is nothing."""
        missing = [one.job.config for one in self.jobs if one.state == "waiting"]
        count = sum(config.model.kind == "simulator" for config in missing)
        if not count:
            return ""
        return (
            f"Not counted: the time of {count} missing runs that plan on the true dynamics; on"
            " robots they take the longest of all."
        )


def make_plan(jobs: Sequence[Job]) -> Plan:
    """List what is missing and estimate what it takes; nothing is run.

    Args:
        jobs: Every run of a comparison. Those finished already give the speed, unless they
            learned nothing and so tell nothing of it.
    """
    planned = [_planned(job) for job in jobs]
    done = [one.job for one in planned if one.state == "done" and run_flop(one.job.config)]
    speeds = [_measured_speed(job) for job in done]
    if speeds:
        return Plan(planned, float(np.median(speeds)), f"{len(speeds)} finished runs")
    return Plan(planned, _matrix_rate() / PER_PRODUCT, "matrix products timed just now")


def run_flop(config: Config, first_iteration: int = 0) -> float:
    """Operations of the matrix products of a run, from some iteration on.

    Planning and the updates of the networks are counted: together nearly all of the time at
    the sizes of the presets `quick` and `paper`. What a simulator computes is not counted, so a
    run that learns nothing costs nothing here.

    Args:
        config: All settings.
        first_iteration: Iterations before this one are done already.
    """
    task, length = load_task(config), episode_length(config)
    per_step = plan_flop(config.model, config.planner, task)
    # Forwards, and backwards twice as much.
    per_sample = 6.0 * _num_parameters(config) if config.model.learns else 0.0
    num_unseen = len(sim_param_sets(config).group_names) - 1
    total = 0.0
    for iteration in range(first_iteration, config.collection.num_iterations):
        collected = config.collection.num_episodes * length
        steps = collected if iteration else 0  # the first collection acts at random
        last = iteration == config.collection.num_iterations - 1
        tested = last or (iteration + 1) % config.evaluation.every == 0
        with_train = last or config.evaluation.training_group == "always"
        groups = num_unseen + with_train if tested else 0
        steps += groups * config.evaluation.num_episodes * length
        samples = (iteration + 1) * collected * config.fitting.future_length
        passes = config.fitting.epochs
        total += steps * per_step + passes * samples * per_sample
    return total


def _num_parameters(config: Config) -> int:
    learned = eqx.filter_eval_shape(lambda: initial(config, load_task(config)))
    return sum(leaf.size for leaf in jax.tree.leaves(learned.fit.model))


def _planned(job: Job) -> PlannedJob:
    status = first_status(job)
    left = run_flop(job.config, status.iteration) if status.state == "waiting" else 0.0
    return PlannedJob(job, status.state, status.iteration, left)


def _measured_speed(job: Job) -> float:
    """Operations per second of a finished run, with all that it did beside products."""
    seconds = sum(sum(line["seconds"].values()) for line in RunDir(job.path).metrics())
    return run_flop(job.config) / max(seconds, 1e-3)


def _matrix_rate() -> float:
    """Operations per second of this machine's matrix products in float32."""
    matrix = np.ones((_SIZE, _SIZE), np.float32)
    np.matmul(matrix, matrix)  # the first one starts threads
    fastest = float("inf")
    for _ in range(_PRODUCTS):
        begin = time.perf_counter()
        np.matmul(matrix, matrix)
        fastest = min(fastest, time.perf_counter() - begin)
    return 2 * _SIZE**3 / fastest
