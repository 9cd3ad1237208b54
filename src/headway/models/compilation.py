"""JAX's settings for a run, and the compiler options of functions that run the networks."""

import contextlib
import functools
import os
import warnings
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import platformdirs

from headway.config import Precision
from headway.errors import ConfigError, shown

# Found by measuring on CPUs (docs/performance.md): full-width vectors make the activations
# faster, and YNNPACK's fusions slow float32 products down but are the only way to fast
# bfloat16 ones.
_WIDE_VECTORS = {"xla_cpu_prefer_vector_width": 512}
_NO_FUSIONS = {"xla_cpu_experimental_ynn_fusion_type": ""}
_WANTED: Mapping[Precision, tuple[dict[str, Any], ...]] = {
    "float32": (_WIDE_VECTORS, _NO_FUSIONS),
    "bfloat16": (_WIDE_VECTORS,),
}
_NEEDED: Mapping[str, Any] = {
    "jax_enable_x64": False,
    "jax_numpy_dtype_promotion": "standard",
    "jax_numpy_rank_promotion": "allow",
    "jax_debug_infs": False,
    "jax_default_prng_impl": "threefry2x32",  # decides all draws, as does the next one
    "jax_threefry_partitionable": True,
}
"""Settings of JAX without which a run has other numbers, or none."""
_JAX_KEEPS, _KEPT = 1.0, 0.05
"""Seconds that a program must take to compile to be kept: JAX's default, and ours."""


def prepare_jax() -> None:
    """Set JAX up for a run, before its first compilation; a second call changes nothing.

    Turns on the persistent compilation cache in the user's cache folder, unless the user chose
    another with `JAX_COMPILATION_CACHE_DIR` or turned it off with
    `JAX_ENABLE_COMPILATION_CACHE=0`. Programs that take 0.05 s to compile are kept, because a plan
    is several of them and JAX would keep none; `JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS` says
    otherwise. Training, fitting, checking, loading an agent and the command line call this;
    importing Headway changes nothing.

    Raises:
        ConfigError: JAX is in 64-bit mode, or set to something else that changes the numbers.
    """
    settings: Any = jax.config  # JAX declares its settings while running
    for name, needed in _NEEDED.items():
        got = getattr(settings, name, needed)
        if getattr(got, "value", got) != needed:
            raise ConfigError(
                f"JAX has {name} {shown(got)}, allowed: {needed}, with which runs are trained;"
                f" unset {name.upper()}, or give a process of its own to what needs it."
            )
    if not settings.jax_enable_compilation_cache:
        return
    if settings.jax_compilation_cache_dir is None:
        folder = platformdirs.user_cache_path("headway", appauthor=False) / "compiled"
        jax.config.update("jax_compilation_cache_dir", str(folder))
    name = "jax_persistent_cache_min_compile_time_secs"
    folder, kept_from = str(settings.jax_compilation_cache_dir), getattr(settings, name)
    in_cloud = "://" in folder
    if not in_cloud:
        with contextlib.suppress(OSError):
            Path(folder).mkdir(parents=True, exist_ok=True)
    if not (in_cloud or os.access(folder, os.W_OK | os.X_OK)):
        if kept_from != float("inf"):
            warnings.warn(
                f"compiled programs cannot be kept in {folder}, so every process compiles again;"
                " set JAX_COMPILATION_CACHE_DIR to a folder that can be written.",
                stacklevel=3,
            )
        # JAX would warn once for every program; what is there is read all the same.
        jax.config.update(name, float("inf"))
        jax.config.update("jax_enable_compilation_cache", Path(folder).is_dir())
    elif kept_from == _JAX_KEEPS and name.upper() not in os.environ:
        jax.config.update(name, _KEPT)


@functools.cache
def compiler_options(precision: Precision = "float32") -> dict[str, Any]:
    """Options for products of a precision, without those that this XLA does not know."""
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

    The function is wrapped when first called, so that importing does not start JAX's backend.
    """

    @functools.cache
    def compiled() -> Callable:
        options: Any = {"compiler_options": compiler_options(precision)}
        return eqx.filter_jit(function, **options)

    @functools.wraps(function)
    def call(*args: Any, **kwargs: Any) -> Any:
        return compiled()(*args, **kwargs)

    return call


def in_each_precision(function: Callable) -> dict[Precision, Callable]:
    """A function that runs the networks, compiled for products of each precision."""
    return {one: jit_networks(function, precision=one) for one in _WANTED}
