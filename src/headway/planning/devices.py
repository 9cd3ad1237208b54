"""Where a plan runs: how many environments at once, and on which devices.

Decided when a plan is compiled. None of it changes a result beyond rounding.
"""

from typing import TypeVar

import jax
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from jaxtyping import Array

Tree = TypeVar("Tree")

CPU_BUDGET = 4 * 2**20
"""Bytes that one array of activations may take on a CPU: more would leave its caches."""
SHARE_BUDGET = 2**20
"""The same where every core has a program of its own, and so only its own caches."""
ARRAYS = 8
"""How many such arrays a plan holds at most; the share of free GPU memory that one may take."""


def environments_at_once(num_envs: int, bytes_per_env: int, budget: int | None = None) -> int:
    """How many environments are imagined side by side, so that memory stays bounded.

    Args:
        num_envs: Environments in all.
        bytes_per_env: Size of one environment's widest array of activations.
        budget: Bytes that all of them may take together; None for the `activation_budget`.

    Returns:
        At least 1; the environments are spread evenly over the fewest chunks that fit.
    """
    budget = activation_budget() if budget is None else budget
    fitting = max(1, budget // bytes_per_env)
    chunks = -(-num_envs // fitting)
    return -(-num_envs // chunks)


def activation_budget() -> int:
    """Bytes that one array of activations may take, on all devices together."""
    devices = jax.local_devices()
    return sum(memory_budget(device.platform, device.memory_stats()) for device in devices)


def spread_candidates(x: Array) -> Array:
    """Share the last axis, the candidates, among the local devices."""
    mesh = _mesh()
    if mesh.size == 1:
        return x
    spec = PartitionSpec(*[PartitionSpec.UNCONSTRAINED] * (x.ndim - 1), "candidate")
    return jax.lax.with_sharding_constraint(x, NamedSharding(mesh, spec))


def whole_on_each(tree: Tree) -> Tree:
    """Give every device all of some arrays that a compiled step returns.

    So they can be the next step's arguments as they are.
    """
    everywhere = _everywhere()
    if everywhere.mesh.size == 1:
        return tree
    return jax.lax.with_sharding_constraint(tree, everywhere)


def brought_to_each(tree: Tree) -> Tree:
    """What a compiled step remembers, where `whole_on_each` leaves it, also before the first step.

    So the second step does not have to be compiled again for arrays that lie elsewhere.
    """
    everywhere = _everywhere()
    if everywhere.mesh.size == 1:
        return tree
    return jax.tree.map(
        lambda x: (
            x if getattr(x, "sharding", None) == everywhere else jax.device_put(x, everywhere)
        ),
        tree,
    )


def _everywhere() -> NamedSharding:
    return NamedSharding(_mesh(), PartitionSpec())


def _mesh() -> Mesh:
    return Mesh(np.array(jax.local_devices()), ("candidate",))


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
