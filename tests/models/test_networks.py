"""Layers and normalisers against NumPy twins."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from headway.models.networks import (
    Dense,
    DenseHeads,
    Normalizer,
    columns_of_each,
    softplus,
    truncated_normal,
)


def test_normalised_values_have_zero_mean_and_unit_variance():
    values = np.random.default_rng(0).normal(3.0, 2.0, (200, 3)).astype(np.float32)
    normalizer = Normalizer.fit(values)
    exact = values.astype(np.float64)
    np.testing.assert_allclose(normalizer.mean, exact.mean(0), rtol=1e-6)
    np.testing.assert_allclose(normalizer.std, exact.std(0), rtol=1e-6)
    scaled = np.asarray(normalizer.normalize(jnp.asarray(values)))
    np.testing.assert_allclose(scaled.mean(0), 0.0, atol=1e-5)
    np.testing.assert_allclose(scaled.std(0), 1.0, rtol=1e-5)


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
    assert float(normalizer.std[0]) == 0.0
    assert float(normalizer.scale[0]) == 1.0
    np.testing.assert_array_equal(normalizer.normalize(jnp.asarray(values)), 0.0)
    np.testing.assert_array_equal(normalizer.denormalize(jnp.full((3, 1), 99.0)), values[:3])


def test_dense_layers_equal_their_numpy_twins_per_member_and_head():
    rng = np.random.default_rng(0)
    x = rng.normal(size=(2, 5, 4))
    weight, bias = rng.normal(size=(2, 3, 4, 6)), rng.normal(size=(2, 3, 6))
    heads = DenseHeads(jnp.asarray(weight, jnp.float32), jnp.asarray(bias, jnp.float32))
    got = heads(jnp.asarray(x, jnp.float32))
    layer = Dense(heads.weight[:, 1], heads.bias[:, 1])
    single = layer(jnp.asarray(x, jnp.float32))
    for member in range(2):
        for head in range(3):
            twin = x[member] @ weight[member, head] + bias[member, head]
            np.testing.assert_allclose(got[member, head], twin, rtol=1e-4, atol=1e-5)
        np.testing.assert_allclose(single[member], got[member, 1], rtol=1e-5, atol=1e-6)


def test_layers_of_heads_in_one_product_are_those_of_each():
    draw = np.random.default_rng(1).normal
    x = jnp.asarray(draw(size=(2, 4, 5)), jnp.float32)
    layers = [
        DenseHeads(
            jnp.asarray(draw(size=(2, 3, 4, 6)), jnp.float32),
            jnp.asarray(draw(size=(2, 3, 6)), jnp.float32),
        )
        for _ in range(2)
    ]
    for layer, found in zip(layers, columns_of_each(layers, x), strict=True):
        np.testing.assert_allclose(found, layer(x.mT).mT, rtol=1e-5, atol=1e-6)


def test_softplus_and_its_slope_are_jaxs():
    x = jnp.asarray([-200.0, -20.0, -3.0, -0.1, 0.0, 0.1, 3.0, 20.0, 200.0])
    np.testing.assert_allclose(softplus(x), jax.nn.softplus(x), rtol=1e-6, atol=1e-7)
    slope, twin = (jax.vmap(jax.grad(one))(x) for one in (softplus, jax.nn.softplus))
    np.testing.assert_allclose(slope, twin, rtol=1e-5, atol=1e-7)
    np.testing.assert_array_equal(softplus(jnp.asarray([-jnp.inf, jnp.inf])), [0.0, jnp.inf])


def test_initial_weights_are_truncated_at_two_deviations_and_biases_zero():
    weight = np.asarray(truncated_normal(jax.random.key(0), (2, 100, 100), 100))
    sigma = 1 / (2 * np.sqrt(100))
    assert np.abs(weight).max() <= 2 * sigma * (1 + 1e-6)
    assert weight.std() == pytest.approx(0.88 * sigma, rel=0.01)  # of a normal cut at 2 sigma
    layer = Dense.init(2, 3, 4, key=jax.random.key(0))
    assert not np.asarray(layer.bias).any()
    assert (np.asarray(layer.weight[0]) != np.asarray(layer.weight[1])).all()
