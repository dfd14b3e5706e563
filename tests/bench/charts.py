"""Log-log charts of costs for the benchmark."""

from collections.abc import Sequence
from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.figure import Figure

WIDTH, HEIGHT, DPI = 640, 420, 100  # px, px, px/inch
FAINT = "#999999"


def cost_chart(title: str, across: str, upwards: str, ticks: Sequence[int]) -> Axes:
    """Empty axes of a log-log chart with these ticks on the x axis."""
    figure = Figure((WIDTH / DPI, HEIGHT / DPI), DPI, layout="constrained")
    axes = figure.add_subplot(xscale="log", yscale="log", xlabel=across, ylabel=upwards)
    axes.set_title(title, loc="left")
    axes.set_xticks(ticks, [str(tick) for tick in ticks])
    axes.set_xticks([], minor=True)
    axes.yaxis.set_major_formatter("{x:g}")
    axes.grid(which="both", color="#eeeeee")
    axes.spines[["top", "right"]].set_visible(False)
    return axes


def save(axes: Axes, path: Path) -> None:
    """Write the chart with its legend as a PNG file."""
    axes.margins(x=0.08)
    axes.legend(loc="best", framealpha=1, edgecolor="white")
    figure = axes.get_figure(root=True)
    assert figure is not None
    figure.savefig(path)
