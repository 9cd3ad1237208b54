"""The released T-MCL code's numbers on one batch, reproduced with the real loss functions.

`released_code.npz` holds weights, normalisers, a batch and what the released code computed
from them in float32. Scalars must agree to 1e-5 relative, the context and every gradient to
1e-5 of the largest entry of its array. Both are checked in float32 and float64.
"""

import functools
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from headway.config import FittingConfig
from headway.data import History, segment_sums
from headway.models.losses import (
    Assignment,
    Batch,
    assign_heads,
    head_losses,
    independent_loss,
    logvar_bound_loss,
    oracle_loss,
    total_loss,
    weight_decay_loss,
)
from headway.models.multi_headed import MultiHeadNet
from headway.models.networks import ContextEncoder, Dense, GaussianNet
from headway.models.statistics import Normalizer, Statistics
from headway.worlds.locomotion import HalfCheetahTask

SEGMENT = 10
NUM_HEADS = 3
TOLERANCE = 1e-5
VALUES = np.load(Path(__file__).with_name("released_code.npz"))
TASK = HalfCheetahTask()


def read(name):
    return jnp.asarray(np.asarray(VALUES[name], np.float64))  # narrowed unless x64 is on


def dense(path):
    return Dense(read(f"{path}/weight"), read(f"{path}/bias")[:, 0])


def dense_heads(path, kind):
    heads = [dense(f"{path}/head{i}/{kind}") for i in range(NUM_HEADS)]
    return Dense(
        jnp.stack([head.weight for head in heads], 1), jnp.stack([head.bias for head in heads], 1)
    )


def gaussian_net(path):
    return GaussianNet(
        tuple(dense(f"{path}/hidden{i}") for i in range(4)),
        dense_heads(path, "mu"),
        dense_heads(path, "logvar"),
        read(f"{path}/max_logvar")[:, 0, 0],
        read(f"{path}/min_logvar")[:, 0, 0],
    )


def dynamics(path):
    """A model from the weights under `path`; gradients are stored under the same names."""
    encoder = ContextEncoder(
        tuple(dense(f"{path}/context/hidden{i}") for i in range(3)), dense(f"{path}/context/output")
    )
    return MultiHeadNet(gaussian_net(f"{path}/forward"), gaussian_net(f"{path}/backward"), encoder)


def normalizer(name, *shape):
    return Normalizer(
        read(f"norm/{name}_mean").reshape(shape), read(f"norm/{name}_std").reshape(shape)
    )


def statistics():
    return Statistics(
        normalizer("obs", 18),
        normalizer("act", 6),
        normalizer("delta", 18),
        normalizer("back_delta", 18),
        normalizer("cp_act", 10, 6),
    )


def flat(name):
    """One of the batch's arrays as [member, sample, feature]."""
    values = read(f"batch/{name}")
    return values.reshape(values.shape[0], -1, values.shape[-1])


def batch():
    obs = flat("obs")
    past = History(
        flat("history_obs_diff").reshape(2, 70, 10, 18), flat("history_act").reshape(2, 70, 10, 6)
    )
    return Batch(obs, flat("act"), flat("next_obs"), past, jnp.ones(obs.shape[:2]))


def winners(losses):
    return assign_heads(segment_sums(losses, jnp.ones(losses.shape[-1], bool), SEGMENT))


def per_sample(heads):
    return jnp.repeat(heads, SEGMENT, axis=-1)


def total(model, losses, owners, weight, *, context_decay=False):
    config = FittingConfig(context_weight_decay=context_decay)
    return total_loss(model, losses, owners, weight, config)[0]


def oracle_total(model, statistics, batch, owners):
    return total(model, head_losses(model, TASK, statistics, batch), owners, batch.weight)


