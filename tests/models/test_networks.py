"""Layers, normalisers and products in reduced precision, against NumPy twins."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from headway.models.folding import bounded_var
from headway.models.networks import (
    Dense,
    affine,
    bound_logvar,
    heads_columns,
    rounded,
    softplus,
    truncated_normal,
)
from headway.models.statistics import Normalizer


def draws(seed, *shape):
    return jax.random.normal(jax.random.key(seed), shape)


@given(st.integers(0, 2**16), st.floats(-1e3, 1e3, width=32))
def test_denormalise_undoes_normalise_where_the_feature_varies(seed, offset):
    values = (np.random.default_rng(seed).normal(size=(20, 2)) + offset).astype(np.float32)
    normalizer = Normalizer.fit(values)
    back = normalizer.denormalize(normalizer.normalize(jnp.asarray(values)))
    np.testing.assert_allclose(back, values, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("constant", [0.0, 1.0, -3.7, 0.1, 1e6, 1e-20])
def test_a_constant_feature_is_shifted_not_scaled_and_always_given_back(constant):
    values = np.full((1000, 1), constant, np.float32)
    normalizer = Normalizer.fit(values)
    assert (float(normalizer.std[0]), float(normalizer.scale[0])) == (0.0, 1.0)
    np.testing.assert_array_equal(normalizer.normalize(jnp.asarray(values)), 0.0)
    np.testing.assert_array_equal(normalizer.denormalize(jnp.full((3, 1), 99.0)), values[:3])


def test_layers_equal_their_numpy_twins_per_member_and_head():
    x = draws(0, 2, 5, 4)
    layers = [Dense(draws(seed, 2, 3, 4, 6), draws(seed + 1, 2, 3, 6)) for seed in (1, 3)]
    for layer, found in zip(layers, heads_columns(layers, x.mT), strict=True):
        single = Dense(layer.weight[:, 1], layer.bias[:, 1])(x)
        for member, head in np.ndindex(2, 3):
            twin = np.asarray(x[member] @ layer.weight[member, head] + layer.bias[member, head])
            np.testing.assert_allclose(found[member, head].T, twin, rtol=1e-4, atol=1e-5)
            if head == 1:
                np.testing.assert_allclose(single[member], twin, rtol=1e-4, atol=1e-5)


def test_initial_weights_are_truncated_at_two_deviations_and_biases_zero():
    weight = np.asarray(truncated_normal(jax.random.key(0), (2, 100, 100), 100))
    sigma = 1 / (2 * np.sqrt(100))
    assert np.abs(weight).max() <= 2 * sigma * (1 + 1e-6)
    assert weight.std() == pytest.approx(0.88 * sigma, rel=0.01)  # of a normal cut at 2 sigma
    layer = Dense.init((2,), 3, 4, key=jax.random.key(0))
    assert not np.asarray(layer.bias).any()
    assert (np.asarray(layer.weight[0]) != np.asarray(layer.weight[1])).all()


def test_softplus_and_its_slope_are_jaxs():
    x = jnp.asarray([-200.0, -20.0, -3.0, -0.1, 0.0, 0.1, 3.0, 20.0, 200.0])
    np.testing.assert_allclose(softplus(x), jax.nn.softplus(x), rtol=1e-6, atol=1e-7)
    slope, twin = (jax.vmap(jax.grad(one))(x) for one in (softplus, jax.nn.softplus))
    np.testing.assert_allclose(slope, twin, rtol=1e-5, atol=1e-7)
    np.testing.assert_array_equal(softplus(jnp.asarray([-jnp.inf, jnp.inf])), [0.0, jnp.inf])


def test_the_variance_of_a_plan_is_that_of_bounded_log_variances():
    logvar = jnp.asarray([-300.0, -80.0, -12.0, -3.0, 0.4, 5.0, 80.0, 300.0])
    for bounds in ((-10.0, 0.5), (-40.0, 20.0), (-2.0, -1.5)):
        expected = jnp.exp(bound_logvar(logvar, *map(jnp.float32, bounds)))
        found = bounded_var(logvar, *map(jnp.float32, bounds))
        np.testing.assert_allclose(found, expected, rtol=2e-5)


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


def test_reduced_products_and_gradients_are_those_of_rounded_factors():
    x, weight = draws(0, 2, 5, 7), draws(1, 2, 5, 4)
    bias, gradient = draws(3, 2, 4), draws(2, 2, 4, 7)
    out, back = jax.vjp(lambda *layer: affine(*layer, "bfloat16"), x, weight, bias)
    columns, matrix, above = (
        np.asarray(rounded(values, jnp.bfloat16).astype(jnp.float32), np.float64)
        for values in (x, weight, gradient)
    )
    twins = (
        matrix.swapaxes(1, 2) @ columns + np.asarray(bias)[:, :, None],
        matrix @ above,
        columns @ above.swapaxes(1, 2),
        above.sum(-1),
    )
    for found, twin in zip((out, *back(gradient)), twins, strict=True):
        np.testing.assert_allclose(found, twin, rtol=1e-5, atol=1e-6)
        assert found.dtype == np.float32
