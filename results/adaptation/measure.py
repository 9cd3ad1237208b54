"""Scores of trained runs with and without heads that keep learning, per physics.

    python results/adaptation/measure.py runs/pendulum-0 --table results/adaptation/pendulum.csv

Every arm meets the same test episodes. Rows are written as soon as an arm is tested, and what the
table holds already is skipped, so the same command goes on where it was interrupted.
"""

import argparse
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import headway
from headway.experiment.progress import make_progress
from headway.report.tables import by_physics
from headway.storage.records import read_csv, write_csv
from headway.storage.run_dir import RunDir

COLUMNS = (
    "run", "env", "method", "seed", "arm", "group", "sim_params", "settings", "episodes",
    "score", "return_mean", "return_std", "seconds_per_step",
)  # fmt: skip
LAST_LAYER = {"planner.adaptation": "last-layer"}
ARMS: dict[str, dict[str, Any]] = {
    "none": {},
    "last-layer": LAST_LAYER,
    "last-layer, noise of the heads": LAST_LAYER | {"planner.adaptation_noise": "heads"},
    "last-layer, prior of the runner-up": LAST_LAYER | {"planner.adaptation_prior": "runner-up"},
    "last-layer, corrected selection": LAST_LAYER | {"planner.selection_error": "corrected"},
    "evidence": {"planner.head_selection": "evidence"},
    "last-layer, evidence": LAST_LAYER | {"planner.head_selection": "evidence"},
    "last-layer, evidence-sampled": LAST_LAYER | {"planner.head_selection": "evidence-sampled"},
    "last-layer, variance": LAST_LAYER | {"planner.adaptation_variance": True},
    "last-layer, variance, risk 1": LAST_LAYER
    | {"planner.adaptation_variance": True, "planner.risk_aversion": 1.0},
    "last-layer, risk 1": LAST_LAYER | {"planner.risk_aversion": 1.0},
    "risk 1": {"planner.risk_aversion": 1.0},
    "last-layer, forgetting 0.001": LAST_LAYER | {"planner.forgetting": 0.001},
    "last-layer, change detection": LAST_LAYER | {"planner.change_threshold": 20.0},
}
"""Settings that the run is tested with, by name."""


def measure(
    run_dir: Path, settings: Mapping[str, Any], groups: list[str] | None
) -> list[dict[str, Any]]:
    """Test the run on some groups; one row per physics."""
    progress = make_progress(quiet=True)
    found = headway.evaluate(run_dir, groups=groups, settings=settings, progress=progress)
    shared = {
        "env": found.config.env,
        "method": found.config.method,
        "seed": found.config.seed,
        "seconds_per_step": found.cost.seconds_per_step,
    }
    rows = []
    for part in by_physics(found):
        score = "" if part["score"] is None else part["score"]
        kept = {name: part[name] for name in ("group", "episodes", "return_mean", "return_std")}
        sim_params = json.dumps(part["sim_params"])
        rows.append({**shared, **kept, "score": score, "sim_params": sim_params})
    return rows


def main() -> None:
    """Measure what the table lacks."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("runs", type=Path, nargs="+", help="directories of trained runs")
    parser.add_argument("--table", type=Path, required=True, help="CSV file to add rows to")
    parser.add_argument("--arms", nargs="+", default=["none", "last-layer"], choices=list(ARMS))
    parser.add_argument("--groups", nargs="+", help="all by default")
    parser.add_argument("--episodes", type=int, help="per group; the run's own number by default")
    parser.add_argument("--precision", default="float32", help="of the planner's products")
    asked = parser.parse_args()
    for run in asked.runs:
        episodes = asked.episodes or RunDir(run).config().evaluation.num_episodes
        shared = {"planner.precision": asked.precision, "evaluation.num_episodes": episodes}
        for arm in asked.arms:
            add(asked.table, arm, run, {**ARMS[arm], **shared}, asked.groups)


def add(
    table: Path, arm: str, run: Path, settings: Mapping[str, Any], groups: list[str] | None
) -> None:
    """Measure one arm and write its rows, unless the table has them."""
    rows: list[Mapping[str, Any]] = [*read_csv(table, COLUMNS)]
    place = {"run": run.name, "arm": arm, "settings": json.dumps(settings)}
    for old in rows:
        if (old["run"], old["arm"]) == (run.name, arm):
            if old["settings"] != place["settings"]:
                raise SystemExit(f"{place} was measured with {old['settings']}; use a new table.")
            return
    found = [place | row for row in measure(run, settings, groups)]
    write_csv(table, COLUMNS, [*rows, *found])
    for row in found:
        print(run.name, arm, row["sim_params"], row["score"], flush=True)


if __name__ == "__main__":
    main()
