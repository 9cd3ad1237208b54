"""Draw how well what comes is foreseen under every prior that is tried, on training episodes.

    python results/adaptation/foresight.py RUN ... --table NAME.csv --figure NAME.png

Prints for each run which prior is chosen by foresight, and how far the one that is chosen by
likelihood sees. Errors are relative to those of heads that learn nothing. Only training episodes
are looked at.
"""

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.ticker import FuncFormatter, LogLocator, NullLocator
from measure import name_of

from headway.config import PlannerConfig
from headway.planning.last_layer import foresight
from headway.planning.last_layer.prior import fit_prior, foreseen_errors
from headway.planning.last_layer.residuals import Onlooker
from headway.report import style
from headway.storage.records import read_csv, write_csv
from headway.training.loading import load_learned, load_task
from headway.training.run import RunDir

COLUMNS = ("run", "env", "method", "head", "power", "ratio", "relative_error", "likelihood_ratio")
COLORS = dict(zip(map(str, foresight.POWERS), (style.FAINT, *style.UNSEEN), strict=False))
Row = dict[str, Any]


def measure(run: RunDir) -> list[Row]:
    """The relative error of every head, power and ratio."""
    config, trajectories = run.config(), run.load_data()
    learned, task = load_learned(run, config), load_task(config)
    model, length = learned.fit.model, config.model.history_length
    onlooker = Onlooker(model, task, learned.statistics, length)
    directions, errors = foreseen_errors(
        onlooker, trajectories, config.planner.horizon, [None] * model.num_members
    )
    likely = fit_prior(
        model,
        task,
        learned.statistics,
        trajectories,
        history_length=length,
        planner=PlannerConfig(adaptation_criterion="likelihood"),
    )
    # In units of an average transition, as foresight's ratios are.
    scale = np.mean([one.values.sum() for one in directions])
    rows = []
    for rank, of_rank in errors.items():
        for (i, j), error in np.ndenumerate(of_rank):
            rows.append(
                {
                    "run": name_of(run.path),
                    "env": config.env,
                    "method": config.method,
                    "head": rank,
                    "power": foresight.POWERS[i],
                    "ratio": float(foresight.RATIOS[j]),
                    "relative_error": float(error),
                    "likelihood_ratio": float(np.exp(np.log(likely.ratio).mean()) * scale),
                }
            )
    return rows


def errors_of(rows: Sequence[Row], head: str) -> foresight.Errors:
    """The relative errors [power, ratio] of one head."""
    kept = [float(row["relative_error"]) for row in rows if row["head"] == head]
    return np.reshape(kept, (len(foresight.POWERS), -1))


def summary(rows: Sequence[Row]) -> str:
    """One line of a Markdown table."""
    heads = list(dict.fromkeys(row["head"] for row in rows))
    errors = [errors_of(rows, head) for head in heads]
    power, ratio = foresight.best(errors)
    place = foresight.POWERS.index(power), np.abs(np.log(foresight.RATIOS / ratio)).argmin()
    likely = float(rows[0]["likelihood_ratio"])
    nearest = np.abs(np.log(foresight.RATIOS / likely)).argmin()
    cells = [f"{power:g}", f"{ratio:.0e}", f"{likely:.0e}"]
    cells.append(", ".join(f"{of_head[place]:.2f}" for of_head in errors))
    cells.append(", ".join(f"{of_head[0, nearest]:.2f}" for of_head in errors))
    return f"| {rows[0]['env']} | `{rows[0]['method']}` | " + " | ".join(cells) + " |"


def draw(runs: Sequence[Sequence[Row]], path: Path) -> None:
    """A panel per run; solid lines for the owner, dashed ones for the runner-up."""
    caption = (
        "Mean squared error of one planning horizon ahead, after learning from the beginning of"
        " training episodes, over that of heads that learn nothing. Solid: the head that explains"
        " an episode best; dashed: the second best. Dot: what the likelihood chooses, or more."
    )
    title, size = "How well what comes is foreseen, by prior", (3.3 * len(runs), 3.6)
    with style.figure(path, title=title, caption=caption, size=size) as figure:
        for place, rows in enumerate(runs, 1):
            axes = figure.add_subplot(1, len(runs), place)
            for head, line in zip(("owner", "runner-up"), ("-", "--"), strict=True):
                for power, values in zip(COLORS, errors_of(rows, head), strict=True):
                    label = f"α = {float(power):g}" if line == "-" else None
                    axes.loglog(foresight.RATIOS, values, line, color=COLORS[power], label=label)
                if rows[-1]["head"] == "owner":
                    break
            likely = float(rows[0]["likelihood_ratio"])
            nearest = np.abs(np.log(foresight.RATIOS / likely)).argmin()
            axes.plot(foresight.RATIOS[nearest], errors_of(rows, "owner")[0, nearest], "o",
                      color=COLORS["0.0"])  # fmt: skip
            axes.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
            axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
            axes.yaxis.set_minor_locator(NullLocator())
            axes.axhline(1.0, color=style.THREAD, lw=1, zorder=0)
            axes.set_title(f"{rows[0]['method']}, {rows[0]['env']}")
            style.label_axis(axes, "ratio ρ", "relative error" if place == 1 else "")
        style.legend(figure)


def main() -> None:
    """Measure what the table lacks; print and draw all of it."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("runs", type=Path, nargs="+", help="directories of trained runs")
    parser.add_argument("--table", type=Path, required=True, help="CSV file to add rows to")
    parser.add_argument("--figure", type=Path, help="PNG of all these runs")
    asked = parser.parse_args()
    print("| environment | method | α | ρ | likelihood's ρ | errors | likelihood's errors |")
    print("|---|---|---|---|---|---|---|")
    found = []
    for run in asked.runs:
        rows: list[Row] = [*read_csv(asked.table, COLUMNS)]
        known = [row for row in rows if row["run"] == name_of(run)]
        if not known:
            known = measure(RunDir(run))
            write_csv(asked.table, COLUMNS, [*rows, *known])
        print(summary(known), flush=True)
        found.append(known)
    if asked.figure:
        draw(found, asked.figure)


if __name__ == "__main__":
    main()
