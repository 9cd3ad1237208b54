"""Ways to select heads, compared on the very same test episodes.

    python results/adaptation/selection.py runs/pendulum-0 --table results/adaptation/selection.csv

The episodes are those that a run was tested with, or are run once where it kept none. In each of
them every rule selects heads as if it had acted; nothing is planned for it. Rows are written as
soon as a run is examined, and what the table holds already is skipped.
"""

import argparse
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from measure import ARMS, name_of

from headway.data import Trajectory
from headway.report.diagnosis import examined
from headway.storage.records import read_csv, write_csv
from headway.training.evaluate import run_tests
from headway.training.methods import config_to_evaluate
from headway.training.run import RunDir

COLUMNS = (
    "run", "env", "method", "seed", "rule", "group", "chosen_error", "best_error",
    "average_error", "wrong", "settling_steps", "settled",
)  # fmt: skip
RULES: dict[str, dict[str, Any]] = {
    "last 10": {},
    "last 1": {"planner.selection_length": 1},
    "evidence": {"planner.head_selection": "evidence"},
    "random": {"planner.head_selection": "random"},
}
for arm, heads in (("last-layer", "last layer"), ("likelihood", "likelihood")):
    detecting = ARMS[f"{arm}, change detection"]
    RULES |= {
        f"{heads}; frozen heads, last 10": detecting,
        f"{heads}; corrected heads, last 10": detecting | {"planner.selection_error": "corrected"},
        f"{heads}; evidence": detecting | {"planner.head_selection": "evidence"},
    }
"""Settings of the planner, by name."""


def measure(
    run: RunDir, rules: Sequence[str], episodes: Mapping[str, list[Trajectory]]
) -> list[dict[str, Any]]:
    """Apply some rules to some episodes; one row per rule and group."""
    rows = []
    for rule in rules:
        config = config_to_evaluate(run.config(), RULES[rule], ("planner",))
        diagnosis = examined(run, config, episodes)
        for group in diagnosis.episodes:
            summary = diagnosis.summary(group)
            rows.append(
                {
                    "run": name_of(run.path),
                    "env": config.env,
                    "method": config.method,
                    "seed": config.seed,
                    "rule": rule,
                    "group": group,
                    "chosen_error": summary.chosen_error,
                    "best_error": summary.best_error,
                    "average_error": summary.average_error,
                    "wrong": summary.wrong,
                    "settling_steps": "" if summary.settling is None else summary.settling,
                    "settled": summary.settled,
                }
            )
    return rows


def main() -> None:
    """Measure what the table lacks, and print it."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("runs", type=Path, nargs="+", help="directories of trained runs")
    parser.add_argument("--table", type=Path, required=True, help="CSV file to add rows to")
    parser.add_argument("--rules", nargs="+", default=list(RULES), choices=list(RULES))
    parser.add_argument("--episodes", type=int, help="per group, to run tests with")
    asked = parser.parse_args()
    for run in map(RunDir, asked.runs):
        rows: list[Mapping[str, Any]] = [*read_csv(asked.table, COLUMNS)]
        done = {row["rule"] for row in rows if row["run"] == name_of(run.path)}
        rules = [rule for rule in asked.rules if rule not in done]
        if not rules:
            continue
        episodes = run.tests() if asked.episodes is None else {}
        episodes = episodes or run_tests(run.path, num_episodes=asked.episodes).trajectories
        found = measure(run, rules, episodes)
        write_csv(asked.table, COLUMNS, [*rows, *found])
        for row in found:
            print(*(row[name] for name in ("run", "rule", "group", "chosen_error")), flush=True)


if __name__ == "__main__":
    main()
