"""Layers of the networks in a precision, forwards and backwards; features before samples.

Reduced precision rounds what is multiplied; sums are always float32. On CPUs XLA multiplies
bfloat16 fast (YNNPACK) only where the first factor lies row by row in memory: with features before
samples only weights have to be transposed for that, which are smaller than activations.
"""

import functools

import jax
import jax.numpy as jnp
from jax.experimental.layout import Layout, with_layout_constraint
from jaxtyping import Array, DTypeLike, Float

from headway.config import Precision

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


def row_by_row(x: Float[Array, "member row column"]) -> Float[Array, "member row column"]:
    """`x`, laid out so; XLA would multiply the transpose of what is there without moving it."""
    if jax.default_backend() != "cpu":
        return x
    return with_layout_constraint(x, Layout(major_to_minor=(0, 1, 2)))
