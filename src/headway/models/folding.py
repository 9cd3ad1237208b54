"""Multi-headed networks folded for a plan: all that is fixed while it lasts is in the weights."""

import dataclasses
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from headway.config import Precision
from headway.models.base import Dynamics, Layer, over_rows, plan_layers
from headway.models.networks import PRECISIONS, Dense, GaussianNet, swish
from headway.models.statistics import Statistics
from headway.task import Task

Context = Float[Array, "member env context"] | None


class OwnHeads(NamedTuple):
    """Weights of a plan that differ by environment: its heads, and the context in a hidden layer.

    Means and log-variances come out of one product: the layer's outputs are the mean delta in
    raw units (averaged over the choices), then each choice's log-variance.
    """

    layer: Layer
    min_logvar: Float[Array, "*env member choice obs"] | None
    max_logvar: Float[Array, "*env member choice obs"] | None
    context_bias: Float[Array, "*env member out"] | None
    """Bias of the hidden layer that the context joins; None if it joins the heads."""


class FoldedDynamics(Dynamics):
    """Multi-headed networks with all that is fixed during one plan folded into their weights.

    Only the chosen heads remain, one set per environment and member; the context has become
    part of the biases where it joins; normalisation has gone into the first layer and
    de-normalisation into the heads. With several chosen heads the sampled delta is the average
    of their samples (non-adaptive planning), drawn in one go.
    """

    own: OwnHeads
    hidden: tuple[Layer, ...]
    delta_std: Float[Array, " obs"]
    task: Task
    context_layer: int | None = eqx.field(static=True)
    """The hidden layer that the context joins; None if it joins the heads."""
    outcomes: int = eqx.field(static=True, default=0)
    """Outputs after the delta: 2 where the reward and the end are learned."""

    @property
    def num_members(self) -> int:
        """Networks in the ensemble."""
        return self.hidden[0].bias.shape[0]

    @property
    def stochastic(self) -> bool:
        """True where deltas have a variance."""
        return self.own.min_logvar is not None

    def of_member(self, member: Int[Array, ""]) -> "FoldedDynamics":
        """See `Dynamics.of_member`."""
        own, hidden = jax.tree.map(
            lambda x: jax.lax.dynamic_slice_in_dim(x, member, 1), (self.own, self.hidden)
        )
        return dataclasses.replace(self, own=own, hidden=hidden)

    def start(self) -> Any:
        """See `Dynamics.start`: the learned reward and end of the last step, if there are any."""
        return jnp.zeros((self.num_members, self.outcomes)) if self.outcomes else ()

    def outcome(self, carry: Any) -> Any:
        """See `Dynamics.outcome`."""
        return (carry[:, 0], carry[:, 1] > 0) if self.outcomes else None

    def step(
        self,
        carry: Any,
        obs: Float[Array, "member obs particle candidate"],
        action: Float[Array, "member action particle candidate"],
        noise: Float[Array, "member obs particle #candidate"] | None,
    ) -> tuple[Any, Float[Array, "member obs particle candidate"]]:
        """See `Dynamics.step`: a sample of the next delta, or its mean without noise."""
        heads, low, high, context_bias = self.own
        x = jnp.concatenate([over_rows(self.task.preprocess)(obs), action], axis=1)
        for index, layer in enumerate(self.hidden):
            if index == self.context_layer and context_bias is not None:
                layer = layer._replace(bias=context_bias)  # noqa: PLW2901
            x = swish(layer(x))
        out, obs_size = heads(x), obs.shape[1]
        delta, outcome, out = jnp.split(out, (obs_size, obs_size + self.outcomes), axis=1)
        if noise is not None and low is not None and high is not None:
            members, choices, _ = low.shape
            logvar = out.reshape(members, choices, obs_size, *out.shape[2:])
            var = bounded_var(logvar, low[..., None, None], high[..., None, None])
            std = jnp.sqrt(var.sum(1)) * (self.delta_std / choices)[:, None, None]
            delta = delta + noise * std
        carry = outcome if self.outcomes else carry
        return carry, over_rows(self.task.postprocess)(obs, delta)


