"""Fits: best heads, shuffles, updates and epochs; heads separate what physics differ."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

import toys
from headway.config import MultiHeadedConfig
from headway.models.fitting import FitState, assign_segments, fit_epoch, gather_batch, permutations
from headway.models.losses import Assignment
from headway.models.multi_headed import MultiHeadNet

UP, DOWN = np.eye(2), -np.eye(2)
IDENTITY = toys.identity_statistics()
LINEAR = MultiHeadedConfig(
    num_members=2, num_heads=2, hidden_sizes=(16,), context_size=0, backward_net=False
)
PLAIN = {"context_size": 0, "backward_net": False}  # compiles in half the time
PADDED = {"max_length": 9, "capacity": 3, "sample_capacity": 29}


# The best head of each segment, and the samples of an update.


def assign(model, episodes, statistics, **settings):
    return assign_segments(model, toys.make_setup(**settings), episodes, statistics)


@pytest.mark.parametrize("segment", [1, 3, 10])
def test_known_physics_go_to_the_head_that_knows_them_member_by_member(segment):
    gains, lengths = [1.0, -1.0, -1.0, 1.0], [7, 1, 10, 4]
    trajectories = [
        toys.random_trajectory(n, seed=i, gain=g)
        for i, (n, g) in enumerate(zip(lengths, gains, strict=True))
    ]
    episodes, _ = toys.lay_out(trajectories, max_length=11)
    model = toys.linear_model([[UP, DOWN], [DOWN, UP]])
    got = assign(model, episodes, IDENTITY, segment_length=segment)
    assert got.backward is None
    wanted = np.zeros((2, 5, -(-11 // segment)))
    for row, (length, gain) in enumerate(zip(lengths, gains, strict=True)):
        wanted[int(gain > 0), row, : -(-length // segment)] = 1
    np.testing.assert_array_equal(got.forward, wanted)


def test_a_segment_goes_to_the_head_that_is_best_on_the_whole_of_it():
    model = toys.linear_model([[UP, DOWN]])
    mixed = toys.random_trajectory(10)  # pushed up, except in its last step
    obs = mixed.obs.copy()
    obs[10] = obs[9] - mixed.action[9]
    episodes, _ = toys.lay_out([dataclasses.replace(mixed, obs=obs)])
    whole, single = (
        assign(model, episodes, IDENTITY, segment_length=10, oracle=oracle).forward[0, 0]
        for oracle in ("trajectory", "transition")
    )
    np.testing.assert_array_equal(whole, [0])
    np.testing.assert_array_equal(single, [0] * 9 + [1])


def test_directions_are_assigned_independently_and_nothing_behind_an_episodes_end_counts():
    model, statistics = toys.small_model(), toys.odd_statistics()
    trajectories = [toys.random_trajectory(n, seed=n) for n in (4, 7)]
    episodes, _ = toys.lay_out(trajectories, capacity=3, max_length=9)
    inside = np.arange(9) < np.asarray(episodes.length)[:, None]
    spoiled = dataclasses.replace(
        episodes,
        action=jnp.where(inside[..., None], episodes.action, jnp.nan),
        obs=episodes.obs.at[0, 5:].set(jnp.nan).at[1, 8:].set(1e9).at[2].set(jnp.nan),
    )
    found = assign(model, episodes, statistics, segment_length=3)
    assert (np.asarray(found.forward) != np.asarray(found.backward)).any()
    toys.assert_equal(found, assign(model, spoiled, statistics, segment_length=3))


def test_a_sample_has_its_own_transition_but_its_anchors_history_and_head():
    trajectories = [toys.random_trajectory(n, seed=n) for n in (5, 8)]
    setup = toys.make_setup(segment_length=2, future_length=3)
    data = toys.fit_data(trajectories, setup)
    heads = jnp.arange(24).reshape(2, 3, 4)  # all different, to tell the segments apart
    order = jnp.tile(jnp.arange(int(data.samples.count))[::-1], (2, 1))
    assignment = Assignment(heads, 100 - heads)
    batch, owners = gather_batch(data, assignment, order, jnp.ones(order.shape), setup)
    table = np.stack(data.samples[:3], axis=-1)[: order.shape[1]][::-1]
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
    setup = toys.make_setup(bootstrap=True, future_length=2)
    data = toys.fit_data([toys.random_trajectory(40)], setup, sample_capacity=200)
    count = int(data.samples.count)
    rows = np.asarray(data.rows)[:, :count]
    assert rows.max() < count
    assert all(0.45 < len(set(row)) / count < 0.8 for row in rows)  # 1 - 1/e of all samples
    assert (rows[0] != rows[1]).any()


# Orders in which samples are learned from.

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
    assert (order == np.arange(count)).sum() < 8  # a Poisson variable of mean 1


def test_keys_and_members_have_their_own_orders():
    first, second = (permutations(jax.random.key(key), (2, 100), 100) for key in (0, 1))
    assert (first[0] != first[1]).mean() > 0.9
    assert (first != second).mean() > 0.9


# Epochs.


def run_epochs(state, setup, data, epochs, *, key=0):
    losses, skipped = [], 0
    for epoch_key in jax.random.split(jax.random.key(key), epochs):
        state, stats = fit_epoch(state, setup, data, independent=False, key=epoch_key)
        losses.append(float(stats.loss))
        skipped += int(stats.skipped)
    return state, losses, skipped


@pytest.mark.parametrize("key", [0, 1])
def test_trajectory_oracle_gives_each_physics_its_own_head_in_every_member(key):
    """Half of the trajectories are pushed along the action, and half against it."""
    gains = np.tile([1.0, -1.0], 4)
    trajectories = [toys.random_trajectory(20, i, gain) for i, gain in enumerate(gains)]
    setup = toys.make_setup(learning_rate=0.02, batch_size=64, future_length=1, weight_decay=0.0)
    data = toys.fit_data(trajectories, setup)
    state = FitState.new(MultiHeadNet.init(LINEAR, toys.POINT, key=jax.random.key(key)))
    state, losses, skipped = run_epochs(state, setup, data, 40, key=key)
    assert skipped == 0
    assert losses[-1] < losses[0] - 2.0
    heads = np.asarray(assign_segments(state.model, setup, data.episodes, data.statistics).forward)
    for member in heads[:, : len(gains)]:
        wanted = np.where(gains == gains[0], member[0, 0], 1 - member[0, 0])
        np.testing.assert_array_equal(member, np.tile(wanted[:, None], 2))


def small_fit(*, switches=None, trajectories=None, **settings):
    """A model of few parts and some data, ready to fit; of the same shapes for all data."""
    settings = {"segment_length": 3, "batch_size": 8, "future_length": 2} | settings
    setup = toys.make_setup(**settings)
    config = dataclasses.replace(toys.SMALL, hidden_sizes=(8,), **(switches or {}))
    trajectories = trajectories or [toys.random_trajectory(n, seed=n) for n in (9, 5)]
    data = toys.fit_data(trajectories, setup, members=config.num_members, **PADDED)
    return FitState.new(toys.small_model(config=config)), setup, data


def test_same_key_gives_bit_equal_weights_and_another_key_does_not():
    state, setup, data = small_fit()
    first, losses, _ = run_epochs(state, setup, data, 3)
    again, same, _ = run_epochs(state, setup, data, 3)
    other, _, _ = run_epochs(state, setup, data, 3, key=1)
    toys.assert_equal(first, again)
    assert losses == same
    weights = (one.model.forward_net.mean_heads.weight for one in (first, other))
    assert (next(weights) != next(weights)).any()


def test_a_fit_in_reduced_precision_learns_the_same():
    trajectories = [toys.random_trajectory(20, seed=seed) for seed in range(4)]
    state = FitState.new(MultiHeadNet.init(toys.SMALL, toys.POINT, key=jax.random.key(0)))
    losses = []
    for precision in ("float32", "bfloat16"):
        setup = toys.make_setup(
            precision=precision, future_length=2, segment_length=4, batch_size=16
        )
        data = toys.fit_data(trajectories, setup)
        fitted, found, _ = run_epochs(state, setup, data, 15)
        assert jax.tree.structure(fitted) == jax.tree.structure(state)
        losses.append(found)
    full, reduced = losses
    assert full != reduced
    assert full[-1] < full[0] - 0.2
    np.testing.assert_allclose(reduced, full, atol=0.03 * (full[0] - full[-1]))


def test_a_constant_observation_dimension_and_one_step_episodes_give_no_nan():
    trajectories = [toys.random_trajectory(n, seed=n, constant=True) for n in (1, 6)]
    state, setup, data = small_fit(trajectories=trajectories)
    assert float(data.statistics.delta.std[1]) == 0.0
    state, losses, skipped = run_epochs(state, setup, data, 3)
    assert skipped == 0
    toys.assert_finite((state, losses))


def test_a_batch_larger_than_the_data_equals_a_batch_of_just_the_data():
    state, _, data = small_fit(switches=PLAIN)
    found = []
    for size in (int(data.samples.count), 100):
        setup = toys.make_setup(segment_length=3, batch_size=size, future_length=2)
        key = jax.random.key(3)
        fitted, stats = fit_epoch(state, setup, data, independent=False, key=key)
        assert int(stats.updates) == 1
        found.append((fitted.model, stats.loss))
    toys.assert_close(*found, rtol=1e-5, atol=2e-5)


def test_only_the_update_with_non_finite_loss_is_skipped_and_counted():
    setup = toys.make_setup(batch_size=4, future_length=1)
    broken = toys.random_trajectory(1, 1)
    broken.obs[-1] = 1e25  # finite, but its squared error is not
    trajectories = [toys.random_trajectory(11), broken]
    data = toys.fit_data(trajectories, setup, members=1, statistics=IDENTITY)
    state = FitState.new(toys.small_model(config=dataclasses.replace(LINEAR, num_members=1)))
    fitted, stats = fit_epoch(state, setup, data, independent=True, key=jax.random.key(0))
    assert (int(stats.updates), int(stats.skipped)) == (3, 1)
    toys.assert_finite((fitted, stats))
    assert int(fitted.optimizer[0].count) == 2
    weights = (one.model.forward_net.mean_heads.weight for one in (fitted, state))
    assert (next(weights) != next(weights)).any()


@pytest.mark.parametrize("precision", ["float32", "bfloat16"])
def test_an_epoch_of_nothing_but_non_finite_updates_leaves_everything_as_it_was(precision):
    state, setup, data = small_fit(switches=PLAIN, precision=precision)
    huge = dataclasses.replace(data.episodes, obs=1e25 * (1 + data.episodes.obs))
    data = data._replace(episodes=huge, statistics=IDENTITY)
    fitted, stats = fit_epoch(state, setup, data, independent=True, key=jax.random.key(0))
    assert int(stats.skipped) == int(stats.updates) > 0
    toys.assert_equal(fitted, state)
    assert float(stats.loss) == 0.0


def test_reported_loss_is_that_of_the_batch_before_its_update():
    setup = toys.make_setup(
        batch_size=100, future_length=1, weight_decay=0.0, logvar_bound_weight=0.0
    )
    trajectory = toys.random_trajectory(10)
    data = toys.fit_data([trajectory], setup, members=1, statistics=IDENTITY)
    state = FitState.new(toys.linear_model([[UP, DOWN]]))
    independent, oracle = (
        fit_epoch(state, setup, data, independent=each, key=jax.random.key(0))[1]
        for each in (True, False)
    )
    wrong = 4 * np.square(np.float64(trajectory.action)).mean()  # the other head's error
    np.testing.assert_allclose(independent.loss, wrong / 2, rtol=1e-4)
    np.testing.assert_allclose(oracle.forward_loss, 0.0, atol=1e-6)
