"""Networks of an ensemble: layers in a precision, heads with variances, context encoder.

Members are a leading axis of every array: a batched matrix product over members runs at the
processor's full rate, so the member axis stays inside the layers; heads are folded into one
product per network as well. Features before samples are faster for layers in a row
(docs/performance.md); methods named `columns` take them so.

Reduced precision rounds what is multiplied; sums are always float32. On CPUs XLA multiplies
bfloat16 fast (YNNPACK) only where the first factor lies row by row in memory: with features before
samples only weights have to be transposed for that, which are smaller than activations.
"""

import functools
from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental.layout import Layout, with_layout_constraint
from jaxtyping import Array, DTypeLike, Float, PRNGKeyArray

from headway.config import ModelConfig, Precision
from headway.task import Task

PRECISIONS = {"float32": jnp.float32, "bfloat16": jnp.bfloat16}


def affine(
    x: Float[Array, "member in batch"],
    weight: Float[Array, "member in out"],
    bias: Float[Array, "member out"],
    precision: Precision,
) -> Float[Array, "member out batch"]:
    """Each member's layer; its gradient multiplies in the same precision."""
    if precision == "float32":
        return weight.mT @ x + bias[:, :, None]
    return _reduced(x, weight, bias)


@jax.custom_vjp
def _reduced(x, weight, bias):
    return _forward(x, weight, bias)[0]


def _forward(x, weight, bias):
    x, weight = row_by_row(x.astype(jnp.bfloat16)), weight.astype(jnp.bfloat16)
    return _sums("moi,mib->mob", row_by_row(weight.mT), x) + bias[:, :, None], (x, weight)


def _backward(factors, gradient):
    x, weight = factors
    gradient = rounded(gradient, jnp.bfloat16)
    of_x = _sums("mio,mob->mib", weight, gradient)
    of_weight = _sums("mib,mob->mio", x, gradient)
    # Of what is rounded: of the rest nothing is kept, or computed twice.
    of_bias = gradient.astype(jnp.float32).sum(-1)
    return of_x, of_weight, of_bias


_reduced.defvjp(_forward, _backward)
_sums = functools.partial(jnp.einsum, preferred_element_type=jnp.float32)


@functools.partial(jax.custom_jvp, nondiff_argnums=(1,))
def rounded(x: Float[Array, "*shape"], dtype: DTypeLike) -> Float[Array, "*shape"]:
    """`x` in a precision of `PRECISIONS`, to the nearest.

    On CPUs XLA's own conversion to bfloat16 halves the vectors of whatever it is fused with. Ours
    takes of two equally near the larger in size, XLA's the even one. A NaN stays one, but for those
    whose bits are nearly all set, which no operation of ours makes.
    """
    if dtype != jnp.bfloat16 or jax.default_backend() != "cpu":
        return x.astype(dtype)
    bits = jax.lax.bitcast_convert_type(x, jnp.uint32) + jnp.uint32(2**15)
    return jax.lax.bitcast_convert_type((bits >> 16).astype(jnp.uint16), jnp.bfloat16)


@rounded.defjvp
def _(dtype, values, changes):
    return rounded(*values, dtype), changes[0].astype(dtype)


def row_by_row(x: Float[Array, "member row column"]) -> Float[Array, "member row column"]:
    """`x`, laid out so; XLA would multiply the transpose of what is there without moving it."""
    if jax.default_backend() != "cpu":
        return x
    return with_layout_constraint(x, Layout(major_to_minor=(0, 1, 2)))


class Dense(eqx.Module):
    """One linear layer for every member, or for every member and head, over the same inputs."""

    weight: Float[Array, "member *head in out"]
    bias: Float[Array, "member *head out"]
    precision: Precision = eqx.field(static=True, default="float32")

    @classmethod
    def init(
        cls, num_each: tuple[int, ...], in_size: int, out_size: int, *, key: PRNGKeyArray
    ) -> "Dense":
        """Draw truncated normal weights of std 1 / (2 sqrt(in)), zero biases (released code).

        Args:
            num_each: Members, or members and heads.
            in_size: Inputs.
            out_size: Outputs.
            key: Draws the weights.
        """
        weight = truncated_normal(key, (*num_each, in_size, out_size), in_size)
        return cls(weight, jnp.zeros((*num_each, out_size)))

    def __call__(self, x: Float[Array, "member batch in"]) -> Float[Array, "member batch out"]:
        """Apply each member's layer to its own inputs."""
        return self.columns(x.mT).mT

    def columns(self, x: Float[Array, "member in batch"]) -> Float[Array, "member out batch"]:
        """The same with features before samples."""
        return affine(x, self.weight, self.bias, self.precision)


def heads_columns(
    layers: Sequence[Dense], x: Float[Array, "member in batch"]
) -> list[Float[Array, "member head out batch"]]:
    """Apply layers with as many heads, and of one precision, to the same inputs in one product."""
    members, heads, in_size, out_size = layers[0].weight.shape
    weights = [one.weight.transpose(0, 2, 1, 3).reshape(members, in_size, -1) for one in layers]
    biases = [one.bias.reshape(members, -1) for one in layers]
    joint = jnp.concatenate(weights, axis=-1), jnp.concatenate(biases, axis=-1)
    found = affine(x, *joint, layers[0].precision)
    shape = (members, heads, out_size, x.shape[-1])
    return [part.reshape(shape) for part in jnp.split(found, len(layers), axis=1)]


def truncated_normal(key: PRNGKeyArray, shape: tuple[int, ...], fan_in: int) -> Array:
    """Normal draws within two standard deviations, of std 1 / (2 sqrt(fan_in))."""
    return jax.random.truncated_normal(key, -2.0, 2.0, shape) / (2.0 * np.sqrt(fan_in))


