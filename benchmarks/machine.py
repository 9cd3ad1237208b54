"""Where and with what something was measured, and how fast that multiplies matrices."""

import dataclasses
import datetime
import importlib.metadata
import os
import platform
import re
import time
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from headway.cpus import num_cpus

PACKAGES = ("headway", "jax", "jaxlib", "numpy", "equinox", "mujoco", "gymnasium")


def facts() -> dict[str, Any]:
    """Date, device, processor and versions, as they stand at the top of every result."""
    backend, device = jax.default_backend(), jax.devices()[0].device_kind
    return {
        "date": datetime.datetime.now(datetime.UTC).date().isoformat(),
        "kind": machine_kind(backend, device, num_cpus(), matrix_units=has_amx()),
        "device": f"{device} ({backend})",
        "processor": processor_name(),
        "cores": num_cpus(),
        "load_at_end": round(os.getloadavg()[0], 2),
        "python": platform.python_version(),
        **{name: importlib.metadata.version(name) for name in PACKAGES},
    }


def machine_kind(backend: str, device: str, cores: int, *, matrix_units: bool) -> str:
    """The folder of `results/speed` that a machine belongs to, like `cpu-2-cores` or `h100`.

    A CPU with matrix units for bfloat16 is of another kind than one without: `cpu-2-cores-amx`.

    Args:
        backend: JAX's name of the backend.
        device: The device's own name.
        cores: Processor cores that the process may use.
        matrix_units: Whether the processor has AMX.
    """
    if backend == "cpu":
        return f"cpu-{cores}-cores" + ("-amx" if matrix_units else "")
    words = re.split(r"[^a-z0-9]+", device.lower())
    dull = re.compile(r"nvidia|geforce|amd|tesla|\d+gb|hbm\w*|pcie|sxm\d*|")
    return "-".join(word for word in words if not dull.fullmatch(word)) or backend


def processor_name() -> str:
    """The processor's own name, where the system tells it."""
    return cpu_info("model name") or platform.processor() or platform.machine()


def has_amx() -> bool:
    """Whether the processor says that it multiplies matrices of bfloat16 (AMX); on Linux alone."""
    return "amx_bf16" in cpu_info("flags").split()


def cpu_info(name: str) -> str:
    """What Linux tells about the first processor under a name; empty where it tells nothing."""
    path = Path("/proc/cpuinfo")
    lines = path.read_text().splitlines() if path.exists() else []
    found = (line.partition(":")[2].strip() for line in lines if line.startswith(name))
    return next(found, "")


# (rows, inner, columns): what the planner multiplies, and what libraries are fastest at.
SHAPES = ((4000, 200, 200), (40_000, 200, 200), (2048, 2048, 2048), (4096, 4096, 4096))
ACCELERATOR_SIZE = 8192


@dataclasses.dataclass(frozen=True)
class Rate:
    """A rate of matrix products, measured in this run."""

    flops: float
    """Floating-point operations per second, multiply and add being two."""
    name: str

    def ratio(self, flop: float, seconds: float) -> dict[str, float | str]:
        """Columns `ratio` and `ratio_to`: `seconds` over the time of `flop` at this rate."""
        at = f"{flop / 1e9:,.1f} GFLOP at {self.flops / 1e9:,.0f} GFLOP/s ({self.name})"
        return {"ratio": seconds * self.flops / flop, "ratio_to": at}


def reference_rate() -> Rate:
    """NumPy's float32 products on a CPU, JAX's bfloat16 products elsewhere."""
    if jax.default_backend() == "cpu":
        return Rate(_numpy_flops(), "NumPy float32")
    return Rate(_accelerator_flops(), "JAX bfloat16")


def _numpy_flops() -> float:
    """The best rate over a few shapes."""
    rng = np.random.default_rng(0)
    best = 0.0
    for n, k, m in SHAPES:
        left = rng.standard_normal((n, k), np.float32)
        right = rng.standard_normal((k, m), np.float32)
        out = left @ right
        repeats = max(1, round(2e10 / (2 * n * k * m)))
        for _ in range(5):
            start = time.perf_counter()
            for _ in range(repeats):
                np.matmul(left, right, out=out)
            best = max(best, repeats * 2 * n * k * m / (time.perf_counter() - start))
    return best


def _accelerator_flops(size: int = ACCELERATOR_SIZE, repeats: int = 20) -> float:
    """The best rate of a large square product."""
    left, right = (
        jax.random.normal(jax.random.key(seed), (size, size), jnp.bfloat16) for seed in (0, 1)
    )
    product = jax.jit(jnp.matmul)
    product(left, right).block_until_ready()
    best = 0.0
    for _ in range(5):
        start = time.perf_counter()
        for _ in range(repeats):
            out = product(left, right)
        out.block_until_ready()
        best = max(best, repeats * 2 * size**3 / (time.perf_counter() - start))
    return best
