"""Where a plan runs: how many environments at once, and on which devices.

Decided when a plan is compiled. None of it changes a result beyond rounding.
"""

from typing import Literal, TypeVar

import jax
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from jaxtyping import Array

from headway.models.meeting import seeds_at_once

Tree = TypeVar("Tree")
Devices = Literal["local", "all"]

CPU_BUDGET = 4 * 2**20
"""Bytes that one array of activations may take on a CPU: more would leave its caches."""
ARRAYS = 8
"""How many such arrays a plan holds at most; the share of free GPU memory that one may take."""


def environments_at_once(num_envs: int, bytes_per_env: int) -> int:
    """How many environments are imagined side by side, so that memory stays bounded.

    Args:
        num_envs: Environments in all.
        bytes_per_env: Size of one environment's widest array of activations, for one seed.

    Returns:
        At least 1; the environments are spread evenly over the fewest chunks that fit.
    """
    fitting = max(1, activation_budget() // (bytes_per_env * seeds_at_once()))
    chunks = -(-num_envs // fitting)
    return -(-num_envs // chunks)


def activation_budget() -> int:
    """Bytes that one array of activations may take, on all devices together."""
    devices = jax.local_devices()
    return sum(memory_budget(device.platform, device.memory_stats()) for device in devices)


def spread_candidates(x: Array, devices: Devices = "local") -> Array:
    """Share the last axis, the candidates, among devices, where it can be divided.

    Args:
        x: Any array whose last axis is the candidates.
        devices: Those of this process, or of all processes together.
    """
    mesh = _mesh(devices)
    if mesh.size == 1 or x.shape[-1] % mesh.size:
        return x
    spec = PartitionSpec(*[PartitionSpec.UNCONSTRAINED] * (x.ndim - 1), "candidate")
    return jax.lax.with_sharding_constraint(x, NamedSharding(mesh, spec))


def whole_on_each(tree: Tree, devices: Devices) -> Tree:
    """Give every device all of some arrays, where several processes share a plan.

    So each process can read them.
    """
    if devices == "local" or jax.process_count() == 1:
        return tree
    return jax.lax.with_sharding_constraint(tree, NamedSharding(_mesh(devices), PartitionSpec()))


def _mesh(devices: Devices) -> Mesh:
    found = jax.devices() if devices == "all" else jax.local_devices()
    return Mesh(np.array(found), ("candidate",))


def memory_budget(platform: str, stats: dict[str, int] | None) -> int:
    """Bytes that one array of activations may take on one device.

    Args:
        platform: `cpu`, `gpu`, ...
        stats: What the device says of its memory; None where it does not.
    """
    if platform == "cpu" or not stats or "bytes_limit" not in stats:
        return CPU_BUDGET
    free = stats["bytes_limit"] - stats.get("bytes_in_use", 0)
    return max(free, 0) // ARRAYS
