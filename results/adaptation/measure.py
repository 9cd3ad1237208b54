"""Scores of trained runs with and without heads that keep learning, per physics.

    python results/adaptation/measure.py runs/pendulum-0 --table results/adaptation/pendulum.csv
    python results/adaptation/measure.py runs/reproduce/runs/pendulum/*/seed* --folder results/NAME

Every arm meets the same test episodes. Rows are written as soon as an arm is tested, and what the
table holds already is skipped, so the same command goes on where it was interrupted. A run tested
as it was in training has its results already: they are read, not made again.
"""

import argparse
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import headway
from headway.config import Config, override
from headway.report.tables import by_physics
from headway.storage.records import read_csv, write_csv
from headway.training.progress import make_progress
from headway.training.run import EVALUATION_COLUMNS, EpisodeRow, RunDir

COLUMNS = (
    "run", "env", "method", "seed", "arm", "group", "sim_params", "settings", "episodes",
    "score", "return_mean", "return_std", "seconds_per_step",
)  # fmt: skip
LAST_LAYER = {"planner.adaptation": "last-layer"}
LIKELIHOOD = LAST_LAYER | {"planner.adaptation_criterion": "likelihood"}
OPTIONS: dict[str, dict[str, Any]] = {
    "noise of the heads": {"planner.adaptation_noise": "heads"},
    "prior of the runner-up": {"planner.adaptation_prior": "runner-up"},
    "corrected selection": {"planner.selection_error": "corrected"},
    "evidence": {"planner.head_selection": "evidence"},
    "evidence-sampled": {"planner.head_selection": "evidence-sampled"},
    "variance": {"planner.adaptation_variance": True},
    "variance, risk 1": {"planner.adaptation_variance": True, "planner.risk_aversion": 1.0},
    "risk 1": {"planner.risk_aversion": 1.0},
    "forgetting 0.05": {"planner.forgetting": 0.05},
    "forgetting 0.001": {"planner.forgetting": 0.001},
    "change detection": {"planner.change_threshold": 20.0},
}
FROZEN = ("evidence", "risk 1")
"""Options that heads which do not learn have too."""
ARMS: dict[str, dict[str, Any]] = {
    "none": {},
    **{name: OPTIONS[name] for name in FROZEN},
    "last-layer": LAST_LAYER,
    **{f"last-layer, {name}": LAST_LAYER | option for name, option in OPTIONS.items()},
    "likelihood": LIKELIHOOD,
    **{f"likelihood, {name}": LIKELIHOOD | option for name, option in OPTIONS.items()},
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
    return [shared | part for part in rows_of(found, found.config)]


def tested_in_training(run_dir: Path) -> list[dict[str, Any]]:
    """What the run itself found after its last iteration; one row per physics."""
    table = [
        EpisodeRow.from_csv(r) for r in read_csv(run_dir / "evaluation.csv", EVALUATION_COLUMNS)
    ]
    table_end = [row for row in table if row.iteration == max(r.iteration for r in table)]
    config = RunDir(run_dir).config()
    shared = {"env": config.env, "method": config.method, "seed": config.seed}
    shared["seconds_per_step"] = ""
    return [shared | part for part in rows_of(table_end, config)]


def rows_of(episodes: Sequence[EpisodeRow], config: Config) -> list[dict[str, Any]]:
    """One row per physics."""
    rows = []
    for part in by_physics(episodes, config):
        score = "" if part["score"] is None else part["score"]
        kept = {name: part[name] for name in ("group", "episodes", "return_mean", "return_std")}
        rows.append({**kept, "score": score, "sim_params": json.dumps(part["sim_params"])})
    return rows


def main() -> None:
    """Measure what the table lacks."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("runs", type=Path, nargs="+", help="directories of trained runs")
    place = parser.add_mutually_exclusive_group(required=True)
    place.add_argument("--table", type=Path, help="CSV file to add rows to")
    place.add_argument("--folder", type=Path, help="for one CSV file per run")
    parser.add_argument("--arms", nargs="+", default=["none", "last-layer"], choices=list(ARMS))
    parser.add_argument("--groups", nargs="+", help="all by default")
    parser.add_argument("--episodes", type=int, help="per group; the run's own number by default")
    parser.add_argument("--precision", default="float32", help="of the planner's products")
    asked = parser.parse_args()
    for run in asked.runs:
        episodes = asked.episodes or RunDir(run).config().evaluation.num_episodes
        shared = {"planner.precision": asked.precision, "evaluation.num_episodes": episodes}
        table = asked.table or asked.folder / f"{name_of(run)}.csv"
        for arm in asked.arms:
            add(table, arm, run, {**ARMS[arm], **shared}, asked.groups)


def name_of(run: Path) -> str:
    """The directory's name; of a seed in a sweep, with the method and settings it belongs to."""
    return f"{run.parent.name}-{run.name}" if run.name.startswith("seed") else run.name


def add(
    table: Path, arm: str, run: Path, settings: Mapping[str, Any], groups: list[str] | None
) -> None:
    """Measure one arm and write its rows, unless the table has them."""
    rows: list[Mapping[str, Any]] = [*read_csv(table, COLUMNS)]
    place = {"run": name_of(run), "arm": arm, "settings": json.dumps(settings)}
    for old in rows:
        if (old["run"], old["arm"]) == (place["run"], arm):
            if old["settings"] != place["settings"]:
                raise SystemExit(f"{place} was measured with {old['settings']}; use a new table.")
            return
    own = RunDir(run).config()
    tested = RunDir(run).evaluation()
    if tested and groups is None and override(own, settings) == own:
        parts = tested_in_training(run)
    else:
        parts = measure(run, settings, groups)
    found = [place | part for part in parts]
    write_csv(table, COLUMNS, [*rows, *found])
    for row in found:
        print(place["run"], arm, row["sim_params"], row["score"], flush=True)


if __name__ == "__main__":
    main()
