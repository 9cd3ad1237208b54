"""Moments of data read part by part, against those of all data at once."""

import jax
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import toys
from headway.data import parts_of
from headway.models import dynamics
from headway.models.dynamics import Statistics
from headway.models.moments import Moments, merge_columns

lengths_lists = st.lists(st.integers(1, 40), min_size=1, max_size=6)


def merged(parts):
    return merge_columns((Moments.of(part),) for part in parts)[0]


@given(
    lengths_lists, st.sampled_from([0.0, 1.0, -1e6]), st.sampled_from([1e-3, 1.0, 1e4]), st.data()
)
def test_merged_moments_equal_those_of_all_values(lengths, offset, spread, data):
    rng = np.random.default_rng(data.draw(st.integers(0, 1000)))
    parts = [offset + spread * rng.normal(size=(n, 3)) for n in lengths]
    values = np.concatenate(parts)
    got = merged(parts)
    assert got.count == len(values)
    np.testing.assert_allclose(got.mean, values.mean(0), rtol=1e-13, atol=1e-13 * spread)
    np.testing.assert_allclose(got.std, values.std(0), rtol=1e-5, atol=1e-9 * spread)


def test_a_tiny_spread_about_a_large_mean_keeps_its_digits():
    rng = np.random.default_rng(0)
    parts = [1e6 + 1e-3 * rng.normal(size=(n, 2)) for n in (1000, 1, 10, 3000)]
    values = np.concatenate(parts)
    np.testing.assert_allclose(merged(parts).std, values.std(0), rtol=1e-7)
    naive = np.square(values).mean(0) - np.square(values.mean(0))
    assert not np.allclose(np.sqrt(np.abs(naive)), values.std(0), rtol=0.1)  # it is a hard case


def test_parts_that_lie_far_apart_are_merged_with_their_distance():
    parts = [np.full((3, 1), 0.0), np.full((1, 1), 8.0)]
    got = merged(parts)
    assert (got.mean[0], got.std[0]) == (2.0, np.sqrt(12.0))


def test_moments_of_one_part_are_numpys_to_the_bit():
    values = np.random.default_rng(0).normal(3.0, 2.0, (5000, 4)).astype(np.float32)
    got, exact = Moments.of(values), values.astype(np.float64)
    np.testing.assert_array_equal(got.mean, exact.mean(0))
    np.testing.assert_array_equal(got.std, exact.std(0))


@pytest.mark.parametrize("most", [1, 7, 20])
def test_statistics_are_the_same_however_the_data_are_cut(most, monkeypatch):
    task = toys.ScaledTask()
    trajectories = [toys.random_trajectory(n, seed=n, gain=n) for n in (3, 12, 1, 7, 9)]
    whole = Statistics.fit(task, trajectories, 3)
    monkeypatch.setattr(dynamics, "PART_TRANSITIONS", most)
    parts = Statistics.fit(task, trajectories, 3)
    for a, b in zip(jax.tree.leaves(whole), jax.tree.leaves(parts), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-6, atol=1e-7)


def test_statistics_never_hold_more_than_a_part(monkeypatch):
    seen = []
    monkeypatch.setattr(dynamics, "PART_TRANSITIONS", 20)
    original = dynamics.transition_moments

    def spying(task, part):
        seen.append(sum(map(len, part)))
        return original(task, part)

    monkeypatch.setattr(dynamics, "transition_moments", spying)
    Statistics.fit(toys.POINT, [toys.random_trajectory(n) for n in (6, 14, 1, 9, 10, 2)], 3)
    assert seen == [20, 20, 2]


@given(lengths_lists, st.integers(1, 60))
def test_parts_keep_order_and_stay_within_their_size(lengths, most):
    trajectories = [toys.random_trajectory(n, seed=n) for n in lengths]
    parts = list(parts_of(trajectories, most))
    assert [id(t) for part in parts for t in part] == [id(t) for t in trajectories]
    sizes = [sum(map(len, part)) for part in parts]
    assert all(size <= most or len(part) == 1 for size, part in zip(sizes, parts, strict=True))
    # Greedy: the next trajectory would not have fitted.
    for size, following in zip(sizes, parts[1:], strict=False):
        assert size + len(following[0]) > most