def swish(x: Float[Array, "..."]) -> Float[Array, "..."]:
    """`x * sigmoid(x)`, the backbone's activation (supplement A.3).

    Through tanh, which XLA computes faster than the exponential and the division.
    """
    half = 0.5 * x
    return half + half * jnp.tanh(half)


def bound_logvar(
    logvar: Float[Array, "..."], low: Float[Array, "..."], high: Float[Array, "..."]
) -> Float[Array, "..."]:
    """Squeeze log-variances softly between learned bounds (PETS)."""
    logvar = high - softplus(high - logvar)
    return low + softplus(logvar - low)


def softplus(x: Float[Array, "..."]) -> Float[Array, "..."]:
    """`log(1 + exp(x))`, to 1e-7: without JAX's `log1p`, which takes longer than all the rest."""
    return jnp.maximum(x, 0.0) + jnp.log(1.0 + jnp.exp(jnp.minimum(x, -x)))


class Prediction(NamedTuple):
    """Gaussian over the normalised `delta`; `logvar` is None in deterministic mode.

    Where the reward is learned, it comes after the delta, and the logit of the end is last.
    """

    mean: Float[Array, "member head out batch"]
    logvar: Float[Array, "member head out batch"] | None


class GaussianNet(eqx.Module):
    """Backbone and prediction heads of every member; the context joins on the way.

    All its methods take and give features before samples.
    """

    hidden: tuple[Dense, ...]
    mean_heads: Dense
    logvar_heads: Dense | None
    max_logvar: Float[Array, "head out"] | None
    min_logvar: Float[Array, "head out"] | None
    context_layer: int | None = eqx.field(static=True, default=None)
    """The hidden layer that takes the context beside its input; None if the heads do."""

    @classmethod
    def init(
        cls,
        config: ModelConfig,
        task: Task,
        context_size: int,
        *,
        deterministic: bool,
        outcomes: int = 0,
        key: PRNGKeyArray,
    ) -> "GaussianNet":
        """Draw the weights of one network per member.

        Args:
            config: Settings of the model.
            task: The sizes of observations and actions.
            context_size: Width of the context.
            deterministic: Heads predict a mean only.
            outcomes: Outputs beside the delta: 2 for the reward and the logit of the end, or 0.
            key: Draws the weights.
        """
        members, heads = config.num_members, config.num_heads
        out_size = task.obs_size + outcomes
        outs = config.hidden_sizes
        ins = [task.feature_size + task.action_size, *outs]
        place = {"input": 0, "last-hidden": len(outs) - 1, "head": None}[config.context_at]
        ins[-1 if place is None else place] += context_size
        *hidden_keys, mean_key, logvar_key = jax.random.split(key, len(outs) + 2)
        hidden = tuple(
            Dense.init((members,), n, m, key=k)
            for n, m, k in zip(ins[:-1], outs, hidden_keys, strict=True)
        )
        mean_heads = Dense.init((members, heads), ins[-1], out_size, key=mean_key)
        if deterministic:
            return cls(hidden, mean_heads, None, None, None, place)
        logvar_heads = Dense.init((members, heads), ins[-1], out_size, key=logvar_key)
        high, low = (jnp.full((heads, out_size), b, jnp.float32) for b in (0.5, -10.0))
        return cls(hidden, mean_heads, logvar_heads, high, low, place)

    def __call__(
        self,
        x: Float[Array, "member in batch"],
        context: Float[Array, "member context batch"] | None,
    ) -> Prediction:
        """Predict with every head."""
        return self.predict(self.head_input(x, context))

    def head_input(
        self,
        x: Float[Array, "member in batch"],
        context: Float[Array, "member context batch"] | None,
    ) -> Float[Array, "member hidden batch"]:
        """Run the shared hidden layers; where the context joins the heads, it is appended."""

        def joined(x):
            return x if context is None else jnp.concatenate([x, context], axis=1)

        x = row_by_row(x)
        for index, layer in enumerate(self.hidden):
            x = swish(layer.columns(joined(x) if index == self.context_layer else x))
        return joined(x) if self.context_layer is None else x

    def predict(self, x: Float[Array, "member hidden batch"]) -> Prediction:
        """Run the heads."""
        if self.logvar_heads is None:
            return Prediction(heads_columns((self.mean_heads,), x)[0], None)
        mean, logvar = heads_columns((self.mean_heads, self.logvar_heads), x)
        low, high = self.min_logvar[:, :, None], self.max_logvar[:, :, None]
        return Prediction(mean, bound_logvar(logvar, low, high))


class ContextEncoder(eqx.Module):
    """Turns the last K transitions into a context vector, once per member."""

    hidden: tuple[Dense, ...]
    output: Dense

    @classmethod
    def init(cls, config: ModelConfig, in_size: int, *, key: PRNGKeyArray) -> "ContextEncoder":
        """Draw the weights of one encoder per member."""
        sizes = (in_size, *config.context_hidden_sizes, config.context_size)
        keys = jax.random.split(key, len(sizes) - 1)
        *hidden, output = (
            Dense.init((config.num_members,), n, m, key=k)
            for n, m, k in zip(sizes[:-1], sizes[1:], keys, strict=True)
        )
        return cls(tuple(hidden), output)

    def __call__(self, x: Float[Array, "member batch in"]) -> Float[Array, "member batch context"]:
        """Encode flattened histories."""
        x = row_by_row(x.mT)
        for layer in self.hidden:
            x = jax.nn.relu(layer.columns(x))
        return self.output.columns(x).mT
