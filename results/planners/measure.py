"""Return per FLOP: test one trained run with many planners.

    python results/planners/measure.py runs/pendulum --table results/planners/pendulum.csv
    python results/planners/measure.py runs/pendulum --learning --table results/planners/NAME.csv

Every planner meets the same test episodes. A row is written as soon as it is measured, and what
the table holds already is skipped, so the same command goes on where it was interrupted. With
`--learning` heads keep learning while they act, and changes of the physics are watched for.
`--precision bfloat16` plans faster where the processor multiplies in bfloat16.
"""

import argparse
import dataclasses
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax
import numpy as np

import headway
from headway.config import Config, PlannerConfig
from headway.report.tables import by_physics
from headway.storage.records import read_csv, write_csv
from headway.storage.run_dir import RunDir
from headway.task import sim_param_sets
from headway.training.methods import config_to_evaluate
from headway.training.progress import make_progress

COLUMNS = (
    "run", "env", "planner", "physics", "settings", "episodes", "score", "return_mean",
    "evaluations_per_step", "flop_per_step", "seconds_per_step", "device",
)  # fmt: skip
LEARNING = {"planner.adaptation": "last-layer", "planner.change_threshold": 20.0}
COLORS_OF_NOISE = (0.25, 0.5, 1.0, 2.0)
Settings = dict[str, Any]


def planners(own: PlannerConfig, num_members: int) -> dict[str, Settings]:
    """The planners to compare, named; all start from the settings of the run.

    Args:
        own: What the run was trained with.
        num_members: Networks in the ensemble, each of which imagines at least one particle.
    """
    paper = size_of(PlannerConfig())
    fast = {"num_candidates": 100, "num_elites": 20, "num_iterations": 3}
    fast = paper | fast | {"num_particles": num_members}
    some = (own.num_iterations + 1) // 2
    fewer_iterations = {"num_iterations": some}
    warm = {"warm_variance": True}
    return {
        "cem": {},
        "paper": paper,
        "fast": fast,  # the preset's with CEM; some environments want "fast, icem, beta 0.25"
        "fast, 4 iterations": fast | {"num_iterations": 4},
        "fast, 133 candidates": fast | {"num_candidates": 133, "num_elites": 27},
        "fast, shared noise": fast | {"particle_noise": "shared"},
        "fast, warm": fast | {"warm_variance": True},
        "fast, warm, shared noise": fast | {"particle_noise": "shared", "warm_variance": True},
        **by_color(fast),
        "cem, 1/2 of the candidates": fewer(own, 2),
        "cem, 1/4 of the candidates": fewer(own, 4),
        f"cem, {some} iterations": fewer_iterations,
        "cem, a particle per member": {"num_particles": num_members},
        "cem, warm": warm,
        f"cem, warm, {some} iterations": warm | fewer_iterations,
        "cem, warm, 1/4 of the candidates": warm | fewer(own, 4),
        "cem, settle 0.05": {"settle_tolerance": 0.05},
        "cem, settle 0.08": {"settle_tolerance": 0.08},
        "cem, warm, settle 0.05": warm | {"settle_tolerance": 0.05},
        "icem": icem(own, 1),
        "icem, 1/2 of the candidates": icem(own, 2),
        "icem, 1/4 of the candidates": icem(own, 4),
        "mppi": mppi(own, 1),
        "mppi, 1/2 of the candidates": mppi(own, 2),
        "mppi, 1/4 of the candidates": mppi(own, 4),
        "random-shooting": {"optimizer": "random-shooting"},
    }


def by_color(fast: Settings) -> dict[str, Settings]:
    """The planners iCEM and MPPI with noise of several colours, from nearly white to red."""
    found = {}
    for beta in COLORS_OF_NOISE:
        colored = {"optimizer": "icem", "num_elites": 10, "noise_beta": beta}
        found[f"fast, icem, beta {beta}"] = fast | colored
        colored = {"optimizer": "mppi", "noise_beta": beta}
        found[f"fast, mppi, beta {beta}"] = without_elites(fast) | colored
    return found


def size_of(planner: PlannerConfig) -> Settings:
    """What decides how much a plan computes."""
    names = ("horizon", "num_candidates", "num_elites", "num_iterations", "num_particles")
    return {name: getattr(planner, name) for name in names}


def without_elites(settings: Settings) -> Settings:
    """The settings of a planner that ranks no elites."""
    return {name: value for name, value in settings.items() if name != "num_elites"}


