"""Standard normal draws of imagined steps: the numbers of `jax.random.normal`, faster on CPUs.

On CPUs JAX runs the rounds of its generator in a loop, which takes three times as long as one
after the other. Here they stand one after the other.
"""

import math
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PRNGKeyArray, UInt32

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

    Args:
        key: Of any of JAX's generators.
        shape: Of the whole.
        start: Where in the whole the block begins, along each axis.
        size: Of the block, which lies within the whole.
    """
    ours = jax.default_backend() == "cpu" and str(jax.random.key_impl(key)) == "threefry2x32"
    settings: Any = jax.config  # JAX declares its settings while running
    if not ours or not settings.jax_threefry_partitionable or math.prod(shape) >= _WORDS:
        whole = jax.random.normal(key, shape)
        return whole if whole.shape == tuple(size) else jax.lax.dynamic_slice(whole, start, size)
    return _normal_of_bits(_bits(key, shape, start, size))


def _bits(
    key: PRNGKeyArray,
    shape: Sequence[int],
    start: Sequence[int | Int[Array, ""]],
    size: Sequence[int],
) -> UInt32[Array, "*size"]:
    """32 random bits for each place of a block; a place's counter is its index in the whole."""
    strides = np.cumprod((1, *tuple(shape)[:0:-1]), dtype=np.uint32)[::-1]
    count = jnp.zeros(size, jnp.uint32)
    for axis, stride in enumerate(strides):
        places = jax.lax.broadcasted_iota(jnp.uint32, tuple(size), axis)
        count += (places + jnp.asarray(start[axis], jnp.uint32)) * stride
    first, second = threefry2x32(jax.random.key_data(key), jnp.zeros_like(count), count)
    return first ^ second


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


def _normal_of_bits(bits: UInt32[Array, "*shape"]) -> Float[Array, "*shape"]:
    """Normal draws of 23 of the bits, through the inverse error function."""
    one = np.float32(1.0).view(np.uint32)
    unit = jax.lax.bitcast_convert_type(bits >> 9 | one, jnp.float32) - 1.0
    low = np.nextafter(np.float32(-1.0), np.float32(0.0))
    uniform = jnp.maximum(low, unit * (np.float32(1.0) - low) + low)
    return np.float32(np.sqrt(2.0)) * jax.lax.erf_inv(uniform)