@jax.jit
def compute(model, statistics, batch):
    """Everything that is compared, from the project's own functions."""
    weight = batch.weight
    losses = head_losses(model, TASK, statistics, batch)
    heads = Assignment(*map(winners, losses))
    owners = Assignment(*map(per_sample, heads))
    silent = [
        GaussianNet(net.hidden, net.mean_heads, None, None, None)
        for net in (model.forward_net, model.backward_net)
    ]
    squared = head_losses(MultiHeadNet(*silent, model.context_encoder), TASK, statistics, batch)
    scalars = {
        "loss_independent_forward": independent_loss(losses.forward, weight),
        "loss_independent_backward": independent_loss(losses.backward, weight),
        "loss_oracle_forward": oracle_loss(losses.forward, owners.forward, weight),
        "loss_oracle_backward": oracle_loss(losses.backward, owners.backward, weight),
        "loss_logvar_bound_forward": 0.01 * logvar_bound_loss(model.forward_net),
        "loss_logvar_bound_backward": 0.01 * logvar_bound_loss(model.backward_net),
        "loss_weight_decay_forward": weight_decay_loss(model.forward_net),
        "loss_weight_decay_backward": weight_decay_loss(model.backward_net),
        "loss_total_independent": total(model, losses, None, weight),
        "loss_total_oracle": total(model, losses, owners, weight),
        "loss_mse_independent": independent_loss(squared.forward, weight),
    }
    return {
        "context": model.context(batch.history, statistics),
        "heads": heads,
        "scalars": scalars,
        "gradient": jax.grad(oracle_total)(model, statistics, batch, owners),
        "total_with_context_decay": total(model, losses, owners, weight, context_decay=True),
        "context_decay": weight_decay_loss(model.context_encoder),
        "delta": TASK.target(batch.obs, batch.next_obs),
        "back_delta": TASK.target(batch.next_obs, batch.obs),
    }


@functools.cache
def computed(x64):
    with jax.enable_x64(x64):
        return jax.tree.map(np.asarray, compute(dynamics("param"), statistics(), batch()))


@pytest.fixture(params=[False, True], ids=["float32", "float64"])
def result(request):
    found = computed(request.param)
    assert found["context"].dtype == (np.float64 if request.param else np.float32)
    return found


@pytest.mark.parametrize("name", ["delta", "back_delta"])
def test_task_gives_the_regression_target_of_the_released_code(result, name):
    expected = VALUES[f"batch/{name}"].reshape(2, 70, 18)
    np.testing.assert_allclose(result[name], expected, rtol=TOLERANCE, atol=1e-6)


def test_context_vector_is_that_of_the_released_code(result):
    expected = VALUES["expect/context"].reshape(2, 70, 4)
    largest = np.abs(expected).max()
    np.testing.assert_allclose(result["context"], expected, rtol=0, atol=TOLERANCE * largest)


@pytest.mark.parametrize("direction", ["forward", "backward"])
def test_every_segment_goes_to_the_released_codes_head(result, direction):
    heads = getattr(result["heads"], direction)
    np.testing.assert_array_equal(heads, VALUES[f"expect/assignment_{direction}"])


def test_every_loss_term_equals_the_released_codes(result):
    stored = {key for key in VALUES if key.startswith("expect/loss")}
    assert {f"expect/{name}" for name in result["scalars"]} == stored
    for name, value in result["scalars"].items():
        np.testing.assert_allclose(value, VALUES[f"expect/{name}"], rtol=TOLERANCE, err_msg=name)


def test_every_gradient_of_the_oracle_loss_equals_the_released_codes(result):
    expected = dynamics("expect/grad_oracle")
    named = jax.tree_util.tree_leaves_with_path(result["gradient"])
    assert len(named) == 8 + 2 * (8 + 4 + 2)
    for (path, got), want in zip(named, jax.tree.leaves(expected), strict=True):
        largest = float(jnp.abs(want).max())
        assert largest > 0
        name = jax.tree_util.keystr(path)
        np.testing.assert_allclose(got, want, rtol=0, atol=TOLERANCE * largest, err_msg=name)


def test_adding_the_context_encoders_decay_changes_the_total_by_exactly_that(result):
    assert result["context_decay"] > 1e-4
    added = result["total_with_context_decay"] - result["scalars"]["loss_total_oracle"]
    np.testing.assert_allclose(added, result["context_decay"], atol=2e-6)
