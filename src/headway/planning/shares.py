"""Candidates shared among the cores of a CPU: each imagines its share in a program of its own.

XLA divides every operation of a program among its threads, which wait for each other before the
next one. Programs that are called in several threads run side by side, each in the caches of
its core, and meet once per iteration of the optimizer.
"""

import functools
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PRNGKeyArray

from headway.config import PlannerConfig
from headway.cpus import num_cpus
from headway.models.compilation import in_each_precision
from headway.planning.returns import Dynamics, RolloutSettings, Share, candidate_returns
from headway.task import Task

LEAST = 5_000
"""Imagined steps of an iteration that a share must have to be worth its while."""


def num_shares(planner: PlannerConfig, num_envs: int) -> int:
    """Into how many shares the candidates of a plan are divided; 1 where they are not.

    They are on a CPU that is one device: where JAX has several devices, these share the candidates
    (`devices.spread_candidates`).

    Args:
        planner: Settings of the planner.
        num_envs: Environments that are planned for.
    """
    if jax.default_backend() != "cpu" or jax.device_count() > 1:
        return 1
    steps = num_envs * planner.num_candidates * planner.num_particles * planner.horizon
    return max(1, min(num_cpus(), steps // LEAST))


class Question(NamedTuple):
    """What is asked of all shares: the arguments of `candidate_returns`."""

    dynamics: Dynamics
    task: Task
    obs: Float[Array, "env obs"]
    candidates: Float[Array, "env candidate horizon action"]
    key: PRNGKeyArray


def returns_of_shares(
    question: Question, planner: PlannerConfig, shares: int
) -> list[Float[Array, "env share"]]:
    """The returns of candidates, in shares of one size; `joined` puts them together.

    Settings of JAX that a context manager makes for this thread do not reach the others.

    Args:
        question: Is a pytree of arrays and of what can be compared.
        planner: Settings of the planner.
        shares: Into how many to divide the candidates, at most.
    """
    total = question.candidates.shape[1]
    size = -(-total // shares)
    compiled = _COMPILED[planner.precision]
    settings = RolloutSettings.of(planner, question.dynamics.num_members)

    def of_share(first):
        start = np.int32(min(first, total - size))
        return jax.block_until_ready(compiled(question, start, size=size, settings=settings))

    others = [(first, _begun(of_share, first)) for first in range(size, total, size)]
    here = of_share(0)
    # What no thread has begun by now, because all are busy with other plans, is done here.
    return [here, *(of_share(i) if future.cancel() else future.result() for i, future in others)]


def _begun(of_share: Callable[[int], Any], first: int) -> Future:
    """A share that another thread computes, or that can be cancelled."""
    try:
        return _threads().submit(of_share, first)
    except RuntimeError:  # the interpreter is ending, and starts no more threads
        return Future()


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


_COMPILED = in_each_precision(_share_returns)


@functools.cache
def _threads() -> ThreadPoolExecutor:
    """Threads that wait for the programs they called; XLA computes in its own."""
    return ThreadPoolExecutor(max(1, num_cpus() - 1), thread_name_prefix="headway-share")
