"""Imagined rollouts against NumPy ones, and the folded model against the unfolded one."""

import dataclasses
from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import toys
from headway.models.dynamics import GaussianNet, MultiHeadDynamics, network_input
from headway.models.networks import DenseHeads, bound_logvar, swish
from headway.planning import returns
from headway.planning.imagination import ImaginedDynamics, bounded_var, rough_swish, rounded
from headway.planning.returns import RolloutSettings, candidate_returns

KEY = jax.random.key(0)


class CornerTask(toys.PointTask):
    """Actions in other units; an episode ends when the first number exceeds one."""

    action_low: ClassVar[tuple[float, ...]] = (-2.0, 0.0)
    action_high: ClassVar[tuple[float, ...]] = (2.0, 3.0)

    def reward(self, obs, action, next_obs):
        return obs[..., 0] + jnp.square(next_obs[..., 1]) - 0.3 * action[..., 0] + action[..., 1]

    def released_reward(self, obs, action, next_obs):
        return obs[..., 0]

    def terminated(self, obs, action, next_obs):
        return next_obs[..., 0] > 1.0


def fold(model, heads, statistics=None, context=None, **options):
    statistics = statistics or toys.identity_statistics()
    return ImaginedDynamics.fold(model, statistics, jnp.asarray(heads), context, **options)


def returns_of(dynamics, obs, candidates, task=toys.POINT, *, key=KEY, **settings):
    settings = RolloutSettings(**{"particles_per_member": 2} | settings)
    return candidate_returns(
        dynamics, task, jnp.asarray(obs), jnp.asarray(candidates), settings=settings, key=key
    )


def twin_returns(gains, heads, obs, candidates, reward, *, low, high, end=np.inf):
    """Every env, candidate and member rolled out by hand; gains are [member, head, ...]."""
    num_envs, num_candidates, horizon, _ = candidates.shape
    total = np.zeros((num_envs, num_candidates))
    for env, candidate in np.ndindex(total.shape):
        for member, gain in enumerate(gains):
            x = np.float64(obs[env])
            for step in range(horizon):
                scaled = candidates[env, candidate, step]
                action = low + (scaled + 1) / 2 * (high - low)
                following = x + scaled @ gain[heads[env, member, 0]]
                total[env, candidate] += reward(x, action, following) / len(gains)
                x = following
                if x[0] > end:
                    break
    return total


def random_problem(seed=0, num_envs=3):
    rng = np.random.default_rng(seed)
    gains = rng.normal(size=(2, 3, 2, 2))
    heads = rng.integers(0, 3, (num_envs, 2, 1))
    obs = rng.normal(size=(num_envs, 2)).astype(np.float32)
    candidates = rng.uniform(-1, 1, (num_envs, 4, 5, 2)).astype(np.float32)
    return gains, heads, obs, candidates


def corner_reward(x, action, y):
    return x[0] + y[1] ** 2 - 0.3 * action[0] + action[1]


def test_returns_on_a_known_linear_model_equal_hand_rollouts():
    gains, heads, obs, candidates = random_problem()
    got = returns_of(fold(toys.linear_model(gains), heads), obs, candidates)
    bounds = {"low": np.array([-1.0, -1.0]), "high": np.array([1.0, 1.0])}
    twin = twin_returns(
        gains, heads, obs, candidates, lambda x, a, y: -(y @ y) - 0.1 * (a @ a), **bounds
    )
    np.testing.assert_allclose(got, twin, rtol=1e-4, atol=1e-4)


def test_rewards_use_the_environments_units_and_stop_after_termination():
    gains, heads, obs, candidates = random_problem(1)
    task = CornerTask()
    dynamics = fold(toys.linear_model(gains), heads)
    bounds = {"low": np.array([-2.0, 0.0]), "high": np.array([2.0, 3.0])}
    ended = twin_returns(gains, heads, obs, candidates, corner_reward, **bounds, end=1.0)
    endless = twin_returns(gains, heads, obs, candidates, corner_reward, **bounds)
    assert np.abs(ended - endless).max() > 0.1
    got = returns_of(dynamics, obs, candidates, task)
    np.testing.assert_allclose(got, ended, rtol=1e-4, atol=1e-4)
    released = returns_of(dynamics, obs, candidates, task, released_reward=True)
    lagging = twin_returns(gains, heads, obs, candidates, lambda x, a, y: x[0], **bounds, end=1.0)
    np.testing.assert_allclose(released, lagging, rtol=1e-4, atol=1e-4)


def test_what_a_terminated_rollout_does_next_cannot_spoil_its_return():
    gains = np.zeros((1, 1, 2, 2))
    gains[0, 0, 0, 0], gains[0, 0, 1, 1] = 2.0, 1e38  # first ends the episode, then overflows
    candidates = np.array([[[[1.0, 0.0], [1.0, 1.0], [1.0, 1.0]]]], np.float32)
    got = returns_of(
        fold(toys.linear_model(gains), [[[0]]]), np.zeros((1, 2)), candidates, CornerTask()
    )
    np.testing.assert_allclose(got, [[-0.3 * 2.0 + 1.5]], rtol=1e-5)


