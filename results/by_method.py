"""Print scores by method as a Markdown table: one number per seed, best on unseen physics first.

    python results/by_method.py results/pendulum-quick
    python results/by_method.py results/pendulum-quick --same-episodes results/ceilings

Scores use the references that all of the project's scores use, which were measured on other
starts. With `--same-episodes` they use what `random` and `true-dynamics` earned in the very
episodes of the test.
"""

import argparse
from collections import defaultdict
from pathlib import Path

import numpy as np
from summarise import Means, last_rows, of_run

from headway.training.references import normalised
from headway.training.run import EpisodeRow, format_sim_params

Scores = dict[bool, list[float]]
"""One score per seed, over training (False) and over unseen physics (True)."""
Returns = dict[tuple[str, int, str], float]
"""Return of an episode, by its group, number and physics."""


def scores_of(runs: list[Means]) -> Scores:
    """Mean score of each run; every physics counts once."""
    return {
        unseen: [
            float(np.mean([s for (u, _), (_, s) in run.items() if u == unseen])) for run in runs
        ]
        for unseen in (False, True)
    }


def against(references: Path, run_dir: Path) -> Means:
    """Return and score of each physics; the references are of the same episodes."""
    rows = last_rows(run_dir)
    low, high = (
        returns_of(references / f"{rows[0].env}-{method}.csv")
        for method in ("random", "true-dynamics")
    )
    found = defaultdict(list)
    for row in rows:
        episode = place(row)
        found[row.group != "train", episode[2]].append(
            (row.episode_return, low[episode], high[episode])
        )
    means = {physics: np.mean(values, axis=0) for physics, values in found.items()}
    return {physics: (value[0], normalised(*value)) for physics, value in means.items()}


def returns_of(table: Path) -> Returns:
    """What a reference earned in each of its test episodes."""
    return {place(row): row.episode_return for row in last_rows(table.parent, table.name)}


def place(row: EpisodeRow) -> tuple[str, int, str]:
    """What two runs' episodes have in common if they are the same."""
    return row.group, row.episode, format_sim_params(row.sim_params)


def main() -> None:
    """Print the table of a folder with a folder for each method."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("folder", type=Path, help="holds METHOD/seed-N")
    parser.add_argument("--same-episodes", type=Path, help="folder of the references' tables")
    asked = parser.parse_args()
    methods = {path.parent.name for path in asked.folder.glob("*/seed-*")}
    scores = {}
    for name in methods:
        paths = sorted((asked.folder / name).glob("seed-*"))
        same = asked.same_episodes
        scores[name] = scores_of([against(same, path) if same else of_run(path) for path in paths])
    print("| method | seeds | training | mean | unseen | mean |")
    print("|---|---|---|---|---|---|")
    for name in sorted(scores, key=lambda name: -np.mean(scores[name][True])):
        cells = [f"`{name}`", str(len(scores[name][True]))]
        for unseen in (False, True):
            values = scores[name][unseen]
            cells += [" ".join(f"{value:.2f}" for value in values), f"{np.mean(values):.2f}"]
        print("|", " | ".join(cells), "|")


if __name__ == "__main__":
    main()
