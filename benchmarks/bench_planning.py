"""One planning step at the paper's HalfCheetah size, and the memory it takes."""

import resource
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import pytest
from workloads import make_agent, plan_flop


@pytest.mark.parametrize("num_envs", [1, 10])
def test_plan(num_envs, timed, report):
    agent, state, obs = make_agent(num_envs)
    timing = timed(lambda: agent.act(state, obs), rounds=7 if num_envs == 1 else 3)
    flop = num_envs * plan_flop(agent)
    report.add(f"plan, {num_envs} env", timing.seconds, "s", **timing.ratio(flop))


def test_peak_memory_of_plan(report):
    done = subprocess.run([sys.executable, __file__], check=True, capture_output=True, text=True)
    before, after = (int(word) / 2**20 for word in done.stdout.split())
    report.add("plan, 10 env, peak memory of the process", after, "GiB")
    report.add("  of which before the plan", before, "GiB")


def peak_kib() -> int:
    """The largest resident set of this process so far, in KiB."""
    status = Path("/proc/self/status")
    if status.exists():  # getrusage would count the parent's memory too
        (line,) = [line for line in status.read_text().splitlines() if line.startswith("VmHWM")]
        return int(line.split()[1])
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss


if __name__ == "__main__":
    jnp.zeros(1).block_until_ready()
    before_plan = peak_kib()
    agent, state, obs = make_agent(10)
    jax.block_until_ready(agent.act(state, obs))
    print(before_plan, peak_kib())