def test_a_rollout_that_leaves_the_finite_numbers_has_a_non_finite_return():
    gains = np.full((1, 1, 2, 2), 1e25)
    candidates = np.zeros((1, 2, 3, 2), np.float32)
    candidates[0, 1] = 1.0
    got = np.asarray(
        returns_of(fold(toys.linear_model(gains), [[[0]]]), np.zeros((1, 2)), candidates)
    )
    np.testing.assert_array_equal(np.isfinite(got), [[True, False]])


def test_particles_stay_with_their_member_for_the_whole_horizon():
    opposite = np.stack([np.eye(2)[None], -np.eye(2)[None]])
    obs, candidates = np.zeros((1, 2)), np.ones((1, 1, 6, 2), np.float32)
    heads = np.zeros((1, 2, 1), int)
    got = returns_of(fold(toys.linear_model(opposite), heads), obs, candidates)
    far = -2 * sum(t**2 for t in range(1, 7)) - 6 * 0.2  # members that swapped would cancel out
    np.testing.assert_allclose(got, [[far]], rtol=1e-5)


def random_walk_dynamics(std, num_heads=1):
    """A model that never moves but for its noise, equally for each head."""
    net = toys.linear_model(np.zeros((1, num_heads, 2, 2))).forward_net
    logvar = DenseHeads(
        jnp.zeros(net.mean_heads.weight.shape), jnp.full((1, num_heads, 2), 2 * np.log(std))
    )
    bounds = jnp.full((num_heads, 2), 20.0), jnp.full((num_heads, 2), -40.0)
    model = MultiHeadDynamics(GaussianNet(net.hidden, net.mean_heads, logvar, *bounds), None, None)
    return fold(model, [[list(range(num_heads))]])


@pytest.mark.parametrize("num_heads", [1, 4])
def test_noise_is_drawn_afresh_at_every_step_and_averages_out_over_heads(num_heads):
    std, horizon = 0.2, 6
    candidates = np.zeros((1, 2, horizon, 2), np.float32)
    dynamics = random_walk_dynamics(std, num_heads)
    got = returns_of(dynamics, np.zeros((1, 2)), candidates, particles_per_member=8000)
    spread = -2 * std**2 * sum(range(1, horizon + 1)) / num_heads
    np.testing.assert_allclose(got, [[spread, spread]], rtol=0.08)
    assert got[0, 0] != got[0, 1]


def test_shared_noise_gives_equal_candidates_equal_returns_and_keeps_the_distribution():
    std, horizon = 0.2, 6
    candidates = np.zeros((1, 2, horizon, 2), np.float32)
    dynamics = random_walk_dynamics(std)
    settings = {"particles_per_member": 8000, "shared_noise": True}
    got = returns_of(dynamics, np.zeros((1, 2)), candidates, **settings)
    assert got[0, 0] == got[0, 1]
    spread = -2 * std**2 * sum(range(1, horizon + 1))
    np.testing.assert_allclose(got, [[spread, spread]], rtol=0.08)


@pytest.mark.parametrize("at_once", [1, 2, 3, 5])
def test_environments_in_chunks_have_the_same_returns_as_side_by_side(at_once, monkeypatch):
    rng = np.random.default_rng(3)
    model = toys.small_model()
    obs = rng.normal(size=(5, 2)).astype(np.float32)
    candidates = rng.uniform(-1, 1, (5, 6, 4, 2)).astype(np.float32)
    heads = rng.integers(0, 2, (5, 2, 1))
    context = jnp.asarray(rng.normal(size=(2, 5, 3)), jnp.float32)
    dynamics = fold(model, heads, context=context)
    whole = returns_of(dynamics, obs, candidates)
    monkeypatch.setattr(returns, "environments_at_once", lambda *_: at_once)
    np.testing.assert_allclose(returns_of(dynamics, obs, candidates), whole, rtol=1e-5)


def test_on_other_devices_than_cpus_the_same_noise_is_drawn_step_by_step(monkeypatch):
    candidates = np.zeros((1, 3, 4, 2), np.float32)
    dynamics = fold(toys.small_model(), np.zeros((1, 2, 1), int), context=jnp.ones((2, 1, 3)))
    before = returns_of(dynamics, np.zeros((1, 2)), candidates)
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    found = returns_of(dynamics, np.zeros((1, 2)), candidates)
    np.testing.assert_allclose(found, before, rtol=1e-5)
    assert len(set(found[0].tolist())) == 3


def test_the_rough_activation_is_within_a_tenth_of_what_bfloat16_loses():
    x = jnp.linspace(-40.0, 40.0, 100_001)
    error = jnp.abs(rough_swish(x) - swish(x))
    assert 1e-5 < error.max() < 2e-4
    above = x > 1
    lost = jnp.abs(swish(x).astype(jnp.bfloat16).astype(jnp.float32) - swish(x))
    assert error[above].mean() < 0.1 * lost[above].mean()
    np.testing.assert_allclose(
        rough_swish(jnp.asarray([1e30, jnp.inf])), [1e30, jnp.inf], rtol=1e-4
    )


