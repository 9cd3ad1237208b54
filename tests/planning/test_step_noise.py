"""The noise of imagined steps against JAX's own generator, and known blocks of its cipher."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from headway.planning.noise import normal_block, threefry2x32


def normal(key, shape):
    return normal_block(key, shape, [0] * len(shape), shape)


@pytest.mark.parametrize("shape", [(1,), (3,), (2, 7, 3), (5, 4, 2, 25), (1, 1, 1, 1)])
def test_draws_are_those_of_jax(shape):
    key = jax.random.key(7)
    np.testing.assert_array_equal(normal(key, shape), jax.random.normal(key, shape))


def test_draws_of_another_generator_are_those_of_jax_too():
    key = jax.random.key(8, impl="rbg")
    np.testing.assert_array_equal(normal(key, (2, 5)), jax.random.normal(key, (2, 5)))


def test_draws_of_many_keys_at_once_are_those_of_each():
    keys = jax.random.split(jax.random.key(1), 3)
    together = jax.vmap(lambda key: normal(key, (2, 5)))(keys)
    np.testing.assert_array_equal(together, [jax.random.normal(key, (2, 5)) for key in keys])


@pytest.mark.parametrize("impl", ["threefry2x32", "rbg"])
def test_a_block_is_that_of_the_whole(impl):
    key = jax.random.key(9, impl=impl)
    whole = jax.random.normal(key, (4, 3, 2, 10))
    block = jax.jit(lambda start: normal_block(key, whole.shape, (start, 0, 1, 5), (2, 3, 1, 4)))
    np.testing.assert_array_equal(block(1), whole[1:3, :, 1:, 5:9])


@pytest.mark.parametrize(
    ("key", "counter", "block"),
    [
        ((0, 0), (0, 0), (0x6B200159, 0x99BA4EFE)),
        ((2**32 - 1, 2**32 - 1), (2**32 - 1, 2**32 - 1), (0x1CB996FC, 0xBB002BE7)),
        ((0x13198A2E, 0x03707344), (0x243F6A88, 0x85A308D3), (0xC4923A9C, 0x483DF7A0)),
    ],
)
def test_known_answers_of_the_cipher(key, counter, block):
    """Those that its authors publish with Random123 (kat_vectors, threefry 2x32, 20 rounds)."""
    found = threefry2x32(jnp.asarray(key, jnp.uint32), *map(jnp.uint32, counter))
    assert tuple(int(word) for word in found) == block
