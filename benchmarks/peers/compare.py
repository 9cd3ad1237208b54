"""One plan by mbrl-lib and by Headway, in processes that take turns on the same machine.

    python benchmarks/peers/compare.py --peer-python .venv-peers/bin/python

Same sizes and the same work where the two overlap: an ensemble without heads and context (PETS).
T-MCL is timed beside it.
"""

import argparse
import json
import statistics
import subprocess
import sys
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[1]))
from machine import facts
from reporting import markdown_table, write_result
from workloads import planners

HERE = Path(__file__).parent
PEER_PACKAGES = ("mbrl", "torch")


def contestants(peer_python: str) -> dict[str, list[str]]:
    """The command of everything that is timed; the peer is first."""
    ours = [sys.executable, str(HERE / "plan_headway.py")]
    commands = {"mbrl-lib, PETS": [peer_python, str(HERE / "plan_mbrl.py")]}
    for precision in planners():
        for method, name in (("pets", "PETS"), ("tmcl", "T-MCL")):
            command = [*ours, "--method", method, "--precision", precision]
            commands[f"Headway, {name}, {precision}"] = command
    return commands


def take_turns(
    commands: dict[str, list[str]], turns: int, extra: list[str]
) -> dict[str, list[float]]:
    """Run every command in turn, several times over; the seconds of all plans of each."""
    seconds: dict[str, list[float]] = {name: [] for name in commands}
    for turn in range(turns):
        for name, command in commands.items():
            done = subprocess.run([*command, *extra], check=True, stdout=subprocess.PIPE, text=True)
            seconds[name] += json.loads(done.stdout)
            print(f"turn {turn + 1}, {name}: {done.stdout.strip()}", flush=True)
    return seconds


def peer_versions(peer_python: str) -> dict[str, str]:
    """Versions of what the peer runs on."""
    code = f"from importlib.metadata import version; print(*map(version, {PEER_PACKAGES}))"
    done = subprocess.run([peer_python, "-c", code], check=True, capture_output=True, text=True)
    return dict(zip(PEER_PACKAGES, done.stdout.split(), strict=True))


def table(seconds: dict[str, list[float]]) -> str:
    """Medians, their spread, and the peer's time over each."""
    (peer, *_), rows = seconds, []
    for name, times in seconds.items():
        median = statistics.median(times)
        ratio = statistics.median(seconds[peer]) / median
        spread = f"{min(times):.2f} to {max(times):.2f} s"
        rows.append([name, f"{median:.2f} s", spread, str(len(times)), f"{ratio:.2f}×"])
    return markdown_table(
        ["one plan", "median", "range", "plans", f"times as fast as {peer}"], rows
    )


def main() -> None:
    """Compare, print, and write the result."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--peer-python", required=True, help="Python of the peer's venv")
    parser.add_argument("--num-envs", type=int, default=1)
    parser.add_argument("--plans", type=int, default=3, help="plans of one process")
    parser.add_argument("--turns", type=int, default=2, help="processes of each")
    arguments = parser.parse_args()
    extra = ["--num-envs", str(arguments.num_envs), "--plans", str(arguments.plans)]
    seconds = take_turns(contestants(arguments.peer_python), arguments.turns, extra)
    about: dict[str, Any] = {**facts(), **peer_versions(arguments.peer_python)}
    about["environments"] = arguments.num_envs
    name = "peers" if arguments.num_envs == 1 else f"peers-{arguments.num_envs}-env"
    print(write_result(name, about, {"seconds": seconds}, table(seconds)))


if __name__ == "__main__":
    main()
