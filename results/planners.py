"""Return against arithmetic: one trained run, planned with every planner, in the same episodes.

    python results/planners.py RUN OUT.csv [--groups train low] [--episodes 4] [--steps 200]
    python results/figures.py planners results/planners/six.csv results/planners/six.png

Rows are added to OUT.csv; planners that it holds for the run are left out.
"""

import argparse
import csv
from contextlib import closing
from pathlib import Path
from typing import Any

import jax
import numpy as np

from headway.config import override
from headway.models.compilation import prepare_jax
from headway.training.collect import agent_policy, random_policy, run_episodes
from headway.training.environments import Environments
from headway.training.evaluate import PlanningCost, group_episodes
from headway.training.run import RunDir, format_sim_params
from headway.training.trainers import load_agent

RANDOM = "random actions"
SPREAD = {"initial_std": 0.3, "noise_beta": 0.25}


def search(name: str, candidates: int, iterations: int, horizon: int, particles: int, **own: Any):
    """Settings of a search; its steps are means unless `particle_noise` says otherwise."""
    noise = own.pop("particle_noise", "none")
    return {
        "optimizer.name": name,
        **{f"optimizer.{setting}": value for setting, value in own.items()},
        "num_candidates": candidates,
        "num_iterations": iterations,
        "horizon": horizon,
        "num_particles": particles,
        "particle_noise": noise,
    }


NOISY = {"initial_std": 0.5, "particle_noise": "independent"}
PLANNERS: dict[str, dict[str, Any]] = {
    RANDOM: {},
    "paper": search("cem", 200, 5, 30, 20, num_elites=50, narrow_at_bounds=True, **NOISY),
    "CEM": search("cem", 100, 3, 30, 5, num_elites=20, **NOISY),
    "iCEM": search("icem", 100, 3, 30, 5, num_elites=10, noise_beta=0.25, **NOISY),
    "iCEM, means": search("icem", 100, 3, 20, 5, num_elites=10, **SPREAD),
    "iCEM, means, 40 × 2": search("icem", 40, 2, 15, 5, num_elites=5, **SPREAD),
    "iCEM, means, one member": search("icem", 100, 3, 20, 1, num_elites=10, **SPREAD),
    "iLQR, means": search("ilqr", 8, 3, 20, 5),
    "random shooting, means, one member": search("random-shooting", 300, 1, 15, 1),
}


def episodes_of(run: RunDir, name: str, asked: argparse.Namespace) -> list[dict[str, Any]]:
    """A row for every test episode under a planner."""
    groups, number, planner = asked.groups, asked.episodes, PLANNERS[name]
    config = override(
        run.config(),
        {
            "collection.num_episodes": number * len(groups),
            "evaluation.num_episodes": number,
            "collection.episode_length": asked.steps,
            "planner.precision": "bfloat16",
            **{f"planner.{setting}": value for setting, value in planner.items()},
        },
    )
    with closing(Environments.make(config)) as environments:
        agent = load_agent(run, config, environments)
        tests = [
            (group, episode)
            for group in groups
            for episode in group_episodes(environments.sim_params, group, number, asked.seed)
        ]
        episodes = [episode for _, episode in tests]
        if name == RANDOM:
            policy = random_policy(environments, np.random.default_rng(asked.seed))
        else:
            policy = agent_policy(agent, len(episodes), episodes, key=jax.random.key(asked.seed))
        rollout = run_episodes(environments, episodes, policy)
    used, planner = PlanningCost.of(rollout.use, config, environments.task), config.planner
    cost = {
        "network_evaluations_per_step": round(
            used.evaluations_per_step * planner.num_particles * planner.horizon
        ),
        "gflop_per_step": used.flop_per_step / 1e9,
        "seconds_per_step": used.seconds_per_step,
    }
    return [
        {
            "planner": name,
            "env": config.env,
            "seed": config.seed,
            "group": tests[place][0],
            "sim_params": format_sim_params(found.sim_params),
            "steps": asked.steps,
            "return": found.returns,
            **cost,
        }
        for place, found in rollout.episodes.items()
    ]


def main() -> None:
    """Test a run with every planner that the table lacks."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("run", type=Path)
    parser.add_argument("table", type=Path)
    parser.add_argument("--groups", nargs="+", default=["train", "low"])
    parser.add_argument("--episodes", type=int, default=4, help="in each group")
    parser.add_argument("--steps", type=int, default=200)
    parser.add_argument("--seed", type=int, default=20_000)
    parser.add_argument("--planners", nargs="+", choices=PLANNERS, default=list(PLANNERS))
    asked = parser.parse_args()
    prepare_jax()
    run = RunDir(asked.run)
    env, seed = run.config().env, str(run.config().seed)
    kept = list(csv.DictReader(asked.table.open())) if asked.table.exists() else []
    done = {row["planner"] for row in kept if (row["env"], row["seed"]) == (env, seed)}
    for name in asked.planners:
        if name in done:
            continue
        rows = episodes_of(run, name, asked)
        with asked.table.open("a", newline="") as file:
            writer = csv.DictWriter(file, list(rows[0]))
            if not kept:
                writer.writeheader()
            writer.writerows(rows)
        kept += rows
        means = {g: np.mean([r["return"] for r in rows if r["group"] == g]) for g in asked.groups}
        told = ", ".join(f"{group} {mean:.1f}" for group, mean in means.items())
        cost = rows[0]["network_evaluations_per_step"], 1e3 * rows[0]["seconds_per_step"]
        print(f"{env} {name}: {cost[0]} evaluations, {cost[1]:.1f} ms per step: {told}", flush=True)


if __name__ == "__main__":
    main()
