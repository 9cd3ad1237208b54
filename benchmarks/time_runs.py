"""Runs the paper's HalfCheetah and Pendulum experiments and times them. Wants a GPU.

    python benchmarks/time_runs.py            both
    python benchmarks/time_runs.py pendulum   one

Each run starts in a new process, so importing and compiling count. On two CPU cores the
HalfCheetah run would take days.
"""

import argparse
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable

from reporting import Report
from targets import RUN_TARGETS

SECONDS_PER_MINUTE = 60
RUNS = {"half-cheetah": ("min", SECONDS_PER_MINUTE), "pendulum": ("s", 1)}


def headway_train(env: str, run_dir: str) -> None:
    """Train and evaluate with the paper's settings."""
    command = [sys.executable, "-m", "headway", "train", env, "--preset", "paper", "--seed", "0"]
    subprocess.run([*command, "--run-dir", run_dir], check=True)


def seconds_of(run: Callable[[str, str], None], env: str) -> float:
    """How long one run takes; its files are thrown away."""
    with tempfile.TemporaryDirectory() as folder:
        start = time.perf_counter()
        run(env, f"{folder}/run")
        return time.perf_counter() - start


def main() -> None:
    """Time the wanted runs and write the result."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("envs", nargs="*", metavar="env", help=f"any of {', '.join(RUNS)}")
    wanted = parser.parse_args().envs or list(RUNS)
    if unknown := set(wanted) - set(RUNS):
        parser.error(f"unknown {', '.join(sorted(unknown))}, allowed: {', '.join(RUNS)}")
    report = Report(RUN_TARGETS)
    for env in wanted:
        unit, scale = RUNS[env]
        taken = seconds_of(headway_train, env) / scale
        report.add(f"{env}, the paper's run", taken, unit, key=f"run-{env}")
    print(report.write("runs"))


if __name__ == "__main__":
    main()
