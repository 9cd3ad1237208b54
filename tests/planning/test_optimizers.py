"""What every optimizer must keep to, and how well each searches a problem with a known answer."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from headway.config import PlannerConfig
from headway.planning.optimizers import CEM, RandomShooting, SearchState, make_optimizer

ROUNDS = 3
OPTIMIZERS = [
    CEM(num_candidates=40, num_elites=8, num_iterations=ROUNDS),
    RandomShooting(num_candidates=40, num_iterations=ROUNDS),
]
NUM_ENVS, HORIZON, ACTIONS = 2, 4, 2
KEY = jax.random.key(0)


@pytest.fixture(params=OPTIMIZERS, ids=lambda optimizer: type(optimizer).__name__)
def optimizer(request):
    return request.param


def start(value=0.0):
    return jnp.full((NUM_ENVS, HORIZON, ACTIONS), value)


def towards(target):
    """A score that is highest where every action equals the environment's target."""

    def score(candidates, key):
        del key
        aim = jnp.asarray(target)[:, None, None, None]
        return -jnp.square(candidates - aim).sum((-1, -2))

    return score


@eqx.filter_jit
def optimize(optimizer, target, guess, bad, bad_envs, bad_if_positive, key):
    def score(candidates, key):
        spoiled = bad_envs[:, None] | (bad_if_positive & (candidates[..., 0, 0] > 0))
        return jnp.where(spoiled, bad, towards(target)(candidates, key))

    return optimizer.optimize(score, begin(optimizer, guess), key=key)


def begin(optimizer, guess):
    """The optimizer's own first state, but for the guess."""
    return optimizer.init(*guess.shape)._replace(guess=guess)


def search(optimizer, target, *, guess=None, bad=0.0, bad_envs=(), bad_if_positive=False, key=0):
    """Search for `target`; some candidates or all of some environments have a `bad` return."""
    return optimize(
        optimizer,
        jnp.asarray(target),
        start() if guess is None else guess,
        jnp.asarray(bad),
        jnp.asarray([env in bad_envs for env in range(NUM_ENVS)]),
        jnp.asarray(bad_if_positive),
        jax.random.key(key),
    )


@eqx.filter_jit
def push_outwards(optimizer, guess, key):
    """Search for the largest action; the return is at most 1 if no candidate is beyond bounds."""

    def largest(candidates, key):
        del key
        assert candidates.shape == (NUM_ENVS, 40, HORIZON, ACTIONS)
        return jnp.abs(candidates).max((-1, -2))

    return optimizer.optimize(largest, begin(optimizer, guess), key=key)


@pytest.mark.parametrize("guess", [0.0, 0.97, -1.0])
def test_plans_and_candidates_stay_within_bounds_and_shape(optimizer, guess):
    plan = push_outwards(optimizer, start(guess), KEY)
    assert plan.actions.shape == (NUM_ENVS, HORIZON, ACTIONS)
    assert plan.expected_return.shape == plan.failures.shape == (NUM_ENVS,)
    assert np.abs(np.asarray(plan.actions)).max() <= 1.0
    assert (np.asarray(plan.expected_return) <= 1.0).all()
    np.testing.assert_array_equal(plan.failures, 0)


def test_search_moves_towards_each_environments_own_optimum(optimizer):
    means = np.asarray(search(optimizer, [0.6, -0.6]).actions).mean((1, 2))
    assert means[0] > 0.2
    assert means[1] < -0.2


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_a_non_finite_candidate_never_wins_nor_is_an_elite(optimizer, bad):
    plan = search(optimizer, [0.9, 0.9], bad=bad, bad_if_positive=True)
    assert (np.asarray(plan.actions)[:, 0, 0] <= 0).all()
    assert np.isfinite(plan.expected_return).all()
    np.testing.assert_array_equal(plan.failures, 0)


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_when_nothing_is_finite_the_guess_is_kept_and_counted_in_that_environment_only(
    optimizer, bad
):
    guess = start(0.25).at[:, 1].set(-0.5)
    healthy = search(optimizer, [0.5, 0.5], guess=guess)
    plan = search(optimizer, [0.5, 0.5], guess=guess, bad=bad, bad_envs=[0])
    np.testing.assert_array_equal(plan.actions[0], guess[0])
    np.testing.assert_array_equal(plan.failures, [ROUNDS, 0])
    np.testing.assert_array_equal(plan.actions[1], healthy.actions[1])
    assert not np.isfinite(plan.expected_return[0])
    assert plan.expected_return[1] == healthy.expected_return[1]