def test_the_variance_of_a_plan_is_that_of_bounded_log_variances():
    logvar = jnp.asarray([-300.0, -80.0, -12.0, -3.0, 0.4, 5.0, 80.0, 300.0])
    for bounds in ((-10.0, 0.5), (-40.0, 20.0), (-2.0, -1.5)):
        expected = jnp.exp(bound_logvar(logvar, *map(jnp.float32, bounds)))
        found = bounded_var(logvar, *map(jnp.float32, bounds))
        np.testing.assert_allclose(found, expected, rtol=2e-5)


def test_an_environments_returns_do_not_depend_on_its_neighbours():
    dynamics = fold(toys.small_model(), np.zeros((3, 2, 1), int), context=jnp.ones((2, 3, 3)))
    alone = fold(toys.small_model(), np.zeros((1, 2, 1), int), context=jnp.ones((2, 1, 3)))
    candidates = np.random.default_rng(4).uniform(-1, 1, (3, 4, 5, 2)).astype(np.float32)
    together = returns_of(dynamics, np.ones((3, 2)), candidates)
    single = returns_of(alone, np.ones((1, 2)), candidates[:1])
    np.testing.assert_allclose(together[:1], single, rtol=1e-5)
    assert not np.allclose(together[0], together[1])


def test_noise_depends_on_the_key_only():
    candidates = np.zeros((1, 1, 3, 2), np.float32)
    dynamics = random_walk_dynamics(0.2)
    first, again, other = (
        returns_of(dynamics, np.zeros((1, 2)), candidates, key=jax.random.key(k)) for k in (1, 1, 2)
    )
    assert first == again
    assert first != other


HEADS = {"chosen": [[[0], [1]], [[1], [1]], [[1], [0]]], "all": [[[0, 1], [0, 1]]] * 3}


@pytest.mark.parametrize("with_context", [True, False])
@pytest.mark.parametrize("which", HEADS)
def test_folded_model_equals_the_unfolded_one(which, with_context):
    task = toys.ScaledTask()
    config = toys.SMALL if with_context else dataclasses.replace(toys.SMALL, context_size=0)
    model, statistics = toys.small_model(task=task, config=config), toys.odd_statistics(task)
    rng = np.random.default_rng(0)
    obs, action, noise = (
        jnp.asarray(rng.normal(size=(2, 3, 4, 2)), jnp.float32) for _ in range(3)
    )  # [member, env, particle, feature]
    context = jnp.asarray(rng.normal(size=(2, 3, 3)), jnp.float32) if with_context else None
    heads = np.asarray(HEADS[which])
    dynamics = fold(model, heads, statistics, context)
    x = jnp.concatenate([task.preprocess(obs), action], axis=-1)
    mean, sample = np.empty((2, 2, 3, 4, 2))
    for env in range(3):
        one = dynamics.of_env(jax.tree.map(lambda leaf, env=env: leaf[env], dynamics.heads))
        wide = x[:, env].mT[..., None], noise[:, env].mT[..., None]  # one candidate
        mean[:, env] = one.sample_delta(wide[0], None)[..., 0].mT
        sample[:, env] = one.sample_delta(*wide)[..., 0].mT
    for env in range(3):
        inputs = network_input(task, statistics, obs[:, env], action[:, env])
        wide = None if context is None else jnp.repeat(context[:, env][:, None], 4, axis=1)
        whole = model.forward_net(inputs, wide)
        for member in range(2):
            picked = heads[env, member]
            raw = (
                np.asarray(whole.mean)[member, picked] * statistics.delta.std
                + statistics.delta.mean
            )
            std = np.exp(0.5 * np.asarray(whole.logvar)[member, picked]) * statistics.delta.std
            np.testing.assert_allclose(mean[member, env], raw.mean(0), rtol=1e-3, atol=2e-4)
            blended = np.sqrt((std**2).sum(0)) / len(picked)
            np.testing.assert_allclose(
                sample[member, env] - mean[member, env],
                noise[member, env] * blended,
                rtol=1e-3,
                atol=2e-4,
            )


def test_numbers_are_rounded_to_the_nearest_bfloat16_and_halves_away_from_zero():
    rng = np.random.default_rng(0)
    some = rng.normal(size=10_000) * 10.0 ** rng.uniform(-38, 38, 10_000)
    special = np.asarray([0.0, -0.0, np.inf, -np.inf, np.nan, 3.4e38, 1e-40], np.float32)
    x = np.concatenate([some.astype(np.float32), special])
    x = jnp.asarray(x[x.view(np.uint32) % 2**16 != 2**15])  # not between two of them
    found = rounded(x, jnp.bfloat16)
    assert found.dtype == jnp.bfloat16
    expected = x.astype(jnp.bfloat16).astype(jnp.float32)
    np.testing.assert_array_equal(found.astype(jnp.float32), expected)
    np.testing.assert_array_equal(rounded(x, jnp.float32), x)
    half = jnp.asarray([1 + 2**-8, -1 - 2**-8, 1 + 3 * 2**-8], jnp.float32)
    assert rounded(half, jnp.bfloat16).tolist() == [1 + 2**-7, -1 - 2**-7, 1 + 2**-6]
