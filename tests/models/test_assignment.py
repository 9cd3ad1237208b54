"""The best head of each segment, and the samples of an update."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import toys
from headway.config import FittingConfig
from headway.models.fitting import FitSetup, assign_segments, gather_batch, make_data
from headway.models.losses import Assignment

UP, DOWN = np.eye(2), -np.eye(2)
STATISTICS = toys.identity_statistics()


def setup(**settings):
    return FitSetup(toys.POINT, FittingConfig(**settings), history_length=3)


def data_of(trajectories, *, members=2, config=None, key=0, **layout):
    episodes, samples = toys.lay_out(trajectories, **layout)
    return make_data(
        episodes,
        samples,
        STATISTICS,
        config or FittingConfig(),
        num_members=members,
        key=jax.random.key(key),
    )


@pytest.mark.parametrize("segment", [1, 3, 10])
def test_known_physics_go_to_the_head_that_knows_them_member_by_member(segment):
    model = toys.linear_model([[UP, DOWN], [DOWN, UP]])
    gains, lengths = [1.0, -1.0, -1.0, 1.0], [7, 1, 10, 4]
    trajectories = [
        toys.random_trajectory(n, seed=i, gain=g)
        for i, (n, g) in enumerate(zip(lengths, gains, strict=True))
    ]
    episodes, _ = toys.lay_out(trajectories, max_length=11)
    got = assign_segments(model, setup(segment_length=segment), episodes, STATISTICS)
    assert got.backward is None
    assert got.forward.shape == (2, 5, -(-11 // segment))
    for row, (length, gain) in enumerate(zip(lengths, gains, strict=True)):
        used = -(-length // segment)
        wanted = int(gain < 0)
        np.testing.assert_array_equal(got.forward[0, row, :used], wanted)
        np.testing.assert_array_equal(got.forward[1, row, :used], 1 - wanted)
        np.testing.assert_array_equal(got.forward[:, row, used:], 0)


def test_a_segment_goes_to_the_head_that_is_best_on_the_whole_of_it():
    model = toys.linear_model([[UP, DOWN]])
    mixed = toys.random_trajectory(10)  # pushed up, except in its last step
    obs = mixed.obs.copy()
    obs[10] = obs[9] - mixed.action[9]
    episodes, _ = toys.lay_out([dataclasses.replace(mixed, obs=obs)])
    whole = assign_segments(model, setup(segment_length=10), episodes, STATISTICS).forward
    single = assign_segments(model, setup(segment_length=1), episodes, STATISTICS).forward
    np.testing.assert_array_equal(whole[0, 0], [0])
    np.testing.assert_array_equal(single[0, 0], [0] * 9 + [1])


def test_directions_are_assigned_independently():
    found = assign_segments(
        toys.small_model(),
        setup(segment_length=1),
        toys.lay_out([toys.random_trajectory(20)])[0],
        toys.odd_statistics(),
    )
    assert (np.asarray(found.forward) != np.asarray(found.backward)).any()


def test_what_lies_behind_an_episodes_end_changes_no_assignment():
    model, statistics = toys.small_model(), toys.odd_statistics()
    trajectories = [toys.random_trajectory(n, seed=n) for n in (4, 7)]
    episodes, _ = toys.lay_out(trajectories, capacity=3, max_length=9)
    inside = np.arange(9) < np.asarray(episodes.length)[:, None]
    spoiled = dataclasses.replace(
        episodes,
        action=jnp.where(inside[..., None], episodes.action, jnp.nan),
        obs=episodes.obs.at[0, 5:].set(jnp.nan).at[1, 8:].set(1e9).at[2].set(jnp.nan),
    )
    for a, b in zip(
        assign_segments(model, setup(segment_length=3), episodes, statistics),
        assign_segments(model, setup(segment_length=3), spoiled, statistics),
        strict=True,
    ):
        np.testing.assert_array_equal(a, b)


def test_a_sample_has_its_own_transition_but_its_anchors_history_and_head():
    trajectories = [toys.random_trajectory(n, seed=n) for n in (5, 8)]
    data = data_of(trajectories, future_length=3)
    heads = jnp.arange(24).reshape(2, 3, 4)  # all different, to tell the segments apart
    count = int(data.samples.count)
    order = jnp.tile(jnp.arange(count)[::-1], (2, 1))
    weight = jnp.ones(order.shape)
    batch, owners = gather_batch(
        data, Assignment(heads, 100 - heads), order, weight, setup(segment_length=2)
    )
    table = np.stack(data.samples[:3], axis=-1)[:count][::-1]
    assert (table[:, 2] > 0).any()
    for i, (episode, anchor, offset) in enumerate(table):
        trajectory, step = trajectories[episode], anchor + offset
        past = data.episodes.history(*map(jnp.asarray, (episode, anchor)), 3)
        for member in range(2):
            np.testing.assert_array_equal(batch.obs[member, i], trajectory.obs[step])
            np.testing.assert_array_equal(batch.action[member, i], trajectory.action[step])
            np.testing.assert_array_equal(batch.next_obs[member, i], trajectory.obs[step + 1])
            np.testing.assert_array_equal(batch.history.action[member, i], past.action)
            np.testing.assert_array_equal(batch.history.obs_diff[member, i], past.obs_diff)
            assert owners.forward[member, i] == heads[member, episode, anchor // 2]
            assert owners.backward[member, i] == 100 - heads[member, episode, anchor // 2]


def test_bootstrap_draws_valid_samples_with_replacement_anew_for_each_member():
    trajectories = [toys.random_trajectory(40)]
    data = data_of(trajectories, config=FittingConfig(bootstrap=True), sample_capacity=200)
    count = int(data.samples.count)
    rows = np.asarray(data.rows)[:, :count]
    assert rows.max() < count
    distinct = [len(set(row)) / count for row in rows]
    assert all(0.45 < share < 0.8 for share in distinct)  # 1 - 1/e of all samples
    assert (rows[0] != rows[1]).any()