def test_environments_do_not_see_each_other(optimizer):
    first = search(optimizer, [0.5, -0.3])
    second = search(optimizer, [-0.9, -0.3], guess=start().at[0].set(0.4))
    np.testing.assert_array_equal(first.actions[1], second.actions[1])
    assert (first.actions[0] != second.actions[0]).any()


def test_same_key_same_plan_and_another_key_another(optimizer):
    plans = [search(optimizer, [0.5, -0.3], key=key).actions for key in (1, 1, 2)]
    np.testing.assert_array_equal(plans[0], plans[1])
    assert (plans[0] != plans[2]).any()


def test_evaluations_are_what_was_really_scored(optimizer):
    sizes = []

    def score(candidates, key):
        jax.debug.callback(lambda x: sizes.append(x.shape[1]), candidates)
        return towards([0.3, -0.3])(candidates, key)

    plan = optimizer.optimize(score, begin(optimizer, start()), key=KEY)
    jax.effects_barrier()
    assert len(sizes) == ROUNDS
    np.testing.assert_array_equal(plan.evaluations, sum(sizes))
    assert optimizer.max_evaluations == sum(sizes)


def test_a_first_state_starts_from_zero_and_shifting_moves_the_plan_on_by_one_step(optimizer):
    first = optimizer.init(NUM_ENVS, HORIZON, ACTIONS)
    np.testing.assert_array_equal(first.guess, start())
    ended = search(optimizer, [0.6, -0.6]).state
    later = optimizer.shift(ended)
    np.testing.assert_array_equal(later.guess[:, :-1], ended.guess[:, 1:])
    np.testing.assert_array_equal(later.guess[:, -1], 0.0)
    assert jax.tree.map(jnp.shape, later) == jax.tree.map(jnp.shape, first)


def test_environments_draw_different_candidates(optimizer):
    plan = search(optimizer, [0.5, 0.5])
    assert (plan.actions[0] != plan.actions[1]).any()


def test_a_round_of_cem_equals_its_numpy_twin():
    cem = CEM(num_candidates=40, num_elites=8, num_iterations=1, smoothing=0.2, initial_std=0.3)
    guess = start(0.5)
    captured = []

    def score(candidates, key):
        jax.debug.callback(lambda x: captured.append(np.float64(x)), candidates)
        return towards([0.9, 0.1])(candidates, key)

    plan = cem.optimize(score, SearchState(guess), key=KEY)
    jax.effects_barrier()
    (candidates,) = captured
    room = 0.25  # (1 - 0.5) / 2: closer than the initial deviation
    assert np.abs(candidates - 0.5).max() <= 2 * room + 1e-6
    for env, aim in enumerate([0.9, 0.1]):
        returns = -((candidates[env] - aim) ** 2).sum((-1, -2))
        elites = candidates[env][np.argsort(-returns)[:8]]
        np.testing.assert_allclose(plan.actions[env], 0.2 * 0.5 + 0.8 * elites.mean(0), atol=1e-6)
        np.testing.assert_allclose(
            plan.expected_return[env], np.sort(returns)[-8:].mean(), rtol=1e-5
        )


