"""Draw, for every method, the return after physics changed in the middle of an episode.

    python results/adaptation/by_change.py results/adaptation/changes results/adaptation/changes.png

The folder holds one table of `changes.py` per run. The same numbers are printed as a Markdown
table: the mean return from the change on, and the median of the steps until recovery.
"""

import json
import sys
from pathlib import Path

import numpy as np
from by_method import Row, Scores, colors_of, draw, handles_of, label
from changes import COLUMNS

from headway.report import style
from headway.storage.records import read_csv


def name_of(row: Row) -> str:
    """What changes, for readers."""
    before, after = json.loads(row["before"]), json.loads(row["after"])
    changes = [f"{name} {before[name]:g} → {value:g}" for name, value in after.items()]
    return ", ".join(changes) + (f" in {row['over']} steps" if row["over"] != "1" else "")


def returns_of(tables: list[list[Row]], *, drift: bool) -> Scores:
    """The mean return of each run and arm after all jumps, or all drifts."""
    found: Scores = {}
    for rows in tables:
        for arm in dict.fromkeys(row["arm"] for row in rows):
            kept = [r for r in rows if r["arm"] == arm and (r["over"] != "1") == drift]
            mean = float(np.mean([float(row["return_after"]) for row in kept]))
            found.setdefault(rows[0]["method"], {}).setdefault(arm, []).append(mean)
    return found


def ordered(returns: Scores) -> list[str]:
    """The methods, the best mean of any arm first."""
    return sorted(returns, key=lambda name: -max(np.mean(v) for v in returns[name].values()))


def save_figure(jumps: Scores, drifts: Scores, path: Path) -> None:
    """Jumps on the left, drifts on the right."""
    methods, colors = ordered(jumps), colors_of(jumps)
    caption = (
        "A dot is one run (mean over changes and episodes), a bar the mean over runs. Return from"
        " the change to the end of the episode. Same trained models, same episodes for all arms."
    )
    title = "Physics that change while acting"
    size = (8.0, 1.9 + 0.5 * len(methods))
    with style.figure(path, title=title, caption=caption, size=size) as figure:
        left, right = figure.subplots(1, 2, sharey=True)
        for axes, returns, name in ((left, jumps, "a jump"), (right, drifts, "a drift")):
            draw(axes, returns, methods, colors)
            style.label_axis(axes, f"return after {name}", "")
        style.legend(figure, handles_of(colors))


def print_table(tables: list[list[Row]]) -> None:
    """One line per method and arm, one column per change."""
    rows = [row for table in tables for row in table]
    changes = list(dict.fromkeys(map(name_of, rows)))
    print("| method | |", " | ".join(changes), "|")
    print("|---|---|" + "---|" * len(changes))
    for method in dict.fromkeys(row["method"] for row in rows):
        for arm in dict.fromkeys(row["arm"] for row in rows if row["method"] == method):
            cells = []
            for change in changes:
                same = [
                    row
                    for row in rows
                    if (row["method"], row["arm"], name_of(row)) == (method, arm, change)
                ]
                mean = np.mean([float(row["return_after"]) for row in same])
                steps = np.median([float(row["recovery_steps"]) for row in same])
                cells.append(f"{mean:.0f} ({steps:.0f})")
            print(f"| `{method}` |", label(arm), "|", " | ".join(cells), "|")


if __name__ == "__main__":
    folder, output = map(Path, sys.argv[1:])
    found = [read_csv(table, COLUMNS) for table in sorted(folder.glob("*.csv"))]
    print_table(found)
    save_figure(returns_of(found, drift=False), returns_of(found, drift=True), output)
