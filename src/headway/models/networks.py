"""Networks of an ensemble: normaliser, layers in a precision, heads with variances, encoder.

Members are a leading axis of every array: a batched matrix product over members runs at the
processor's full rate, so the member axis stays inside the layers; heads are folded into one
product per network as well. Methods named `columns` take features before samples, which is faster
for layers in a row (docs/performance.md).

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


class Normalizer(eqx.Module):
    """Shifts and scales features to zero mean and unit variance (released `tmcl.py`).

    A feature that never varied has `std` 0: it is shifted but not scaled, and
    `denormalize` gives back its mean whatever the network says.
    """

    mean: Float[Array, "*size"]
    std: Float[Array, "*size"]

    @classmethod
    def identity(cls, *size: int) -> "Normalizer":
        """A normaliser that changes nothing."""
        return cls(jnp.zeros(size), jnp.ones(size))

    @classmethod
    def fit(cls, values: Float[np.ndarray, "count size"]) -> "Normalizer":
        """Take mean and standard deviation of values, in float64."""
        values = np.asarray(values, np.float64)
        return cls.of_moments(values.mean(0), values.std(0))

    @classmethod
    def of_moments(cls, mean: np.ndarray, std: np.ndarray) -> "Normalizer":
        """Build from moments computed in float64; what float32 can't resolve is constant."""
        constant = std <= 1e-5 * np.maximum(np.abs(mean), 1e-12)
        return cls(
            jnp.asarray(mean, jnp.float32), jnp.asarray(np.where(constant, 0, std), jnp.float32)
        )

    @property
    def scale(self) -> Float[Array, "*size"]:
        """Divisor of `normalize`: the standard deviation, or 1 where it is 0."""
        return jnp.where(self.std > 0, self.std + 1e-10, 1.0)

    def normalize(self, values: Float[Array, "*batch size"]) -> Float[Array, "*batch size"]:
        """Scale values to zero mean and unit variance."""
        return (values - self.mean) / self.scale

    def denormalize(self, values: Float[Array, "*batch size"]) -> Float[Array, "*batch size"]:
        """Undo `normalize`."""
        return values * self.std + self.mean


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
def _reduced(
    x: Float[Array, "member in batch"],
    weight: Float[Array, "member in out"],
    bias: Float[Array, "member out"],
) -> Float[Array, "member out batch"]:
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


def row_by_row(x: Float[Array, "member row column"]) -> Float[Array, "member row column"]:
    """`x`, laid out so; XLA would multiply the transpose of what is there without moving it."""
    if jax.default_backend() != "cpu":
        return x
    return with_layout_constraint(x, Layout(major_to_minor=(0, 1, 2)))


class Dense(eqx.Module):
    """One linear layer for every member."""

    weight: Float[Array, "member in out"]
    bias: Float[Array, "member out"]
    precision: Precision = eqx.field(static=True, default="float32")

    @classmethod
    def init(cls, num_members: int, in_size: int, out_size: int, *, key: PRNGKeyArray) -> "Dense":
        """Draw truncated normal weights of std 1 / (2 sqrt(in)), zero biases (released code)."""
        weight = truncated_normal(key, (num_members, in_size, out_size), in_size)
        return cls(weight, jnp.zeros((num_members, out_size)))

    def __call__(self, x: Float[Array, "member batch in"]) -> Float[Array, "member batch out"]:
        """Apply each member's layer to its own inputs."""
        return self.columns(x.mT).mT

    def columns(self, x: Float[Array, "member in batch"]) -> Float[Array, "member out batch"]:
        """The same with features before samples."""
        return affine(x, self.weight, self.bias, self.precision)


class DenseHeads(eqx.Module):
    """One linear layer for every member and head, over shared inputs."""

    weight: Float[Array, "member head in out"]
    bias: Float[Array, "member head out"]
    precision: Precision = eqx.field(static=True, default="float32")

    @classmethod
    def init(
        cls, num_members: int, num_heads: int, in_size: int, out_size: int, *, key: PRNGKeyArray
    ) -> "DenseHeads":
        """As `Dense.init`, with a head axis."""
        weight = truncated_normal(key, (num_members, num_heads, in_size, out_size), in_size)
        return cls(weight, jnp.zeros((num_members, num_heads, out_size)))

    def __call__(self, x: Float[Array, "member batch in"]) -> Float[Array, "member head batch out"]:
        """Apply every head to its member's inputs, in one product."""
        return columns_of_each((self,), x.mT)[0].mT


