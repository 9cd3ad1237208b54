"""Random orders of samples, without sorting.

The swap-or-not shuffle (Hoang, Morris and Rogaway, CRYPTO 2012) moves every number by itself: each
of several rounds pairs the numbers below `count` at random and swaps each pair or not, by a coin
that both of them compute. Sorting random draws took twenty times as long on a CPU
(`docs/performance.md`).
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Int, PRNGKeyArray, UInt32

ROUNDS = 32
"""Each moves a number with probability one half."""


def permutations(
    key: PRNGKeyArray, shape: tuple[int, int], count: int | Int[Array, ""]
) -> Int[Array, "member sample"]:
    """An order of the numbers below `count` for each member; the others keep their place.

    Args:
        key: Draws the orders.
        shape: Members, and numbers of each.
        count: How many of the numbers are put in a random order.
    """
    pivot_key, salt_key = jax.random.split(key)
    each_round = (ROUNDS, shape[0], 1)
    pivots = jax.random.randint(pivot_key, each_round, 0, jnp.maximum(count, 1))
    salts = jax.random.bits(salt_key, each_round, jnp.uint32)
    places = jnp.broadcast_to(jnp.arange(shape[1]), shape)

    def swap_or_not(order, drawn):
        pivot, salt = drawn
        partner = pivot - order
        partner = jnp.where(partner < 0, partner + count, partner)
        return jnp.where(_coin(jnp.maximum(order, partner), salt), partner, order), None

    order, _ = jax.lax.scan(swap_or_not, places, (pivots, salts))
    return jnp.where(places < count, order, places)


def _coin(number: Int[Array, "*shape"], salt: UInt32[Array, "*#shape"]) -> Array:
    """A fair coin for every number: the first bit of MurmurHash3's final mix."""
    bits = number.astype(jnp.uint32) ^ salt
    bits = (bits ^ (bits >> 16)) * jnp.uint32(0x85EBCA6B)
    bits = (bits ^ (bits >> 13)) * jnp.uint32(0xC2B2AE35)
    return bits >> 31 == 1
