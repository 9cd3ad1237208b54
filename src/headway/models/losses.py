"""Losses over heads and the assignment of segments to heads (paper, section 3).

Everything is per member: heads compete within a member, never across members.
"""

from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from headway.config import FittingConfig
from headway.data import History
from headway.models.multi_headed import MultiHeadNet
from headway.models.networks import ContextEncoder, GaussianNet, Prediction, softplus
from headway.models.statistics import Statistics, network_input
from headway.task import Task

HIDDEN_DECAY = (2.5e-5, 5e-5, 7.5e-5)
HEAD_DECAY = 1e-4


class Batch(NamedTuple):
    """Samples of every member; leading axes [member, sample]."""

    obs: Float[Array, "member sample obs"]
    action: Float[Array, "member sample action"]
    next_obs: Float[Array, "member sample obs"]
    history: History
    weight: Float[Array, "member sample"]
    """1 for a sample, 0 for padding."""
    sim_params: Float[Array, "member sample sim_param"] | None = None
    """The true simulator parameters, for a model that is told them."""
    trajectory: Int[Array, "member sample"] | None = None
    """Row of the trajectory that each sample comes from."""
    outcome: Float[Array, "member sample outcome"] | None = None
    """Reward, and 1 where the episode ended for good, for a model that learns them."""


class HeadLosses(NamedTuple):
    """NLL of every head on every sample, forwards and backwards in time."""

    forward: Float[Array, "member head sample"]
    backward: Float[Array, "member head sample"] | None


class Assignment(NamedTuple):
    """The best head per member and segment (or sample), for each direction."""

    forward: Int[Array, "member *segment"]
    backward: Int[Array, "member *segment"] | None


def negative_log_likelihood(
    prediction: Prediction, target: Float[Array, "..."], axis: int = -1
) -> Float[Array, "..."]:
    """Gaussian NLL without constants, averaged over dimensions; squared error if deterministic.

    `(mean - target)^2 exp(-logvar) + logvar` (released code).

    Args:
        prediction: Compared with the target.
        target: The normalised `delta`, broadcast against it.
        axis: That of the dimensions, over which the average is.
    """
    squared = jnp.square(prediction.mean - target)
    if prediction.logvar is None:
        return squared.mean(axis)
    return (squared * jnp.exp(-prediction.logvar) + prediction.logvar).mean(axis)


def head_losses(
    model: MultiHeadNet, task: Task, statistics: Statistics, batch: Batch
) -> HeadLosses:
    """Loss of every head on every sample, with the context of the sample's history.

    A learned reward is one more dimension of what is predicted; to it comes the cross-entropy of
    the end of the episode.
    """
    context = model.context(batch.history, statistics, batch.sim_params)

    def predicted(net: GaussianNet, start) -> Prediction:
        x = network_input(task, statistics, start, batch.action)
        return net(x.mT, None if context is None else context.mT)

    forward = predicted(model.forward_net, batch.obs)
    target = statistics.delta.normalize(task.target(batch.obs, batch.next_obs))
    ends = jnp.zeros(())
    if statistics.reward is not None and batch.outcome is not None:
        logit, ended = forward.mean[:, :, -1], batch.outcome[:, None, :, 1]
        ends = softplus(logit) - ended * logit
        forward = jax.tree.map(lambda x: x[:, :, :-1], forward)
        reward = statistics.reward.normalize(batch.outcome[..., :1])
        target = jnp.concatenate([target, reward], axis=-1)
    loss = negative_log_likelihood(forward, target.mT[:, None], axis=-2) + ends
    if model.backward_net is None:
        return HeadLosses(loss, None)
    backward = predicted(model.backward_net, batch.next_obs)
    target = statistics.backward_delta.normalize(task.target(batch.next_obs, batch.obs))
    return HeadLosses(loss, negative_log_likelihood(backward, target.mT[:, None], axis=-2))


def assign_heads(losses: Float[Array, "*batch head segment"]) -> Int[Array, "*batch segment"]:
    """Give each segment to the head of least loss; ties go to the lower index.

    A head with a non-finite loss never wins over one with a finite loss.
    """
    return jnp.argmin(jnp.where(jnp.isfinite(losses), losses, jnp.inf), axis=-2)


