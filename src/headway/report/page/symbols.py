"""A series' line and marker, as legend and tables show it."""

from matplotlib.axes import Axes

from headway.report.page import charts, svg
from headway.report.page.series import Series

_SIZE = (0.42, 0.16)  # inches


def symbol(series: Series) -> str:
    """A small SVG of a piece of line with one marker; the page holds it once."""

    def draw(axes: Axes) -> None:
        look = {**charts.look(series), "gid": None}  # it stays when the series is hidden
        axes.plot([0, 1, 2], [0, 0, 0], **look, markersize=5, markevery=[1])
        axes.set_axis_off()
        axes.margins(0.02, 0.5)

    drawn = svg.panel(draw, name=f"symbol-{series.index}", label="", size=_SIZE)
    return drawn.replace("<svg ", f'<svg id="{_name(series)}" ', 1)


def same_symbol(series: Series) -> str:
    """The same symbol, wherever else it is wanted."""
    width, height = (72 * size for size in _SIZE)
    used = f'<use href="#{_name(series)}"/>'
    return f'<svg viewBox="0 0 {width:g} {height:g}" aria-hidden="true">{used}</svg>'


def _name(series: Series) -> str:
    return f"symbol-{series.index}"
