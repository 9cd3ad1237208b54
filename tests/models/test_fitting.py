"""Updates and epochs: finite and repeatable; heads separate what physics differ."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import toys
from headway.config import FittingConfig, MultiHeadedConfig
from headway.models.fitting import FitSetup, FitState, assign_segments, fit_epoch, make_data
from headway.models.multi_headed import MultiHeadDynamics, Statistics

LINEAR = MultiHeadedConfig(
    num_members=2, num_heads=2, hidden_sizes=(16,), context_size=0, backward_net=False
)


PLAIN = {"context_size": 0, "backward_net": False}  # compiles in half the time
PADDED = {"max_length": 9, "capacity": 3, "sample_capacity": 29}


def make_setup(history_length=3, **settings):
    return FitSetup(toys.POINT, FittingConfig(**settings), history_length)


def make_fit_data(trajectories, setup, *, members=2, statistics=None, **layout):
    episodes, samples = toys.lay_out(
        trajectories, future_length=setup.config.future_length, **layout
    )
    if statistics is None:
        statistics = Statistics.fit(toys.POINT, trajectories, setup.history_length)
    key = jax.random.key(9)
    return make_data(episodes, samples, statistics, setup.config, num_members=members, key=key)


def run_epochs(state, setup, data, epochs, *, independent=False, key=0):
    losses, skipped = [], 0
    for epoch_key in jax.random.split(jax.random.key(key), epochs):
        state, stats = fit_epoch(state, setup, data, independent=independent, key=epoch_key)
        losses.append(float(stats.loss))
        skipped += int(stats.skipped)
    return state, losses, skipped


def assert_trees_equal(first, second):
    for a, b in zip(jax.tree.leaves(first), jax.tree.leaves(second), strict=True):
        np.testing.assert_array_equal(a, b)


def assert_finite(tree):
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(tree))


def two_physics(num=8, steps=20):
    """Trajectories pushed along the action, and against it; the label is whether against."""
    labels = np.arange(num) % 2
    return [toys.random_trajectory(steps, i, 1.0 - 2.0 * k) for i, k in enumerate(labels)], labels


def fit_two_physics(oracle, key=0, epochs=40):
    trajectories, labels = two_physics()
    setup = make_setup(
        oracle=oracle, learning_rate=0.02, batch_size=64, future_length=1, weight_decay=0.0
    )
    data = make_fit_data(trajectories, setup)
    state = FitState.new(MultiHeadDynamics.init(LINEAR, toys.POINT, key=jax.random.key(key)))
    state, losses, skipped = run_epochs(
        state, setup, data, epochs, independent=oracle == "independent", key=key
    )
    assert skipped == 0
    return state, losses, data, setup, labels


@pytest.mark.parametrize("key", [0, 1])
def test_trajectory_oracle_gives_each_physics_its_own_head_in_every_member(key):
    state, losses, data, setup, labels = fit_two_physics("trajectory", key)
    heads = np.asarray(assign_segments(state.model, setup, data.episodes, data.statistics).forward)
    for member in heads[:, : len(labels)]:
        first = member[0, 0]
        np.testing.assert_array_equal(
            member, np.where(labels == labels[0], first, 1 - first)[:, None] * np.ones((1, 2))
        )
    assert losses[-1] < losses[0] - 2.0


def test_independent_loss_keeps_all_heads_at_the_average_of_the_physics():
    state, losses, data, *_ = fit_two_physics("independent")
    action = jnp.asarray(np.random.default_rng(0).uniform(-1, 1, (2, 50, 2)), jnp.float32)
    x = jnp.concatenate([jnp.zeros_like(action), data.statistics.action.normalize(action)], -1)
    mean = np.asarray(state.model.forward_net(x, None).mean)
    assert np.abs(mean).mean() < 0.5  # opposite pushes cancel; either physics alone has about 0.9
    best, *_ = fit_two_physics("trajectory")
    assert np.abs(np.asarray(best.model.forward_net(x, None).mean)).mean() > 0.7
    assert losses[-1] < losses[0]


def small_fit(*, switches=None, trajectories=None, **settings):
    """A model of few parts and some data, ready to fit; of the same shapes for all data."""
    settings = {"segment_length": 3, "batch_size": 8, "future_length": 2} | settings
    setup = make_setup(**settings)
    config = dataclasses.replace(toys.SMALL, hidden_sizes=(8,), **(switches or {}))
    trajectories = trajectories or [toys.random_trajectory(n, seed=n) for n in (9, 5)]
    state = FitState.new(toys.small_model(config=config))
    return state, setup, make_fit_data(trajectories, setup, members=config.num_members, **PADDED)


def test_same_key_gives_bit_equal_weights_and_another_key_does_not():
    state, setup, data = small_fit()
    first, losses, _ = run_epochs(state, setup, data, 3)
    again, same, _ = run_epochs(state, setup, data, 3)
    other, _, _ = run_epochs(state, setup, data, 3, key=1)
    assert_trees_equal(first, again)
    assert losses == same
    assert (
        first.model.forward_net.mean_heads.weight != other.model.forward_net.mean_heads.weight
    ).any()


@pytest.mark.parametrize(
    ("switches", "settings"),
    [
        (PLAIN | {"num_members": 1, "num_heads": 1}, {"reduction": "segment", "bootstrap": True}),
        ({"deterministic": True}, {"oracle": "transition", "bootstrap": True}),
    ],
    ids=str,
)
def test_every_switch_fits_without_nan_and_lowers_the_loss(switches, settings):
    state, setup, data = small_fit(switches=switches, learning_rate=1e-2, **settings)
    state, losses, skipped = run_epochs(state, setup, data, 8)
    assert skipped == 0
    assert_finite(state)
    assert losses[-1] < losses[0]


def test_a_constant_observation_dimension_and_one_step_episodes_give_no_nan():
    trajectories = [toys.random_trajectory(n, seed=n, constant=True) for n in (1, 6)]
    state, setup, data = small_fit(trajectories=trajectories)
    assert float(data.statistics.delta.std[1]) == 0.0
    state, losses, skipped = run_epochs(state, setup, data, 3)
    assert skipped == 0
    assert_finite(state)
    assert np.isfinite(losses).all()


def test_a_batch_larger_than_the_data_equals_a_batch_of_just_the_data():
    state, _, data = small_fit(switches=PLAIN)
    count = int(data.samples.count)
    exact, larger = (
        make_setup(segment_length=3, batch_size=size, future_length=2) for size in (count, 100)
    )
    key = jax.random.key(3)
    first, stats = fit_epoch(state, exact, data, independent=False, key=key)
    second, padded = fit_epoch(state, larger, data, independent=False, key=key)
    assert int(stats.updates) == int(padded.updates) == 1
    np.testing.assert_allclose(stats.loss, padded.loss, rtol=1e-5)
    for a, b in zip(jax.tree.leaves(first.model), jax.tree.leaves(second.model), strict=True):
        np.testing.assert_allclose(a, b, atol=2e-5)


def overflowing(steps, seed):
    """Finite data whose squared error is not a finite float32."""
    trajectory = toys.random_trajectory(steps, seed)
    obs = trajectory.obs.copy()
    obs[-1] = 1e25
    return dataclasses.replace(trajectory, obs=obs)


def test_only_the_update_with_non_finite_loss_is_skipped_and_counted():
    setup = make_setup(batch_size=4, future_length=1)
    config = dataclasses.replace(LINEAR, num_members=1)
    trajectories = [toys.random_trajectory(11), overflowing(1, 1)]
    data = make_fit_data(trajectories, setup, members=1, statistics=toys.identity_statistics())
    state = FitState.new(toys.small_model(config=config))
    fitted, stats = fit_epoch(state, setup, data, independent=True, key=jax.random.key(0))
    assert (int(stats.updates), int(stats.skipped)) == (3, 1)
    assert_finite(fitted)
    assert np.isfinite(stats.loss)
    assert np.isfinite(stats.forward_loss)
    assert int(fitted.optimizer[0].count) == 2
    assert (
        fitted.model.forward_net.mean_heads.weight != state.model.forward_net.mean_heads.weight
    ).any()


@pytest.mark.parametrize("precision", ["float32", "bfloat16"])
def test_an_epoch_of_nothing_but_non_finite_updates_leaves_everything_as_it_was(precision):
    state, setup, data = small_fit(switches=PLAIN, precision=precision)
    huge = dataclasses.replace(data.episodes, obs=1e25 * (1 + data.episodes.obs))
    data = data._replace(episodes=huge, statistics=toys.identity_statistics())
    fitted, stats = fit_epoch(state, setup, data, independent=True, key=jax.random.key(0))
    assert int(stats.skipped) == int(stats.updates) > 0
    assert_trees_equal(fitted, state)
    assert float(stats.loss) == 0.0


def test_padding_of_episodes_and_samples_changes_nothing():
    state, setup, data = small_fit()
    tight = fit_epoch(state, setup, data, independent=False, key=jax.random.key(0))[1]
    inside = np.arange(9) < np.asarray(data.episodes.length)[:, None]
    spoiled = dataclasses.replace(
        data.episodes, action=jnp.where(inside[..., None], data.episodes.action, jnp.nan)
    )
    loose = data._replace(episodes=spoiled)
    padded = fit_epoch(state, setup, loose, independent=False, key=jax.random.key(0))[1]
    assert int(padded.skipped) == 0
    np.testing.assert_array_equal(tight.loss, padded.loss)


def test_reported_loss_is_that_of_the_batch_before_its_update():
    setup = make_setup(batch_size=100, future_length=1, weight_decay=0.0, logvar_bound_weight=0.0)
    model = toys.linear_model([[np.eye(2), -np.eye(2)]])
    trajectory = toys.random_trajectory(10)
    data = make_fit_data([trajectory], setup, members=1, statistics=toys.identity_statistics())
    state = FitState.new(model)
    key = jax.random.key(0)
    _, independent = fit_epoch(state, setup, data, independent=True, key=key)
    _, oracle = fit_epoch(state, setup, data, independent=False, key=key)
    wrong = 4 * np.square(np.float64(trajectory.action)).mean()  # the other head's error
    np.testing.assert_allclose(independent.loss, wrong / 2, rtol=1e-4)
    np.testing.assert_allclose(oracle.forward_loss, 0.0, atol=1e-6)
