"""Products in reduced precision against float64, and fits that multiply so."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import toys
from headway.config import FittingConfig, MultiHeadedConfig
from headway.models.fitting import FitSetup, FitState, episode_losses, fit_epoch, make_data
from headway.models.multi_headed import MultiHeadDynamics, Statistics
from headway.models.networks import affine, rounded

TWO_LAYERS = MultiHeadedConfig(
    num_members=2, num_heads=2, hidden_sizes=(8, 8), context_size=3, context_hidden_sizes=(5,)
)

BOTH = ("float32", "bfloat16")


def draws(seed, *shape):
    return jax.random.normal(jax.random.key(seed), shape)


def exact(values):
    """Values rounded to bfloat16, in float64."""
    return np.asarray(rounded(values, jnp.bfloat16).astype(jnp.float32), np.float64)


def test_reduced_products_and_gradients_are_those_of_rounded_factors():
    x, weight, bias = draws(0, 2, 5, 7), draws(1, 2, 5, 4), draws(3, 2, 4)
    gradient = draws(2, 2, 4, 7)
    out, back = jax.vjp(lambda *layer: affine(*layer, "bfloat16"), x, weight, bias)
    of_x, of_weight, of_bias = back(gradient)
    columns, matrix, above = exact(x), exact(weight), exact(gradient)
    twin = matrix.swapaxes(1, 2) @ columns + np.asarray(bias)[:, :, None]
    np.testing.assert_allclose(out, twin, rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(of_x, matrix @ above, rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(of_weight, columns @ above.swapaxes(1, 2), rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(of_bias, above.sum(-1), rtol=1e-5, atol=1e-6)
    assert {part.dtype for part in (out, of_x, of_weight, of_bias)} == {np.dtype("float32")}


def test_a_model_in_reduced_precision_keeps_its_weights_and_its_first_layers():
    model = MultiHeadDynamics.init(TWO_LAYERS, toys.POINT, key=jax.random.key(0))
    reduced = model.in_precision("bfloat16")
    for net in (reduced.forward_net, reduced.backward_net):
        assert [layer.precision for layer in net.hidden] == ["float32", "bfloat16"]
        assert net.mean_heads.precision == "bfloat16"
    assert {layer.precision for layer in reduced.context_encoder.hidden} == {"bfloat16"}
    for a, b in zip(jax.tree.leaves(model), jax.tree.leaves(reduced), strict=True):
        assert a is b
    assert model.in_precision("float32") is model


def test_heads_are_assigned_by_the_model_that_is_fitted():
    trajectories = [toys.random_trajectory(9, seed=seed) for seed in range(2)]
    episodes, _ = toys.lay_out(trajectories, future_length=2)
    model = MultiHeadDynamics.init(TWO_LAYERS, toys.POINT, key=jax.random.key(0))

    def losses(model, precision):
        setup = FitSetup(toys.POINT, FittingConfig(precision=precision), TWO_LAYERS.history_length)
        statistics = Statistics.fit(toys.POINT, trajectories, TWO_LAYERS.history_length)
        return episode_losses(model, setup, episodes, 0, statistics).forward

    reduced = losses(model, "bfloat16")
    np.testing.assert_array_equal(reduced, losses(model.in_precision("bfloat16"), "float32"))
    assert (reduced != losses(model, "float32")).any()


@pytest.mark.parametrize("deterministic", [False, True])
def test_a_fit_in_reduced_precision_learns_the_same(deterministic):
    trajectories = [toys.random_trajectory(20, seed=seed) for seed in range(4)]
    episodes, samples = toys.lay_out(trajectories, future_length=2)
    config = dataclasses.replace(TWO_LAYERS, deterministic=deterministic)
    model = MultiHeadDynamics.init(config, toys.POINT, key=jax.random.key(0))
    losses = {}
    for precision in BOTH:
        settings = FittingConfig(
            precision=precision, future_length=2, segment_length=4, batch_size=16
        )
        setup = FitSetup(toys.POINT, settings, TWO_LAYERS.history_length)
        statistics = Statistics.fit(toys.POINT, trajectories, TWO_LAYERS.history_length)
        key = jax.random.key(1)
        data = make_data(episodes, samples, statistics, settings, num_members=2, key=key)
        state, losses[precision] = FitState.new(model), []
        for epoch in range(15):
            key = jax.random.fold_in(key, epoch)
            state, stats = fit_epoch(state, setup, data, independent=False, key=key)
            losses[precision].append(float(stats.forward_loss))
        assert jax.tree.structure(state.model) == jax.tree.structure(model)
    full, reduced = losses["float32"], losses["bfloat16"]
    assert full != reduced
    assert full[-1] < full[0] - 0.2
    np.testing.assert_allclose(reduced, full, atol=0.03 * (full[0] - full[-1]))