def columns_of_each(
    layers: Sequence[DenseHeads], x: Float[Array, "member in batch"]
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
    """Gaussian over the normalised `delta`; `logvar` is None in deterministic mode."""

    mean: Float[Array, "*batch obs"]
    logvar: Float[Array, "*batch obs"] | None

    @property
    def mT(self) -> "Prediction":  # noqa: N802, as arrays call it
        """The same with the last two axes exchanged."""
        return Prediction(self.mean.mT, None if self.logvar is None else self.logvar.mT)


class GaussianNet(eqx.Module):
    """Backbone and prediction heads of every member; the context joins on the way."""

    hidden: tuple[Dense, ...]
    mean_heads: DenseHeads
    logvar_heads: DenseHeads | None
    max_logvar: Float[Array, "head obs"] | None
    min_logvar: Float[Array, "head obs"] | None
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
        key: PRNGKeyArray,
    ) -> "GaussianNet":
        """Draw the weights of one network per member.

        Args:
            config: Settings of the model.
            task: The sizes of observations and actions.
            context_size: Width of the context.
            deterministic: Whether heads predict a mean only.
            key: Draws the weights.
        """
        members, heads = config.num_members, config.num_heads
        *hidden_keys, mean_key, logvar_key = jax.random.split(key, len(config.hidden_sizes) + 2)
        outs = config.hidden_sizes
        ins = [task.feature_size + task.action_size, *outs]
        ins[{"input": 0, "last-hidden": -2, "head": -1}[config.context_at]] += context_size
        hidden = tuple(
            Dense.init(members, n, m, key=k)
            for n, m, k in zip(ins[:-1], outs, hidden_keys, strict=True)
        )
        mean_heads = DenseHeads.init(members, heads, ins[-1], task.obs_size, key=mean_key)
        place = context_layer(config)
        if deterministic:
            return cls(hidden, mean_heads, None, None, None, place)
        logvar_heads = DenseHeads.init(members, heads, ins[-1], task.obs_size, key=logvar_key)
        shape = (heads, task.obs_size)
        bounds = jnp.full(shape, 0.5, jnp.float32), jnp.full(shape, -10.0, jnp.float32)
        return cls(hidden, mean_heads, logvar_heads, *bounds, place)

    def __call__(
        self,
        x: Float[Array, "member batch in"],
        context: Float[Array, "member batch context"] | None,
    ) -> Prediction:
        """Predict with every head; results are [member, head, batch, obs]."""
        return self.columns(x.mT, None if context is None else context.mT).mT

    def columns(
        self,
        x: Float[Array, "member in batch"],
        context: Float[Array, "member context batch"] | None,
    ) -> Prediction:
        """The same with features before samples; results are [member, head, obs, batch]."""
        return self._predict(self._head_input(x, context))

    def head_input(
        self,
        x: Float[Array, "member batch in"],
        context: Float[Array, "member batch context"] | None,
    ) -> Float[Array, "member batch hidden"]:
        """Run the shared hidden layers; where the context joins the heads, it is appended."""
        return self._head_input(x.mT, None if context is None else context.mT).mT

    def predict(self, x: Float[Array, "member batch hidden"]) -> Prediction:
        """Run the heads; results are [member, head, batch, obs]."""
        return self._predict(x.mT).mT

    def _head_input(self, x, context):
        def joined(x):
            return x if context is None else jnp.concatenate([x, context], axis=1)

        x = row_by_row(x)
        for index, layer in enumerate(self.hidden):
            x = swish(layer.columns(joined(x) if index == self.context_layer else x))
        return joined(x) if self.context_layer is None else x

    def _predict(self, x):
        if self.logvar_heads is None:
            return Prediction(columns_of_each((self.mean_heads,), x)[0], None)
        mean, logvar = columns_of_each((self.mean_heads, self.logvar_heads), x)
        low, high = self.min_logvar[:, :, None], self.max_logvar[:, :, None]
        return Prediction(mean, bound_logvar(logvar, low, high))


def context_layer(config: ModelConfig) -> int | None:
    """Index of the hidden layer that takes the context beside its input; None if the heads do."""
    last = len(config.hidden_sizes) - 1
    return {"input": 0, "last-hidden": last, "head": None}[config.context_at]


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
            Dense.init(config.num_members, n, m, key=k)
            for n, m, k in zip(sizes[:-1], sizes[1:], keys, strict=True)
        )
        return cls(tuple(hidden), output)

    def __call__(self, x: Float[Array, "member batch in"]) -> Float[Array, "member batch context"]:
        """Encode flattened histories."""
        x = row_by_row(x.mT)
        for layer in self.hidden:
            x = jax.nn.relu(layer.columns(x))
        return self.output.columns(x).mT
