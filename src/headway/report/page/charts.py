"""What the figures of a comparison draw on their axes."""

import textwrap
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.collections import PatchCollection
from matplotlib.colors import to_rgba
from matplotlib.patches import Rectangle
from matplotlib.ticker import MaxNLocator

from headway.report import statistics
from headway.report.page.measures import Curve
from headway.report.page.runs import Row
from headway.report.page.series import Series
from headway.report.page.svg import DASHES, MARKERS, ORDERED, SWATCHES
from headway.report.physics import axis_label, distinct, value_label, varying
from headway.report.style import FAINT, INK, RULE, group_label, label_axis
from headway.training.run import parse_sim_params

Marks = Mapping[str, float]
TICK_LETTERS = 24  # in a line of a bar's name


def color_of(series: Series) -> str:
    """The series' colour, the same in every figure."""
    return SWATCHES[series.swatch][0]


def learning_curves(
    axes: Axes, curves: Sequence[tuple[Series, Curve]], levels: Marks | None = None
) -> None:
    """Draw return over environment steps.

    A line is the mean over seeds. The band is its 95 % interval; with fewer than three seeds
    each seed has a thin line instead. Unfinished runs are thin and dotted.

    Args:
        axes: Where to draw.
        curves: What to draw.
        levels: Returns to mark with a dotted line, by name.
    """
    for series, curve in curves:
        color = color_of(series)
        thin = {"color": color, "linewidth": 0.8, "alpha": 0.7, "gid": _gid(series)}
        if curve.low is not None and curve.high is not None:
            band = axes.fill_between(curve.steps, curve.low, curve.high, color=color, alpha=0.16)
            band.set(linewidth=0, gid=_gid(series))
        elif len(curve.runs) > 1:
            for returns in curve.runs:
                axes.plot(curve.steps, returns, **thin)
        for steps, returns in curve.unfinished:
            axes.plot(steps, returns, **thin, linestyle=":", marker=".", markersize=3)
        axes.plot(curve.steps, curve.runs.mean(0), **look(series), markersize=4)
    _mark_levels(axes, levels or {})
    axes.set_xlim(left=0)
    axes.xaxis.set_major_locator(MaxNLocator(4))
    axes.xaxis.set_major_formatter(lambda value, _: f"{value:,.0f}")
    _plain_numbers(axes)
    label_axis(axes, "environment steps collected", "return per episode")


def group_bars(
    axes: Axes, bars: Sequence[tuple[Series, Sequence[float]]], label: str, levels: Marks | None
) -> None:
    """Draw a bar per series for one group: mean over seeds, its interval, a dot per seed.

    Args:
        axes: Where to draw.
        bars: The seeds' values of each series.
        label: What is measured.
        levels: Values to mark with a dotted line, by name.
    """
    for place, (series, values) in enumerate(bars):
        color, gid = color_of(series), _gid(series)
        value = float(np.mean(values))
        axes.bar(place, value, 0.72, color=color, alpha=0.75, gid=gid)
        for patch in axes.patches[-1:]:
            patch.set_gid(gid)
        ends = statistics.interval([values], statistics.mean)
        if ends is not None:
            (line,) = axes.plot([place, place], ends, color=INK, linewidth=1.4)
            line.set_gid(gid)
        spread = np.linspace(-0.16, 0.16, len(values)) if len(values) > 1 else np.zeros(1)
        style = {"color": INK, "markersize": 2.6, "linestyle": "none", "alpha": 0.75}
        axes.plot(place + spread, values, MARKERS[0], **style, gid=gid)
    _mark_levels(axes, levels or {})
    axes.axhline(0, color=FAINT, linewidth=0.8)
    names = [_wrapped(series.label) for series, _ in bars]
    crowded = len(names) > 4 or max(map(len, names)) > 10
    axes.set_xticks(range(len(bars)), names)
    if crowded:
        axes.tick_params(axis="x", labelrotation=40, labelsize=7)
        for text in axes.get_xticklabels():
            text.set(ha="right", rotation_mode="anchor")
    axes.tick_params(axis="x", length=0)
    middle, half = (len(bars) - 1) / 2, max(len(bars), 3) / 2 + 0.1
    axes.set_xlim(middle - half, middle + half)
    _plain_numbers(axes)
    axes.set_ylabel(label)


def prediction_error(axes: Axes, lines: Sequence[tuple[Series, Sequence[Sequence[Row]]]]) -> None:
    """Draw the error of imagined observations over the steps imagined.

    Args:
        axes: Where to draw.
        lines: For every series and seed, rows of `prediction_error.csv` of one group.
    """
    highest = 0.0
    for series, seeds in lines:
        length = min(len(rows) for rows in seeds)
        errors = np.array([[row["error"] for row in rows[:length]] for rows in seeds])
        steps = [row["step"] for row in seeds[0][:length]]
        if len(seeds) > 1:
            span = axes.fill_between(steps, errors.min(0), errors.max(0), color=color_of(series))
            span.set(alpha=0.16, linewidth=0, gid=_gid(series))
        axes.plot(steps, errors.mean(0), **look(series), markersize=3, markevery=3)
        highest = max(highest, float(np.nanmax(errors, initial=0.0)))
    axes.axhline(1.0, color=FAINT, linewidth=1, linestyle=":", zorder=1)
    if highest > 10:
        axes.set_yscale("log")
    else:
        axes.set_ylim(0, max(1.1, 1.05 * highest))
    axes.xaxis.set_major_locator(MaxNLocator(5, integer=True))
    label_axis(axes, "imagined steps ahead", "error (standard deviations)")


