"""One planning step at the paper's HalfCheetah size: its time, its memory, its first call."""

import os
import statistics
import subprocess
import sys
import time
from pathlib import Path

import pytest
from workloads import make_agent, planners

from headway.config import MultiHeadedConfig
from headway.planning.rollouts import plan_flop

FIRST_PLAN = Path(__file__).parent / "first_plan.py"


@pytest.mark.parametrize("precision", planners())
@pytest.mark.parametrize("num_envs", [1, 10])
def test_plan(num_envs, precision, timed, report):
    planner = planners()[precision]
    agent, state, obs = make_agent(num_envs, planner=planner)
    flop = num_envs * plan_flop(MultiHeadedConfig(), planner, agent.task, 5 * 200.0)
    timing = timed(lambda: agent.act(state, obs), rounds=7 if num_envs == 1 else 3)
    report.add(
        f"plan, {num_envs} env, {precision}",
        timing.seconds,
        "s",
        **timing.rate.ratio(flop, timing.seconds),
        key=f"plan-{num_envs}-{precision}",
    )


def test_peak_memory_of_plan(report):
    measured = first_plan(10, {})
    report.add(
        "plan, 10 env, peak memory of the process",
        measured["peak_gib"],
        "GiB",
        key="memory",
    )
    report.add("  of which before the plan", measured["before_gib"], "GiB")


def test_first_plan(report, tmp_path):
    cold = first_plan(1, {"JAX_ENABLE_COMPILATION_CACHE": "false"})
    cache = {"JAX_COMPILATION_CACHE_DIR": str(tmp_path)}
    first_plan(1, cache)
    warm = first_plan(1, cache)
    for name, key, measured in (("no cache", "cold", cold), ("cached", "warm", warm)):
        report.add(
            f"first plan of a process, 1 env, {name}",
            measured["seconds"],
            "s",
            key=f"first-plan-{key}",
        )


def test_import(report):
    """What a controller imports, in new processes."""
    seconds = []
    for _ in range(5):
        begun = time.perf_counter()
        subprocess.run([sys.executable, "-c", "import headway; headway.load"], check=True)
        seconds.append(time.perf_counter() - begun)
    report.add("a process that imports headway.load", statistics.median(seconds), "s")


def first_plan(num_envs: int, environment: dict[str, str]) -> dict[str, float]:
    """What `first_plan.py` measures in a process of its own."""
    done = subprocess.run(
        [sys.executable, str(FIRST_PLAN), str(num_envs)],
        check=True,
        capture_output=True,
        text=True,
        env=os.environ | environment,
    )
    words = dict(word.split("=") for word in done.stdout.split())
    return {name: float(value) for name, value in words.items()}
