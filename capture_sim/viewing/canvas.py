"""Sheets to draw on, and how they are saved: no screen needed, the same file every time."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import matplotlib as mpl
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine

from capture_sim.errors import RecordingError

#: Of axes' labels, in points; chosen to be read when a figure is shown at half its size.
FONT = 14.0
#: Of everything else.
SMALL = 12.5
#: Pixels per inch of PNG files.
DPI = 110

# the same figure gives the same bytes; letters stay letters of a font that every system has
_SAVING: Any = {"svg.hashsalt": "capture_sim", "svg.fonttype": "path"}


def new_figure(width: float, height: float) -> Figure:
    """Return an empty figure, inches, that arranges what is drawn in it."""
    figure = Figure(figsize=(width, height), layout=ConstrainedLayoutEngine(w_pad=0.08, h_pad=0.07))
    FigureCanvasAgg(figure)  # none of pyplot's global state
    return figure


def set_fonts(all_axes: Iterable[Axes], size: float = FONT) -> None:
    """Give labels and numbers of axes their size, in points."""
    for axes in all_axes:
        axes.tick_params(labelsize=size - 1.5)
        axes.xaxis.label.set_fontsize(size)
        axes.yaxis.label.set_fontsize(size)


def save(figure: Figure, path: Path | str) -> Path:
    """Save a figure, as PNG, SVG or whatever the path's ending says.

    Returns
    -------
    Path
        Of the file.

    Raises
    ------
    RecordingError
        The file cannot be written.
    """
    path = Path(path)
    metadata = {"Date": None} if path.suffix == ".svg" else None
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with mpl.rc_context(_SAVING):
            figure.savefig(path, dpi=DPI, metadata=metadata)
    except OSError as error:
        raise RecordingError(f"{path}: cannot write: {error.strerror or error}") from None
    return path


def save_both(figure: Figure, stem: Path | str) -> list[Path]:
    """Save a figure as ``stem.svg`` and ``stem.png``.

    Returns
    -------
    list of Path
        Of both files.

    Raises
    ------
    RecordingError
        A file cannot be written.
    """
    return [save(figure, Path(f"{stem}{ending}")) for ending in (".svg", ".png")]