def fold(
    net: GaussianNet,
    statistics: Statistics,
    task: Task,
    heads: Int[Array, "env member choice"],
    context: Context,
    *,
    precision: Precision = "float32",
    correction: Float[Array, "env member head feature obs"] | None = None,
) -> FoldedDynamics:
    """Fold networks for one plan.

    Args:
        net: The network that predicts forwards.
        statistics: The normalisers in use.
        task: How observations enter and leave it.
        heads: The chosen heads; one per environment and member, or all of them.
        context: Of every member and environment.
        precision: Of the products; the first layer and the sums stay in float32.
        correction: Added to the weights of the mean heads, the last row to their biases.
    """
    place, hidden, context_bias = net.context_layer, list(net.hidden), None
    if context is not None and place is not None:
        # The rows that take the context become a bias, each environment's own.
        weight, bias = hidden[place].weight, hidden[place].bias
        width = weight.shape[1] - context.shape[-1]
        hidden[place] = Dense(weight[:, :width], bias)
        context_bias = jnp.einsum("mec,mco->emo", context, weight[:, width:])
        context = None
    # The first layer takes raw features and actions.
    scale = jnp.concatenate([statistics.features.scale, statistics.action.scale])
    mean = jnp.concatenate([statistics.features.mean, statistics.action.mean])
    weight = hidden[0].weight / scale[:, None]
    hidden[0] = Dense(weight, hidden[0].bias - jnp.einsum("i,mio->mo", mean, weight))
    layers = plan_layers(hidden, precision)
    if context_bias is not None and place is not None:
        context_bias = layers[place].bias + context_bias
    # Heads give raw deltas, averaged over the choices, and log-variances of each.
    delta, reward, low, high = statistics.delta, statistics.reward, None, None
    mean, std, obs_size = delta.mean, delta.std, delta.std.size
    if reward is not None:  # it comes next, and last the logit of the end, as it is
        mean = jnp.concatenate([mean, reward.mean, jnp.zeros(1)])
        std = jnp.concatenate([std, reward.std, jnp.ones(1)])
    weight, bias = _chosen(net.mean_heads, heads, context, correction)
    weights = [weight.mean(2) * std]
    biases = [bias.mean(2) * std + mean]
    if net.logvar_heads is not None:
        logvar_heads = jax.tree.map(lambda x: x[..., :obs_size], net.logvar_heads)
        weight, bias = _chosen(logvar_heads, heads, context)
        num_envs, members, _, hidden_size, _ = weight.shape
        weights.append(weight.transpose(0, 1, 3, 2, 4).reshape(num_envs, members, hidden_size, -1))
        biases.append(bias.reshape(num_envs, members, -1))
        low, high = (x[heads, :obs_size] for x in (net.min_logvar, net.max_logvar))
    weight = jnp.concatenate(weights, axis=-1).mT.astype(PRECISIONS[precision])
    own = OwnHeads(Layer(weight, jnp.concatenate(biases, axis=-1)), low, high, context_bias)
    return FoldedDynamics(own, layers, delta.std, task, place, std.size - obs_size)


def _chosen(
    layer: Dense,
    heads: Int[Array, "env member choice"],
    context: Context,
    correction: Float[Array, "env member head feature obs"] | None = None,
) -> tuple[Float[Array, "env member choice hidden out"], Float[Array, "env member choice out"]]:
    """Weights and biases of the chosen heads, the context added to the biases."""
    member = jnp.arange(heads.shape[1])[:, None]
    weight, bias = layer.weight[member, heads], layer.bias[member, heads]
    if correction is not None:
        env = jnp.arange(len(heads))[:, None, None]
        chosen = correction[env, member, heads]  # of the delta only
        rest = weight.shape[-1] - chosen.shape[-1]
        chosen = jnp.pad(chosen, [(0, 0)] * (chosen.ndim - 1) + [(0, rest)])
        weight, bias = weight + chosen[..., :-1, :], bias + chosen[..., -1, :]
    if context is None:
        return weight, bias
    hidden_size = weight.shape[-2] - context.shape[-1]
    bias = bias + jnp.einsum("mec,emkco->emko", context, weight[..., hidden_size:, :])
    return weight[..., :hidden_size, :], bias


def bounded_var(
    logvar: Float[Array, "..."], low: Float[Array, "..."], high: Float[Array, "..."]
) -> Float[Array, "..."]:
    """`exp(bound_logvar(...))`, in which all logarithms cancel: one exponential instead of five."""
    return jnp.exp(low) + 1.0 / (jnp.exp(-high) + jnp.exp(-logvar))
