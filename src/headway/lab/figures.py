"""Every figure: one restrained style, safe for colour-blind readers (hues of Okabe and Ito).

Functions that draw on `axes` serve files (`figure`) and the report's page (`panel`) alike. Looks
are keyword arguments of `Axes.plot` by label. Figures are made without pyplot; the user's own
Matplotlib settings are put back as soon as one is done.
"""

import contextlib
import io
import re
import textwrap
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
import pandas as pd
from markupsafe import escape
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator

from headway.lab import episode, statistics, tables
from headway.lab.tables import COLLECTED, TRAIN, group_label
from headway.training.files import write_bytes
from headway.training.methods import METHODS
from headway.training.run import parse_sim_params
from headway.worlds.rendering import HEADS

STYLE = matplotlib.rc_params_from_file(
    Path(__file__).with_name("headway.mplstyle"), use_default_template=False
)
INK, FAINT, RULE = STYLE["text.color"], STYLE["xtick.color"], STYLE["grid.color"]
GROUND = "#f4f4f4"
LABELS = STYLE["axes.prop_cycle"].by_key()["color"]
MARKERS, DASHES = "osD^vPX*", ("-", "--", ":")
THEME = {
    **{"ink": INK, "faint": FAINT, "rule": RULE, "axis": STYLE["axes.edgecolor"]},
    **{"ground": GROUND, "paper": "#ffffff"},
    **{f"s{i}": color for i, color in enumerate(LABELS)},
    **{f"h{i}": color for i, color in enumerate(HEADS)},
}
"""Variables of the page's style sheet, which gives them other colours in the dark."""

Looks = Mapping[str, Mapping[str, Any]]


@contextlib.contextmanager
def figure(
    path: Path,
    *,
    title: str,
    caption: str,
    size: tuple[float, float],
    looks: Looks | None = None,
    svg: bool = False,
) -> Iterator[Figure]:
    """Make a figure, hand it out to be drawn on, and write it.

    Args:
        path: The PNG file; its directory is created.
        title: One line that says what is seen.
        caption: What the marks are and where the numbers come from; wrapped to the width.
        size: Width and height of what is drawn in inches; title, legend and caption come on top.
        looks: Explained above the axes, in as many columns as the width has room for.
        svg: Whether to write an SVG file beside the PNG as well.
    """
    with matplotlib.rc_context(STYLE):
        drawing = Figure(figsize=size, layout="constrained")
        yield drawing
        # Around the axes, in inches from the figure's box: the file is cut to what it holds.
        above = 0.14
        if looks:
            keys = [
                Line2D([], [], label=label, **{"markersize": 4, **look})
                for label, look in looks.items()
            ]
            columns = int(size[0] / (0.62 + 0.068 * max(map(len, looks))))
            place = {"loc": "lower left", "bbox_to_anchor": (0.005, 1.0)}
            legend = drawing.legend(handles=keys, ncols=min(max(columns, 1), len(keys)), **place)
            legend.set_in_layout(False)
            drawing.draw_without_rendering()
            above += legend.get_window_extent().height / drawing.dpi
        heading = {"va": "bottom", "fontsize": 11, "fontweight": "bold"}
        drawing.text(0.01, 1 + above / size[1], title, **heading)
        lines = textwrap.fill(caption, int(size[0] / 0.058))
        small = {"va": "top", "fontsize": 7.5, "color": FAINT, "linespacing": 1.35}
        drawing.text(0.01, -0.1 / size[1], lines, **small)
        for kind in ("png", *["svg"] * svg):
            image = io.BytesIO()
            cut: dict[str, Any] = {"bbox_inches": "tight", "pad_inches": 0.16}
            drawing.savefig(image, format=kind, metadata=dict.fromkeys(["Date"]), **cut)
            write_bytes(path.with_suffix(f".{kind}"), image.getvalue())


