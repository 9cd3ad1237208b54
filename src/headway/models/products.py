"""Products of the networks in a precision, forwards and backwards.

Reduced precision rounds what is multiplied; sums are always float32. On CPUs XLA multiplies
bfloat16 fast (YNNPACK) only where the first factor lies row by row in memory.
"""

import functools

import jax
import jax.numpy as jnp
from jax.experimental.layout import Layout, with_layout_constraint
from jaxtyping import Array, BFloat16, DTypeLike, Float

from headway.config import Precision

PRECISIONS = {"float32": jnp.float32, "bfloat16": jnp.bfloat16}


def product(
    x: Float[Array, "member batch in"],
    weight: Float[Array, "member in out"],
    precision: Precision,
) -> Float[Array, "member batch out"]:
    """Each member's product; its gradient multiplies in the same precision."""
    return x @ weight if precision == "float32" else _reduced(x, weight)


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
    x: Float[Array, "member batch in"], weight: Float[Array, "member in out"]
) -> Float[Array, "member batch out"]:
    return _forward(x, weight)[0]


def _forward(x, weight):
    x, weight = x.astype(jnp.bfloat16), weight.astype(jnp.bfloat16)
    return _sums("mbi,mio->mbo", x, weight), (x, weight)


def _backward(factors, gradient):
    x, weight = factors
    gradient = rounded(gradient, jnp.bfloat16)
    of_x = _sums("mbo,mio->mbi", gradient, weight)
    return of_x, _sums("mib,mbo->mio", _row_by_row(x.mT), gradient)


_reduced.defvjp(_forward, _backward)
_sums = functools.partial(jnp.einsum, preferred_element_type=jnp.float32)


def _row_by_row(x: BFloat16[Array, "member row column"]) -> BFloat16[Array, "member row column"]:
    """`x`, laid out so; XLA would multiply the transpose of what is there without moving it."""
    if jax.default_backend() != "cpu":
        return x
    return with_layout_constraint(x, Layout(major_to_minor=(0, 1, 2)))
