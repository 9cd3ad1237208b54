"""Fixtures of the benchmarks: what times a function, and the report at the end."""

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import pytest
from machine import Rate, reference_rate
from reporting import LATEST, TARGETS, Report

REPORT = pytest.StashKey[Report]()


@dataclasses.dataclass(frozen=True)
class Timing:
    """A median, and the rate of matrix products measured around it."""

    seconds: float
    rate: Rate


def pytest_configure(config: pytest.Config) -> None:
    config.stash[REPORT] = Report(TARGETS)


@pytest.fixture(scope="session")
def report(request: pytest.FixtureRequest) -> Report:
    """Where measurements go."""
    return request.config.stash[REPORT]


@pytest.fixture
def timed(benchmark) -> Callable[..., Timing]:
    """Time a function, after one call to warm up, with matrix products just before and after."""

    def run(function: Callable[[], Any], rounds: int) -> Timing:
        before = reference_rate()
        benchmark.pedantic(
            lambda: jax.block_until_ready(function()), rounds=rounds, warmup_rounds=1
        )
        after = reference_rate()
        rate = max(before, after, key=lambda rate: rate.flops)
        return Timing(benchmark.stats.stats.median, rate)

    return run


def pytest_terminal_summary(
    terminalreporter: pytest.TerminalReporter, config: pytest.Config
) -> None:
    report = config.stash[REPORT]
    if report.measurements:
        terminalreporter.write_line("\n" + report.write("bench"))
        terminalreporter.write_line(f"written to {LATEST.relative_to(config.rootpath)}/bench.*")
