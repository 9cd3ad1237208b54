"""Coloured noise has the spectrum, the size and the independence it promises."""

import jax
import numpy as np
import pytest

from headway.planning.optimizers.noise import colored_noise


def draw(beta, *, horizon=32, num_draws=4000):
    shape = (num_draws, horizon, 2)
    return np.float64(colored_noise(jax.random.key(0), shape, beta))


@pytest.mark.parametrize("beta", [0.0, 0.5, 1.0, 2.0, 3.5])
def test_power_falls_with_frequency_by_the_exponent(beta):
    power = (np.abs(np.fft.rfft(draw(beta), axis=1)) ** 2).mean((0, 2))
    frequency = np.arange(1, 16)  # neither the constant part nor the highest frequency
    slope, _ = np.polyfit(np.log(frequency), np.log(power[1:16]), 1)
    assert slope == pytest.approx(-beta, abs=0.05)


@pytest.mark.parametrize("beta", [0.0, 2.0])
@pytest.mark.parametrize("horizon", [1, 2, 7, 32])
def test_every_step_has_zero_mean_and_unit_variance(beta, horizon):
    noise = draw(beta, horizon=horizon)
    np.testing.assert_allclose(noise.mean(0), 0.0, atol=0.07)
    np.testing.assert_allclose(noise.var(0), 1.0, atol=0.12)


def test_actions_and_draws_are_independent():
    noise = draw(2.0)
    assert abs(np.corrcoef(noise[:, 5, 0], noise[:, 5, 1])[0, 1]) < 0.06
    assert abs(np.corrcoef(noise[:-1, 5, 0], noise[1:, 5, 0])[0, 1]) < 0.06
    assert np.corrcoef(noise[:, 5, 0], noise[:, 6, 0])[0, 1] > 0.8


def test_exponent_zero_is_plain_normal_noise():
    shape = (3, 5, 2)
    white = jax.random.normal(jax.random.key(0), shape)
    np.testing.assert_array_equal(colored_noise(jax.random.key(0), shape, 0.0), white)
