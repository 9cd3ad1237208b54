"""The orders in which samples are learned from: permutations, and evenly drawn ones."""

import jax
import jax.numpy as jnp
import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from headway.models.fitting import permutations

drawn = jax.jit(permutations, static_argnums=1)


@given(st.integers(0, 2**31), st.integers(0, 300))
def test_orders_hold_every_number_once_and_the_rest_stays(seed, count):
    orders = np.asarray(drawn(jax.random.key(seed), (3, 300), count))
    np.testing.assert_array_equal(np.sort(orders[:, :count]), np.tile(np.arange(count), (3, 1)))
    np.testing.assert_array_equal(orders[:, count:], np.tile(np.arange(count, 300), (3, 1)))


def test_all_orders_of_four_are_equally_likely():
    orders = np.asarray(permutations(jax.random.key(0), (24_000, 4), 4))
    _, found = np.unique(orders, axis=0, return_counts=True)
    assert len(found) == 24
    assert stats.chisquare(found).pvalue > 1e-3


def test_a_long_order_looks_like_one_of_numpys():
    """Distances between neighbors, inversions against the old place: as of a uniform order."""
    count = 50_000
    order = np.asarray(permutations(jax.random.key(2), (1, 60_000), count))[0, :count]
    steps = np.abs(np.diff(order))
    expected = np.abs(np.diff(np.random.default_rng(0).permutation(count)))
    assert stats.ks_2samp(steps, expected).pvalue > 1e-3
    assert abs(stats.spearmanr(np.arange(count), order).statistic) < 4 / np.sqrt(count)
    fixed = int((order == np.arange(count)).sum())
    assert fixed < 8  # a Poisson variable of mean 1


def test_keys_and_members_have_their_own_orders():
    ours = permutations(jax.random.key(0), (2, 100), 100)
    assert (ours[0] != ours[1]).mean() > 0.9
    assert (ours != permutations(jax.random.key(1), (2, 100), 100)).mean() > 0.9
    assert jnp.array_equal(ours, permutations(jax.random.key(0), (2, 100), 100))
