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
STATISTICS = toys.odd_statistics()
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


def twin_loss(losses, owner, weight, reduction):
    total = 0.0
    for member, heads, used in zip(losses.astype(np.float64), owner, weight > 0, strict=True):
        if reduction == "independent":
            total += member[:, used].mean()
        elif reduction == "segment":
            total += np.mean([member[heads[i], i] for i in np.flatnonzero(used)])
        else:
            each = [member[head, used & (heads == head)] for head in range(len(member))]
            total += sum(mine.mean() for mine in each if mine.size)
    return total


@given(seeds, sizes)
def test_negative_log_likelihood_equals_its_numpy_twin(seed, size):
    rng = np.random.default_rng(seed)
    mean, logvar, target = rng.normal(size=(3, *size)).astype(np.float32)
    prediction = Prediction(jnp.asarray(mean), jnp.asarray(logvar))
    got = negative_log_likelihood(prediction, jnp.asarray(target))
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


@pytest.mark.parametrize("reduction", ["independent", *REDUCTIONS])
@given(seed=seeds, size=sizes, poison=st.floats(-1e6, 1e6, width=32))
def test_losses_equal_their_numpy_twins_whatever_the_padding(reduction, seed, size, poison):
    losses, owner, weight = random_losses(seed, size)
    losses = np.where(weight[:, None] > 0, losses, np.float32(poison))
    args = map(jnp.asarray, (losses, owner, weight))
    if reduction == "independent":
        got = independent_loss(next(args), jnp.asarray(weight))
    else:
        got = oracle_loss(*args, reduction)
    twin = twin_loss(losses, owner, weight, reduction)
    np.testing.assert_allclose(got, twin, rtol=1e-4, atol=1e-5)


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


@eqx.filter_jit
def gradient(model, owners, batch, config):
    def objective(model):
        losses = head_losses(model, toys.POINT, STATISTICS, batch)
        return total_loss(model, losses, owners, batch.weight, config)[0]

    return jax.grad(objective)(model)


@pytest.mark.parametrize("reduction", REDUCTIONS)
def test_a_head_that_wins_nothing_learns_nothing_and_makes_no_nan(reduction):
    model, batch = toys.small_model(), random_batch(0)
    owners = Assignment(jnp.zeros((2, 6), int), jnp.ones((2, 6), int))
    config = FittingConfig(reduction=reduction, weight_decay=0.0, logvar_bound_weight=0.0)
    grads = gradient(model, owners, batch, config)
    for net, winner in ((grads.forward_net, 0), (grads.backward_net, 1)):
        for values in jax.tree.leaves((net.mean_heads, net.logvar_heads)):
            assert not np.asarray(values[:, 1 - winner]).any()
            assert np.asarray(values[:, winner]).any()
        assert not np.asarray(net.max_logvar[1 - winner]).any()
        assert not np.asarray(net.min_logvar[1 - winner]).any()
    toys.assert_finite(grads)


def test_weight_decay_equals_its_numpy_twin_and_spares_biases():
    model = toys.small_model()
    exact = toys.f64(model)
    nets = {name: getattr(exact, name) for name in ("forward_net", "backward_net")}
    for name, net in (nets | {"context_encoder": exact.context_encoder}).items():
        heads = (net.mean_heads, net.logvar_heads) if name in nets else ()
        layers = [*net.hidden, *([] if heads else [net.output])]
        rates = (2.5e-5, 5e-5, 7.5e-5, 7.5e-5)
        twin = sum(c * (layer.weight**2).sum() for c, layer in zip(rates, layers, strict=False))
        twin += sum(1e-4 * (head.weight**2).sum() for head in heads)
        np.testing.assert_allclose(weight_decay_loss(net), twin / 2, rtol=1e-5)
    grads = jax.grad(lambda m: model_decay_loss(m, context=True))(model)
    assert not np.asarray(grads.forward_net.hidden[0].bias).any()
    assert not np.asarray(grads.forward_net.mean_heads.bias).any()
