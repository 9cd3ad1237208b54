"""A series' line and marker, as the legend shows it."""

from matplotlib.axes import Axes

from headway.report.page import charts, svg
from headway.report.page.series import Series


def symbol(series: Series) -> str:
    """A small SVG of a piece of line with one marker."""

    def draw(axes: Axes) -> None:
        axes.plot([0, 1, 2], [0, 0, 0], **charts.look(series), markersize=5, markevery=[1])
        axes.set_axis_off()
        axes.margins(0.02, 0.5)

    return svg.panel(draw, name=f"symbol-{series.index}", label="", size=(0.42, 0.16))
