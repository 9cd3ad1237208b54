"""How functions that run the networks are compiled, and where compiled ones are kept."""

import functools
import os
import typing
from collections.abc import Callable, Mapping
from typing import Any

import jax
import platformdirs

from headway.config import Precision
from headway.models.meeting import Program, seat_here

# Found by measuring on CPUs (docs/performance.md): full-width vectors make the activations
# faster, and YNNPACK's fusions slow float32 products down but are the only way to fast
# bfloat16 ones.
_WIDE_VECTORS = {"xla_cpu_prefer_vector_width": 512}
_NO_FUSIONS = {"xla_cpu_experimental_ynn_fusion_type": ""}
_WANTED: Mapping[Precision, tuple[dict[str, Any], ...]] = {
    "float32": (_WIDE_VECTORS, _NO_FUSIONS),
    "bfloat16": (_WIDE_VECTORS,),
}
_JAX_KEEPS, _KEPT = 1.0, 0.05
"""Seconds that a program must take to compile to be kept: JAX's default, and ours."""


@functools.cache
def compiler_options(precision: Precision = "float32") -> dict[str, Any]:
    """The compiler options for products of a precision, without those this XLA does not know.

    Args:
        precision: `float32` or `bfloat16`.
    """
    options: dict[str, Any] = {}
    if jax.default_backend() != "cpu":
        return options
    for wanted in _WANTED[precision]:
        try:
            jax.jit(lambda x: x + 1, compiler_options=wanted)(0.0)
        except (jax.errors.JaxRuntimeError, ValueError):
            continue
        options.update(wanted)
    return options


def jit_networks(function: Callable, *, precision: Precision = "float32") -> Callable:
    """`equinox.filter_jit` with the compiler options for many small products.

    The function is wrapped when first called, so that importing stays light. In a run that goes
    side by side with others, it is called for all of them at once (`models.meeting`).
    """
    program = Program(function, lambda: {"compiler_options": compiler_options(precision)})

    @functools.wraps(function)
    def call(*args: Any, **kwargs: Any) -> Any:
        seat = seat_here()
        if seat is None:
            return program.alone(*args, **kwargs)
        return seat.compute(program, args, kwargs)

    return call


def in_each_precision(function: Callable) -> dict[Precision, Callable]:
    """A function that runs the networks, compiled for products of each precision."""
    precisions: tuple[Precision, ...] = typing.get_args(Precision)
    return {one: jit_networks(function, precision=one) for one in precisions}


def keep_compilations() -> None:
    """Turn on JAX's persistent compilation cache, unless the user has chosen a folder.

    It lies in the user's cache folder; `JAX_COMPILATION_CACHE_DIR` moves it and
    `JAX_ENABLE_COMPILATION_CACHE=0` turns it off. JAX looks once, at its first compilation:
    that is why this runs on import. A step is several programs, none of which takes the second
    to compile from which JAX would keep them, so all programs of 0.05 s are kept, in any folder,
    unless `JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS` says otherwise.
    """
    settings: Any = jax.config  # JAX declares its settings while running
    if settings.jax_compilation_cache_dir is None:
        folder = platformdirs.user_cache_path("headway", appauthor=False) / "compiled"
        jax.config.update("jax_compilation_cache_dir", str(folder))
    name = "jax_persistent_cache_min_compile_time_secs"
    if getattr(settings, name) == _JAX_KEEPS and name.upper() not in os.environ:
        jax.config.update(name, _KEPT)


keep_compilations()
