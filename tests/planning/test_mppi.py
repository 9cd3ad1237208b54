"""MPPI: against a NumPy twin, and its weights where returns are equal, huge or not finite."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from search_helpers import KEY, STEPS, begin, linear_quadratic, start, towards, watch

from headway.planning.optimizers import MPPI, RandomShooting
from headway.planning.optimizers.mppi import softmax_weights
from headway.planning.optimizers.noise import colored_noise

AIMS = [0.9, -0.2]
SMALL = MPPI(num_candidates=40, num_iterations=3, initial_std=0.4, temperature=0.6)


def numpy_search(mppi, aims, mean):
    """MPPI in NumPy, on `towards`; it shares only the noise."""
    mean = np.float64(mean)
    for iteration_key in jax.random.split(KEY, mppi.num_iterations):
        draw_key, _ = jax.random.split(iteration_key)
        shape = (len(mean), mppi.num_candidates, *mean.shape[1:])
        noise = np.float64(colored_noise(draw_key, shape, mppi.noise_beta))
        candidates = np.clip(mean[:, None] + mppi.initial_std * noise, -1, 1)
        returns = -((candidates - np.reshape(aims, (-1, 1, 1, 1))) ** 2).sum((-1, -2))
        standard = (returns - returns.mean(1, keepdims=True)) / returns.std(1, keepdims=True)
        weights = np.exp(standard / mppi.temperature)
        weights /= weights.sum(1, keepdims=True)
        mean = np.einsum("ec,ecta->eta", weights, candidates)
        expected = (weights * returns).sum(1)
    return mean, expected


@pytest.mark.parametrize("beta", [0.0, 2.0])
def test_a_search_equals_its_numpy_twin(beta):
    mppi = dataclasses.replace(SMALL, noise_beta=beta)
    plan, _ = watch(mppi, towards(AIMS), begin(mppi, start(0.1)))
    mean, expected = numpy_search(mppi, AIMS, start(0.1))
    np.testing.assert_allclose(plan.actions, mean, atol=1e-5)
    np.testing.assert_allclose(plan.expected_return, expected, rtol=1e-4)
    np.testing.assert_array_equal(plan.state.guess, plan.actions)


def test_weights_do_not_change_with_the_scale_and_the_origin_of_the_returns():
    returns = jax.random.normal(jax.random.key(3), (2, 30))
    weights = softmax_weights(returns, 0.5)
    np.testing.assert_allclose(weights.sum(1), 1.0, rtol=1e-5)
    np.testing.assert_allclose(softmax_weights(1e3 * returns - 50, 0.5), weights, rtol=1e-2)


def test_a_lower_temperature_looks_at_the_best_only_and_a_high_one_at_all():
    returns = jnp.asarray([[3.0, 1.0, 2.0, 0.0]])
    np.testing.assert_allclose(softmax_weights(returns, 1e-3), [[1, 0, 0, 0]], atol=1e-6)
    np.testing.assert_allclose(softmax_weights(returns, 1e6), [[0.25] * 4], atol=1e-5)


def test_weights_of_equal_and_of_non_finite_returns():
    low = -jnp.inf
    returns = jnp.asarray([[2.0, 2.0, low], [low, low, low], [low, 5.0, low], [1e30, -1e30, 0.0]])
    weights = softmax_weights(returns, 0.5)
    np.testing.assert_allclose(weights[:3], [[0.5, 0.5, 0], [0, 0, 0], [0, 1, 0]], atol=1e-6)
    assert np.isfinite(weights).all()


def test_mppi_beats_random_shooting_with_as_many_candidates_and_nears_the_optimum():
    x0 = jnp.asarray([[0.5, -0.4], [-0.3, 0.1], [0.2, 0.4]])
    score, best = linear_quadratic(x0)
    guess = jnp.zeros((3, STEPS, 2))

    @eqx.filter_jit
    def achieved(optimizer, key):
        found = optimizer.optimize(score, begin(optimizer, guess), key=key)
        return score(found.actions[:, None], None)[:, 0]

    idle = np.asarray(score(guess[:, None], None))[:, 0]
    for key in range(3):
        found, drawn = (
            np.asarray(achieved(optimizer(num_candidates=200), jax.random.key(key)))
            for optimizer in (MPPI, RandomShooting)
        )
        assert (found > drawn).all()
        assert ((best - found) < 0.15 * (best - idle)).all()
