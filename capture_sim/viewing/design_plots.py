"""The design flow in pictures: how it went, and what a longer stroke saves."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from capture_sim.detection.exact import CaptureState
from capture_sim.studies.design import Design
from capture_sim.viewing import palette
from capture_sim.viewing.canvas import new_figure, save, set_fonts

_MARKS = {
    CaptureState.CAPTURED: (palette.GREEN, "o"),
    CaptureState.REBOUND: (palette.ORANGE, "v"),
    CaptureState.STUCK: (palette.PURPLE, "s"),
    CaptureState.MISSED: (palette.GREY, "x"),
}


def save_design(design: Design, path: Path | str) -> Path:
    """Draw how a design was found and save it; see :func:`draw_design`.

    Raises
    ------
    RecordingError
        The file cannot be written.
    """
    return save(draw_design(design), path)


def save_trade_off(designs: Sequence[Design], path: Path | str) -> Path:
    """Draw force against stroke and save it; see :func:`draw_trade_off`.

    Raises
    ------
    RecordingError
        The file cannot be written.
    """
    return save(draw_trade_off(designs), path)


def draw_design(design: Design) -> Figure:
    """Return a figure of the flow: the strokes run by run, and the verdict over the damper."""
    figure = new_figure(13.0, 5.6)
    strokes, dampers = figure.subplots(1, 2)
    _draw_strokes(strokes, design)
    _draw_dampers(dampers, design)
    set_fonts(figure.axes)
    return figure


def _draw_strokes(axes: Axes, design: Design) -> None:
    trials = [trial for trial in design.history if trial.step == 5]
    number = np.arange(1, len(trials) + 1)
    target = design.target
    for values, name, colour in (
        ([t.axial_stroke / target.axial_stroke for t in trials], "axial", palette.BLUE),
        ([t.torsion / target.torsion for t in trials], "torsional", palette.VERMILION),
    ):
        off = np.maximum(np.abs(np.array(values) - 1.0), 1e-6)
        axes.plot(number, off, "o-", color=colour, label=f"{name} stroke")
    axes.set_yscale("log")
    axes.set_xlabel("run")
    axes.set_ylabel("off the target, relative")
    axes.set_title("Steps 1 to 5: springs for the strokes", fontsize=15)
    axes.grid(color=palette.LIGHT, lw=0.6)
    axes.legend(fontsize=12.5)


def _draw_dampers(axes: Axes, design: Design) -> None:
    trials = [trial for trial in design.history if trial.step == 7]
    for state, (colour, marker) in _MARKS.items():
        those = [trial for trial in trials if trial.verdict is state]
        if those:
            axes.plot(
                [trial.c_A for trial in those],
                [trial.nearest * 1e3 for trial in those],
                marker,
                color=colour,
                label=state.label,
                ms=7,
            )
    if trials:
        lowest = min((trial.c_A for trial in trials if trial.c_A > 0.0), default=1.0)
        axes.set_xscale("symlog", linthresh=lowest)
        axes.set_xlim(left=-0.3 * lowest)
        highest = max(trial.c_A for trial in trials)
        top = math.floor(math.log10(max(highest, lowest)))
        decades = [10.0**n for n in range(math.ceil(math.log10(lowest)), top + 1)]
        axes.set_xticks([0.0, *decades])
    if design.capturing is not None:
        axes.axvspan(*design.capturing, color=palette.GREEN, alpha=0.15, lw=0)
    if design.met and design.scene is not None:
        c_A = design.scene.buffer.c_A
        axes.axvline(c_A, color=palette.BLACK, lw=2.0, label=f"chosen: {c_A:.3g} N s/m")
    axes.set_ylim(bottom=0.0)
    axes.set_xlabel("axial damping  [N s/m]")
    axes.set_ylabel("nearest to the centre of BE  [mm]")
    title = "Step 7: damper by the verdict" if design.met else "Step 7: no damper meets the target"
    axes.set_title(title, fontsize=15)
    axes.grid(color=palette.LIGHT, lw=0.6)
    if trials:
        axes.legend(fontsize=12.5)


def draw_trade_off(designs: Sequence[Design]) -> Figure:
    """Return a figure of peak force over axial stroke, and of the springs that it takes."""
    figure = new_figure(13.0, 5.6)
    force, buffer = figure.subplots(1, 2)
    good = [d for d in designs if d.met]
    stroke = [d.target.axial_stroke * 1e3 for d in good]
    curves = (
        ("largest touch until the verdict", "outcome", "peak_force", palette.VERMILION, "o-"),
        ("largest touch of the first contact", "damped", "peak_force", palette.ORANGE, "s-"),
        (
            "largest force of the buffer, first contact",
            "damped",
            "buffer_force",
            palette.BLUE,
            "^-",
        ),
    )
    for label, part, name, colour, line in curves:
        values = [getattr(getattr(d, part), name) for d in good]
        force.plot(stroke, values, line, color=colour, label=label)
    force.set_ylabel("force  [N]")
    force.set_title("Force against stroke", fontsize=15)
    for name, unit, colour in (
        ("k_A", "N/m", palette.BLUE),
        ("k_T", "N m/rad", palette.VERMILION),
        ("c_A", "N s/m", palette.GREEN),
    ):
        values = [getattr(d.scene.buffer, name) for d in good if d.scene is not None]
        buffer.plot(stroke, values, "o-", color=colour, label=f"{name}  [{unit}]")
    low = [d.capturing[0] if d.capturing else math.nan for d in good]
    high = [d.capturing[1] if d.capturing else math.nan for d in good]
    buffer.fill_between(stroke, low, high, color=palette.GREEN, alpha=0.2, lw=0)
    buffer.set_yscale("log")
    buffer.set_title("The buffer (shaded: dampers that capture)", fontsize=15)
    refused = [d for d in designs if not d.met]
    for axes in (force, buffer):
        for design in designs:
            if not design.met:
                note = "no buffer meets the target" if design is refused[0] else None
                place = design.target.axial_stroke * 1e3
                axes.axvline(place, color=palette.GREY, ls=":", lw=1.5, label=note)
        axes.set_xlabel("target axial stroke  [mm]")
        axes.grid(color=palette.LIGHT, lw=0.6)
        axes.legend(fontsize=12, loc="upper left", framealpha=1.0)
    force.set_ylim(0.0, 1.45 * force.get_ylim()[1])
    low_end, high_end = buffer.get_ylim()
    buffer.set_ylim(low_end, high_end * 8.0)
    set_fonts(figure.axes)
    return figure
