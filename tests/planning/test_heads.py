"""Which head plans: the best on the last N transitions, and nothing older."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import toys
from headway.config import PlannerConfig
from headway.models.dynamics import GaussianNet, MultiHeadDynamics
from headway.models.networks import DenseHeads, Normalizer
from headway.planning.heads import RecentTransitions, head_errors, select_heads

UP, DOWN = 1.0, -1.0
MODEL = toys.linear_model([[np.eye(2), -np.eye(2)], [-np.eye(2), np.eye(2)]])
UP_HEADS, DOWN_HEADS = [0, 1], [1, 0]  # the heads of the two members that know each physics
SLOTS = 6


def remember(pushes, *, num_slots=SLOTS):
    """The transitions of one environment whose pushes went up or down, by any size."""
    rng = np.random.default_rng(0)
    recent = RecentTransitions.empty(1, num_slots, toys.POINT)
    obs = jnp.zeros((1, 2))
    for push in pushes:
        action = jnp.asarray(rng.uniform(0.5, 1, (1, 2)), jnp.float32)
        recent = recent.push(obs, action, obs + push * action, jnp.asarray([True]))
        obs = obs + push * action
    return recent


@eqx.filter_jit
def errors_and_use(model, statistics, recent, config):
    slots, used = recent.newest(config)
    sampling = jax.random.key(7) if config.selection_error == "sampled" else None
    errors = head_errors(model, toys.POINT, statistics, slots, None, sampling_key=sampling)
    return errors, used


def choose(pushes, *, model=MODEL, statistics=None, key=0, **settings):
    config = PlannerConfig(**settings)
    statistics = statistics or toys.identity_statistics()
    errors, used = errors_and_use(model, statistics, remember(pushes), config)
    return select_heads(errors, used, key=jax.random.key(key))[0].tolist()


def spread_over_keys(pushes, **settings):
    return {tuple(choose(pushes, key=key, **settings)) for key in range(30)}


@pytest.mark.parametrize(
    ("pushes", "length", "expected"),
    [
        ([UP] * 5 + [DOWN], 1, DOWN_HEADS),
        ([DOWN] * 5 + [UP], 1, UP_HEADS),
        ([-9.0, UP, UP, UP], 3, UP_HEADS),
        ([-9.0, UP, UP, UP], 4, DOWN_HEADS),
        ([UP, UP, UP, -9.0], 3, DOWN_HEADS),
        ([UP], 5, UP_HEADS),
        ([DOWN, DOWN], 5, DOWN_HEADS),
        ([-9.0] + [UP] * 6, 6, UP_HEADS),
    ],
)
def test_each_member_takes_the_head_that_is_best_on_the_last_n_and_no_older(
    pushes, length, expected
):
    assert choose(pushes, selection_length=length) == expected


@pytest.mark.parametrize(
    ("pushes", "length", "expected"),
    [
        ([UP, UP, -9.0], 3, UP_HEADS),
        ([-9.0, UP, UP, -9.0], 3, UP_HEADS),
        ([-9.0, UP, UP, -9.0], 4, DOWN_HEADS),
        ([UP, -9.0], 6, UP_HEADS),
    ],
)
def test_skipping_the_newest_leaves_the_n_minus_one_before_it(pushes, length, expected):
    found = choose(pushes, selection_length=length, selection_skips_newest=True)
    assert found == expected


def test_head_is_random_per_member_when_nothing_is_remembered():
    assert spread_over_keys([]) == {(0, 0), (0, 1), (1, 0), (1, 1)}


def test_head_is_random_when_only_the_skipped_newest_is_remembered():
    assert len(spread_over_keys([UP], selection_skips_newest=True)) == 4
    assert spread_over_keys([UP, UP], selection_skips_newest=True) == {tuple(UP_HEADS)}
    assert spread_over_keys([UP]) == {tuple(UP_HEADS)}


def noisy_heads(gains, stds):
    """One member whose heads have known gains and noise."""
    net = toys.linear_model([gains]).forward_net
    heads = len(stds)
    bias = jnp.broadcast_to(2 * jnp.log(jnp.asarray(stds))[None, :, None], (1, heads, 2))
    logvar = DenseHeads(jnp.zeros(net.mean_heads.weight.shape), bias)
    bounds = jnp.full((heads, 2), 20.0), jnp.full((heads, 2), -60.0)
    return MultiHeadDynamics(GaussianNet(net.hidden, net.mean_heads, logvar, *bounds), None, None)


def test_sampled_error_is_squared_bias_plus_variance_and_the_mean_error_is_bias_alone():
    model = noisy_heads([1.2 * np.eye(2), np.eye(2)], [1e-6, 0.5])
    recent = remember([UP] * SLOTS)
    statistics = toys.identity_statistics()
    plain = head_errors(model, toys.POINT, statistics, recent, None)
    sampled = head_errors(
        model, toys.POINT, statistics, recent, None, sampling_key=jax.random.key(0)
    )
    assert plain.shape == sampled.shape == (1, 1, 2, SLOTS)
    bias = np.square(0.2 * np.asarray(recent.action[0])).mean(-1)
    np.testing.assert_allclose(plain[0, 0], [bias, np.zeros(SLOTS)], atol=1e-5)
    np.testing.assert_allclose(sampled[0, 0, 0], bias, rtol=1e-3)
    np.testing.assert_allclose(sampled[0, 0, 1], 0.25, rtol=0.6)
    np.testing.assert_allclose(sampled[0, 0, 1].mean(), 0.25, rtol=0.2)
    assert choose([UP] * SLOTS, model=model) == [1]
    assert choose([UP] * SLOTS, model=model, selection_error="sampled") == [0]


def test_mean_error_is_in_normalised_and_sampled_error_in_raw_units():
    first_wrong, second_wrong = np.diag([3.0, 0.01]), np.diag([1.0, 0.015])
    model = noisy_heads([first_wrong, second_wrong], [1e-6, 1e-6])
    scale = Normalizer(jnp.zeros(2), jnp.asarray([1.0, 100.0]))
    statistics = dataclasses.replace(toys.identity_statistics(), delta=scale)
    # Raw errors of (2, 0) and (0, 0.5) times the action; the second dimension weighs little.
    assert choose([UP], model=model, statistics=statistics) == [1]
    swapped = noisy_heads([np.diag([1.9, 0.01]), np.diag([1.0, 0.03])], [1e-6, 1e-6])
    assert choose([UP], model=swapped, statistics=statistics) == [1]
    assert choose([UP], model=swapped, statistics=statistics, selection_error="sampled") == [0]


def test_errors_use_the_context_of_each_environment_and_member():
    model, statistics = toys.small_model(), toys.odd_statistics()
    two = jax.tree.map(lambda x: jnp.concatenate([x, x]), remember([UP, DOWN, UP]))
    context = jnp.asarray(np.random.default_rng(0).normal(size=(2, 2, 3)), jnp.float32)
    errors = head_errors(model, toys.POINT, statistics, two, context)
    swapped = head_errors(model, toys.POINT, statistics, two, context[:, ::-1])
    np.testing.assert_allclose(errors, swapped[::-1], rtol=1e-5)
    assert np.abs(np.asarray(errors[0] - errors[1])).max() > 1e-3


def test_a_non_finite_error_never_wins_and_unused_slots_do_not_count():
    errors = jnp.asarray([[[[jnp.nan, 1.0], [0.0, 9.0], [0.0, jnp.inf]]]])
    key = jax.random.key(0)
    newest_only, both = jnp.asarray([[False, True]]), jnp.asarray([[True, True]])
    assert select_heads(errors, newest_only, key=key).tolist() == [[0]]
    assert select_heads(errors, both, key=key).tolist() == [[1]]


def test_push_shifts_only_where_something_happened():
    recent = jax.tree.map(lambda x: jnp.concatenate([x, x]), remember([UP, UP]))
    ones = jnp.ones((2, 2))
    pushed = recent.push(5 * ones, ones, 6 * ones, jnp.asarray([True, False]))
    np.testing.assert_array_equal(pushed.count, [3, 2])
    np.testing.assert_array_equal(pushed.obs[0, -1], [5.0, 5.0])
    np.testing.assert_array_equal(pushed.next_obs[0, -1], [6.0, 6.0])
    np.testing.assert_array_equal(pushed.obs[0, :-1], recent.obs[0, 1:])
    for after, before in zip(pushed[:3], recent[:3], strict=True):
        np.testing.assert_array_equal(after[1], before[1])


@pytest.mark.parametrize("length", [1, 2, 5, 8])
@pytest.mark.parametrize("num_slots", [8, 11])
def test_history_equals_that_of_the_same_episode_in_the_data_at_every_step(length, num_slots):
    trajectory = toys.random_trajectory(14)
    episodes, _ = toys.lay_out([trajectory])
    recent = RecentTransitions.empty(1, num_slots, toys.POINT)
    for step in range(14):
        expected = episodes.history(jnp.asarray([0]), jnp.asarray([step]), length)
        for got, want in zip(recent.history(length), expected, strict=True):
            np.testing.assert_array_equal(got, want)
        obs, action = jnp.asarray(trajectory.obs), jnp.asarray(trajectory.action)
        recent = recent.push(
            obs[None, step], action[None, step], obs[None, step + 1], jnp.asarray([True])
        )
