"""How cost grows with what a user may enlarge: curves, exponents and a figure.

    python benchmarks/growth.py                 all curves
    python benchmarks/growth.py horizon members   these only; the others are kept

Each point is the median of a few calls after one that compiles. The exponent is the slope of
time over size on logarithmic axes, fitted to the upper half of the range; linear growth is 1.
"""

import argparse
import json
import statistics
import time
from pathlib import Path
from typing import Any

import jax
import numpy as np
from growth_axes import AXES, NUM_ENVS, PLANNER, Axis, Work
from machine import facts
from matplotlib.ticker import EngFormatter, FuncFormatter, LogLocator, NullLocator
from reporting import LATEST, markdown_table, write_result

from headway.lab.figures import FAINT, LABELS, figure, legend

POINT_LIMIT = 15.0  # seconds of one call, after which a curve stops
ENOUGH = 2.0  # seconds of calls that make a median
ROUNDS = 5
LINEAR = 1.1

Curve = dict[str, Any]


def measure(axis: Axis) -> Curve:
    """Time the work at every size, up to the first that takes too long."""
    points, stopped = [], None
    for size in axis.sizes:
        points.append((size, median_seconds(axis.work(size))))
        if points[-1][1] > POINT_LIMIT and size != axis.sizes[-1]:
            stopped = f"stopped after {size:,}: over {POINT_LIMIT:g} s"
            break
    return {"what": axis.what, "unit": axis.unit, "points": points, "stopped": stopped}


def median_seconds(work: Work) -> float:
    """The median of up to five calls, fewer when they are long."""
    jax.block_until_ready(work())
    times: list[float] = []
    while len(times) < ROUNDS and (sum(times) < ENOUGH or len(times) < 3):
        start = time.perf_counter()
        jax.block_until_ready(work())
        times.append(time.perf_counter() - start)
    return statistics.median(times)


def exponent(points: list[tuple[int, float]]) -> float:
    """The slope of log time over log size, for sizes above the geometric middle."""
    middle = (points[0][0] * points[-1][0]) ** 0.5
    sizes, seconds = np.log([point for point in points if point[0] >= middle]).T
    return float(np.polyfit(sizes, seconds, 1)[0])


def table(curves: dict[str, Curve]) -> str:
    """One line per curve."""
    rows = []
    for name, curve in curves.items():
        (low, fast), (high, slow) = curve["points"][0], curve["points"][-1]
        slope = exponent(curve["points"])
        growth = "linear or better" if slope <= LINEAR else "worse than linear"
        if curve["stopped"]:
            growth += f", {curve['stopped']}"
        rows.append(
            [
                name,
                curve["what"],
                f"{low:,} to {high:,} {curve['unit']}",
                f"{1e3 * fast:.3g} to {1e3 * slow:.4g} ms",
                f"{slope:.2f}",
                growth,
            ]
        )
    return markdown_table(["curve", "time of one", "range", "median", "exponent", "growth"], rows)


def draw(curves: dict[str, Curve], path: Path, machine: str) -> None:
    """Small multiples on logarithmic axes, each with a line of linear growth."""
    columns, rows = 4, -(-len(curves) // 4)
    caption = (
        f"Exponents are over the upper half of the range; 1 is linear. Small networks, {NUM_ENVS} "
        f"environments, {PLANNER.num_candidates} candidates, horizon {PLANNER.horizon} unless "
        f"varied. {machine}."
    )
    title, size = "How cost grows", (10.0, 2.3 * rows)
    with figure(path, title=title, caption=caption, size=size) as drawing:
        for i, curve in enumerate(curves.values()):
            axes = drawing.add_subplot(rows, columns, i + 1)
            sizes, seconds = np.array(curve["points"]).T
            linear = seconds[-1] * sizes / sizes[-1]
            axes.loglog(sizes, seconds, "o-", color=LABELS[0], ms=4)
            axes.loglog(sizes, linear, "--", color=FAINT, lw=1)
            axes.set_title(f"{curve['what']}, exponent {exponent(curve['points']):.2f}")
            axes.set_xlabel(curve["unit"])
            axes.set_ylabel("seconds" if i % columns == 0 else "")
            for axis, ends in ((axes.xaxis, sizes), (axes.yaxis, seconds)):
                wide = max(ends) > 50 * min(ends)
                axis.set_major_locator(LogLocator(subs=(1,) if wide else (1, 2, 5)))
                axis.set_minor_locator(NullLocator())
            axes.xaxis.set_major_formatter(EngFormatter(sep=""))
            axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        looks = {"median of one call": {"color": LABELS[0], "marker": "o"}}
        looks["linear growth"] = {"color": FAINT, "linestyle": "--"}
        legend(drawing, looks)


def main() -> None:
    """Measure the wanted curves, keep the others, and write everything."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("axes", nargs="*", metavar="curve", help=f"any of {', '.join(AXES)}")
    wanted = parser.parse_args().axes or list(AXES)
    if unknown := set(wanted) - set(AXES):
        parser.error(f"unknown {', '.join(sorted(unknown))}, allowed: {', '.join(AXES)}")
    path = LATEST / "growth.json"
    curves = json.loads(path.read_text())["curves"] if path.exists() else {}
    for name in wanted:
        print(f"{name} ...", flush=True)
        curves[name] = measure(AXES[name])
        text = write({name: curves[name] for name in AXES if name in curves})
    print(f"\n{text}\nwritten to {path.parent.name}/growth.*")


def write(curves: dict[str, Curve]) -> str:
    """Write JSON, Markdown and figure; returns the Markdown."""
    about = facts()
    machine = about["device"]
    if about["device"].endswith("(cpu)"):
        machine = f"{about['cores']} cores of {about['processor']}"
    draw(curves, LATEST / "growth.png", machine)
    return write_result("growth", about, {"curves": curves}, table(curves))


if __name__ == "__main__":
    main()
