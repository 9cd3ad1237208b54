"""A million transitions: what one fitted epoch needs of the host's memory, in blocks and whole.

Random walks of HalfCheetah's size are written as a run writes its data, then fitted by a small
model, each way in a process of its own. In blocks the files stay memory-mapped; whole means
read into memory and laid out at once. `RssAnon` is memory of the process, `RssFile` pages of
mapped files, which the system may take back at any time. On a CPU the device's arrays are in
the host's memory and count too. Linux only. Run with `make bench-million`.
"""

import argparse
import dataclasses
import itertools
import json
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path

import jax
import numpy as np

from headway.config import FittingConfig, ModelConfig
from headway.data import Trajectory
from headway.experiment.blocks import BlockedData, Layout, fit_blocks
from headway.models.dynamics import MultiHeadDynamics, Statistics
from headway.models.fitting import FitSetup
from headway.storage.records import load_trajectories, save_trajectories
from headway.tasks.catalog import env_spec

EPISODE_LENGTH = 1000
FILE_EPISODES = 50  # about 5 MB
MODEL = ModelConfig(num_members=1, hidden_sizes=(32,), context_hidden_sizes=(32,))
FITTING = FittingConfig(batch_size=8192)
TASK = env_spec("half-cheetah").make_task()
SAMPLE_EVERY = 0.005  # seconds
FIELDS = ("RssAnon", "RssFile")


def write(folder: Path, num_episodes: int) -> None:
    """Write random walks, some episodes a file."""
    for first in range(0, num_episodes, FILE_EPISODES):
        rng = np.random.default_rng(first)
        trajectories = [random_walk(rng) for _ in range(min(FILE_EPISODES, num_episodes - first))]
        save_trajectories(folder / f"{first:06d}", trajectories)


def random_walk(rng: np.random.Generator) -> Trajectory:
    """One episode of HalfCheetah's size."""
    steps = rng.normal(0, 0.1, (EPISODE_LENGTH + 1, TASK.obs_size)).cumsum(0)
    action = rng.uniform(-1, 1, (EPISODE_LENGTH, TASK.action_size))
    reward = np.zeros(EPISODE_LENGTH)
    return Trajectory(steps.astype(np.float32), action.astype(np.float32), reward, {})


def read(folder: Path, *, whole: bool) -> list[Trajectory]:
    """Open all files; `whole` copies them into memory."""
    paths = sorted(folder.glob("*.safetensors"))
    trajectories = [t for path in paths for t in load_trajectories(path)]
    return [in_memory(t) for t in trajectories] if whole else trajectories


def in_memory(trajectory: Trajectory) -> Trajectory:
    """A copy that needs no file."""
    arrays = {name: np.array(getattr(trajectory, name)) for name in ("obs", "action", "reward")}
    return dataclasses.replace(trajectory, **arrays)


class MemoryMeter:
    """Follows this process's memory in the background; megabytes."""

    def __init__(self):
        self.before = status()
        self.most = dict.fromkeys(FIELDS, 0.0)
        self._done = threading.Event()
        self._thread = threading.Thread(target=self._follow)

    def _follow(self) -> None:
        while not self._done.wait(SAMPLE_EVERY):
            now = status()
            self.most = {name: max(self.most[name], now[name]) for name in FIELDS}

    def __enter__(self) -> "MemoryMeter":
        self._thread.start()
        return self

    def __exit__(self, *exception: object) -> None:
        self._done.set()
        self._thread.join()


def status() -> dict[str, float]:
    """The memory lines of /proc/self/status, in megabytes."""
    lines = Path("/proc/self/status").read_text().splitlines()
    pairs = (line.partition(":")[::2] for line in lines if line.startswith(("Rss", "VmHWM")))
    return {name: int(value.split()[0]) / 1024 for name, value in pairs}


def fit(folder: Path, *, whole: bool) -> dict[str, float]:
    """Fit one epoch and say what it took."""
    setup = FitSetup(TASK, FITTING, MODEL.history_length)
    state = setup.init(MultiHeadDynamics.init(MODEL, TASK, key=jax.random.key(0)))
    with MemoryMeter() as meter:
        clock = [time.perf_counter()]
        trajectories = read(folder, whole=whole)
        clock.append(time.perf_counter())
        statistics = Statistics.fit(TASK, trajectories, MODEL.history_length)
        clock.append(time.perf_counter())
        most = len(trajectories) if whole else FITTING.block_transitions // EPISODE_LENGTH
        layout = Layout(min(most, len(trajectories)), EPISODE_LENGTH)
        key = jax.random.key(1)
        data = BlockedData(trajectories, layout, statistics, setup, MODEL.num_members, key)
        blocks = itertools.islice(data.stream(1, key), data.num_blocks)
        state, stats = fit_blocks(state, setup, blocks, independent=False)
        jax.block_until_ready(state)
        clock.append(time.perf_counter())
    seconds = dict(zip(("read s", "statistics s", "epoch s"), np.diff(clock).tolist(), strict=True))
    return {
        "blocks": data.num_blocks,
        "updates": int(stats.updates),
        "RssAnon before MB": meter.before["RssAnon"],
        **{f"{name} peak MB": value for name, value in meter.most.items()},
        "VmHWM MB": status()["VmHWM"],
        **seconds,
        "loss": float(stats.loss),
    }


def measure(folder: Path, way: str) -> dict[str, float]:
    """Fit in a new process, so that its peak is its own."""
    command = [sys.executable, __file__, "--fit", way, "--folder", str(folder)]
    done = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True)
    return json.loads(done.stdout)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--episodes", type=int, default=1000, help="of 1000 steps each")
    parser.add_argument("--folder", type=Path, help="keeps the data; used again if there")
    parser.add_argument("--fit", choices=("blocks", "whole"), help="fit once and print JSON")
    options = parser.parse_args()
    if options.fit:
        print(json.dumps(fit(options.folder, whole=options.fit == "whole")))
        return
    with tempfile.TemporaryDirectory() as temporary:
        folder = options.folder or Path(temporary)
        if not any(folder.glob("*.safetensors")):
            write(folder, options.episodes)
        size = sum(path.stat().st_size for path in folder.glob("*.safetensors"))
        found = {way: measure(folder, way) for way in ("blocks", "whole")}
    print(f"{options.episodes * EPISODE_LENGTH:,} transitions, {size / 2**20:.0f} MB of files")
    print(f"{'':20}" + "".join(f"{way:>12}" for way in found))
    for name in found["blocks"]:
        print(f"{name:20}" + "".join(f"{column[name]:12.5g}" for column in found.values()))


if __name__ == "__main__":
    main()
