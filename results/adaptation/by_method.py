"""Draw, for every method, the scores of frozen heads and of heads that keep learning.

    python results/adaptation/by_method.py results/adaptation/NAME results/adaptation/NAME.png
    python results/adaptation/by_method.py results/adaptation/NAME --by-physics

The folder holds one table of `measure.py` per run. Methods with two arms are compared. The figure
has the arms that all of them were tested with; all are printed as a Markdown table. With
`--by-physics` a table of mean returns is printed instead, with a column for each physics.
"""

import argparse
import json
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from measure import COLUMNS

from headway.report import physics, style
from headway.storage.records import read_csv

Row = dict[str, str]
Scores = dict[str, dict[str, list[float]]]
"""Of each method and arm: one score per run."""
FROZEN = "none"
COLORS = (style.FAINT, style.TRAINING, *style.UNSEEN)


def scores_of(tables: list[list[Row]], *, unseen: bool) -> Scores:
    """The mean score over training or unseen physics, each counting once."""
    scores: Scores = {}
    for rows in tables:
        for arm in dict.fromkeys(row["arm"] for row in rows):
            kept = [r for r in rows if r["arm"] == arm and (r["group"] != "train") == unseen]
            mean = float(np.mean([float(row["score"]) for row in kept]))
            scores.setdefault(rows[0]["method"], {}).setdefault(arm, []).append(mean)
    return scores


def order(scores: Scores) -> list[str]:
    """Methods that were tested with several arms, the best mean of any arm first."""
    several = [method for method, arms in scores.items() if len(arms) > 1]
    return sorted(several, key=lambda name: -max(np.mean(v) for v in scores[name].values()))


def colors_of(scores: Scores) -> dict[str, str]:
    """A color for every arm that all methods with several arms were tested with."""
    several = [arms for arms in scores.values() if len(arms) > 1] or list(scores.values())
    shared = [arm for arm in several[0] if all(arm in arms for arms in several)]
    return dict(zip(shared, COLORS, strict=False))


def draw(axes: Axes, scores: Scores, methods: list[str], colors: dict[str, str]) -> None:
    """A row per method, with an arm above the other; a dot per run, a bar at each arm's mean."""
    for row, method in enumerate(methods):
        arms = {arm: scores[method][arm] for arm in colors if arm in scores[method]}
        places = row + 0.2 * (np.arange(len(arms)) - (len(arms) - 1) / 2)
        means = [np.mean(values) for values in arms.values()]
        axes.plot(means, places, color=style.THREAD, lw=3, zorder=1)
        for (arm, values), y in zip(arms.items(), places, strict=True):
            axes.plot(values, [y] * len(values), "o", color=colors[arm], ms=4, alpha=0.6)
            axes.plot(np.mean(values), y, "|", color=colors[arm], ms=11, mew=2.5)
    axes.set_yticks(range(len(methods)), methods)
    axes.set_ylim(len(methods) - 0.5, -0.5)
    axes.grid(visible=True, axis="x")
    axes.grid(visible=False, axis="y")


def save_figure(training: Scores, unseen: Scores, path: Path, source: str) -> None:
    """Training physics on the left, unseen ones on the right."""
    methods, colors = order(unseen), colors_of(unseen)
    caption = (
        f"A dot is one run (mean over physics), a bar the mean over runs; from {source}. Score: 0"
        " is random, 1 the planner on the true dynamics. Same trained models, same test"
        " episodes for all arms; no number was chosen on unseen physics."
    )
    title = "Heads that keep learning while they act, by method"
    size = (8.0, 1.9 + 0.42 * len(methods))
    with style.figure(path, title=title, caption=caption, size=size) as figure:
        left, right = figure.subplots(1, 2, sharex=True, sharey=True)
        for axes, scores, name in ((left, training, "training"), (right, unseen, "unseen")):
            draw(axes, scores, methods, colors)
            style.label_axis(axes, f"score on {name} physics", "")
        style.legend(figure, handles_of(colors))


def handles_of(colors: dict[str, str]) -> list[Line2D]:
    """What explains the colors."""
    return [
        Line2D([], [], color=color, marker="o", linestyle="", label=label(arm))
        for arm, color in colors.items()
    ]


def label(arm: str) -> str:
    """How an arm is called for readers."""
    name = arm.replace("likelihood", "last layer, prior by likelihood").replace("-layer", " layer")
    return "frozen heads" if arm == FROZEN else name


def print_table(training: Scores, unseen: Scores) -> None:
    """One line per method and arm."""
    print("| method | | training, each run | mean | unseen, each run | mean |")
    print("|---|---|---|---|---|---|")
    for method in order(unseen):
        for arm in unseen[method]:
            cells = []
            for scores in (training, unseen):
                values = scores[method][arm]
                cells += [" ".join(f"{v:.2f}" for v in values), f"{np.mean(values):.2f}"]
            print(f"| `{method}` |", label(arm), "|", " | ".join(cells), "|")


def print_by_physics(tables: list[list[Row]], methods: list[str]) -> None:
    """One line per method and arm, with the mean return over runs under each physics."""
    rows = [row for table in tables for row in table]
    unseen = {row["sim_params"]: row["group"] != "train" for row in rows}
    names = physics.varying([json.loads(text) for text in unseen])
    returns: dict[tuple[str, str, str], list[float]] = {}
    for row in rows:
        place = row["method"], row["arm"], row["sim_params"]
        returns.setdefault(place, []).append(float(row["return_mean"]))
    heads = [
        "unseen " * new + physics.value_label(json.loads(text), names)
        for text, new in unseen.items()
    ]
    print("| method | |", " | ".join(heads), "|")
    print("|---|---" + "|---" * len(heads) + "|")
    for method, arm in dict.fromkeys((name, arm) for name, arm, _ in returns if name in methods):
        cells = [f"{np.mean(returns[method, arm, text]):.0f}" for text in unseen]
        print(f"| `{method}` |", label(arm), "|", " | ".join(cells), "|")


def main() -> None:
    """Print a table; draw the figure."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("folder", type=Path, help="tables of measure.py, one per run")
    parser.add_argument("figure", type=Path, nargs="?", help="PNG file to write")
    parser.add_argument("--by-physics", action="store_true", help="returns under each physics")
    asked = parser.parse_args()
    tables = [read_csv(table, COLUMNS) for table in sorted(asked.folder.glob("*.csv"))]
    seen, new = scores_of(tables, unseen=False), scores_of(tables, unseen=True)
    if asked.by_physics:
        print_by_physics(tables, order(new))
    else:
        print_table(seen, new)
    if asked.figure:
        save_figure(seen, new, asked.figure, asked.folder.name)


if __name__ == "__main__":
    main()