def fewer(own: PlannerConfig, share: int) -> Settings:
    """A share of the candidates, and of the elites."""
    return {
        "num_candidates": max(own.num_candidates // share, 1),
        "num_elites": max(own.num_elites // share, 1),
    }


def icem(own: PlannerConfig, share: int) -> Settings:
    """A share of the candidates, a tenth of them elites."""
    num_candidates = max(own.num_candidates // share, 4)
    num_elites = max(num_candidates // 10, 2)
    return {"optimizer": "icem", "num_candidates": num_candidates, "num_elites": num_elites}


def mppi(own: PlannerConfig, share: int) -> Settings:
    """A share of the candidates."""
    return {"optimizer": "mppi", "num_candidates": max(own.num_candidates // share, 1)}


def distinct(config: Config) -> dict[str, Settings]:
    """The planners by name, as `planner.*` settings; one that equals an earlier one is left out."""
    found: dict[str, Settings] = {}
    seen = []
    for name, settings in planners(config.planner, config.model.num_members).items():
        dotted = {f"planner.{setting}": value for setting, value in settings.items()}
        planner = config_to_evaluate(config, dotted).planner
        if planner not in seen:
            seen.append(planner)
            found[name] = dotted
    return found


def measure(run_dir: Path, settings: Settings, groups: list[str]) -> Settings:
    """Test the run on some groups; the score and return are means over their physics."""
    found = headway.evaluate(
        run_dir, groups=groups, settings=settings, progress=make_progress(quiet=True)
    )
    parts = by_physics(found, found.config)
    scores = [part["score"] for part in parts]
    return {
        "env": found.config.env,
        "episodes": len(found),
        "score": "" if None in scores else float(np.mean(scores)),
        "return_mean": float(np.mean([part["return_mean"] for part in parts])),
        **dataclasses.asdict(found.cost),
        "device": jax.devices()[0].device_kind,
    }


def name_of(run: Path) -> str:
    """The directory's name; of a seed in a sweep, with the method and settings it belongs to."""
    return f"{run.parent.name}-{run.name}" if run.name.startswith("seed") else run.name


def physics_groups(config: Config) -> dict[str, list[str]]:
    """Training physics, and all unseen ones together."""
    train, *unseen = sim_param_sets(config).group_names
    return {"training": [train], "unseen": unseen}


def already_there(rows: list[Mapping[str, Any]], row: Settings) -> bool:
    """Whether a table holds a measurement; one of the same name must have the same settings."""
    for old in rows:
        if all(old[name] == row[name] for name in ("run", "planner", "physics")):
            if old["settings"] != row["settings"]:
                raise SystemExit(
                    f"{row['planner']!r} of {row['run']} was measured with {old['settings']}, now"
                    f" it has {row['settings']}; write to another table."
                )
            return True
    return False


def main() -> None:
    """Measure what the table lacks."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("run", type=Path, help="directory of a trained run")
    parser.add_argument("--table", type=Path, required=True, help="CSV file to add rows to")
    parser.add_argument("--episodes", type=int, help="per group; the run's own number by default")
    parser.add_argument("--learning", action="store_true", help="heads learn while they act")
    parser.add_argument("--precision", help="of every planner's products; the run's by default")
    parser.add_argument("--only", nargs="+", metavar="NAME", help="planners; all by default")
    parser.add_argument("--training", action="store_true", help="on training physics only")
    asked = parser.parse_args()
    config = RunDir(asked.run).config()
    episodes = asked.episodes or config.evaluation.num_episodes
    for planner, chosen in distinct(config).items():
        if asked.only and planner not in asked.only:
            continue
        settings = {**chosen, "evaluation.num_episodes": episodes}
        if asked.precision:
            settings["planner.precision"] = asked.precision
        if asked.learning:
            settings |= LEARNING
        for physics, groups in physics_groups(config).items():
            if asked.training and physics != "training":
                continue
            rows: list[Mapping[str, Any]] = [*read_csv(asked.table, COLUMNS)]
            name = planner + ", heads learn" * asked.learning
            row = {"run": name_of(asked.run), "planner": name, "physics": physics}
            row["settings"] = json.dumps(settings)
            if not already_there(rows, row):
                row |= measure(asked.run, settings, groups)
                write_csv(asked.table, COLUMNS, [*read_csv(asked.table, COLUMNS), row])
                print(f"{name}, {physics}: return {row['return_mean']:.1f}", flush=True)


if __name__ == "__main__":
    main()
