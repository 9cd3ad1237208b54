"""The cross-entropy method: against a NumPy twin, its warm start, and stopping early."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from search_helpers import KEY, STEPS, begin, linear_quadratic, start, towards, watch

from headway.planning.optimizers import CEM, RandomShooting, SearchState


def numpy_search(cem, aims, guess, var=None):
    """CEM in NumPy, on `towards`, one environment at a time; it shares only the random draws.

    Returns:
        The mean, variance, expected return and number of iterations of every environment.
    """
    draws = []
    for iteration_key in jax.random.split(KEY, cem.num_iterations):
        draw_key, _ = jax.random.split(iteration_key)
        shape = (len(guess), cem.num_candidates, *guess.shape[1:])
        draws.append(np.float64(jax.random.truncated_normal(draw_key, -2.0, 2.0, shape)))
    return [
        numpy_search_of_one(cem, aim, np.float64(guess[env]), var, [d[env] for d in draws])
        for env, aim in enumerate(aims)
    ]


def numpy_search_of_one(cem, aim, mean, var, draws):
    var = cem.initial_std**2 if var is None else var
    iterations = 0
    for draw in draws:
        room = np.minimum((mean + 1) / 2, (1 - mean) / 2)
        candidates = mean + np.minimum(room, np.sqrt(var)) * draw
        returns = -((candidates - aim) ** 2).sum((-1, -2))
        best = np.argsort(-returns)[: cem.num_elites]
        elites, old, iterations = candidates[best], mean, iterations + 1
        mean = cem.smoothing * mean + (1 - cem.smoothing) * elites.mean(0)
        var = cem.smoothing * var + (1 - cem.smoothing) * elites.var(0)
        if np.sqrt(np.mean((mean - old) ** 2)) < cem.settle_tolerance:
            break
    return mean, var, returns[best].mean(), iterations


AIMS = [0.9, 0.1]
TWIN = CEM(num_candidates=40, num_elites=8, num_iterations=4, smoothing=0.2, initial_std=0.3)


@pytest.mark.parametrize("guess", [0.0, 0.5])
def test_a_search_equals_its_numpy_twin(guess):
    plan, _ = watch(TWIN, towards(AIMS), SearchState(start(guess)))
    for env, (mean, _, expected, _) in enumerate(numpy_search(TWIN, AIMS, start(guess))):
        np.testing.assert_allclose(plan.actions[env], mean, atol=1e-5)
        np.testing.assert_allclose(plan.expected_return[env], expected, rtol=1e-4)
    np.testing.assert_array_equal(plan.state.guess, plan.actions)
    assert plan.state.variance is None


def test_candidates_are_drawn_within_the_room_to_the_bounds():
    plan, seen = watch(TWIN, towards(AIMS), SearchState(start(0.5)))
    room = 0.25  # (1 - 0.5) / 2: closer than the initial deviation
    assert np.abs(seen[0] - 0.5).max() <= 2 * room + 1e-6
    np.testing.assert_array_equal(plan.failures, 0)


def test_variance_of_cem_shrinks_by_the_elites_variance_and_the_smoothing():
    cem = CEM(num_candidates=4000, num_elites=400, num_iterations=2, smoothing=0.1)
    _, (first, second) = watch(cem, towards([0.1, -0.1]), SearchState(start()))
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


def test_cem_beats_random_shooting_with_as_many_candidates_and_nears_the_optimum():
    x0 = jnp.asarray([[0.5, -0.4], [-0.3, 0.1], [0.2, 0.4]])
    score, best = linear_quadratic(x0)
    guess = jnp.zeros((3, STEPS, 2))
    cem = CEM(num_candidates=200, num_elites=20, num_iterations=8)
    shooting = RandomShooting(num_candidates=200, num_iterations=8)

    @eqx.filter_jit
    def plan(optimizer, key):
        found = optimizer.optimize(score, begin(optimizer, guess), key=key)
        return score(found.actions[:, None], None)

    def achieved(optimizer, key):
        return np.asarray(plan(optimizer, jax.random.key(key)))[:, 0]

    idle = np.asarray(score(guess[:, None], None))[:, 0]
    for key in range(3):
        found, drawn = achieved(cem, key), achieved(shooting, key)
        assert (found > drawn).all()
        assert (found <= best + 1e-5).all()
        assert ((best - found) < 0.05 * (best - idle)).all()


WARM = dataclasses.replace(TWIN, warm_variance=True, warm_min_std=0.1)


def test_a_warm_search_starts_from_the_variance_it_is_given_but_not_below_the_floor():
    variance = jnp.broadcast_to(jnp.asarray([0.04, 1e-6])[:, None, None], start().shape)
    plan, _ = watch(WARM, towards(AIMS), SearchState(start(), variance))
    for env, floored in enumerate([0.04, 0.01]):
        mean, var, *_ = numpy_search(WARM, AIMS, start(), var=floored)[env]
        np.testing.assert_allclose(plan.actions[env], mean, atol=1e-5)
        np.testing.assert_allclose(plan.state.variance[env], var, rtol=1e-3)


def test_a_first_warm_search_equals_a_cold_one():
    warm, _ = watch(WARM, towards(AIMS), WARM.init(*start().shape))
    cold, _ = watch(TWIN, towards(AIMS), TWIN.init(*start().shape))
    np.testing.assert_array_equal(warm.actions, cold.actions)


def test_the_shifted_variance_starts_anew_at_the_last_step():
    variance = jnp.arange(1.0, 1.0 + start().size).reshape(start().shape)
    later = WARM.shift(SearchState(start(), variance))
    np.testing.assert_array_equal(later.variance[:, :-1], variance[:, 1:])
    np.testing.assert_allclose(later.variance[:, -1], 0.3**2, rtol=1e-6)


SETTLING = dataclasses.replace(TWIN, num_iterations=8, settle_tolerance=0.04)


def test_a_settled_environment_keeps_its_plan_and_stops_counting():
    aims = [0.9, 0.0]  # one far from the guess, one at it
    plan, seen = watch(SETTLING, towards(aims), SearchState(start()))
    twins = numpy_search(SETTLING, aims, start())
    rounds = [iterations for *_, iterations in twins]
    assert 1 < rounds[1] < rounds[0] < SETTLING.num_iterations
    assert len(seen) == rounds[0]  # the batch waits for the last one, and for no longer
    np.testing.assert_array_equal(plan.evaluations, np.multiply(rounds, SETTLING.num_candidates))
    for env, (mean, _, expected, _) in enumerate(twins):
        np.testing.assert_allclose(plan.actions[env], mean, atol=1e-5)
        np.testing.assert_allclose(plan.expected_return[env], expected, rtol=1e-4)


NEIGHBOURS = ([0.95, 0.3], [0.0, 0.3])


def test_when_an_environment_settles_does_not_depend_on_its_neighbours():
    together = [watch(SETTLING, towards(aims), SearchState(start()))[0] for aims in NEIGHBOURS]
    first, second = together
    assert first.evaluations[0] != second.evaluations[0]
    for name in ("actions", "expected_return", "evaluations", "failures"):
        np.testing.assert_array_equal(getattr(first, name)[1], getattr(second, name)[1])


def test_a_tolerance_that_nothing_meets_changes_nothing():
    patient = dataclasses.replace(TWIN, settle_tolerance=1e-9)
    plans = [watch(cem, towards(AIMS), SearchState(start()))[0] for cem in (TWIN, patient)]
    for never, always in zip(*map(jax.tree.leaves, plans), strict=True):
        np.testing.assert_allclose(never, always, rtol=1e-5, atol=1e-6)


def test_an_iteration_without_finite_returns_settles_nothing():
    def bad(candidates, key):
        return jnp.full(candidates.shape[:2], jnp.nan)

    plan, seen = watch(SETTLING, bad, SearchState(start(0.2)))
    assert len(seen) == SETTLING.num_iterations
    np.testing.assert_array_equal(plan.failures, SETTLING.num_iterations)
    np.testing.assert_array_equal(plan.actions, start(0.2))
