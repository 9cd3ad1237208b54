"""Tricks that make plans fast, each measured (docs/performance.md). None changes a result.

On a CPU every core imagines a shard in a program of its own, some of the environments or, where
they are fewer than cores, some of the candidates: XLA divides every operation of one program among
threads, which wait for each other before the next operation; programs called from several threads
run side by side, each in the caches of its core, and meet once per iteration of the optimizer.
"""

import functools
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from headway.cpus import num_cpus

LEAST_STEPS = 5_000
"""Imagined steps of an iteration that a shard must have to be worth its while."""
CACHES = 4 * 2**20
"""Bytes that one array of activations may take on a CPU: more would leave its caches."""
CACHES_OF_CORE = 2**20
"""The same for a shard, which has one core's caches."""
GPU_ARRAYS = 8
"""Arrays of activations that a plan holds at most; one may take that part of free memory."""


class Shard(NamedTuple):
    """What one program imagines, with the noise that it has in the whole."""

    axis: int
    """0: some environments. 1: some candidates of all environments."""
    first: Any
    """Number of the first of them; a value, so that one program serves all shards."""
    size: int


def num_shards(num_steps: int) -> int:
    """Shards into which the candidates of a plan are divided; 1 where that gains nothing.

    Args:
        num_steps: Imagined steps of one iteration, over all environments.
    """
    if jax.default_backend() != "cpu":
        return 1
    return max(1, min(num_cpus(), num_steps // LEAST_STEPS))


def in_shards(
    returns_of: Callable[[Shard | None], Float[Array, "shard_env shard_candidate"]],
    shape: tuple[int, ...],
    shards: int,
) -> list[Float[Array, "shard_env shard_candidate"]]:
    """Compute returns in shards of one size, side by side; `joined` puts them together.

    JAX's settings that a context manager makes for this thread do not reach the others.

    Args:
        returns_of: Compiled: the returns of a shard, or of all for None.
        shape: Numbers of environments and of candidates.
        shards: Number of shards, at most.
    """
    if shards == 1:
        return [returns_of(None)]
    axis = 0 if shape[0] >= shards else 1
    total = shape[axis]
    size = -(-total // shards)

    def of_shard(first: int) -> Array:
        which = Shard(axis, np.int32(min(first, total - size)), size)
        return jax.block_until_ready(returns_of(which))

    def begin(first: int) -> Future:
        try:
            return _threads().submit(of_shard, first)
        except RuntimeError:  # the interpreter is ending, and starts no more threads
            return Future()

    others = [(first, begin(first)) for first in range(size, total, size)]
    here = of_shard(0)
    # A shard that no thread has begun by now, because all are busy with other plans, is done here.
    return [here, *(of_shard(i) if future.cancel() else future.result() for i, future in others)]


def joined(
    shards: list[Float[Array, "shard_env shard_candidate"]], shape: tuple[int, ...]
) -> Float[Array, "env candidate"]:
    """The returns of all; the last shard may overlap with the one before."""
    *before, last = shards
    axis = 0 if last.shape[0] < shape[0] else 1
    twice = len(shards) * last.shape[axis] - shape[axis]
    rest = jax.lax.slice_in_dim(last, twice, None, axis=axis)
    return jnp.concatenate([*before, rest], axis)


@functools.cache
def _threads() -> ThreadPoolExecutor:
    """Threads that wait for the programs they called; XLA computes in its own."""
    return ThreadPoolExecutor(max(1, num_cpus() - 1), thread_name_prefix="headway-shard")


def environments_at_once(num_envs: int, bytes_per_env: int, budget: int) -> int:
    """Environments that are imagined side by side, so that memory stays bounded.

    Args:
        num_envs: Environments in all.
        bytes_per_env: Size of one environment's widest array of activations.
        budget: Bytes that all of them may take together.

    Returns:
        At least 1; the environments are spread evenly over the fewest chunks that fit.
    """
    fitting = max(1, budget // bytes_per_env)
    chunks = -(-num_envs // fitting)
    return -(-num_envs // chunks)


def activation_budget() -> int:
    """Bytes that one array of activations may take in a program that has the device for itself."""
    stats = jax.local_devices()[0].memory_stats() or {}  # a CPU has none
    if "bytes_limit" not in stats:
        return CACHES
    return max(stats["bytes_limit"] - stats.get("bytes_in_use", 0), 0) // GPU_ARRAYS
