"""How functions that run the networks are compiled."""

import functools
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax

# On a CPU, XLA's YNNPACK fusions slow the ensemble's products down: on two cores a plan of the
# quick preset takes 1.5 times as long with them, a gradient step two to three times.
_WANTED = {"xla_cpu_experimental_ynn_fusion_type": ""}


@functools.cache
def compiler_options() -> dict[str, Any]:
    """The wanted compiler options, or none where this XLA does not know them."""
    try:
        jax.jit(lambda x: x + 1, compiler_options=_WANTED)(0.0)
    except (jax.errors.JaxRuntimeError, ValueError):
        return {}
    return dict(_WANTED)


def jit_networks(function: Callable) -> Callable:
    """`equinox.filter_jit` with the compiler options for many small products.

    The function is wrapped when first called, so that importing stays light.
    """

    @functools.cache
    def compiled() -> Callable:
        options: dict[str, Any] = {"compiler_options": compiler_options()}
        return eqx.filter_jit(function, **options)

    @functools.wraps(function)
    def call(*args: Any, **kwargs: Any) -> Any:
        return compiled()(*args, **kwargs)

    return call