def panel(
    draw: Callable[[Axes], None],
    *,
    name: str,
    label: str,
    size: tuple[float, float] = (3.7, 2.65),
) -> str:
    """Draw a figure of one axes as an SVG element in the colours of the page's theme.

    Text stays text. An artist whose `gid` is `series-N` gets that class, so that it can be hidden.

    Args:
        draw: Draws on the axes it is given.
        name: Unique on the page, so that identifiers inside are too.
        label: What is seen, for those who cannot see it.
        size: Width and height in inches: small enough to be read on a phone.
    """
    inline: dict[Any, Any] = {
        "svg.fonttype": "none",
        "savefig.facecolor": "none",
        "svg.hashsalt": name,
    }
    with matplotlib.rc_context({**STYLE, **inline}):
        drawing = Figure(figsize=size, layout="constrained")
        draw(drawing.subplots())
        written = io.StringIO()
        drawing.savefig(written, format="svg")
    svg = re.sub(r"<(metadata|style).*?</\1>", "", written.getvalue(), flags=re.DOTALL)
    variables = {color: f"var(--{variable})" for variable, color in THEME.items()}
    svg = re.sub(r"(?<=: )#[0-9a-f]{6}\b", lambda hit: variables.get(hit[0], hit[0]), svg)
    svg = re.sub(r'<g id="series-(\d+)(?:-\d+)?">', r'<g class="series-\1">', svg)
    svg = re.sub(r'<g id="[^"]*">', "<g>", svg)
    svg = re.sub(r'(?<= d=")[^"]*', lambda path: re.sub(r"(\.\d\d)\d+", r"\1", path[0]), svg)
    svg = svg[svg.index("<svg") + 4 :]
    return f'<svg role="img" aria-label="{escape(label)}"' + re.sub(r"\s*\n\s*", "\n", svg)


