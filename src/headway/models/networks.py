"""Layers of an ensemble and the normaliser. Members are a leading axis of every array.

A batched matrix product over members runs at the processor's full rate, so the member axis
stays inside the layers; heads are folded into one product per network as well.
"""

import dataclasses
from typing import TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from headway.config import Precision
from headway.models.products import product

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
        return product(x, self.weight, self.precision) + self.bias[:, None, :]


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
        members, heads, in_size, out_size = self.weight.shape
        stacked = self.weight.transpose(0, 2, 1, 3).reshape(members, in_size, heads * out_size)
        out = product(x, stacked, self.precision).reshape(members, -1, heads, out_size)
        return out.transpose(0, 2, 1, 3) + self.bias[:, :, None, :]


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
    logvar = high - jax.nn.softplus(high - logvar)
    return low + jax.nn.softplus(logvar - low)
