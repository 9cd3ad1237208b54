"""Losses against NumPy twins, and what must hold of any oracle."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import toys
from headway.config import FittingConfig
from headway.models.losses import (
    HEAD_DECAY,
    Assignment,
    Batch,
    assign_heads,
    head_losses,
    independent_loss,
    model_decay_loss,
    negative_log_likelihood,
    oracle_loss,
    total_loss,
    weight_decay_loss,
)
from headway.models.networks import Prediction, bound_logvar

REDUCTIONS = ["head", "segment"]
seeds = st.integers(0, 2**16)
sizes = st.sampled_from([(2, 3, 9), (1, 2, 4)])  # few shapes, few compilations


def random_losses(seed, size):
    """Losses, owners and weights (some zero, at least one not) of random samples."""
    rng = np.random.default_rng(seed)
    members, heads, samples = size
    weight = (rng.random((members, samples)) < 0.7).astype(np.float32)
    weight[:, 0] = 1.0
    owner = rng.integers(0, heads, (members, samples)).astype(np.int32)
    return rng.normal(size=size).astype(np.float32), owner, weight


def twin_independent(losses, weight):
    total = 0.0
    for member, used in zip(losses.astype(np.float64), weight > 0, strict=True):
        total += member[:, used].mean()
    return total


def twin_oracle(losses, owner, weight, reduction):
    total = 0.0
    for member, heads, used in zip(losses.astype(np.float64), owner, weight > 0, strict=True):
        if reduction == "segment":
            total += np.mean([member[heads[i], i] for i in np.flatnonzero(used)])
            continue
        for head in range(len(member)):
            mine = used & (heads == head)
            total += member[head, mine].mean() if mine.any() else 0.0
    return total


@given(seeds, sizes)
def test_negative_log_likelihood_equals_its_numpy_twin(seed, size):
    rng = np.random.default_rng(seed)
    mean, logvar, target = rng.normal(size=(3, *size)).astype(np.float32)
    got = negative_log_likelihood(
        Prediction(jnp.asarray(mean), jnp.asarray(logvar)), jnp.asarray(target)
    )
    twin = ((toys.f64(mean) - target) ** 2 / np.exp(toys.f64(logvar)) + logvar).mean(-1)
    np.testing.assert_allclose(got, twin, rtol=1e-4, atol=1e-6)


@given(seeds)
def test_bounded_logvar_equals_its_numpy_twin_and_stays_above_the_lower_bound(seed):
    rng = np.random.default_rng(seed)
    low, high = rng.normal(-10, 1, 4).astype(np.float32), rng.normal(0.5, 1, 4).astype(np.float32)
    logvar = rng.normal(0, 20, (6, 4)).astype(np.float32)
    squeezed = toys.f64(high) - toys.softplus(toys.f64(high) - logvar)
    twin = low + toys.softplus(squeezed - low)
    got = bound_logvar(jnp.asarray(logvar), jnp.asarray(low), jnp.asarray(high))
    np.testing.assert_allclose(got, twin, rtol=1e-5, atol=1e-5)
    assert (np.asarray(got) >= low).all()
    assert (np.asarray(got) <= high + 1e-3).all()


@given(seeds, sizes)
def test_independent_loss_equals_its_numpy_twin(seed, size):
    losses, _, weight = random_losses(seed, size)
    got = independent_loss(jnp.asarray(losses), jnp.asarray(weight))
    np.testing.assert_allclose(got, twin_independent(losses, weight), rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("reduction", REDUCTIONS)
@given(seed=seeds, size=sizes)
def test_oracle_loss_equals_its_numpy_twin(reduction, seed, size):
    losses, owner, weight = random_losses(seed, size)
    got = oracle_loss(jnp.asarray(losses), jnp.asarray(owner), jnp.asarray(weight), reduction)
    np.testing.assert_allclose(
        got, twin_oracle(losses, owner, weight, reduction), rtol=1e-4, atol=1e-5
    )


@pytest.mark.parametrize("reduction", REDUCTIONS)
@given(seed=seeds, size=sizes, poison=st.floats(-1e6, 1e6, width=32))
def test_padding_samples_change_nothing(reduction, seed, size, poison):
    losses, owner, weight = random_losses(seed, size)
    poisoned = np.where(weight[:, None] > 0, losses, np.float32(poison))
    arrays = jnp.asarray(owner), jnp.asarray(weight)
    for values in (losses, poisoned):
        np.testing.assert_allclose(
            oracle_loss(jnp.asarray(values), *arrays, reduction),
            oracle_loss(jnp.asarray(np.where(weight[:, None] > 0, losses, 0)), *arrays, reduction),
            rtol=1e-6,
        )
    np.testing.assert_allclose(
        independent_loss(jnp.asarray(poisoned), arrays[1]),
        independent_loss(jnp.asarray(losses), arrays[1]),
        rtol=1e-6,
    )


def test_ties_go_to_the_lower_head():
    np.testing.assert_array_equal(assign_heads(jnp.zeros((1, 3, 2))), [[0, 0]])


def random_batch(seed, samples=6, members=2):
    rng = np.random.default_rng(seed)
    episodes, _ = toys.lay_out([toys.random_trajectory(samples + 1, seed)])
    step = jnp.asarray(rng.integers(0, samples, (members, samples)))
    row = jnp.zeros_like(step)
    return Batch(
        episodes.obs[row, step],
        episodes.action[row, step],
        episodes.obs[row, step + 1],
        episodes.history(row, step, 3),
        jnp.ones((members, samples)),
    )


def gradient(model, owners, batch, config):
    return compiled_gradient(model, owners, batch, config, toys.odd_statistics())


@eqx.filter_jit
def compiled_gradient(model, owners, batch, config, statistics):
    def objective(model):
        losses = head_losses(model, toys.POINT, statistics, batch)
        return total_loss(model, losses, owners, batch.weight, config)[0]

    return jax.grad(objective)(model)


@pytest.mark.parametrize("reduction", REDUCTIONS)
def test_a_head_that_wins_nothing_learns_nothing_and_makes_no_nan(reduction):
    model, batch = toys.small_model(), random_batch(0)
    owners = Assignment(jnp.zeros((2, 6), int), jnp.ones((2, 6), int))
    config = FittingConfig(reduction=reduction, weight_decay=0.0, logvar_bound_weight=0.0)
    grads = gradient(model, owners, batch, config)
    for net, winner in ((grads.forward_net, 0), (grads.backward_net, 1)):
        for heads in (net.mean_heads, net.logvar_heads):
            for values in (heads.weight, heads.bias):
                assert not np.asarray(values[:, 1 - winner]).any()
                assert np.asarray(values[:, winner]).any()
        assert not np.asarray(net.max_logvar[1 - winner]).any()
        assert not np.asarray(net.min_logvar[1 - winner]).any()
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(grads))


def test_context_encoder_learns_through_both_directions():
    model, batch = toys.small_model(), random_batch(2)
    both = gradient(model, None, batch, FittingConfig(weight_decay=0.0))
    forward = gradient(model, None, batch, FittingConfig(weight_decay=0.0, backward_weight=0.0))
    encoder = both.context_encoder.output.weight, forward.context_encoder.output.weight
    assert np.asarray(encoder[1]).any()
    assert np.abs(np.asarray(encoder[0] - encoder[1])).max() > 1e-6


def test_weight_decay_equals_its_numpy_twin_and_spares_biases():
    model = toys.f64(toys.small_model())
    for net in (model.forward_net, model.backward_net, model.context_encoder):
        layers = [*net.hidden] + ([net.output] if net is model.context_encoder else [])
        twin = sum(
            c / 2 * (layer.weight**2).sum()
            for c, layer in zip((2.5e-5, 5e-5, 7.5e-5, 7.5e-5), layers, strict=False)
        )
        if net is not model.context_encoder:
            twin += (
                HEAD_DECAY
                / 2
                * sum((h.weight**2).sum() for h in (net.mean_heads, net.logvar_heads))
            )
        np.testing.assert_allclose(weight_decay_loss(net), twin, rtol=1e-5)
    assert HEAD_DECAY == 1e-4
    grads = jax.grad(lambda m: model_decay_loss(m, context=True))(toys.small_model())
    assert not np.asarray(grads.forward_net.hidden[0].bias).any()
    assert not np.asarray(grads.forward_net.mean_heads.bias).any()
