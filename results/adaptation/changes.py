"""Physics that change while acting: the return after the change, and how long recovery takes.

    python results/adaptation/changes.py runs/pendulum-0 --table results/adaptation/changes.csv

One episode per change, all side by side. What the table holds already is skipped.

Recovered is the first step after the change from which the mean reward of 20 steps reaches 90 % of
the way from a random controller's to that of the 20 steps before the change (Pendulum), or 90 % of
the latter (others); where it never happens, the steps that were left.
"""

import argparse
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jaxtyping import Float

from headway.experiment.loading import load_agent
from headway.experiment.methods import config_to_evaluate
from headway.experiment.rollouts import AgentPolicy, Arena, Episode, run_episodes
from headway.storage.records import read_csv, write_csv
from headway.storage.run_dir import RunDir

COLUMNS = (
    "run", "env", "seed", "arm", "settings", "step", "before", "after",
    "return_after", "reward_before", "recovery_steps",
)  # fmt: skip
LAST_LAYER = {"planner.adaptation": "last-layer"}
ARMS: dict[str, dict[str, Any]] = {
    "none": {},
    "last-layer": LAST_LAYER,
    "last-layer, change detection": LAST_LAYER | {"planner.change_threshold": 20.0},
    "last-layer, forgetting 0.01": LAST_LAYER | {"planner.forgetting": 0.01},
    "evidence": {"planner.head_selection": "evidence"},
    "last-layer, evidence": LAST_LAYER | {"planner.head_selection": "evidence"},
}
"""Settings that the run is tested with, by name."""
CHANGES: dict[str, tuple[tuple[dict[str, float], dict[str, float]], ...]] = {
    "pendulum": (
        ({"length": 1.25, "mass": 1.0}, {"length": 0.5}),
        ({"length": 0.5, "mass": 1.0}, {"length": 1.25}),
        ({"length": 1.0, "mass": 1.0}, {"length": 0.25}),
        ({"length": 1.0, "mass": 1.0}, {"length": 1.75}),
        ({"length": 1.0, "mass": 1.0}, {"mass": 2.0}),
    ),
    "half-cheetah": (
        ({"mass_scale": 0.5, "damping_scale": 1.0}, {"mass_scale": 1.5}),
        ({"mass_scale": 1.5, "damping_scale": 1.0}, {"mass_scale": 0.5}),
        ({"mass_scale": 1.5, "damping_scale": 1.0}, {"mass_scale": 3.0}),
        ({"mass_scale": 1.5, "damping_scale": 1.0}, {"damping_scale": 2.0}),
    ),
}
"""Physics before and what changes, from training physics to training or unseen ones."""
RANDOM_REWARD = {"pendulum": -6.0}
"""Mean reward of random actions, to measure recovery where rewards are costs."""
WINDOW = 20
SEED = 777_000


def recovery_steps(env: str, reward: Float[np.ndarray, " time"], step: int) -> int:
    """Steps after the change until rewards are as before; all that are left if never."""
    means = np.convolve(reward, np.full(WINDOW, 1.0 / WINDOW), mode="valid")
    before, low = means[step - WINDOW], RANDOM_REWARD.get(env, 0.0)
    recovered = means[step:] >= low + 0.9 * (before - low)
    return int(np.argmax(recovered)) if recovered.any() else len(reward) - step


def measure(run_dir: Path, settings: Mapping[str, Any], step: int) -> list[dict[str, Any]]:
    """Run all changes of an environment once; one row per change."""
    run = RunDir(run_dir)
    config = config_to_evaluate(run.config(), settings)
    arena = Arena.make(config)
    episodes = [
        Episode(before, SEED + i, {step: after})
        for i, (before, after) in enumerate(CHANGES[config.env])
    ]
    policy = AgentPolicy(load_agent(run, config), arena.vector.num_envs, key=jax.random.key(SEED))
    found = run_episodes(arena, episodes, policy).trajectories
    return [
        {
            "env": config.env,
            "seed": config.seed,
            "step": step,
            "before": json.dumps(episode.sim_params),
            "after": json.dumps(episode.schedule[step]),
            "return_after": float(trajectory.reward[step:].sum()),
            "reward_before": float(trajectory.reward[step - WINDOW : step].mean()),
            "recovery_steps": recovery_steps(config.env, trajectory.reward, step),
        }
        for episode, trajectory in zip(episodes, found, strict=True)
    ]


def main() -> None:
    """Measure what the table lacks."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("runs", type=Path, nargs="+", help="directories of trained runs")
    parser.add_argument("--table", type=Path, required=True, help="CSV file to add rows to")
    parser.add_argument("--arms", nargs="+", default=list(ARMS), choices=list(ARMS))
    parser.add_argument("--step", type=int, default=100, help="before which the physics changes")
    parser.add_argument("--precision", default="float32", help="of the planner's products")
    asked = parser.parse_args()
    for run in asked.runs:
        for arm in asked.arms:
            settings = {**ARMS[arm], "planner.precision": asked.precision}
            place = {"run": run.name, "arm": arm, "settings": json.dumps(settings)}
            rows: list[Mapping[str, Any]] = [*read_csv(asked.table, COLUMNS)]
            if any(all(old[name] == place[name] for name in place) for old in rows):
                continue
            found = [place | row for row in measure(run, settings, asked.step)]
            write_csv(asked.table, COLUMNS, [*rows, *found])
            for row in found:
                print(arm, row["after"], row["return_after"], row["recovery_steps"], flush=True)


if __name__ == "__main__":
    main()