def head_shares(axes: Axes, rows: Sequence[Row]) -> None:
    """Draw which head owns which physics: a row per member and head, a column per physics.

    Args:
        axes: Where to draw.
        rows: Rows of `assignments.csv` of one iteration.
    """
    by_text = {row["sim_params"]: parse_sim_params(row["sim_params"]) for row in rows}
    physics = distinct(by_text.values())
    column = {text: physics.index(sim_params) for text, sim_params in by_text.items()}
    owners = sorted({(int(row["member"]), int(row["head"])) for row in rows})
    heads = 1 + max(head for _, head in owners)
    shares = {(int(r["member"]), int(r["head"]), column[r["sim_params"]]): r["share"] for r in rows}
    cells, colors, places = [], [], []
    for member, head in owners:
        places.append(member * (heads + 0.5) + head)
        for x in range(len(physics)):
            cells.append(Rectangle((x - 0.47, places[-1] - 0.47), 0.94, 0.94))
            share = np.clip(np.nan_to_num(shares.get((member, head, x), 0.0)), 0, 1)
            colors.append(to_rgba(SWATCHES[0][0], float(share)))
    frames = {"edgecolor": RULE, "linewidth": 0.5}
    axes.add_collection(PatchCollection(cells, facecolor=colors, **frames))
    names = varying(physics)
    axes.set_xticks(range(len(physics)), [value_label(p, names) for p in physics])
    axes.set_yticks(places, [f"{member} · {head}" for member, head in owners], fontsize=6.5)
    axes.set_xlim(-0.55, len(physics) - 0.45)
    axes.set_ylim(max(places) + 0.6, -0.6)
    axes.tick_params(length=0)
    axes.grid(visible=False)
    axes.spines[:].set_visible(False)
    label_axis(axes, axis_label(names), "member · head")


def contexts(
    axes: Axes,
    points: Float[np.ndarray, "point 2"],
    physics: Sequence[Mapping[str, float]],
    explained: Float[np.ndarray, " 2"],
) -> None:
    """Draw context vectors on their first two principal components, coloured by physics.

    Args:
        axes: Where to draw.
        points: Where each context lies.
        physics: The simulator parameters of each point.
        explained: Share of the variance that each component has.
    """
    different = distinct(physics)
    names = varying(different)
    for index, sim_params in enumerate(different):
        chosen = points[[dict(p) == sim_params for p in physics]]
        color = physics_color(index, len(different))
        look: dict[str, Any] = {
            "color": color,
            "marker": MARKERS[index % len(MARKERS)],
            "linestyle": "none",
        }
        label = value_label(sim_params, names)
        axes.plot(*chosen.T, **look, markersize=3, alpha=0.7, markeredgewidth=0, label=label)
    axes.grid(visible=False)
    axes.margins(0.06)
    axes.set_xticks([])
    axes.set_yticks([])
    share = [f"{100 * part:.3g} %" for part in explained]
    label_axis(axes, f"1st component ({share[0]})", f"2nd component ({share[1]})")
    legend = axes.legend(
        title=axis_label(names), loc="upper left", bbox_to_anchor=(1.0, 1.0), borderaxespad=0.3,
        fontsize=7.5, title_fontsize=7.5, handletextpad=0.1,
        markerscale=1.6, labelspacing=0.3,
    )  # fmt: skip
    legend.get_title().set_color(INK)


def physics_color(index: int, count: int) -> str:
    """A colour for the value of this rank among all."""
    return ORDERED[round(index * (len(ORDERED) - 1) / max(count - 1, 1))][0]


def run_times(axes: Axes, bars: Sequence[tuple[Series, Mapping[str, float]]]) -> None:
    """Draw how long a run took, phase after phase.

    Args:
        axes: Where to draw.
        bars: Minutes by phase, for every series.
    """
    shades = {"collect": 1.0, "fit": 0.62, "evaluate": 0.32}
    for place, (series, minutes) in enumerate(bars):
        left = 0.0
        for phase, alpha in shades.items():
            width = minutes.get(phase, 0.0)
            (bar,) = axes.barh(place, width, 0.66, left, color=color_of(series), alpha=alpha)
            bar.set_gid(_gid(series))
            left += width
    axes.set_yticks(range(len(bars)), [series.label for series, _ in bars])
    axes.set_ylim(len(bars) - 0.4, -0.6)
    axes.tick_params(axis="y", length=0)
    axes.grid(visible=False, axis="y")
    axes.grid(visible=True, axis="x")
    axes.xaxis.set_major_locator(MaxNLocator(5))
    axes.set_xlabel("minutes")


def group_title(group: str) -> str:
    """Name a group for readers; `collected` are the training episodes."""
    return "training physics, while collecting" if group == "collected" else group_label(group)


def look(series: Series) -> dict[str, Any]:
    """Colour, marker and dashes of a series."""
    return {
        "color": color_of(series),
        "marker": MARKERS[series.index % len(MARKERS)],
        "linestyle": DASHES[series.round % len(DASHES)],
        "gid": _gid(series),
    }


def _wrapped(name: str) -> str:
    return textwrap.fill(name, TICK_LETTERS, break_long_words=False, break_on_hyphens=False)


def _gid(series: Series) -> str:
    return f"series-{series.index}"


def _mark_levels(axes: Axes, levels: Marks) -> None:
    for name, level in levels.items():
        axes.axhline(level, color=FAINT, linewidth=1, linestyle=":", zorder=1)
        place = axes.get_yaxis_transform()
        axes.text(0.995, level, name, ha="right", va="bottom", color=FAINT, fontsize=7,
                  transform=place)  # fmt: skip


def _plain_numbers(axes: Axes) -> None:
    axes.yaxis.set_major_locator(MaxNLocator(5))
    axes.yaxis.set_major_formatter(lambda value, _: f"{value:,.10g}".replace("-", "−"))
