"""Losses over heads and the assignment of segments to heads (paper, section 3).

Everything is per member: heads compete within a member, never across members.
"""

from typing import Literal

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from headway.models.multi_headed import ContextEncoder, GaussianNet, MultiHeadDynamics, Prediction

HIDDEN_DECAY = (2.5e-5, 5e-5, 7.5e-5)
HEAD_DECAY = 1e-4


def negative_log_likelihood(
    prediction: Prediction, target: Float[Array, "..."], axis: int = -1
) -> Float[Array, "..."]:
    """Gaussian NLL without constants, averaged over dimensions; squared error if deterministic.

    `(mean - target)^2 exp(-logvar) + logvar` (released code).

    Args:
        prediction: What is compared with the target.
        target: The normalised `delta`, broadcast against it.
        axis: That of the dimensions, over which the average is.
    """
    squared = jnp.square(prediction.mean - target)
    if prediction.logvar is None:
        return squared.mean(axis)
    return (squared * jnp.exp(-prediction.logvar) + prediction.logvar).mean(axis)


def assign_heads(losses: Float[Array, "*batch head segment"]) -> Int[Array, "*batch segment"]:
    """Give each segment to the head of least loss; ties go to the lower index.

    A head with a non-finite loss never wins over one with a finite loss.
    """
    return jnp.argmin(jnp.where(jnp.isfinite(losses), losses, jnp.inf), axis=-2)


def independent_loss(
    losses: Float[Array, "member head sample"], weight: Float[Array, "member sample"]
) -> Float[Array, ""]:
    """Every head learns from every sample: mean over samples and heads, sum over members.

    Args:
        losses: NLL of every head on every sample.
        weight: 1 for a sample, 0 for padding.
    """
    per_head = (losses * weight[:, None]).sum(-1) / jnp.maximum(weight.sum(-1), 1.0)[:, None]
    return per_head.mean(-1).sum()


def oracle_loss(
    losses: Float[Array, "member head sample"],
    assignment: Int[Array, "member sample"],
    weight: Float[Array, "member sample"],
    reduction: Literal["head", "segment"] = "head",
) -> Float[Array, ""]:
    """Each sample teaches only the head that owns it; sum over members.

    Args:
        losses: NLL of every head on every sample.
        assignment: The head that owns each sample.
        weight: 1 for a sample, 0 for padding.
        reduction: `head` averages within each head, then sums over heads, so that a head
            counts the same however few samples it owns (released code); `segment`
            is the plain average over samples.
    """
    num_heads = losses.shape[1]
    owned = (assignment[:, None] == jnp.arange(num_heads)[:, None]) * weight[:, None]
    total = jnp.where(owned > 0, losses * owned, 0.0).sum(-1)
    if reduction == "head":
        return (total / jnp.maximum(owned.sum(-1), 1.0)).sum()
    return (total.sum(-1) / jnp.maximum(weight.sum(-1), 1.0)).sum()


def logvar_bound_loss(net: GaussianNet) -> Float[Array, ""]:
    """Sum of upper minus lower variance bounds: keeps the learned bounds close (PETS)."""
    if net.max_logvar is None or net.min_logvar is None:
        return jnp.zeros(())
    return net.max_logvar.sum() - net.min_logvar.sum()


def weight_decay_loss(net: GaussianNet | ContextEncoder) -> Float[Array, ""]:
    """Per-layer L2 penalty c/2 |W|^2 over all members; biases are free (released code)."""
    layers = [*net.hidden]
    if isinstance(net, ContextEncoder):
        heads = []
        layers.append(net.output)
    else:
        heads = [head for head in (net.mean_heads, net.logvar_heads) if head is not None]
    decays = [HIDDEN_DECAY[min(i, len(HIDDEN_DECAY) - 1)] for i in range(len(layers))]
    weighted = [*zip(decays, layers, strict=True), *((HEAD_DECAY, head) for head in heads)]
    penalties = [c * sum_of_squares(layer.weight) for c, layer in weighted]
    return 0.5 * jnp.stack(penalties).sum()


def sum_of_squares(values: Float[Array | np.ndarray, "..."]) -> Float[Array, ""]:
    """As a product, which XLA computes faster than a sum on one core of a CPU."""
    return jnp.vdot(values, values, precision="highest")


def model_decay_loss(model: MultiHeadDynamics, *, context: bool) -> Float[Array, ""]:
    """Weight decay of every network; the context encoder's only if `context`."""
    nets = [model.forward_net, model.backward_net, model.context_encoder if context else None]
    return sum((weight_decay_loss(net) for net in nets if net is not None), jnp.zeros(()))
