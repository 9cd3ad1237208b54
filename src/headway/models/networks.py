"""Layers of an ensemble and the normaliser. Members are a leading axis of every array.

A batched matrix product over members runs at the processor's full rate, so the member axis
stays inside the layers; heads are folded into one product per network as well.
"""

import dataclasses
from collections.abc import Sequence
from typing import TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from headway.config import Precision
from headway.models.products import affine

AnyDense = TypeVar("AnyDense", "Dense", "DenseHeads")


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
        """What `normalize` divides by: the standard deviation, or 1 where it is 0."""
        return jnp.where(self.std > 0, self.std + 1e-10, 1.0)

    def normalize(self, values: Float[Array, "*batch size"]) -> Float[Array, "*batch size"]:
        """Scale values to zero mean and unit variance."""
        return (values - self.mean) / self.scale

    def denormalize(self, values: Float[Array, "*batch size"]) -> Float[Array, "*batch size"]:
        """Undo `normalize`."""
        return values * self.std + self.mean


class Dense(eqx.Module):
    """One linear layer for every member."""

    weight: Float[Array, "member in out"]
    bias: Float[Array, "member out"]
    precision: Precision = eqx.field(static=True, default="float32")
    """What is multiplied."""

    @classmethod
    def init(cls, num_members: int, in_size: int, out_size: int, *, key: PRNGKeyArray) -> "Dense":
        """Draw truncated normal weights of std 1 / (2 sqrt(in)), zero biases (released code)."""
        return cls(
            truncated_normal(key, (num_members, in_size, out_size), in_size),
            jnp.zeros((num_members, out_size)),
        )

    def __call__(self, x: Float[Array, "member batch in"]) -> Float[Array, "member batch out"]:
        """Apply each member's layer to its own inputs."""
        return self.columns(x.mT).mT

    def columns(self, x: Float[Array, "member in batch"]) -> Float[Array, "member out batch"]:
        """The same with features before samples, which is faster for layers in a row."""
        return affine(x, self.weight, self.bias, self.precision)


class DenseHeads(eqx.Module):
    """One linear layer for every member and head, over shared inputs."""

    weight: Float[Array, "member head in out"]
    bias: Float[Array, "member head out"]
    precision: Precision = eqx.field(static=True, default="float32")
    """What is multiplied."""

    @classmethod
    def init(
        cls, num_members: int, num_heads: int, in_size: int, out_size: int, *, key: PRNGKeyArray
    ) -> "DenseHeads":
        """As `Dense.init`, with a head axis."""
        shape = (num_members, num_heads, in_size, out_size)
        return cls(
            truncated_normal(key, shape, in_size), jnp.zeros((num_members, num_heads, out_size))
        )

    def __call__(self, x: Float[Array, "member batch in"]) -> Float[Array, "member head batch out"]:
        """Apply every head to its member's inputs, in one product."""
        return self.columns(x.mT).mT

    def columns(self, x: Float[Array, "member in batch"]) -> Float[Array, "member head out batch"]:
        """The same with features before samples."""
        (found,) = columns_of_each((self,), x)
        return found


def columns_of_each(
    layers: Sequence[DenseHeads], x: Float[Array, "member in batch"]
) -> list[Float[Array, "member head out batch"]]:
    """What layers with as many heads make of the same inputs, in one product.

    Args:
        layers: Of one precision.
        x: Their inputs, features before samples.
    """
    members, heads, in_size, out_size = layers[0].weight.shape
    weights = [one.weight.transpose(0, 2, 1, 3).reshape(members, in_size, -1) for one in layers]
    biases = [one.bias.reshape(members, -1) for one in layers]
    joint = jnp.concatenate(weights, axis=-1), jnp.concatenate(biases, axis=-1)
    found = affine(x, *joint, layers[0].precision)
    shape = (members, heads, out_size, x.shape[-1])
    return [part.reshape(shape) for part in jnp.split(found, len(layers), axis=1)]


def in_precision(layer: AnyDense, precision: Precision) -> AnyDense:
    """The layer, with products in a precision."""
    return dataclasses.replace(layer, precision=precision)


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
