"""Prints what share of a plan its parts take, from the operations that really ran.

    python benchmarks/profile_plan.py
    python benchmarks/profile_plan.py --num-envs 10 --planner num_candidates=400 --top 20
    python benchmarks/profile_plan.py --planner precision=bfloat16

Parts of the compiled plan are timed by JAX's profiler; `hlo_parts` says to which part of
Headway each belongs.
"""

import argparse
import ast
import collections
import dataclasses
import statistics
import time
from collections.abc import Callable
from typing import Any

import jax
from hlo_parts import CONTAINERS, Module
from op_trace import Operation, exclusive_seconds, record
from rich import box
from rich.console import Console
from rich.table import Table
from workloads import make_agent

from headway.config import PlannerConfig

OVERHEAD = "loops and dispatch (no operation runs)"


@dataclasses.dataclass(frozen=True)
class Profile:
    """Seconds of one plan."""

    plain: float
    """Of a plan without the profiler."""
    traced: float
    """Of the traced plan, first to last operation."""
    parts: dict[str, float]
    operations: dict[Operation, float]
    shares: dict[Operation, dict[str, float]]
    """The parts of each operation."""


def profile(function: Callable[[], Any], rounds: int = 3) -> Profile:
    """Time a compiled function and the operations in it."""
    jax.block_until_ready(function())
    plain = statistics.median(seconds(function) for _ in range(rounds))
    spans = record(function)
    shares, containers = operation_shares({span.op.module for span in spans})
    operations = exclusive_seconds(spans)
    parts: dict[str, float] = collections.defaultdict(float)
    for op, time_taken in operations.items():
        mix = {OVERHEAD: 1.0} if op in containers else shares[op]
        for part, share in mix.items():
            parts[part] += share * time_taken
    traced = max(span.end for span in spans) - min(span.start for span in spans)
    parts[OVERHEAD] += traced - sum(parts.values())
    return Profile(plain, traced, parts, operations, shares)


def seconds(function: Callable[[], Any]) -> float:
    """How long one call takes."""
    start = time.perf_counter()
    jax.block_until_ready(function())
    return time.perf_counter() - start


def operation_shares(
    modules: set[str],
) -> tuple[dict[Operation, dict[str, float]], set[Operation]]:
    """The parts of every operation of the loaded modules, and which operations are loops."""
    shares: dict[Operation, dict[str, float]] = collections.defaultdict(lambda: {"other": 1.0})
    containers = set()
    for executable in jax.devices()[0].client.live_executables():
        for module in executable.hlo_modules():
            if module.name in modules:
                for instruction, parts in Module(module.to_string()).operations():
                    operation = Operation(module.name, instruction.name)
                    shares[operation] = parts
                    if instruction.opcode in CONTAINERS:
                        containers.add(operation)
    return shares, containers


def show(found: Profile, top: int) -> None:
    """Print the parts, and the operations that take longest."""
    console = Console(width=110, highlight=False)
    parts = Table("part", "ms", "share", box=box.SIMPLE_HEAD)
    for part, taken in sorted(found.parts.items(), key=lambda item: -item[1]):
        parts.add_row(part, f"{1e3 * taken:.1f}", f"{taken / found.traced:.1%}")
    console.print(parts)
    operations = Table("operation", "ms", "parts", box=box.SIMPLE_HEAD)
    for op, taken in sorted(found.operations.items(), key=lambda item: -item[1])[:top]:
        mix = sorted(found.shares[op].items(), key=lambda item: -item[1])
        text = ", ".join(f"{part} {share:.0%}" for part, share in mix if share >= 0.01)
        operations.add_row(op.name, f"{1e3 * taken:.1f}", text)
    console.print(operations)
    console.print(
        f"one plan: {1e3 * found.plain:.1f} ms, under the profiler {1e3 * found.traced:.1f} ms; "
        "shares within an operation are estimates"
    )


def setting(text: str) -> tuple[str, Any]:
    """Read `name=value`; a value that is no Python literal is a string."""
    name, _, value = text.partition("=")
    try:
        return name, ast.literal_eval(value)
    except (ValueError, SyntaxError):
        return name, value


def main() -> None:
    """Profile one plan at the paper's HalfCheetah sizes."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--num-envs", type=int, default=1)
    parser.add_argument("--top", type=int, default=12, help="operations to list")
    parser.add_argument(
        "--planner", type=setting, action="append", default=[], metavar="NAME=VALUE"
    )
    arguments = parser.parse_args()
    agent, state, obs = make_agent(
        arguments.num_envs, planner=PlannerConfig(**dict(arguments.planner))
    )
    show(profile(lambda: agent.act(state, obs)), arguments.top)


if __name__ == "__main__":
    main()
