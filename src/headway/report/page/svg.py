"""Small figures as inline SVG: text stays text, colours follow the page's light or dark theme.

A figure is drawn with the light theme's colours; in the SVG each of them becomes a variable of
the page's style sheet. Every panel is small enough to be read on a phone at its own size, and the
page lays panels out in as many columns as it has room for.
"""

import io
import re
from collections.abc import Callable
from typing import Any

import matplotlib
import numpy as np
from markupsafe import escape
from matplotlib.axes import Axes
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.colors import to_hex
from matplotlib.figure import Figure

from headway.report import style

PANEL = (3.5, 2.5)  # inches

_IN_DARK = (
    "#5aaee8", "#f28a45", "#35c79a", "#e39cc6", "#f0b93a", "#d4d4d8", "#a5d8f6", "#ded35c",
)  # fmt: skip
SWATCHES = tuple(zip(map(str.lower, style.SERIES), _IN_DARK, strict=True))
"""Colours of series in light and dark."""

_SCALE = matplotlib.colormaps["plasma"]
ORDERED = tuple(
    (to_hex(_SCALE(0.08 + 0.72 * place)), to_hex(_SCALE(0.4 + 0.6 * place)))
    for place in np.linspace(0, 1, 12)
)
"""Colours of ascending values in light and dark, all of them far from the ground."""

MARKERS = "osD^vPX*"
DASHES: tuple[str | tuple[int, tuple[int, ...]], ...] = ("-", (0, (5, 2)), (0, (1, 1.5)))  # type: ignore

THEME = {
    "ink": (style.INK, "#e7e7ea"),
    "faint": (style.FAINT, "#9c9ca6"),
    "rule": (style.RULE, "#33343b"),
    "axis": ("#9a9a9a", "#60616b"),
    "paper": ("#ffffff", "#17181c"),
    **{f"s{i}": pair for i, pair in enumerate(SWATCHES)},
    **{f"p{i}": pair for i, pair in enumerate(ORDERED)},
}
"""Variables of the style sheet: their value in light and in dark."""

_VARIABLES = {light.lower(): f"var(--{name})" for name, (light, _) in THEME.items()}
_COORDINATES = re.compile(
    r' (?:d|points|transform|[xy][12]?|c[xy]|r|width|height)="[^"]*"'  # attributes that hold them
)
_SETTINGS: dict[Any, Any] = {
    "svg.fonttype": "none",
    "text.parse_math": False,  # a dollar is a dollar
    "figure.facecolor": "none",
    "axes.facecolor": "none",
    "savefig.facecolor": "none",
    "font.size": 8.5,
    "axes.labelsize": 8.5,
    "xtick.labelsize": 8,
    "ytick.labelsize": 8,
    "lines.linewidth": 1.6,
}


def panel(
    draw: Callable[[Axes], None], *, name: str, label: str, size: tuple[float, float] = PANEL
) -> str:
    """Draw a figure of one axes as an SVG element.

    Args:
        draw: Draws on the axes it is given.
        name: Unique on the page; every identifier inside begins with it.
        label: What is seen, for those who cannot see it.
        size: Width and height in inches.
    """
    with matplotlib.rc_context({**style.SETTINGS, **_SETTINGS, "svg.hashsalt": name}):
        figure = Figure(figsize=size, layout="constrained")
        FigureCanvasSVG(figure)
        draw(figure.subplots())
        written = io.StringIO()
        nothing = dict.fromkeys(("Date", "Creator", "Format", "Type"))
        figure.savefig(written, format="svg", metadata=nothing)
    return _inline(written.getvalue(), name, label)


def _inline(document: str, name: str, label: str) -> str:
    """Cut the element out of the document and fit it into the page."""
    svg = document[document.index("<svg") :]
    svg = re.sub(r"<metadata>.*?</metadata>", "", svg, flags=re.DOTALL)
    box = re.search(r'viewBox="([-\d. ]+)"', svg)
    svg = svg[svg.index(">") + 1 :]
    svg = f'<svg viewBox="{box[1] if box else ""}" role="img" aria-label="{escape(label)}">{svg}'
    svg = re.sub(r"(fill|stroke): (#[0-9a-f]{6})\b", _themed, svg)
    svg = re.sub(r'<g id="series-(\d+)(?:-\d+)?">', r'<g class="series-\1">', svg)
    svg = re.sub(r'(<\w+) id="', rf'\1 id="{name}-', svg)
    svg = re.sub(r' xlink:href="#', f' href="#{name}-', svg)
    svg = svg.replace('"url(#', f'"url(#{name}-')
    wanted = set(re.findall(r'(?:href="#|url\(#)([^")]+)', svg))
    svg = re.sub(r' id="([^"]+)"', lambda match: match[0] if match[1] in wanted else "", svg)
    svg = re.sub(r"<style.*?</style>", "", svg, flags=re.DOTALL)  # the page has it
    svg = re.sub(r" font-family: [^;\"]*;", "", svg)
    svg = re.sub(r"<\w[^<>]*>", _trimmed, svg)
    return re.sub(r"\s*\n\s*", "\n", svg).strip()


def _themed(match: re.Match[str]) -> str:
    return f"{match[1]}: {_VARIABLES.get(match[2], match[2])}"


def _trimmed(tag: re.Match[str]) -> str:
    """A tag whose coordinates have two decimals; what is written for readers stays as it is."""
    return _COORDINATES.sub(lambda found: re.sub(r"(\d\.\d\d)\d+", r"\1", found[0]), tag[0])
