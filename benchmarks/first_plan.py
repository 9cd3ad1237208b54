"""Plans once in a new process, and prints how long that took and how much memory it needed."""

import resource
import sys
import time
from pathlib import Path

import jax
import jax.numpy as jnp
from workloads import make_agent

KIB_PER_GIB = 2**20


def peak_kib() -> int:
    """The largest resident set of this process so far, in KiB."""
    status = Path("/proc/self/status")
    if status.exists():  # getrusage would count the parent's memory too
        (line,) = [line for line in status.read_text().splitlines() if line.startswith("VmHWM")]
        return int(line.split()[1])
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss


def main(num_envs: int) -> None:
    """Print `seconds`, `before_gib` and `peak_gib`; making the model is not counted."""
    jnp.zeros(1).block_until_ready()
    before = peak_kib()
    agent, state, obs = make_agent(num_envs)
    jax.block_until_ready((state, obs))
    start = time.perf_counter()
    jax.block_until_ready(agent.act(state, obs))
    seconds = time.perf_counter() - start
    print(f"seconds={seconds}")
    print(f"before_gib={before / KIB_PER_GIB} peak_gib={peak_kib() / KIB_PER_GIB}")


if __name__ == "__main__":
    main(int(sys.argv[1]))
