"""Compare what runs earn while they collect, iteration by iteration.

    python results/adaptation/collecting.py results/A/seed-* results/B/seed-* --figure NAME.png

Prints the mean return of each iteration's episodes as a Markdown table, a line per run, and draws
them, a color per method. The first iteration acts at random.
"""

import argparse
from pathlib import Path

import numpy as np
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator

from headway.report import style
from headway.training.run import RunDir

Curves = dict[str, dict[int, list[float]]]
"""Of each method and seed: the mean return of every iteration's episodes."""


def collected(runs: list[Path]) -> Curves:
    """Read what the runs earned."""
    curves: Curves = {}
    for run in map(RunDir, runs):
        config = run.config()
        returns = [float(row["collection"]["return_mean"]) for row in run.metrics()]
        curves.setdefault(config.method, {})[config.seed] = returns
    return curves


def print_table(curves: Curves) -> None:
    """One line per method and run."""
    longest = max(len(returns) for runs in curves.values() for returns in runs.values())
    print("| method | seed |", " | ".join(f"{n}" for n in range(1, longest + 1)), "|")
    print("|---|---" + "|---" * longest + "|")
    for method, runs in curves.items():
        for seed, returns in sorted(runs.items()):
            print(f"| `{method}` | {seed} |", " | ".join(f"{r:.0f}" for r in returns), "|")


def save_figure(curves: Curves, path: Path) -> None:
    """A thin line per run, a thick one for the mean over runs."""
    caption = (
        "Mean return of the episodes of each iteration, from which the model then learns. Thin: a"
        " run; thick: mean over runs. Training physics only; the first iteration acts at random."
    )
    size = (7.0, 4.2)
    title = "What is earned while collecting"
    with style.figure(path, title=title, caption=caption, size=size) as figure:
        axes = figure.subplots()
        for color, runs in zip(style.SERIES, curves.values(), strict=False):
            for returns in runs.values():
                axes.plot(range(1, len(returns) + 1), returns, color=color, lw=0.8, alpha=0.6)
            mean = np.mean([*runs.values()], axis=0)
            axes.plot(range(1, len(mean) + 1), mean, "o-", color=color, lw=2.2, ms=4)
        axes.xaxis.set_major_locator(MaxNLocator(integer=True))
        style.label_axis(axes, "iteration", "return")
        handles = [
            Line2D([], [], color=color, marker="o", label=method)
            for color, method in zip(style.SERIES, curves, strict=False)
        ]
        style.legend(figure, handles)


def main() -> None:
    """Print and draw."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument(
        "runs", type=Path, nargs="+", help="run directories, or what is kept of them"
    )
    parser.add_argument("--figure", type=Path, help="PNG file to write")
    asked = parser.parse_args()
    curves = collected(asked.runs)
    print_table(curves)
    if asked.figure:
        save_figure(curves, asked.figure)


if __name__ == "__main__":
    main()