def look(index: int) -> dict[str, Any]:
    """Colour, marker and dashes of the label at a place of the legend."""
    return {
        "color": LABELS[index % len(LABELS)],
        "marker": MARKERS[index % len(MARKERS)],
        "linestyle": DASHES[index // len(LABELS) % len(DASHES)],
    }


def arm_looks(arms: Sequence[Any]) -> dict[str, dict[str, Any]]:
    """Looks of an experiment's arms; where arms are methods, a method has one look everywhere."""
    main = ("tmcl", "mcl", "pets", "mh-pets", "pets-cadm", "grbal", "rebal", "ria")
    order = list(dict.fromkeys((*main, *METHODS)))
    methods = len({arm.method for arm in arms}) == len(arms)
    return {
        arm.label: look(order.index(arm.method) if methods else i) for i, arm in enumerate(arms)
    }


def group_looks(groups: Sequence[str]) -> dict[str, dict[str, Any]]:
    """Looks of groups of physics by their labels: blue for training, others for unseen ones."""
    unseen = [group for group in groups if group not in (TRAIN, COLLECTED)]
    looks = {group: look(1 + i) for i, group in enumerate(unseen)}
    looks[TRAIN] = {**look(0), "linestyle": "--", "markerfacecolor": "white"}
    looks[COLLECTED] = look(0)
    return {group_label(group): looks[group] for group in groups}


def numbers(axes: Axes, *, x: str = "", y: str = "") -> None:
    """Name the axes, with few ticks and grouped thousands on those that have numbers."""
    for axis, name in ((axes.xaxis, x), (axes.yaxis, y)):
        if name:
            axis.set_major_locator(MaxNLocator(5))
            axis.set_major_formatter(lambda value, _: f"{value:,.10g}".replace("-", "−"))
            axis.set_label_text(name)


def _band(axes: Axes, x: Any, low: Any, high: Any, style: Mapping[str, Any]) -> None:
    shared = {"color": style["color"], "gid": style.get("gid")}
    axes.fill_between(x, low, high, alpha=0.14, linewidth=0, **shared)


def curves(axes: Axes, table: pd.DataFrame, looks: Looks) -> None:
    """Draw return over environment steps.

    Lines are means over the finished runs, or over all where none is finished. The band is the
    95 % interval of the mean; with fewer than three runs each has a thin line. Unfinished ones
    are thin and dotted. What learns nothing is a level.

    Args:
        axes: Where to draw.
        table: label, run, iteration, timesteps, return, finished.
        looks: Looks by label.
    """
    for label, own in table.groupby("label", sort=False):
        style = {"markersize": 4, **looks[str(label)]}
        thin = {**style, "linewidth": 0.8, "alpha": 0.7, "marker": "", "linestyle": "-"}
        done = own[own.finished] if own.finished.any() else own
        returns = done.pivot(index="run", columns="iteration", values="return").dropna(axis=1)
        if returns.empty:
            continue
        steps = done.groupby("iteration").timesteps.mean()[returns.columns].to_numpy()
        middle = returns.mean().to_numpy()
        if not steps.any():
            level = {name: style[name] for name in ("color", "linestyle")}
            axes.axhline(middle[0], linewidth=1.2, gid=style.get("gid"), **level)
            continue
        columns = returns.to_numpy().T[:, :, None]
        if len(returns) >= statistics.MIN_RUNS:
            ends = [statistics.estimate([c], statistics.mean).interval for c in columns]
            low, high = np.array(ends).T
            _band(axes, steps, low, high, style)
        elif len(returns) > 1:
            axes.plot(steps, columns[:, :, 0], **thin)
        if own.finished.any():
            for _, run in own[~own.finished].groupby("run"):
                axes.plot(run.timesteps, run["return"], **{**thin, "linestyle": ":"})
        axes.plot(steps, middle, **style)
    axes.set_xlim(left=0)
    numbers(axes, x="environment steps collected", y="return per episode")


def dots(axes: Axes, table: pd.DataFrame, looks: Looks, name: str) -> None:
    """Draw a line per label: a dot per run, a bar at their mean, its 95 % interval.

    Args:
        axes: Where to draw.
        table: label, value.
        looks: Looks by label, from top to bottom.
        name: What the values are.
    """
    place = axes.get_yaxis_transform()
    for row, (label, style) in enumerate(looks.items()):
        values = table.loc[table.label == label, "value"].to_numpy()
        shared = {"color": style["color"], "gid": style.get("gid")}
        if not len(values):
            axes.text(0.5, row, "no run", va="center", color=FAINT, transform=place)
            continue
        ends = statistics.estimate([values[:, None]], statistics.mean).interval
        if ends:
            axes.plot(ends, [row, row], linewidth=1.2, alpha=0.7, **shared)
        axes.plot(values, [row] * len(values), "o", alpha=0.6, markersize=5, **shared)
        bar = {**shared, "color": INK, "linewidth": 1.6}
        axes.plot([values.mean()] * 2, [row - 0.3, row + 0.3], **bar)
    axes.set_yticks(range(len(looks)), [textwrap.shorten(label, 34) for label in looks])
    axes.set_ylim(len(looks) - 0.5, -0.5)
    axes.tick_params(axis="y", length=0)
    axes.grid(visible=False, axis="y")
    axes.grid(visible=True, axis="x")
    numbers(axes, x=name)


def by_physics(axes: Axes, table: pd.DataFrame, looks: Looks, name: str) -> None:
    """Draw values over physics in ascending order, and lines through the means of each label.

    Unseen physics stand on a grey ground.

    Args:
        axes: Where to draw.
        table: label, group, sim_params, value.
        looks: Looks by label.
        name: What the values are.
    """
    by_text = {text: parse_sim_params(text) for text in table.sim_params.unique()}
    physics = tables.distinct(by_text.values())
    places = table.sim_params.map({text: physics.index(p) for text, p in by_text.items()})
    for place in places[table.group != TRAIN].unique():
        axes.axvspan(place - 0.5, place + 0.5, color=GROUND, zorder=0, linewidth=0)
    for label, style in looks.items():
        own = table.label == label
        means = table.value[own].groupby(places[own]).mean()
        dots = {"s": 12, "color": style["color"], "alpha": 0.5, "linewidths": 0}
        axes.scatter(places[own], table.value[own], **dots, gid=style.get("gid"))
        axes.plot(means, **{"markersize": 4.5, **style})
    names = tables.varying(physics)
    axes.set_xlim(-0.5, len(physics) - 0.5)
    numbers(axes, y=name)
    axes.set_xticks(range(len(physics)), [tables.value_label(p, names) for p in physics])
    axes.tick_params(axis="x", length=0)
    axes.set_xlabel(tables.axis_label(names))


def error_lines(axes: Axes, table: pd.DataFrame, looks: Looks) -> None:
    """Draw the error of imagined observations over the steps imagined.

    Lines are means over runs, bands reach from the best to the worst run.

    Args:
        axes: Where to draw.
        table: label, run, step, error.
        looks: Looks by label.
    """
    table = table[np.isfinite(table.error)]
    for label, own in table.groupby("label", sort=False):
        style, errors = looks[str(label)], own.groupby("step").error
        if own["run"].nunique() > 1:
            _band(axes, errors.mean().index, errors.min(), errors.max(), style)
        axes.plot(errors.mean(), **{"markersize": 3, "markevery": 2, **style})
    axes.axhline(1.0, color=FAINT, linewidth=1, linestyle=":", zorder=1)
    highest = table.error.max()
    numbers(axes, x="imagined steps ahead", y="error (standard deviations)")
    axes.xaxis.set_major_locator(MaxNLocator(6, integer=True))
    if highest > 10:
        axes.set_yscale("log")
    else:
        axes.set_ylim(0, max(1.1, 1.05 * highest))


def head_shares(axes: Axes, table: pd.DataFrame) -> None:
    """Draw the share of segments that each head explains best: a bar per physics and member.

    Args:
        axes: Where to draw; wide enough for all members side by side.
        table: member, head, sim_params, share.
    """
    physics = tables.distinct(map(parse_sim_params, table.sim_params.unique()))
    members = sorted(table.member.unique())
    for (member, text), heads in table.sort_values("head").groupby(["member", "sim_params"]):
        left, row = 1.12 * members.index(member), physics.index(parse_sim_params(str(text)))
        for head, share in zip(heads["head"], heads.share.fillna(0.0).clip(0, 1), strict=True):
            axes.barh(row, share, 0.82, left, color=HEADS[head % len(HEADS)], linewidth=0)
            left += share
    names = tables.varying(physics)
    axes.set_yticks(range(len(physics)), [tables.value_label(p, names) for p in physics])
    axes.set_ylim(len(physics) - 0.5, -0.5)
    axes.set_xticks([1.12 * i + 0.5 for i in range(len(members))], list(map(str, members)))
    axes.set_xlim(0, 1.12 * len(members) - 0.12)
    axes.tick_params(length=0)
    axes.grid(visible=False)
    axes.spines[:].set_visible(False)
    axes.set_xlabel("member")
    axes.set_ylabel(tables.axis_label(names))


def save_run_figures(run_dir: str | Path) -> list[Path]:
    """Draw every figure that the files of a run allow, from these alone.

    Args:
        run_dir: A run directory; the PNG files go into its `figures/`.

    Returns:
        The files written, in reading order. A figure whose numbers are missing is left out.

    Raises:
        RunError: There is no run that can be read.
    """
    found = tables.read_runs([run_dir])
    (run,) = found.runs.itertuples()
    made: list[Path] = []

    def frame(name: str, title: str, caption: str, size: tuple[float, float], looks: Looks) -> Any:
        made.append(Path(run_dir) / "figures" / f"{name}.png")
        text = f"{run.env}, {run.method}, preset {run.preset}, seed {run.seed}{caption}"
        return figure(made[-1], title=title, caption=text, size=size, looks=looks)

    def labelled(table: pd.DataFrame) -> pd.DataFrame:
        return table.assign(label=table.group.map(group_label))

    last = found.episodes[found.episodes.iteration == found.episodes.iteration.max()]
    learned = labelled(found.curves[found.curves.timesteps > 0])
    if len(learned):
        caption = ". Means over episodes. The first iteration acts at random; tests follow the fit."
        title, looks = "Return while learning", group_looks(learned.group.unique())
        with frame("learning_curve", title, caption, (6.6, 3.3), looks) as drawing:
            curves(drawing.subplots(), learned.assign(finished=True), looks)
    if len(last):
        caption = (
            f", iteration {last.iteration.max() + 1}. Dots are {len(last)} test episodes, lines"
            " their means."
        )
        title, looks = "Return on training and unseen physics", group_looks(last.group.unique())
        with frame("evaluation", title, caption, (6.6, 3.1), looks) as drawing:
            shown = labelled(last).assign(value=last["return"])
            by_physics(drawing.subplots(), shown, looks, "return per episode")
    shares = found.assignments
    if shares["head"].nunique() > 1:
        caption = (
            f", iteration {shares.iteration.max() + 1}. Share of the collected segments"
            " of each physics whose oracle loss is lowest under each head. Head numbers are"
            " arbitrary: head 0 of one member has nothing to do with head 0 of another."
        )
        size = (
            max(1.3 * shares.member.nunique() + 0.6, 5.6),
            0.9 + min(0.3 * shares.sim_params.nunique(), 30.0),
        )
        square = {"marker": "s", "markersize": 8, "linestyle": ""}
        looks = {
            f"head {head}": {"color": HEADS[head % len(HEADS)], **square}
            for head in sorted(shares["head"].unique())
        }
        with frame("head_shares", "Best head of each physics", caption, size, looks) as drawing:
            head_shares(drawing.subplots(), shares)
    if len(found.errors):
        caption = (
            f", iteration {found.errors.iteration.max() + 1}. Root mean squared error of imagined"
            " observations over moments of test episodes, members and dimensions, in units of each"
            " dimension's standard deviation. At 1, predicting the mean would do as well."
        )
        title, looks = "Prediction error by imagined step", group_looks(found.errors.group.unique())
        with frame("prediction_error", title, caption, (6.6, 3.1), looks) as drawing:
            error_lines(drawing.subplots(), labelled(found.errors), looks)
    about, panels = episode.follow_episode(run_dir)
    if panels:
        title, size = "Predicted and real over time", (7.6, 1.05 * len(panels) + 0.4)
        with frame("episode", title, f". {about}", size, episode.LOOKS) as drawing:
            rows = drawing.subplots(len(panels), sharex=True)
            for axes, (name, draw) in zip(rows, panels.items(), strict=True):
                draw(axes)
                axes.set_title(name, pad=2)
                axes.label_outer()
    return made
