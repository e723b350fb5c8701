"""Figures and axes of matplotlib, and their saving to files; no screen is needed."""

from __future__ import annotations

import io
import itertools
from collections.abc import Container, Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import PolyCollection
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from PIL import Image

from capture_sim.base.files import whole_file
from capture_sim.base.version import __version__
from capture_sim.viewing import style

if TYPE_CHECKING:
    from capture_sim.viewing.shapes import Shape

# the same figure gives the same bytes; letters are drawn, so that they need no font
_MARK = f"capture_sim {__version__}"
_SAVING: Any = {"svg.hashsalt": "capture_sim", "svg.fonttype": "path"}


def new_figure(width: float, height: float, *, arranged: bool = True) -> Figure:
    """Return an empty figure; width and height are in inches.

    An arranged figure moves its axes and legends when it is drawn, so that they do not overlap.
    For this, matplotlib measures every tick.  A figure that is not arranged is drawn three times
    as fast; the caller then places its axes, e.g. with :func:`rows_of_axes`.
    """
    layout = ConstrainedLayoutEngine(w_pad=0.08, h_pad=0.07) if arranged else None
    figure = Figure(figsize=(width, height), layout=layout)
    FigureCanvasAgg(figure)  # none of pyplot's global state
    return figure


def subplots(
    width: float,
    height: float,
    rows: int = 1,
    columns: int = 1,
    *,
    grid: Any = "both",
    font: float = style.FONT,
    **options: Any,
) -> tuple[Figure, np.ndarray]:
    """Return a figure and its axes, an array (rows, columns), in the style of all plots.

    Width and height are in inches.  ``grid`` is "x", "y" or "both" for grid lines at the ticks of
    these axes, or None for no grid.  ``font`` is the font size of the axes' labels, in points.
    ``options`` are passed to matplotlib's ``Figure.subplots``.
    """
    figure = new_figure(width, height)
    axes = figure.subplots(rows, columns, squeeze=False, **options)
    for each in axes.flat:
        dress(each, grid, font)
    return figure, axes


def columns_for(count: int) -> int:
    """Return the number of columns in which ``count`` panels are arranged: at most three."""
    return 2 if count == 4 else min(count, 3)


def hide_unused(axes_grid: np.ndarray, used: Container[Axes]) -> None:
    """Hide the axes of a grid that are not in ``used``.

    ``axes_grid`` has the shape (rows, columns).  In each column, only the lowest used axes show
    numbers at the ticks of x.  Each column must contain used axes.
    """
    for column in axes_grid.T:
        shown = [axes for axes in column if axes in used]
        for axes in column:
            if axes not in used:
                axes.set_axis_off()
            axes.tick_params(labelbottom=axes is shown[-1])


def rows_of_axes(
    figure: Figure, sides: tuple[float, float], top: float, rows: Sequence[tuple[float, float]]
) -> list[Axes]:
    """Add axes to a figure, one below the other, and return them; all lengths are in inches.

    ``sides`` are the left and right ends of all axes, from the figure's left edge.  ``top`` is the
    distance of the first axes from the figure's upper edge.  ``rows`` contains, for each axes, its
    height and the gap below it.
    """
    width, height = figure.get_size_inches()
    left, right = sides
    stacked, y = [], height - top
    for high, gap in rows:
        y -= high
        stacked.append(
            figure.add_axes((left / width, y / height, (right - left) / width, high / height))
        )
        y -= gap
    return stacked


def dress(axes: Axes, grid: Any = "both", font: float = style.FONT) -> None:
    """Give axes a light grid behind all curves, and set the font size of labels and tick numbers.

    ``grid`` is "x", "y" or "both", or None for no grid.  ``font`` is the size of the labels, in
    points; the tick numbers are 1.5 points smaller.
    """
    if grid:
        axes.grid(axis=grid, color=style.LIGHT, lw=0.6)
        axes.set_axisbelow(True)
    axes.tick_params(labelsize=font - 1.5)
    axes.xaxis.label.set_fontsize(font)
    axes.yaxis.label.set_fontsize(font)


def draw_shapes(axes: Axes, shapes: Iterable[Shape], factor: float = 1.0) -> None:
    """Draw shapes, with their coordinates multiplied by ``factor``, e.g. 1000 for axes in mm."""
    several = sorted(shapes, key=lambda shape: shape.order)
    for order, group in itertools.groupby(several, key=lambda shape: shape.order):
        same = list(group)
        axes.add_collection(
            PolyCollection(
                [shape.points * factor for shape in same],
                closed=False,
                facecolors=[shape.fill or "none" for shape in same],
                edgecolors=[shape.line or "none" for shape in same],
                linewidths=[shape.width for shape in same],
                linestyles=[style.FREE_LINE if shape.dashed else "solid" for shape in same],
                capstyle="round",
                zorder=order,
            )
        )
    axes.autoscale_view()


def small_png(figure: Figure, dpi: float) -> bytes:
    """Return a figure as the bytes of a PNG file of 64 colours, which keeps the file small.

    ``dpi`` is in pixels per inch; the figure keeps it afterwards.
    """
    _skip_contents_in_layout(figure)
    figure.set_dpi(dpi)
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    image = Image.fromarray(np.asarray(canvas.buffer_rgba())[..., :3])
    file = io.BytesIO()
    image.quantize(64, dither=Image.Dither.NONE).save(file, "PNG")
    return file.getvalue()


def _skip_contents_in_layout(figure: Figure) -> None:
    """Exclude curves and shapes inside the axes from the layout, so that they are not measured."""
    for axes in figure.axes:
        for artist in (*axes.lines, *axes.collections, *axes.patches):
            artist.set_in_layout(False)


def save(figure: Figure, *paths: Path | str) -> Path:
    """Save a figure to each path, in the format of its suffix (PNG or SVG); return the last path.

    The figure is arranged for the first file and keeps this arrangement for all further files.
    At least one path is required.

    Raises
    ------
    RecordingError
        A file cannot be written.
    """
    _skip_contents_in_layout(figure)
    for path in map(Path, paths):
        is_svg = path.suffix == ".svg"
        metadata = {"Date": None, "Creator": _MARK} if is_svg else {"Software": _MARK}
        with whole_file(path) as part, mpl.rc_context(_SAVING):
            figure.savefig(part, dpi=style.DPI, metadata=metadata)
        figure.set_layout_engine("none")  # arranged by the first
    return path