def test_variance_of_cem_shrinks_by_the_elites_variance_and_the_smoothing():
    captured = []

    def score(candidates, key):
        jax.debug.callback(lambda x: captured.append(np.float64(x)), candidates)
        return towards([0.1, -0.1])(candidates, key)

    cem = CEM(num_candidates=4000, num_elites=400, num_iterations=2, smoothing=0.1)
    cem.optimize(score, SearchState(start()), key=KEY)
    jax.effects_barrier()
    first, second = captured
    for env, aim in enumerate([0.1, -0.1]):
        returns = -((first[env] - aim) ** 2).sum((-1, -2))
        elites = first[env][np.argsort(-returns)[:400]]
        var = 0.1 * 0.25 + 0.9 * elites.var(0)
        of_cut_normal = second[env].var(0) / 0.7737  # variance left by cutting at two deviations
        np.testing.assert_allclose(of_cut_normal, var, rtol=0.1)


def test_with_fewer_finite_candidates_than_elites_only_the_finite_ones_count():
    def only_one(candidates, key):
        del key
        returns = jnp.where(jnp.arange(40) == 3, 1.0, jnp.nan)
        return jnp.broadcast_to(returns, candidates.shape[:2])

    plans = [
        CEM(num_candidates=40, num_elites=n, num_iterations=1).optimize(
            only_one, SearchState(start()), key=KEY
        )
        for n in (1, 8)
    ]
    np.testing.assert_allclose(plans[0].actions, plans[1].actions, atol=1e-7)
    np.testing.assert_array_equal(plans[1].expected_return, 1.0)
    assert np.abs(np.asarray(plans[1].actions)).max() > 0.1


GAIN, COST, STEPS = 0.3, 0.1, 10


def linear_quadratic(x0):
    """The return of x' = x + 0.3 u under -x^2 - 0.1 u^2, and its best possible value."""

    def score(candidates, key):
        del key
        x = x0[:, None, None] + GAIN * jnp.cumsum(candidates, axis=-2)
        return -(jnp.square(x) + COST * jnp.square(candidates)).sum((-1, -2))

    lower = GAIN * np.tril(np.ones((STEPS, STEPS)))
    hessian = lower.T @ lower + COST * np.eye(STEPS)
    best = 0.0
    for x in np.asarray(x0, np.float64).T:
        u = -np.linalg.solve(hessian, lower.T @ np.tile(x, (STEPS, 1)))
        assert np.abs(u).max() < 1
        best = best - ((x + lower @ u) ** 2 + COST * u**2).sum(0)
    return score, best


def test_cem_beats_random_shooting_with_as_many_candidates_and_nears_the_optimum():
    x0 = jnp.asarray([[0.5, -0.4], [-0.3, 0.1], [0.2, 0.4]])
    score, best = linear_quadratic(x0)
    guess = jnp.zeros((3, STEPS, 2))
    cem = CEM(num_candidates=200, num_elites=20, num_iterations=8)
    shooting = RandomShooting(num_candidates=200, num_iterations=8)

    @eqx.filter_jit
    def plan(optimizer, key):
        return score(
            optimizer.optimize(score, begin(optimizer, guess), key=key).actions[:, None], None
        )

    def achieved(optimizer, key):
        return np.asarray(plan(optimizer, jax.random.key(key)))[:, 0]

    idle = np.asarray(score(guess[:, None], None))[:, 0]
    for key in range(3):
        found, drawn = achieved(cem, key), achieved(shooting, key)
        assert (found > drawn).all()
        assert (found <= best + 1e-5).all()
        assert ((best - found) < 0.05 * (best - idle)).all()


def test_settings_reach_the_optimizer():
    config = PlannerConfig(
        num_candidates=9, num_elites=3, num_iterations=2, smoothing=0.3, initial_std=0.4
    )
    assert make_optimizer(config) == CEM(9, 3, 2, 0.3, 0.4)
    shooting = PlannerConfig(
        optimizer="random-shooting", num_candidates=9, num_elites=3, num_iterations=2
    )
    assert make_optimizer(shooting) == RandomShooting(9, 2)
