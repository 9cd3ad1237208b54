"""Tricks that make plans fast, each measured (docs/performance.md). None changes a result.

On a CPU every core imagines a shard in a program of its own, some of the environments or, where
they are fewer than cores, some of the candidates: XLA divides every operation of one program among
threads, which wait for each other before the next operation; programs called from several threads
run side by side, each in the caches of its core, and meet once per iteration of the optimizer.
"""

import functools
import math
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PRNGKeyArray, UInt32

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
    stats = None
    if jax.default_backend() != "cpu":
        stats = jax.local_devices()[0].memory_stats()
    if not stats or "bytes_limit" not in stats:
        return CACHES
    return max(stats["bytes_limit"] - stats.get("bytes_in_use", 0), 0) // GPU_ARRAYS


_ROTATIONS = ((13, 15, 26, 6), (17, 29, 16, 24))
_PARITY = 0x1BD11BDA
_WORDS = 2**32
"""Draws after which the second word of the counter would begin."""


def normal_block(
    key: PRNGKeyArray,
    shape: Sequence[int],
    start: Sequence[int | Int[Array, ""]],
    size: Sequence[int],
) -> Float[Array, "*size"]:
    """A block of `jax.random.normal(key, shape)`, mostly without drawing the rest.

    On CPUs JAX runs the rounds of its generator in a loop, which takes three times as long as one
    after the other. Here they stand one after the other; a place's counter is its index in the
    whole.

    Args:
        key: Of any of JAX's generators.
        shape: Of the whole.
        start: Where in the whole the block begins, along each axis.
        size: Of the block, which lies within the whole.
    """
    ours = jax.default_backend() == "cpu" and str(jax.random.key_impl(key)) == "threefry2x32"
    settings: Any = jax.config  # JAX declares its settings while running
    if not ours or not settings.jax_threefry_partitionable or math.prod(shape) >= _WORDS:
        whole = jax.random.normal(key, shape, jnp.float32)
        return whole if whole.shape == tuple(size) else jax.lax.dynamic_slice(whole, start, size)
    strides = np.cumprod((1, *tuple(shape)[:0:-1]), dtype=np.uint32)[::-1]
    count = jnp.zeros(size, jnp.uint32)
    for axis, stride in enumerate(strides):
        places = jax.lax.broadcasted_iota(jnp.uint32, tuple(size), axis)
        count += (places + jnp.asarray(start[axis], jnp.uint32)) * stride
    first, second = threefry2x32(jax.random.key_data(key), jnp.zeros_like(count), count)
    # 23 of the bits are a number in [-1, 1), and through the inverse error function a normal one.
    one = np.float32(1.0).view(np.uint32)
    unit = jax.lax.bitcast_convert_type((first ^ second) >> 9 | one, jnp.float32) - 1.0
    low = np.nextafter(np.float32(-1.0), np.float32(0.0))
    uniform = jnp.maximum(low, unit * (np.float32(1.0) - low) + low)
    return np.float32(np.sqrt(2.0)) * jax.lax.erf_inv(uniform)


def threefry2x32(
    key: UInt32[Array, "2"], high: UInt32[Array, "*shape"], low: UInt32[Array, "*shape"]
) -> tuple[UInt32[Array, "*shape"], UInt32[Array, "*shape"]]:
    """The Threefry block cipher of two 32-bit words and 20 rounds (Salmon et al., SC 2011)."""
    keys = key[0], key[1], key[0] ^ key[1] ^ jnp.uint32(_PARITY)
    high, low = high + keys[0], low + keys[1]
    for group in range(5):
        for rotation in _ROTATIONS[group % 2]:
            high = high + low
            low = (low << rotation | low >> (32 - rotation)) ^ high
        high = high + keys[(group + 1) % 3]
        low = low + keys[(group + 2) % 3] + jnp.uint32(group + 1)
    return high, low
