"""Physics that change while acting: the return after the change, and how long recovery takes.

    python results/adaptation/changes.py runs/pendulum-0 --folder results/adaptation/changes

One table per run; some episodes per change, all side by side. What the table holds already is
skipped, and so are arms that a method does not have.

Recovered is the first step after the change from which the mean reward of 20 steps reaches 90 % of
the way from a random controller's to that of a balanced pendulum (Pendulum), or 90 % of that of the
20 steps before the change (others); where it never happens, the steps that were left. A drift's
steps count from its beginning.
"""

import argparse
import json
from collections.abc import Mapping, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Float
from measure import ARMS as MEASURED
from measure import name_of

from headway.config import Config
from headway.data import Trajectory
from headway.storage.records import read_csv, write_csv
from headway.training.collect import AgentPolicy, Environments, Episode, run_episodes
from headway.training.loading import load_agent
from headway.training.methods import config_to_evaluate
from headway.training.run import RunDir

COLUMNS = (
    "run", "env", "method", "seed", "arm", "settings", "step", "episode", "before", "after", "over",
    "return_after", "reward_before", "recovery_steps",
)  # fmt: skip
ARMS = {
    name: MEASURED[name]
    for name in (
        "none",
        "last-layer",
        "last-layer, change detection",
        "last-layer, forgetting 0.05",
        "evidence",
        "last-layer, evidence",
        "likelihood",
        "likelihood, change detection",
    )
}
"""Settings that the run is tested with, by name."""


class Change(NamedTuple):
    """Physics that begin as they are in training, and what they become."""

    before: dict[str, float]
    after: dict[str, float]
    """Only what changes."""
    over: int = 1
    """Steps that it takes: 1 is a jump, more a steady drift."""

    def schedule(self, step: int) -> dict[int, dict[str, float]]:
        """The physics from a step on."""
        return {
            step + i: {
                name: self.before[name] + (value - self.before[name]) * (i + 1) / self.over
                for name, value in self.after.items()
            }
            for i in range(self.over)
        }


def lengths(before: float, after: float, over: int = 1) -> Change:
    """A pendulum whose length changes."""
    return Change({"length": before, "mass": 1.0}, {"length": after}, over)


def robots(before: float, **after: float) -> Change:
    """A robot of some mass that changes."""
    return Change({"mass_scale": before, "damping_scale": 1.0}, after)


CHANGES: dict[str, tuple[Change, ...]] = {
    "pendulum": (
        lengths(1.25, 0.5),
        lengths(0.5, 1.25),
        lengths(1.0, 0.25),
        lengths(1.0, 1.75),
        Change({"length": 1.0, "mass": 1.0}, {"mass": 2.0}),
        lengths(0.5, 1.25, over=100),
        lengths(1.25, 0.5, over=100),
        lengths(1.0, 1.75, over=100),
    ),
    "half-cheetah": (
        robots(0.5, mass_scale=1.5),
        robots(1.5, mass_scale=0.5),
        robots(1.5, mass_scale=3.0),
        robots(1.5, damping_scale=2.0),
    ),
}
"""From training physics to training or unseen ones."""
REWARDS = {"pendulum": (-6.0, 0.0)}
"""Mean rewards of random actions and of a balanced pendulum, where rewards are costs."""
WINDOW = 20
SEED = 777_000


def recovery_steps(env: str, reward: Float[np.ndarray, " time"], step: int) -> int:
    """Steps after the change until rewards are good again; all that are left if never."""
    means = np.convolve(reward, np.full(WINDOW, 1.0 / WINDOW), mode="valid")
    low, high = REWARDS.get(env, (0.0, means[step - WINDOW]))
    recovered = means[step:] >= low + 0.9 * (high - low)
    return int(np.argmax(recovered)) if recovered.any() else len(reward) - step


def measure(
    run_dir: Path, settings: Mapping[str, Any], step: int, per_change: int
) -> list[dict[str, Any]]:
    """Run all changes of an environment; one row per episode."""
    run = RunDir(run_dir)
    config = config_to_evaluate(run.config(), settings)
    changes = CHANGES[config.env]
    episodes = [
        Episode(change.before, SEED + i, change.schedule(step))
        for i, change in enumerate(changes * per_change)
    ]
    found = act(run, config, episodes)
    return [
        {
            "env": config.env,
            "method": config.method,
            "seed": config.seed,
            "step": step,
            "episode": i // len(changes),
            "before": json.dumps(changes[i % len(changes)].before),
            "after": json.dumps(changes[i % len(changes)].after),
            "over": changes[i % len(changes)].over,
            "return_after": float(trajectory.reward[step:].sum()),
            "reward_before": float(trajectory.reward[step - WINDOW : step].mean()),
            "recovery_steps": recovery_steps(config.env, trajectory.reward, step),
        }
        for i, trajectory in enumerate(found)
    ]


def act(run: RunDir, config: Config, episodes: Sequence[Episode]) -> list[Trajectory]:
    """Run episodes with a trained run, as many side by side as its batch holds."""
    found = []
    with closing(Environments.make(config)) as environments:
        agent, size = load_agent(run, config, environments), environments.vector.num_envs
        for start in range(0, len(episodes), size):
            batch = episodes[start : start + size]
            policy = AgentPolicy(agent, size, batch, key=jax.random.key(SEED + start))
            found += run_episodes(environments, batch, policy).trajectories
    return found


def main() -> None:
    """Measure what the tables lack."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("runs", type=Path, nargs="+", help="directories of trained runs")
    parser.add_argument("--folder", type=Path, required=True, help="for one CSV file per run")
    parser.add_argument("--arms", nargs="+", default=list(ARMS), choices=list(ARMS))
    parser.add_argument("--step", type=int, default=100, help="before which the physics changes")
    parser.add_argument("--episodes", type=int, default=1, help="per change")
    asked = parser.parse_args()
    for run in asked.runs:
        table = asked.folder / f"{name_of(run)}.csv"
        heads = RunDir(run).config().model.kind == "multi-headed"
        for arm in asked.arms if heads else asked.arms[:1]:
            settings = json.dumps(ARMS[arm])
            place = {"run": name_of(run), "arm": arm, "step": str(asked.step), "settings": settings}
            rows: list[Mapping[str, Any]] = [*read_csv(table, COLUMNS)]
            if any(all(old[name] == place[name] for name in place) for old in rows):
                continue
            found = measure(run, ARMS[arm], asked.step, asked.episodes)
            write_csv(table, COLUMNS, [*rows, *(place | row for row in found)])
            for row in found:
                print(
                    place["run"], arm, row["after"], row["return_after"], row["recovery_steps"],
                    flush=True,
                )  # fmt: skip


if __name__ == "__main__":
    main()
