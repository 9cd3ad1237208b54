"""Collects what the benchmarks measure; prints one small table and writes `latest.json`.

Times are medians. A ratio compares with something measured in the same run, so that it can be
compared between machines.
"""

import dataclasses
import importlib.metadata
import json
import os
import platform
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest
from rich import box
from rich.console import Console
from rich.table import Table

OUTPUT = Path(__file__).parent / "latest.json"
PACKAGES = ("headway", "jax", "jaxlib", "numpy", "equinox", "mujoco", "gymnasium")
# (rows, inner, columns): what the planner multiplies, and what libraries are fastest at.
PRODUCT_SHAPES = ((4000, 200, 200), (40_000, 200, 200), (2048, 2048, 2048), (4096, 4096, 4096))


@dataclasses.dataclass(frozen=True)
class Measurement:
    """One line of the table."""

    name: str
    value: float
    unit: str
    ratio: float | None = None
    ratio_to: str = ""


class Report:
    """What the benchmarks of one run have measured."""

    def __init__(self):
        self.measurements: list[Measurement] = []

    def add(self, *args: Any, **kwargs: Any) -> None:
        """Add one line; see `Measurement`."""
        self.measurements.append(Measurement(*args, **kwargs))

    def facts(self) -> dict[str, Any]:
        """Where and with what the numbers were measured."""
        return {
            "device": f"{jax.devices()[0].device_kind} ({jax.default_backend()})",
            "processor": processor_name(),
            "cores": len(os.sched_getaffinity(0)),
            "load_at_end": round(os.getloadavg()[0], 2),
            "python": platform.python_version(),
            **{name: importlib.metadata.version(name) for name in PACKAGES},
        }


REPORT = pytest.StashKey[Report]()


def processor_name() -> str:
    """The processor's own name, where the system tells it."""
    path = Path("/proc/cpuinfo")
    lines = path.read_text().splitlines() if path.exists() else []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or platform.machine()


def product_rate() -> float:
    """The best rate of NumPy's float32 matrix product over a few shapes, in FLOP/s."""
    rng = np.random.default_rng(0)
    best = 0.0
    for n, k, m in PRODUCT_SHAPES:
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


def pytest_configure(config: pytest.Config) -> None:
    config.stash[REPORT] = Report()


@pytest.fixture(scope="session")
def report(request: pytest.FixtureRequest) -> Report:
    """Where measurements go."""
    return request.config.stash[REPORT]


@dataclasses.dataclass(frozen=True)
class Timing:
    """A median, and how it compares with NumPy's products of as many operations."""

    seconds: float
    rate: float

    def ratio(self, flop: float, seconds: float | None = None) -> dict[str, Any]:
        """Columns `ratio` and `ratio_to` of the table, for `seconds` or else the median."""
        products = f"{flop / 1e9:,.1f} GFLOP of NumPy products at {self.rate / 1e9:.0f} GFLOP/s"
        seconds = self.seconds if seconds is None else seconds
        return {"ratio": seconds * self.rate / flop, "ratio_to": products}


@pytest.fixture
def timed(benchmark) -> Callable[..., Timing]:
    """Time a function, after one call to warm up, with NumPy's products just before and after."""

    def run(function: Callable[[], Any], rounds: int) -> Timing:
        before = product_rate()
        benchmark.pedantic(
            lambda: jax.block_until_ready(function()), rounds=rounds, warmup_rounds=1
        )
        return Timing(benchmark.stats.stats.median, max(before, product_rate()))

    return run


def pytest_terminal_summary(config: pytest.Config) -> None:
    report = config.stash[REPORT]
    if not report.measurements:
        return
    facts = report.facts()
    rows = [dataclasses.asdict(measurement) for measurement in report.measurements]
    OUTPUT.write_text(json.dumps({**facts, "measurements": rows}, indent=1) + "\n")
    table = Table("what", "median", "ratio", "to", box=box.SIMPLE_HEAD)
    for row in report.measurements:
        ratio = "" if row.ratio is None else f"{row.ratio:.2f}"
        table.add_row(row.name, f"{row.value:.4g} {row.unit}", ratio, row.ratio_to)
    console = Console(width=120, highlight=False)
    console.print(table)
    console.print("  ".join(f"{name} {value}" for name, value in facts.items()))
    console.print(f"written to {OUTPUT.relative_to(config.rootpath)}")
