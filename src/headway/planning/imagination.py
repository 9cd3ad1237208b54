"""The dynamics model as one plan needs it: folded, and laid out for fast products.

Inside a plan the layout is [member, feature, particle, candidate]. Members lead because their
weights differ; candidates come last, so that every elementwise operation, slice and sum over
features runs over long contiguous rows, and what all candidates share is a plain broadcast.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from headway.models.dynamics import GaussianNet, MultiHeadDynamics, Statistics
from headway.models.networks import Dense, DenseHeads, swish
from headway.models.products import PRECISIONS, rounded
from headway.task import Task

Correction = Float[Array, "env member head feature obs"]


class Layer(NamedTuple):
    """One linear layer of every member; its products run in the weight's precision."""

    weight: Float[Array, "*env member out in"]
    bias: Float[Array, "*env member out"]

    def __call__(
        self, x: Float[Array, "member in particle candidate"]
    ) -> Float[Array, "member out particle candidate"]:
        """Apply each member's layer; sums are always float32."""
        product = jnp.einsum(
            "moi,mipc->mopc",
            self.weight,
            rounded(x, self.weight.dtype),
            preferred_element_type=jnp.float32,
        )
        return product + self.bias[:, :, None, None]


def rough_swish(x: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    """`swish` to within 2e-4, a tenth of what rounding to bfloat16 takes from a number near 1.

    Its tanh is a quotient of polynomials of lower degree than XLA's, fitted to the least
    largest error of swish.
    """
    half = 0.5 * x
    bounded = jnp.clip(half, -5.4, 5.4)
    square = jnp.square(bounded)
    above = 0.998925793 + square * (0.098016076 + square * 5.71165459e-4)
    below = 1.0 + square * (0.429472208 + square * 0.0116753473)
    return half + half * (bounded * above / below)


class ChosenHeads(NamedTuple):
    """What one plan has of each environment's own: its heads, and the context in a hidden layer.

    Means and log-variances come out of one product: the layer's outputs are the mean delta in
    raw units (averaged over the choices), then each choice's log-variance.
    """

    layer: Layer
    min_logvar: Float[Array, "*env member choice obs"] | None
    max_logvar: Float[Array, "*env member choice obs"] | None
    context_bias: Float[Array, "*env member out"] | None = None
    """Bias of the hidden layer that the context joins; None if it joins the heads."""


class ImaginedDynamics(eqx.Module):
    """A dynamics model with all that is fixed during one plan folded into its weights.

    Only the chosen heads remain, one set per environment and member; the context has become
    part of the biases where it joins; normalisation has gone into the first layer and
    de-normalisation into the heads. With several chosen heads the sampled delta is the average
    of their samples (non-adaptive planning), drawn in one go.
    """

    hidden: tuple[Layer, ...]
    heads: ChosenHeads
    """With a leading environment axis after `fold`, without one after `of_env`."""
    delta_std: Float[Array, " obs"]
    context_layer: int | None = eqx.field(static=True, default=None)
    """The hidden layer that the context joins; None if it joins the heads."""

    @classmethod
    def fold(
        cls,
        model: MultiHeadDynamics,
        statistics: Statistics,
        heads: Int[Array, "env member choice"],
        context: Float[Array, "member env context"] | None,
        *,
        precision: str = "float32",
        correction: Correction | None = None,
    ) -> "ImaginedDynamics":
        """Fold a model for one plan.

        Args:
            model: The dynamics model.
            statistics: The normalisers in use.
            heads: The chosen heads; one per environment and member, or all of them.
            context: The context vector of each member and environment.
            precision: Of the products' inputs, `float32` or `bfloat16`. The first layer stays
                in float32: it takes raw observations, whose offsets bfloat16 would not resolve.
            correction: Added to the weights of the mean heads, the last row to their biases.
        """
        net = model.forward_net
        dtype = PRECISIONS[precision]
        (first, *others), shift = _hidden_without_context(net, context)
        hidden = plan_layers((_fold_input(first, statistics), *others), precision)
        context_bias, place = None, net.context_layer
        if place is not None and shift is not None:
            context, context_bias = None, hidden[place].bias + shift
        delta = statistics.delta
        mean_weight, mean_bias = _chosen(net.mean_heads, heads, context, correction)
        weights = [mean_weight.mean(2) * delta.std]
        biases = [mean_bias.mean(2) * delta.std + delta.mean]
        low = high = None
        if net.logvar_heads is not None:
            logvar_weight, logvar_bias = _chosen(net.logvar_heads, heads, context)
            num_envs, members, _, hidden_size, _ = logvar_weight.shape
            joined = logvar_weight.transpose(0, 1, 3, 2, 4)
            weights.append(joined.reshape(num_envs, members, hidden_size, -1))
            biases.append(logvar_bias.reshape(num_envs, members, -1))
            low, high = net.min_logvar[heads], net.max_logvar[heads]
        weight = jnp.concatenate(weights, axis=-1).mT.astype(dtype)
        output = Layer(weight, jnp.concatenate(biases, axis=-1))
        own = ChosenHeads(output, low, high, context_bias)
        return cls(hidden, own, delta.std, place)

    @property
    def per_env(self) -> ChosenHeads:
        """See `Dynamics.per_env`."""
        return self.heads

    def of_env(self, part: ChosenHeads) -> "ImaginedDynamics":
        """See `Dynamics.of_env`."""
        hidden = [*self.hidden]
        if self.context_layer is not None and part.context_bias is not None:
            layer = hidden[self.context_layer]
            hidden[self.context_layer] = layer._replace(bias=part.context_bias)
        return ImaginedDynamics(tuple(hidden), part, self.delta_std, self.context_layer)

    def of_member(self, member: Int[Array, ""]) -> "ImaginedDynamics":
        """See `Ensemble.of_member`."""
        hidden, heads = jax.tree.map(
            lambda x: jax.lax.dynamic_slice_in_dim(x, member, 1), (self.hidden, self.heads)
        )
        return ImaginedDynamics(hidden, heads, self.delta_std, self.context_layer)

    @property
    def widest(self) -> int:
        """See `Dynamics.widest`."""
        return max(layer.bias.shape[-1] for layer in self.hidden)

    @property
    def num_members(self) -> int:
        """Networks in the ensemble."""
        return self.hidden[0].bias.shape[0]

    @property
    def stochastic(self) -> bool:
        """Whether deltas have a variance."""
        return self.heads.min_logvar is not None

    def start(self) -> tuple[()]:
        """See `Dynamics.start`; nothing is carried from step to step."""
        return ()

    def step(
        self,
        task: Task,
        carry: tuple[()],
        obs: Float[Array, "member obs particle candidate"],
        action: Float[Array, "member action particle candidate"],
        noise: Float[Array, "member obs particle #candidate"] | None,
    ) -> tuple[tuple[()], Float[Array, "member obs particle candidate"]]:
        """See `Dynamics.step`."""
        x = jnp.concatenate([over_rows(task.preprocess)(obs), action], axis=1)
        return carry, over_rows(task.postprocess)(obs, self.sample_delta(x, noise))

    def sample_delta(
        self,
        x: Float[Array, "member in particle candidate"],
        noise: Float[Array, "member obs particle #candidate"] | None,
    ) -> Float[Array, "member obs particle candidate"]:
        """Draw the next delta of one environment in raw units; its mean where `noise` is None.

        Args:
            x: Raw features, then actions in [-1, 1].
            noise: Standard normal draws.
        """
        reduced = self.heads.layer.weight.dtype == jnp.bfloat16
        for layer in self.hidden:
            x = rough_swish(layer(x)) if reduced else swish(layer(x))
        out = self.heads.layer(x)
        obs_size = self.delta_std.shape[0]
        mean = out[:, :obs_size]
        low, high = self.heads.min_logvar, self.heads.max_logvar
        if noise is None or low is None or high is None:
            return mean
        return mean + noise * self._std(out[:, obs_size:], low, high)

    def _std(
        self,
        logvar: Float[Array, "member choice_obs particle candidate"],
        low: Float[Array, "member choice obs"],
        high: Float[Array, "member choice obs"],
    ) -> Float[Array, "member obs particle candidate"]:
        """Standard deviation of the average of the choices' samples, in raw units."""
        members, choices, obs_size = low.shape
        logvar = logvar.reshape(members, choices, obs_size, *logvar.shape[2:])
        var = bounded_var(logvar, low[..., None, None], high[..., None, None])
        return jnp.sqrt(var.sum(1)) * (self.delta_std / choices)[:, None, None]


def bounded_var(
    logvar: Float[Array, "..."], low: Float[Array, "..."], high: Float[Array, "..."]
) -> Float[Array, "..."]:
    """`exp(bound_logvar(...))`, in which all logarithms cancel: one exponential instead of five."""
    return jnp.exp(low) + 1.0 / (jnp.exp(-high) + jnp.exp(-logvar))


def plan_layers(layers: Sequence[Dense], precision: str) -> tuple[Layer, ...]:
    """Lay layers out for a plan; all but the first, which takes observations, in a precision.

    Args:
        layers: Of every member, perhaps of every environment.
        precision: Of the products' inputs, `float32` or `bfloat16`.
    """
    dtypes = [jnp.float32, *[PRECISIONS[precision]] * (len(layers) - 1)]
    return tuple(
        Layer(layer.weight.mT.astype(dtype), layer.bias)
        for layer, dtype in zip(layers, dtypes, strict=True)
    )


def _hidden_without_context(
    net: GaussianNet, context: Float[Array, "member env context"] | None
) -> tuple[tuple[Dense, ...], Float[Array, "env member out"] | None]:
    """The hidden layers without the rows that take the context, and what those rows add."""
    if context is None or net.context_layer is None:
        return net.hidden, None
    layer = net.hidden[net.context_layer]
    width = layer.weight.shape[1] - context.shape[-1]
    narrow = Dense(layer.weight[:, :width], layer.bias)
    hidden = (*net.hidden[: net.context_layer], narrow, *net.hidden[net.context_layer + 1 :])
    return hidden, jnp.einsum("mec,mco->emo", context, layer.weight[:, width:])


def _fold_input(layer: Dense, statistics: Statistics) -> Dense:
    """Let the first layer take raw features and actions."""
    scale = jnp.concatenate([statistics.features.scale, statistics.action.scale])
    mean = jnp.concatenate([statistics.features.mean, statistics.action.mean])
    weight = layer.weight / scale[:, None]
    return Dense(weight, layer.bias - jnp.einsum("i,mio->mo", mean, weight))


def _chosen(
    layer: DenseHeads,
    heads: Int[Array, "env member choice"],
    context: Float[Array, "member env context"] | None,
    correction: Correction | None = None,
) -> tuple[Float[Array, "env member choice hidden obs"], Float[Array, "env member choice obs"]]:
    """Weights and biases of the chosen heads, the context added to the biases."""
    member = jnp.arange(heads.shape[1])[:, None]
    weight, bias = layer.weight[member, heads], layer.bias[member, heads]
    if correction is not None:
        env = jnp.arange(len(heads))[:, None, None]
        chosen = correction[env, member, heads]
        weight, bias = weight + chosen[..., :-1, :], bias + chosen[..., -1, :]
    if context is None:
        return weight, bias
    hidden_size = weight.shape[-2] - context.shape[-1]
    bias = bias + jnp.einsum("mec,emkco->emko", context, weight[..., hidden_size:, :])
    return weight[..., :hidden_size, :], bias


def over_rows(function: Callable) -> Callable:
    """Let a Task's method, which wants features last, take [member, feature, *rows]."""
    return jax.vmap(jax.vmap(function, in_axes=-1, out_axes=-1), in_axes=-1, out_axes=-1)
