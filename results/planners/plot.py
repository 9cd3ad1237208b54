"""Draw the scores of planners against their FLOP per step, and print them as a table.

python results/planners/plot.py results/planners/pendulum.csv results/planners/pendulum.png
"""

import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter
from measure import COLUMNS

from headway.report import style
from headway.storage.records import read_csv

FAMILIES = {"cem": "o", "icem": "^", "mppi": "s", "random-shooting": "D"}
COLORS = dict(zip(FAMILIES, (style.TRAINING, *style.UNSEEN), strict=False))


class Point(NamedTuple):
    """One planner on one kind of physics: means over runs."""

    planner: str
    family: str
    """Its optimizer."""
    flop: float
    seconds: float
    values: tuple[float, ...]
    """Score of each run, or its return where no score is known."""

    @property
    def value(self) -> float:
        """The mean over runs."""
        return float(np.mean(self.values))


def read_points(path: Path) -> tuple[dict[str, list[Point]], str]:
    """The planners on each kind of physics, and what their values are."""
    rows = read_csv(path, COLUMNS)
    column = "score" if all(row["score"] for row in rows) else "return_mean"
    points: dict[str, list[Point]] = {row["physics"]: [] for row in rows}
    for physics, found in points.items():
        here = [row for row in rows if row["physics"] == physics]
        for planner in dict.fromkeys(row["planner"] for row in here):
            same = [row for row in here if row["planner"] == planner]
            flop, seconds = (
                float(np.mean([float(row[name] or "nan") for row in same]))
                for name in ("flop_per_step", "seconds_per_step")
            )
            family = json.loads(same[0]["settings"]).get("planner.optimizer", "cem")
            values = tuple(float(row[column]) for row in same)
            found.append(Point(planner, family, flop, seconds, values))
    return points, column.partition("_")[0]


def pareto(points: Sequence[Point]) -> list[Point]:
    """The planners that no cheaper one equals, by rising cost."""
    best: list[Point] = []
    for point in sorted(points, key=lambda point: (point.flop, -point.value)):
        if not best or point.value > best[-1].value:
            best.append(point)
    return best


def is_extended(planner: str) -> bool:
    """Whether it is CEM with an option that the paper's does not have."""
    return "warm" in planner or "settle" in planner


def numbered(points: dict[str, list[Point]]) -> dict[str, int]:
    """A number for every planner, by rising cost."""
    everything = [point for found in points.values() for point in found]
    by_cost = sorted(everything, key=lambda point: (point.flop, point.planner))
    names = dict.fromkeys(point.planner for point in by_cost)
    return {name: number for number, name in enumerate(names, start=1)}


def draw(axes: Axes, points: Sequence[Point], numbers: dict[str, int]) -> None:
    """One panel: every planner with its number, its range over runs, and the Pareto line."""
    for point in points:
        family = point.family
        gflop = point.flop / 1e9
        fill = "none" if is_extended(point.planner) else "full"
        look = {"color": COLORS[family], "fillstyle": fill, "markersize": 5}
        axes.plot(gflop, point.value, FAMILIES[family], **look)
        if len(point.values) > 1:
            axes.vlines(gflop, min(point.values), max(point.values), color=COLORS[family], lw=0.8)
    front = pareto(points)
    x, y = [point.flop / 1e9 for point in front], [point.value for point in front]
    axes.step(x, y, where="post", color=style.FAINT, lw=1.0, zorder=1)
    for point in points:
        axes.annotate(
            str(numbers[point.planner]),
            (point.flop / 1e9, point.value),
            (4, 3),
            textcoords="offset points",
            fontsize=7.5,
            fontweight="bold" if point in front else "normal",
        )
    axes.set_xscale("log")
    axes.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.xaxis.set_minor_formatter(NullFormatter())
    axes.margins(x=0.2, y=0.12)


def save_figure(points: dict[str, list[Point]], value: str, path: Path, source: str) -> None:
    """Draw a panel for each kind of physics."""
    num_runs = max(len(point.values) for found in points.values() for point in found)
    several = "; thin lines: lowest and highest run" * (num_runs > 1)
    caption = (
        f"Means over {num_runs} run{'s' * (num_runs > 1)} of {source}{several}. Line and bold"
        " numbers: planners that no cheaper one equals. FLOP: matrix products of the imagined"
        " rollouts that were really evaluated."
    )
    title = f"{value.capitalize()} against planning cost"
    numbers = numbered(points)
    with style.figure(path, title=title, caption=caption, size=(11.0, 4.6)) as figure:
        widths = [4.0] * len(points) + [2.2]
        *panels, key = figure.subplots(1, len(widths), width_ratios=widths)
        key.axis("off")
        lines = [f"{number}  {planner}" for planner, number in numbers.items()]
        key.text(0, 1, "\n".join(lines), va="top", fontsize=8, linespacing=1.5)
        for axes, (physics, found) in zip(panels, points.items(), strict=True):
            draw(axes, found, numbers)
            axes.set_title(f"{physics} physics")
            style.label_axis(axes, "GFLOP per step", value)
        everything = [point for found in points.values() for point in found]
        shown, there = [p.planner for p in everything], {p.family for p in everything}
        looks = [(name, FAMILIES[name], COLORS[name], "full") for name in FAMILIES if name in there]
        if any(map(is_extended, shown)):
            looks.insert(1, ("cem, warm or settling", FAMILIES["cem"], COLORS["cem"], "none"))
        handles = [
            Line2D([], [], color=color, marker=marker, fillstyle=fill, linestyle="", label=name)
            for name, marker, color, fill in looks
        ]
        style.legend(figure, handles)


def print_table(points: dict[str, list[Point]], value: str) -> None:
    """One line per planner."""
    print("planner", *(f"{p}: GFLOP, ms, {value}" for p in points), sep=" | ")
    for planner in dict.fromkeys(p.planner for found in points.values() for p in found):
        same = [p for found in points.values() for p in found if p.planner == planner]
        print(planner, *map(cell, same), sep=" | ")


def cell(point: Point) -> str:
    """Cost and values of one planner."""
    values = " ".join(f"{value:.2f}" for value in point.values)
    return f"{point.flop / 1e9:.3g}, {1e3 * point.seconds:.3g}, {values}"


if __name__ == "__main__":
    table, output = map(Path, sys.argv[1:])
    found, kind = read_points(table)
    print_table(found, kind)
    save_figure(found, kind, output, table.stem)
