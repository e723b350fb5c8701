"""A capture envelope as a map: cells by verdict, the boundary as wide as it is unknown."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from capture_sim.detection.exact import CaptureState
from capture_sim.studies.approach import approach_of
from capture_sim.studies.envelope import Cell, Envelope
from capture_sim.viewing import palette
from capture_sim.viewing.canvas import new_figure, save, set_fonts
from capture_sim.viewing.source import ViewableRun, verdict

_COLOURS = {
    CaptureState.CAPTURED: palette.GREEN,
    CaptureState.REBOUND: palette.ORANGE,
    CaptureState.STUCK: palette.PURPLE,
    CaptureState.MISSED: palette.LIGHT,
}
_BOUNDARY = "#404040"
# of the axes, as a person reads them: title, unit, how many to the SI unit
_SHOWN = (
    ("angle of the target", "deg", math.degrees(1.0)),
    ("lateral offset", "mm", 1e3),
    ("speed at the touch", "m/s", 1.0),
)


def save_envelope(envelope: Envelope, path: Path | str, marks: Sequence[ViewableRun] = ()) -> Path:
    """Draw a map and save it; see :func:`draw_envelope`.

    Raises
    ------
    RecordingError
        The file cannot be written.
    """
    return save(draw_envelope(envelope, marks), path)


def draw_envelope(envelope: Envelope, marks: Sequence[ViewableRun] = ()) -> Figure:
    """Return the figure of a map: a panel for each slice.

    ``marks`` are runs of experiments; each is marked in the slice it belongs to (where it
    does not belong to one, in none), with what came of it.
    """
    slices = envelope.plan.slices
    columns = min(len(slices), 3)
    rows = math.ceil(len(slices) / columns)
    figure = new_figure(1.5 + 5.6 * columns, 1.6 + 5.0 * rows)
    panels = figure.subplots(rows, columns, squeeze=False).ravel()
    for panel in panels[len(slices) :]:
        panel.set_axis_off()
    for number, panel in enumerate(panels[: len(slices)]):
        _draw_slice(panel, envelope, number)
        _mark(panel, envelope, number, marks)
    patches = [Patch(color=colour, label=state.label) for state, colour in _COLOURS.items()]
    patches.append(Patch(color=_BOUNDARY, label="boundary of capture lies in here"))
    figure.legend(handles=patches, loc="outside lower center", ncols=5, fontsize=12)
    figure.suptitle(
        f"Capture envelope of {envelope.plan.scene.name}: {len(envelope.rows)} runs", fontsize=16
    )
    set_fonts(figure.axes, 12.0)
    return figure


def _draw_slice(axes: Axes, envelope: Envelope, number: int) -> None:
    plan = envelope.plan
    (across, _), (up, _) = plan.plane
    cells = [cell for cell in envelope.cells if cell.slice == number]
    corners = np.array([[plan.values(key) for key in plan.points(cell)] for cell in cells])
    # points() goes up first: 0 low left, 1 high left, 2 low right, 3 high right
    outline = corners[:, [0, 2, 3, 1]][:, :, [across, up]]
    outline *= [_SHOWN[across][2], _SHOWN[up][2]]
    colours = [_colour(envelope, cell) for cell in cells]
    axes.add_collection(
        PolyCollection(list(outline), facecolors=colours, edgecolors=colours, linewidths=0.3)
    )
    axes.set_xlim(outline[:, :, 0].min(), outline[:, :, 0].max())
    axes.set_ylim(outline[:, :, 1].min(), outline[:, :, 1].max())
    doubtful = [
        square.mean(axis=0)
        for cell, square in zip(cells, outline, strict=True)
        if envelope.is_boundary(cell) and _hangs_on_tolerance(envelope, cell)
    ]
    if doubtful:
        x, y = np.array(doubtful).T
        axes.plot(x, y, "x", color=palette.VERMILION, ms=6, mew=1.6, label="ill-conditioned")
        axes.legend(loc="lower right", fontsize=11, framealpha=1.0)
    axes.set_xlabel(f"{_SHOWN[across][0]} [{_SHOWN[across][1]}]")
    axes.set_ylabel(f"{_SHOWN[up][0]} [{_SHOWN[up][1]}]")
    title, unit, factor = _SHOWN[plan.sliced]
    share = envelope.shares[number]
    axes.set_title(
        f"{title} {plan.slices[number] * factor:.3g} {unit}\n"
        f"captured {100 * share['surely']:.1f} to {100 * share['perhaps']:.1f} %",
        fontsize=13,
    )


def _hangs_on_tolerance(envelope: Envelope, cell: Cell) -> bool:
    rows = envelope.corner_rows(cell)
    return bool(np.any(rows["verdict"] != rows["finer_verdict"]))


def _colour(envelope: Envelope, cell: Cell) -> str:
    if envelope.is_boundary(cell):
        return _BOUNDARY
    verdicts, counts = np.unique(envelope.corner_rows(cell)["verdict"], return_counts=True)
    return _COLOURS[CaptureState(verdicts[counts.argmax()])]


def _mark(axes: Axes, envelope: Envelope, number: int, marks: Sequence[ViewableRun]) -> None:
    plan = envelope.plan
    (across, _), (up, _) = plan.plane
    for run in marks:
        approach = approach_of(run.scene)
        if not math.isclose(approach[plan.sliced], plan.slices[number], rel_tol=1e-6, abs_tol=1e-9):
            continue
        x, y = (approach[axis] * _SHOWN[axis][2] for axis in (across, up))
        axes.plot(x, y, "o", mfc="white", mec=palette.BLACK, ms=8, mew=1.8)
        axes.annotate(
            f"{run.scene.name}\n{verdict(run)}",
            (x, y),
            xytext=(0, 9),
            textcoords="offset points",
            ha="center",
            fontsize=10.5,
            bbox={"facecolor": "white", "edgecolor": "none", "alpha": 0.75, "pad": 1},
        )
