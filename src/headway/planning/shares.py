"""Candidates shared among the cores of a CPU: each imagines its share in a program of its own.

XLA divides every operation of a program among its threads, which wait for each other before the
next one. Programs that are called in several threads run side by side, each in the caches of
its core, and meet once per iteration of the optimizer.
"""

import functools
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float, Int, PRNGKeyArray

from headway.config import PlannerConfig
from headway.cpus import num_cpus
from headway.models.compilation import jit_networks
from headway.models.meeting import seat_here
from headway.planning.returns import Dynamics, RolloutSettings, Share, candidate_returns
from headway.tasks.base import Task

LEAST = 10_000
"""Imagined steps of an iteration below which to share them costs more than it saves."""


def worth_sharing(planner: PlannerConfig, obs: Any) -> bool:
    """Whether cores share the candidates of a plan.

    They do on a CPU that is one device, in a run by itself; where JAX has several devices, these
    share the candidates (`devices.spread_candidates`), and runs that meet share the cores.

    Args:
        planner: Settings of the planner.
        obs: Where each environment is; being traced, it is part of a program already.
    """
    if isinstance(obs, Tracer) or seat_here() is not None:
        return False
    if jax.default_backend() != "cpu" or jax.device_count() > 1 or num_cpus() == 1:
        return False
    steps = len(obs) * planner.num_candidates * planner.num_particles * planner.horizon
    return steps >= LEAST


class Question(NamedTuple):
    """What is asked of all shares: the arguments of `candidate_returns`."""

    dynamics: Dynamics
    task: Task
    obs: Float[Array, "env obs"]
    candidates: Float[Array, "env candidate horizon action"]
    key: PRNGKeyArray


def returns_of_shares(
    question: Question, planner: PlannerConfig
) -> list[Float[Array, "env share"]]:
    """The returns of candidates, in shares of one size; `joined` puts them together."""
    total = question.candidates.shape[1]
    size = -(-total // num_cpus())
    compiled = _COMPILED[planner.precision]
    settings = RolloutSettings.of(planner, question.dynamics.num_members)

    def of_share(first):
        start = np.int32(min(first, total - size))
        return compiled(question, start, size=size, settings=settings)

    def wait_for_share(first):
        return jax.block_until_ready(of_share(first))

    others = [_threads().submit(wait_for_share, first) for first in range(size, total, size)]
    return [of_share(0), *(other.result() for other in others)]


def joined(shares: list[Float[Array, "env share"]], total: int) -> Float[Array, "env candidate"]:
    """The returns of all candidates; the last share may overlap with the one before."""
    *before, last = shares
    twice = len(shares) * last.shape[1] - total
    return jnp.concatenate([*before, last[:, twice:]], axis=1)


def _share_returns(
    question: Question, first: Int[Array, ""], *, size: int, settings: RolloutSettings
) -> Float[Array, "env share"]:
    """The returns of some candidates."""
    dynamics, task, obs, candidates, key = question
    share = Share(first, candidates.shape[1])
    mine = jax.lax.dynamic_slice_in_dim(candidates, first, size, axis=1)
    return candidate_returns(dynamics, task, obs, mine, settings=settings, key=key, share=share)


_COMPILED = {
    precision: jit_networks(_share_returns, precision=precision)
    for precision in ("float32", "bfloat16")
}


@functools.cache
def _threads() -> ThreadPoolExecutor:
    """Threads that wait for the programs they called; XLA computes in its own."""
    return ThreadPoolExecutor(max(1, num_cpus() - 1), thread_name_prefix="headway-share")
