"""Draw the scores of several arms per physics, and print them as a table.

python results/adaptation/plot.py results/adaptation/pendulum.csv results/adaptation/pendulum.png
"""

import json
import sys
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from matplotlib.lines import Line2D
from measure import COLUMNS

from headway.report import style
from headway.report.physics import axis_label, value_label, varying
from headway.storage.records import read_csv

SHIFT = 0.13  # between arms, in units of the distance between physics
Scores = dict[str, dict[tuple[str, str], list[float]]]


def read_scores(rows: list[dict[str, str]]) -> Scores:
    """Scores of every method and arm on each (group, physics), one per run."""
    scores: Scores = {}
    for row in rows:
        arm = scores.setdefault(f"{row['method']}, {row['arm']}", {})
        arm.setdefault((row["group"], row["sim_params"]), []).append(float(row["score"]))
    return scores


def places(scores: Scores) -> list[tuple[str, str]]:
    """Training physics, then unseen ones, each by their values."""
    found = {place for arm in scores.values() for place in arm}
    return sorted(found, key=lambda p: (p[0] != "train", sorted(json.loads(p[1]).items())))


def labels(found: list[tuple[str, str]]) -> tuple[list[str], str]:
    """How each physics and the axis are written."""
    physics: list[Mapping[str, float]] = [json.loads(place[1]) for place in found]
    names = varying(physics)
    return [value_label(one, names) for one in physics], axis_label(names)


def mean(arm: Mapping[tuple[str, str], list[float]], *, unseen: bool) -> np.ndarray:
    """Mean over training or unseen physics, one per run."""
    kept = [values for (group, _), values in arm.items() if (group != "train") == unseen]
    return np.mean(kept, axis=0)


def save_figure(scores: Scores, path: Path, source: str) -> None:
    """A column per physics, a mark per run."""
    order = places(scores)
    ticks, axis = labels(order)
    colors = dict(zip(scores, (style.FAINT, style.TRAINING, *style.UNSEEN), strict=False))
    caption = (
        f"A mark is the mean over the episodes of one run, a bar the mean over runs; from {source}."
        " Score: 0 is random, 1 the planner on the true dynamics. Nothing was chosen on unseen"
        " physics."
    )
    title = "Heads that keep learning while they act"
    with style.figure(path, title=title, caption=caption, size=(8.0, 4.0)) as figure:
        axes = figure.subplots()
        for n, (name, arm) in enumerate(scores.items()):
            for x, place in enumerate(order):
                at, values = x + (n - (len(scores) - 1) / 2) * SHIFT, arm.get(place, [])
                axes.plot([at] * len(values), values, "o", color=colors[name], ms=3.5, alpha=0.7)
                if values:
                    axes.plot(at, np.mean(values), "_", color=colors[name], ms=11, mew=2)
        num_training = sum(group == "train" for group, _ in order)
        axes.axvline(num_training - 0.5, color=style.THREAD, lw=0.8)
        axes.set_xticks(range(len(order)), ticks)
        style.label_axis(axes, f"{axis}: training, then unseen", "score")
        handles = [
            Line2D([], [], color=color, marker="o", linestyle="", label=name)
            for name, color in colors.items()
        ]
        style.legend(figure, handles)


def print_table(scores: Scores) -> None:
    """One line per arm: mean over runs of each physics, and the means of each run."""
    order = places(scores)
    print("arm", *labels(order)[0], "training", "unseen of each run", "unseen", sep=" | ")
    for name, arm in scores.items():
        cells = [f"{np.mean(arm[place]):.2f}" if place in arm else "" for place in order]
        unseen = mean(arm, unseen=True)
        runs = " ".join(f"{value:.2f}" for value in unseen)
        training = f"{mean(arm, unseen=False).mean():.2f}"
        print(name, *cells, training, runs, f"{unseen.mean():.2f}", sep=" | ")


if __name__ == "__main__":
    table, output = map(Path, sys.argv[1:])
    found = read_scores(read_csv(table, COLUMNS))
    print_table(found)
    save_figure(found, output, table.name)
