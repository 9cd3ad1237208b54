"""The cross-entropy method, against a NumPy twin."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from search_helpers import KEY, STEPS, begin, linear_quadratic, start, towards, watch

from headway.planning.optimizers import CEM, RandomShooting, SearchState


def numpy_search(cem, aims, guess):
    """CEM in NumPy, on `towards`, one environment at a time; it shares only the random draws.

    Returns:
        The mean and the expected return of every environment.
    """
    draws = []
    for iteration_key in jax.random.split(KEY, cem.num_iterations):
        draw_key, _ = jax.random.split(iteration_key)
        shape = (len(guess), cem.num_candidates, *guess.shape[1:])
        draws.append(np.float64(jax.random.truncated_normal(draw_key, -2.0, 2.0, shape)))
    return [
        numpy_search_of_one(cem, aim, np.float64(guess[env]), [d[env] for d in draws])
        for env, aim in enumerate(aims)
    ]


def numpy_search_of_one(cem, aim, mean, draws):
    var = cem.initial_std**2
    for draw in draws:
        room = np.minimum((mean + 1) / 2, (1 - mean) / 2)
        candidates = mean + np.minimum(room, np.sqrt(var)) * draw
        returns = -((candidates - aim) ** 2).sum((-1, -2))
        best = np.argsort(-returns)[: cem.num_elites]
        elites = candidates[best]
        mean = cem.smoothing * mean + (1 - cem.smoothing) * elites.mean(0)
        var = cem.smoothing * var + (1 - cem.smoothing) * elites.var(0)
    return mean, returns[best].mean()


AIMS = [0.9, 0.1]
TWIN = CEM(num_candidates=40, num_elites=8, num_iterations=4, smoothing=0.2, initial_std=0.3)


@pytest.mark.parametrize("guess", [0.0, 0.5])
def test_a_search_equals_its_numpy_twin(guess):
    plan, _ = watch(TWIN, towards(AIMS), SearchState(start(guess)))
    for env, (mean, expected) in enumerate(numpy_search(TWIN, AIMS, start(guess))):
        np.testing.assert_allclose(plan.actions[env], mean, atol=1e-5)
        np.testing.assert_allclose(plan.expected_return[env], expected, rtol=1e-4)
    np.testing.assert_array_equal(plan.state.guess, plan.actions)


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