def independent_loss(
    losses: Float[Array, "member head sample"], weight: Float[Array, "member sample"]
) -> Float[Array, ""]:
    """Every head learns from every sample: mean over samples and heads, sum over members."""
    per_head = (losses * weight[:, None]).sum(-1) / jnp.maximum(weight.sum(-1), 1.0)[:, None]
    return per_head.mean(-1).sum()


def oracle_loss(
    losses: Float[Array, "member head sample"],
    assignment: Int[Array, "member sample"],
    weight: Float[Array, "member sample"],
    reduction: Literal["head", "segment"] = "head",
) -> Float[Array, ""]:
    """Each sample teaches only its best head; sum over members.

    Args:
        losses: NLL of every head on every sample.
        assignment: The best head of each sample.
        weight: 1 for a sample, 0 for padding.
        reduction: `head` averages within each head, then sums over heads, so that a head
            counts the same however few samples it has (released code); `segment`
            is the plain average over samples.
    """
    num_heads = losses.shape[1]
    owned = (assignment[:, None] == jnp.arange(num_heads)[:, None]) * weight[:, None]
    total = jnp.where(owned > 0, losses * owned, 0.0).sum(-1)
    if reduction == "head":
        return (total / jnp.maximum(owned.sum(-1), 1.0)).sum()
    return (total.sum(-1) / jnp.maximum(weight.sum(-1), 1.0)).sum()


def total_loss(
    model: MultiHeadNet,
    losses: HeadLosses,
    assignment: Assignment | None,
    weight: Float[Array, "member sample"],
    config: FittingConfig,
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """The objective (paper, section 3), and the forward prediction loss in it.

    Args:
        model: For its variance bounds and weights.
        losses: Loss of every head on every sample.
        assignment: The best head of each sample; None trains all heads on all samples.
        weight: 1 for a sample, 0 for padding.
        config: Weights of the terms.
    """

    def reduce(direction, heads):
        if heads is None:
            return independent_loss(direction, weight)
        return oracle_loss(direction, heads, weight, config.reduction)

    bound = config.logvar_bound_weight
    forward = reduce(losses.forward, assignment and assignment.forward)
    loss = forward + bound * logvar_bound_loss(model.forward_net)
    if losses.backward is not None and model.backward_net is not None:
        backward = reduce(losses.backward, assignment and assignment.backward)
        backward = backward + bound * logvar_bound_loss(model.backward_net)
        loss = loss + config.backward_weight * backward
    decay = model_decay_loss(model, context=config.context_weight_decay)
    return loss + config.weight_decay * decay, forward


def logvar_bound_loss(net: GaussianNet) -> Float[Array, ""]:
    """Sum of upper minus lower variance bounds: keeps the learned bounds close (PETS)."""
    if net.max_logvar is None or net.min_logvar is None:
        return jnp.zeros(())
    return net.max_logvar.sum() - net.min_logvar.sum()


def weight_decay_loss(net: GaussianNet | ContextEncoder) -> Float[Array, ""]:
    """Per-layer L2 penalty c/2 |W|^2 over all members; biases are free (released code)."""
    layers, heads = [*net.hidden], []
    if isinstance(net, ContextEncoder):
        layers.append(net.output)
    else:
        heads = [head for head in (net.mean_heads, net.logvar_heads) if head is not None]
    decays = [HIDDEN_DECAY[min(i, len(HIDDEN_DECAY) - 1)] for i in range(len(layers))]
    weighted = [*zip(decays, layers, strict=True), *((HEAD_DECAY, head) for head in heads)]
    return 0.5 * jnp.stack([c * sum_of_squares(layer.weight) for c, layer in weighted]).sum()


def model_decay_loss(model: MultiHeadNet, *, context: bool) -> Float[Array, ""]:
    """Weight decay of every network; the context encoder's only if `context`."""
    nets = [model.forward_net, model.backward_net, model.context_encoder if context else None]
    return sum((weight_decay_loss(net) for net in nets if net is not None), jnp.zeros(()))


def sum_of_squares(values: Float[Array | np.ndarray, "..."]) -> Float[Array, ""]:
    """As a product, which XLA computes faster than a sum on one core of a CPU."""
    return jnp.vdot(values, values, precision="highest")
