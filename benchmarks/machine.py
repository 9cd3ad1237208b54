"""Where and with what something was measured."""

import datetime
import importlib.metadata
import os
import platform
import re
from pathlib import Path
from typing import Any

import jax

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
