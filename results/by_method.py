"""Print scores by method as a Markdown table: one number per seed, best on unseen physics first.

python results/by_method.py results/pendulum-quick
"""

import sys
from pathlib import Path

import numpy as np
from summarise import of_run

Scores = dict[bool, list[float]]
"""One score per seed, over training (False) and over unseen physics (True)."""


def scores_of(method: Path) -> Scores:
    """Mean score of each seed; every physics counts once."""
    runs = [of_run(seed) for seed in sorted(method.glob("seed-*"))]
    return {
        unseen: [np.mean([s for (u, _), (_, s) in run.items() if u == unseen]) for run in runs]
        for unseen in (False, True)
    }


def main(folder: Path) -> None:
    """Print the table of a folder with a folder for each method."""
    methods = {path.parent.name for path in folder.glob("*/seed-*")}
    scores = {name: scores_of(folder / name) for name in methods}
    print("| method | seeds | training | mean | unseen | mean |")
    print("|---|---|---|---|---|---|")
    for name in sorted(scores, key=lambda name: -np.mean(scores[name][True])):
        cells = [f"`{name}`", str(len(scores[name][True]))]
        for unseen in (False, True):
            values = scores[name][unseen]
            cells += [" ".join(f"{value:.2f}" for value in values), f"{np.mean(values):.2f}"]
        print("|", " | ".join(cells), "|")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
