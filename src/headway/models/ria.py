"""Relational intervention (RIA; Guo et al., ICLR 2022).

Two contexts of one trajectory describe the same physics. Two of different trajectories may,
too: they count as the same in so far as exchanging one for the other, an intervention, leaves
the predictions as they are. A linear relation head learns to tell whether two contexts are the
same, and what it learns shapes the context encoder.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from headway.config import FittingConfig
from headway.models.losses import HIDDEN_DECAY, Batch, sum_of_squares, weight_decay_loss
from headway.models.multi_headed import MultiHeadNet
from headway.models.networks import ContextEncoder, Dense, GaussianNet, swish
from headway.models.statistics import Statistics, flat_history, network_input
from headway.task import Task

RelationParts = tuple[ContextEncoder, Dense]
"""The context encoder and the relation head, which the relation loss trains."""


class Pairs(NamedTuple):
    """All pairs of the contexts of a batch."""

    same: Float[Array, "member context context"]
    """1 for two contexts of the same trajectory, else 0."""
    weight: Float[Array, "member context context"]
    """1 for a pair of samples, 0 where one of them is padding."""

    @classmethod
    def of(cls, batch: Batch) -> "Pairs":
        """Pair all samples of a batch with all."""
        row, weight = batch.trajectory, batch.weight
        assert row is not None
        same = (row[:, :, None] == row[:, None, :]).astype(jnp.float32)
        return cls(same, weight[:, :, None] * weight[:, None, :])

    def mean(self, values: Float[Array, "member context context"]) -> Float[Array, " member"]:
        """Mean over the pairs of each member."""
        total = self.weight.sum((1, 2))
        return (values * self.weight).sum((1, 2)) / jnp.maximum(total, 1.0)


def intervention_distance(
    net: GaussianNet,
    x: Float[Array, "member state in"],
    weight: Float[Array, "member state"],
    context: Float[Array, "member sample context"],
) -> Float[Array, "member sample sample"]:
    """Distance of two contexts by what a network predicts of the same states and actions.

    The absolute difference of the predicted means, averaged over states and dimensions. The
    layer that the context joins is linear in it, so its product is done once per state and once
    per context, not once per pair. States are gone through one by one, and again for the
    gradient: memory holds the pairs of one.

    Args:
        net: A network with one head.
        x: Network inputs of the states and actions.
        weight: 1 for a state, 0 for padding.
        context: The contexts to compare.
    """
    place = len(net.hidden) if net.context_layer is None else net.context_layer
    for layer in net.hidden[:place]:
        x = swish(layer(x))
    heads = Dense(net.mean_heads.weight[:, 0], net.mean_heads.bias[:, 0])
    joint, *after = [*net.hidden, heads][place:]
    width = x.shape[-1]
    of_state = Dense(joint.weight[:, :width], joint.bias)(x)
    of_context = context @ joint.weight[:, width:]

    @jax.checkpoint
    def add_state(total, state):
        of_one_state, weight = state
        mean = of_one_state[:, None] + of_context
        for layer in after:
            mean = layer(swish(mean))
        mean = mean.mT
        difference = jnp.abs(mean[:, :, :, None] - mean[:, :, None, :]).mean(1)
        return total + weight[:, None, None] * difference, None

    members, samples = context.shape[:2]
    empty = jnp.zeros((members, samples, samples))
    total, _ = jax.lax.scan(add_state, empty, (of_state.swapaxes(0, 1), weight.T))
    return total / jnp.maximum(weight.sum(-1), 1.0)[:, None, None]


def similarity(
    distance: Float[Array, "member sample sample"], pairs: Pairs, temperature: float
) -> Float[Array, "member sample sample"]:
    """Similarity of two contexts, from 0 to 1, by what they predict.

    `exp(-d / temperature)`, where `d` is the distance in units of its standard deviation over
    the pairs of a member.
    """
    centred = distance - pairs.mean(distance)[:, None, None]
    std = jnp.sqrt(pairs.mean(jnp.square(centred)))[:, None, None]
    return jnp.exp(-distance / (std + 1e-6) / temperature)


def relation_loss(
    head: Dense,
    context: Float[Array, "member sample context"],
    similarity: Float[Array, "member sample sample"],
    pairs: Pairs,
) -> Float[Array, ""]:
    """Cross-entropy of the relation head on all pairs: mean over pairs, sum over members.

    With y = 1 for the same trajectory and w the similarity, a pair is the same with
    `y + w (1 - y)`, and different with `(1 - y) (1 - w)`.

    Args:
        head: Takes two contexts, one after the other.
        context: The contexts of a batch.
        similarity: How much two of them count as the same; no gradient goes through it.
        pairs: Which of them are of the same trajectory.
    """
    size = context.shape[-1]
    first, second = (context @ head.weight[:, part] for part in (slice(size), slice(size, None)))
    logit = first + second.mT + head.bias[:, None]
    similarity = jax.lax.stop_gradient(similarity)
    same = pairs.same + similarity * (1 - pairs.same)
    loss = -same * jax.nn.log_sigmoid(logit) - (1 - same) * jax.nn.log_sigmoid(-logit)
    return pairs.mean(loss).sum()


def relation_decay_loss(parts: RelationParts) -> Float[Array, ""]:
    """Weight decay of the encoder, averaged over its layers, and of the relation head."""
    encoder, head = parts
    of_head = 0.5 * HIDDEN_DECAY[0] * sum_of_squares(head.weight)
    return weight_decay_loss(encoder) / (len(encoder.hidden) + 1) + of_head


def intervene(
    model: MultiHeadNet,
    task: Task,
    statistics: Statistics,
    batch: Batch,
    config: FittingConfig,
) -> tuple[Float[Array, ""], Float[Array, "member sample sample"]]:
    """Exchange the contexts of a batch with each other, and see what becomes of its predictions.

    Returns:
        The loss that pulls predictions with contexts of one trajectory together, summed over
        members, and how similar all contexts are by what they predict.
    """
    pairs = Pairs.of(batch)
    encoder, _ = relation_parts(model)
    context = encoder(flat_history(batch.history, statistics))
    first = slice(config.relation_transitions or None)

    def distance(net: GaussianNet, obs: Array) -> Float[Array, "member sample sample"]:
        x = network_input(task, statistics, obs[:, first], batch.action[:, first])
        return intervention_distance(net, x, batch.weight[:, first], context)

    mean = weighted = distance(model.forward_net, batch.obs)
    if model.backward_net is not None:
        backward = distance(model.backward_net, batch.next_obs)
        mean, weighted = 0.5 * (mean + backward), weighted + config.backward_weight * backward
    pull = config.relation_distance_weight * pairs.mean(weighted * pairs.same).sum()
    return pull, similarity(jax.lax.stop_gradient(mean), pairs, config.relation_temperature)


def relation_gradient(
    model: MultiHeadNet,
    statistics: Statistics,
    batch: Batch,
    similar: Float[Array, "member sample sample"],
    decay: float,
) -> tuple[Float[Array, ""], Any]:
    """The relation loss with weight decay, and its gradient, laid out as `RelationParts`.

    Args:
        model: A model with a relation head.
        statistics: The normalisers in use.
        batch: The samples.
        similar: How similar their contexts are.
        decay: Factor on the weight decay.
    """

    def objective(parts: RelationParts) -> Float[Array, ""]:
        encoder, head = parts
        context = encoder(flat_history(batch.history, statistics))
        loss = relation_loss(head, context, similar, Pairs.of(batch))
        return loss + decay * relation_decay_loss(parts)

    return jax.value_and_grad(objective)(relation_parts(model))


def relation_parts(model: MultiHeadNet) -> RelationParts:
    """Weights that the relation loss trains, of a model that has a relation head."""
    assert model.context_encoder is not None
    assert model.relation_head is not None
    return model.context_encoder, model.relation_head
