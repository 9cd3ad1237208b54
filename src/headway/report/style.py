"""One restrained look for all figures, safe for colour-blind readers.

Colours are Okabe and Ito's. Figures are made without pyplot, on the Agg canvas; the user's
own matplotlib settings are put back as soon as a figure is done.
"""

import contextlib
import io
import textwrap
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import matplotlib
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine

from headway.training.run import write_bytes

INK = "#222222"
FAINT = "#7a7a7a"
RULE = "#e4e4e4"
THREAD = "#cccccc"
TRAINING = "#0072B2"
UNSEEN = ("#D55E00", "#009E73", "#CC79A7", "#E69F00")
HEADS = (
    "#0072B2", "#E69F00", "#009E73", "#CC79A7", "#56B4E9", "#D55E00", "#F0E442", "#999999",
)  # fmt: skip
SERIES = (
    "#0072B2", "#D55E00", "#009E73", "#B0578D", "#C98A00", "#3F3F46", "#4AA3D6", "#8A7A00",
)  # fmt: skip
"""Of methods: Okabe and Ito's hues, dark enough for lines and dots on white."""
DPI = 160

_MARGIN, _TITLE, _LEGEND = 0.16, 0.42, 0.3  # inches
_LEGEND_SYMBOL, _LEGEND_LETTER, _LEGEND_LINE = 0.5, 0.062, 0.19  # inches
_CAPTION_LINE, _CAPTION_LETTER = 0.155, 0.055  # inches

SETTINGS: dict[Any, Any] = {
    "font.family": "sans-serif",
    "font.sans-serif": ["DejaVu Sans"],
    "font.size": 9.0,
    "text.color": INK,
    "text.usetex": False,
    "axes.facecolor": "white",
    "axes.edgecolor": "#9a9a9a",
    "axes.labelcolor": INK,
    "axes.labelsize": 9.0,
    "axes.linewidth": 0.8,
    "axes.titlesize": 9.5,
    "axes.titlelocation": "left",
    "axes.titlepad": 8.0,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.grid.axis": "y",
    "axes.axisbelow": True,
    "axes.unicode_minus": True,
    "grid.color": RULE,
    "grid.linewidth": 0.8,
    "grid.linestyle": "-",
    "xtick.color": FAINT,
    "ytick.color": FAINT,
    "xtick.labelcolor": INK,
    "ytick.labelcolor": INK,
    "xtick.labelsize": 8.5,
    "ytick.labelsize": 8.5,
    "legend.frameon": False,
    "legend.fontsize": 8.5,
    "lines.linewidth": 1.8,
    "lines.solid_capstyle": "round",
    "figure.facecolor": "white",
    "savefig.facecolor": "white",
    "svg.hashsalt": "headway",
}


@contextlib.contextmanager
def figure(
    path: Path,
    *,
    title: str,
    caption: str,
    size: tuple[float, float],
    svg: bool = False,
    has_legend: bool = True,
) -> Iterator[Figure]:
    """Make a figure, hand it out to be drawn on, and write it.

    Args:
        path: The PNG file; its directory is created.
        title: One line that says what is seen.
        caption: What the marks are and where the numbers come from; wrapped to the width.
        size: Width and height in inches.
        svg: Whether to write an SVG file beside the PNG as well.
        has_legend: Whether to leave room for a `legend` below the title.
    """
    with matplotlib.rc_context(SETTINGS):
        width, height = size
        drawing = Figure(figsize=size)
        FigureCanvasAgg(drawing)
        lines = textwrap.wrap(caption, int((width - 2 * _MARGIN) / _CAPTION_LETTER))
        low = (_MARGIN + _CAPTION_LINE * len(lines)) / height
        high = 1 - (_TITLE + _LEGEND * has_legend) / height
        space = (_MARGIN / width / 2, low, 1 - _MARGIN / width, high - low)
        drawing.set_layout_engine(ConstrainedLayoutEngine(rect=space, w_pad=0.06, h_pad=0.06))
        left, top = _MARGIN / width, 1 - _MARGIN / height
        drawing.text(left, top, title, va="top", fontsize=11, fontweight="bold")
        below = {"va": "bottom", "fontsize": 7.5, "color": FAINT, "linespacing": 1.35}
        drawing.text(left, 0.6 * _MARGIN / height, "\n".join(lines), **below)
        yield drawing
        image = io.BytesIO()
        drawing.savefig(image, format="png", dpi=DPI)
        write_bytes(path, image.getvalue())
        if svg:
            drawn = io.BytesIO()
            drawing.savefig(drawn, format="svg", metadata={"Date": None})
            write_bytes(path.with_suffix(".svg"), drawn.getvalue())


def legend(drawing: Figure, handles: Sequence[Any] | None = None) -> None:
    """Write the legend below the title, in as many lines as the width asks for.

    Args:
        drawing: A figure made by `figure`.
        handles: What to explain; everything labelled in the first axes by default.
    """
    if handles is None:
        handles = drawing.axes[0].get_legend_handles_labels()[0]
    width, height = drawing.get_size_inches()
    needed = [_LEGEND_SYMBOL + _LEGEND_LETTER * len(str(h.get_label())) for h in handles]
    free = width - 2 * _MARGIN
    fitting = len(handles) if sum(needed) <= free else max(int(free / max(needed)), 1)
    lines = -(-len(handles) // fitting)
    engine = drawing.get_layout_engine()
    if isinstance(engine, ConstrainedLayoutEngine):
        left, low, across, up = engine.get()["rect"]
        engine.set(rect=(left, low, across, up - (lines - 1) * _LEGEND_LINE / height))
    drawing.legend(
        handles=list(handles),
        loc="upper left",
        bbox_to_anchor=(_MARGIN / width, 1 - _TITLE / height),
        borderaxespad=0,
        borderpad=0,
        handlelength=1.4,
        columnspacing=1.6,
        ncols=-(-len(handles) // lines),
    )


def group_colors(groups: Sequence[str]) -> dict[str, str]:
    """A colour per group: blue for training, warm and green ones for unseen groups."""
    unseen = [group for group in groups if group != "train"]
    colors = {group: UNSEEN[i % len(UNSEEN)] for i, group in enumerate(unseen)}
    return {group: colors.get(group, TRAINING) for group in groups}


def group_label(group: str) -> str:
    """Name a group for readers."""
    names = {"train": "training physics", "unseen": "unseen physics"}
    return names.get(group, f"unseen: {group.replace('_', ' ')}")


def label_axis(axes: Axes, x: str, y: str) -> None:
    """Write both axis labels."""
    axes.set_xlabel(x)
    axes.set_ylabel(y)
