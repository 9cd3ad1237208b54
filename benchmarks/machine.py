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
    return {
        "date": datetime.datetime.now(datetime.UTC).date().isoformat(),
        "kind": machine_kind(jax.default_backend(), jax.devices()[0].device_kind, num_cpus()),
        "device": f"{jax.devices()[0].device_kind} ({jax.default_backend()})",
        "processor": processor_name(),
        "cores": num_cpus(),
        "load_at_end": round(os.getloadavg()[0], 2),
        "python": platform.python_version(),
        **{name: importlib.metadata.version(name) for name in PACKAGES},
    }


def machine_kind(backend: str, device: str, cores: int) -> str:
    """The folder of `results/speed` that a machine belongs to, like `cpu-2-cores` or `h100`.

    Args:
        backend: JAX's name of the backend.
        device: The device's own name.
        cores: Processor cores that the process may use.
    """
    if backend == "cpu":
        return f"cpu-{cores}-cores"
    words = re.split(r"[^a-z0-9]+", device.lower())
    dull = re.compile(r"nvidia|geforce|amd|tesla|\d+gb|hbm\w*|pcie|sxm\d*|")
    return "-".join(word for word in words if not dull.fullmatch(word)) or backend


def processor_name() -> str:
    """The processor's own name, where the system tells it."""
    path = Path("/proc/cpuinfo")
    lines = path.read_text().splitlines() if path.exists() else []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or platform.machine()
