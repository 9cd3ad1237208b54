"""Imagined rollouts against NumPy ones."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import toys
from headway.config import ILQRConfig, MultiHeadedConfig, PlannerConfig
from headway.models.folding import fold
from headway.models.multi_headed import MultiHeadNet
from headway.planning import cpu
from headway.planning.rollouts import candidate_returns, plan_flop, within_members
from headway.task import env_spec

KEY = jax.random.key(0)
UNIT = {"low": np.array([-1.0, -1.0]), "high": np.array([1.0, 1.0])}
CORNER = {"low": np.array([-2.0, 0.0]), "high": np.array([2.0, 3.0])}


class CornerTask(toys.ScaledTask):
    """Its network sees plain observations; its reward may overflow."""

    def preprocess(self, obs):
        return obs

    def reward(self, obs, action, next_obs):
        return obs[..., 0] + jnp.square(next_obs[..., 1]) - 0.3 * action[..., 0] + action[..., 1]


def dynamics_of(net, heads, context=None, task=toys.POINT):
    return fold(net.forward_net, toys.identity_statistics(task), task, jnp.asarray(heads), context)


def returns_of(dynamics, obs, candidates, task=toys.POINT, *, key=KEY, particles=2, **settings):
    planner = PlannerConfig(num_particles=particles * dynamics.num_members, **settings)
    args = dynamics, task, jnp.asarray(obs, jnp.float32), jnp.asarray(candidates)
    return candidate_returns(*args, planner=planner, key=key)


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


def test_returns_on_a_known_linear_model_equal_hand_rollouts():
    gains, heads, obs, candidates = random_problem()
    got = returns_of(dynamics_of(toys.linear_model(gains), heads), obs, candidates)
    paid = lambda x, a, y: -(y @ y) - 0.1 * (a @ a)  # noqa: E731
    twin = twin_returns(gains, heads, obs, candidates, paid, **UNIT)
    np.testing.assert_allclose(got, twin, rtol=1e-4, atol=1e-4)


def test_rewards_use_the_environments_units_and_stop_after_termination():
    gains, heads, obs, candidates = random_problem(1)
    task = CornerTask()
    dynamics = dynamics_of(toys.linear_model(gains), heads, task=task)

    def paid(x, action, y):
        return x[0] + y[1] ** 2 - 0.3 * action[0] + action[1]

    ended = twin_returns(gains, heads, obs, candidates, paid, **CORNER, end=1.0)
    endless = twin_returns(gains, heads, obs, candidates, paid, **CORNER)
    assert np.abs(ended - endless).max() > 0.1
    got = returns_of(dynamics, obs, candidates, task)
    np.testing.assert_allclose(got, ended, rtol=1e-4, atol=1e-4)
    released = returns_of(dynamics, obs, candidates, task, reward="released")
    lagging = twin_returns(gains, heads, obs, candidates, lambda x, a, y: x[0], **CORNER, end=1.0)
    np.testing.assert_allclose(released, lagging, rtol=1e-4, atol=1e-4)


def test_what_a_terminated_rollout_does_next_cannot_spoil_its_return():
    gains = np.zeros((1, 1, 2, 2))
    gains[0, 0, 0, 0], gains[0, 0, 1, 1] = 2.0, 1e38  # first ends the episode, then overflows
    candidates = np.array([[[[1.0, 0.0], [1.0, 1.0], [1.0, 1.0]]]], np.float32)
    dynamics = dynamics_of(toys.linear_model(gains), [[[0]]])
    got = returns_of(dynamics, np.zeros((1, 2)), candidates, CornerTask())
    np.testing.assert_allclose(got, [[-0.3 * 2.0 + 1.5]], rtol=1e-5)


def test_a_rollout_that_leaves_the_finite_numbers_has_a_non_finite_return():
    candidates = np.zeros((1, 2, 3, 2), np.float32)
    candidates[0, 1] = 1.0
    dynamics = dynamics_of(toys.linear_model(np.full((1, 1, 2, 2), 1e25)), [[[0]]])
    got = returns_of(dynamics, np.zeros((1, 2)), candidates)
    np.testing.assert_array_equal(np.isfinite(got), [[True, False]])


def test_particles_stay_with_their_member_for_the_whole_horizon():
    opposite = np.stack([np.eye(2)[None], -np.eye(2)[None]])
    dynamics = dynamics_of(toys.linear_model(opposite), np.zeros((1, 2, 1), int))
    got = returns_of(dynamics, np.zeros((1, 2)), np.ones((1, 1, 6, 2), np.float32))
    far = -2 * sum(t**2 for t in range(1, 7)) - 6 * 0.2  # members that swapped would cancel out
    np.testing.assert_allclose(got, [[far]], rtol=1e-5)


def test_a_single_particle_is_one_members_and_counts_from_the_mean_of_its_fellows():
    opposite = np.stack([np.eye(2)[None], 3 * np.eye(2)[None]])
    dynamics = dynamics_of(toys.linear_model(opposite), np.zeros((1, 2, 1), int))
    planner = PlannerConfig(num_particles=1, particle_noise="none")
    pushes = np.float32([0, 0, 1, 1, -1])[None, :, None, None] * np.ones(2, np.float32)
    args = dynamics, toys.POINT, jnp.zeros((1, 2)), jnp.asarray(pushes)
    whole = candidate_returns(*args, planner=planner, key=KEY)
    np.testing.assert_allclose(whole, [[0, 0, -2.2, -18.2, -2.2]], atol=1e-5)
    ends = [(1, 0, 3), (1, 2, 3)]  # shards overlap, and may begin at any member
    parts = [candidate_returns(*args, planner=planner, key=KEY, shard=cpu.Shard(*s)) for s in ends]
    np.testing.assert_allclose(cpu.joined(parts, (1, 5)), whole, rtol=1e-6)
    means = -4.4 / 3, -9.1
    own = np.array([0, 0, -2.2, -18.2, -2.2]) - np.array(means)[[0, 1, 0, 1, 0]]
    found = within_members(whole, planner, 2)
    np.testing.assert_allclose(found, [own + np.mean(means)], rtol=1e-5)
    broken = within_members(whole.at[0, 1].set(np.nan).at[0, 3].set(-np.inf), planner, 2)
    assert np.isfinite(broken).tolist() == [[True, False, True, False, True]]


@pytest.mark.parametrize("num_heads", [1, 4])
def test_noise_is_drawn_afresh_at_every_step_and_averages_out_over_heads(num_heads):
    std, horizon = 0.2, 6
    net = toys.linear_model(np.zeros((1, num_heads, 2, 2))).forward_net  # it never moves
    noisy = MultiHeadNet(toys.with_noise(net, [std] * num_heads), None, None)
    dynamics = dynamics_of(noisy, [[list(range(num_heads))]])
    candidates = np.zeros((1, 2, horizon, 2), np.float32)
    got = returns_of(dynamics, np.zeros((1, 2)), candidates, particles=8000)
    spread = -2 * std**2 * sum(range(1, horizon + 1)) / num_heads
    np.testing.assert_allclose(got, [[spread, spread]], rtol=0.08)
    assert got[0, 0] != got[0, 1]  # each candidate has luck of its own


def some_dynamics(num_envs, seed=3):
    rng = np.random.default_rng(seed)
    heads = rng.integers(0, 2, (num_envs, 2, 1))
    context = jnp.asarray(rng.normal(size=(2, num_envs, 3)), jnp.float32)
    return dynamics_of(toys.small_model(), heads, context)


@pytest.mark.parametrize("at_once", [1, 2, 3, 5])
def test_environments_in_chunks_have_the_same_returns_as_side_by_side(at_once, monkeypatch):
    rng, dynamics = np.random.default_rng(3), some_dynamics(5)
    obs = rng.normal(size=(5, 2)).astype(np.float32)
    candidates = rng.uniform(-1, 1, (5, 6, 4, 2)).astype(np.float32)
    whole = returns_of(dynamics, obs, candidates)
    monkeypatch.setattr(cpu, "environments_at_once", lambda *_: at_once)
    np.testing.assert_allclose(returns_of(dynamics, obs, candidates), whole, rtol=1e-5)


def test_on_other_devices_than_cpus_the_same_noise_is_drawn_step_by_step(monkeypatch):
    candidates, dynamics = np.zeros((1, 3, 4, 2), np.float32), some_dynamics(1)
    before = returns_of(dynamics, np.zeros((1, 2)), candidates)
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    found = returns_of(dynamics, np.zeros((1, 2)), candidates)
    np.testing.assert_allclose(found, before, rtol=1e-5)
    assert len(set(found[0].tolist())) == 3


# The cost of a plan, counted by hand.

MODEL = MultiHeadedConfig(hidden_sizes=(8, 6), num_heads=3)
PLANNER = dataclasses.replace(
    toys.TINY, horizon=5, num_candidates=40, num_iterations=3, num_particles=10
)
PER_STEP = 2 * (4 * 8 + 8 * 6 + 6 * 4)  # two observations and two actions; mean and variance


def test_arithmetic_of_the_papers_half_cheetah():
    task, candidates = env_spec("half-cheetah").make_task(), 5 * 200.0
    found = plan_flop(MultiHeadedConfig(), PlannerConfig(), task, candidates)
    assert found == pytest.approx(158.4e9)


@pytest.mark.parametrize(
    ("model", "planner", "per_step"),
    [
        ({}, {}, PER_STEP),
        ({"context": "history", "context_at": "input"}, {}, PER_STEP),  # it costs nothing
        ({"deterministic": True}, {}, PER_STEP - 2 * 6 * 2),
        ({}, {"head_selection": "average"}, PER_STEP + 2 * 6 * 2 * 2),
        ({}, {"optimizer": ILQRConfig()}, PER_STEP / 2),  # a rollout for each of five members
    ],
    ids=str,
)
def test_arithmetic_of_a_plan(model, planner, per_step):
    model, planner = dataclasses.replace(MODEL, **model), dataclasses.replace(PLANNER, **planner)
    assert plan_flop(model, planner, toys.POINT, 1.5) == 1.5 * 10 * 5 * per_step
