"""Studies in pictures: design, sensitivities, the envelope of capture, two runs compared."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from capture_sim.detection.exact import CaptureState
from capture_sim.studies.approach import approach_of
from capture_sim.studies.design import Design
from capture_sim.studies.envelope import Cell, Envelope
from capture_sim.studies.measurements import Series
from capture_sim.studies.sensitivity import (
    QUANTITIES,
    SMOOTH,
    Global,
    Local,
    Parameter,
    Quantity,
)
from capture_sim.studies.touches import Touches
from capture_sim.viewing import style
from capture_sim.viewing.canvas import subplots
from capture_sim.viewing.curves import STROKE, TORSION
from capture_sim.viewing.source import ViewableRun, verdict

if TYPE_CHECKING:
    from capture_sim.recording.comparing import Comparable

# a parameter below and above by its spread
_BELOW, _ABOVE = "#9DBFD3", "#3E5F73"
_TIGHT: Any = {"linespacing": 0.85}


def draw_design(design: Design) -> Figure:
    """Return a figure of the search: the strokes run by run, and the verdict over the damper."""
    figure, [[strokes, dampers]] = subplots(13.0, 5.6, 1, 2)
    _draw_strokes(strokes, design)
    _draw_dampers(dampers, design)
    return figure


def _draw_strokes(axes: Axes, design: Design) -> None:
    target = design.target
    # over whole runs each damper has springs of its own
    runs = [c for c in design.history if (c.verdict is None) == target.first_contact]
    number = np.arange(1, len(runs) + 1)
    line = "o-" if target.first_contact else "."
    for values, name, colour in (
        ([run.axial_stroke / target.axial_stroke for run in runs], "axial", style.BLUE),
        ([run.torsion / target.torsion for run in runs], "torsional", style.VERMILION),
    ):
        error = np.maximum(np.abs(np.array(values) - 1.0), 1e-6)
        axes.plot(number, error, line, color=colour, label=f"{name} stroke")
    axes.set_yscale("log")
    axes.set_xlabel("run")
    axes.set_ylabel("error of the stroke, relative")
    period = "first contact" if target.first_contact else "whole run"
    axes.set_title(f"Springs for the strokes of the {period}", fontsize=15)
    axes.legend(fontsize=12.5)


def _draw_dampers(axes: Axes, design: Design) -> None:
    # of the searches for springs the last run, which is the nearest to the target
    by_damper = {c.c_A: c for c in design.history if c.verdict is not None}
    trials = list(by_damper.values())
    for state, (colour, marker) in style.VERDICTS.items():
        matching_trials = [trial for trial in trials if trial.verdict is state]
        if matching_trials:
            axes.plot(
                [trial.c_A for trial in matching_trials],
                [trial.nearest * 1e3 for trial in matching_trials],
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
        first = math.floor(math.log10(lowest)) + 1  # a decade nearer to 0 would lie on its tick
        axes.set_xticks([0.0, *(10.0**n for n in range(first, top + 1))])
    if design.capturing is not None:
        axes.axvspan(*design.capturing, color=style.GREEN, alpha=0.15, lw=0)
    if design.met and design.scene is not None:
        c_A = design.scene.buffer.c_A
        axes.axvline(c_A, color=style.BLACK, lw=2.0, label=f"chosen: {c_A:.3g} N s/m")
    axes.set_ylim(bottom=0.0)
    axes.set_xlabel("axial damping  [N s/m]")
    axes.set_ylabel("nearest to the centre of BE  [mm]")
    title = "Damper by the verdict" if design.met else "No damper meets the target"
    axes.set_title(title, fontsize=15)
    if trials:
        axes.legend(fontsize=12.5)


def draw_trade_off(designs: Sequence[Design]) -> Figure:
    """Return a figure of peak force over axial stroke, and of the springs that it takes."""
    figure, [[force, buffer]] = subplots(13.0, 5.6, 1, 2)
    good = [d for d in designs if d.met]
    stroke = [d.target.axial_stroke * 1e3 for d in good]
    for label, load, colour, line in (
        ("peak normal force, whole run", "max_normal_force", style.DARK, "o-"),
        ("peak force of the buffer, whole run", "max_buffer_force", style.BLUE, "^-"),
    ):
        values = [d.outcome.loads[load] for d in good if d.outcome is not None]
        force.plot(stroke, values, line, color=colour, label=label)
    first_touch = [d.damped.peak_force for d in good if d.damped is not None]
    label = "peak normal force, first contact"
    force.plot(stroke, first_touch, "s-", color=style.GREY, label=label)
    force.set_ylabel("force  [N]")
    force.set_title("Force against stroke", fontsize=15)
    for name, unit, colour in (
        ("k_A", "N/m", style.BLUE),
        ("k_T", "N m/rad", style.VERMILION),
        ("c_A", "N s/m", style.BLACK),
    ):
        values = [getattr(d.scene.buffer, name) for d in good if d.scene is not None]
        buffer.plot(stroke, values, "o-", color=colour, label=f"{name}  [{unit}]")
    low, high = np.array([d.capturing or (math.nan, math.nan) for d in good]).reshape(-1, 2).T
    buffer.fill_between(stroke, low, high, color=style.GREEN, alpha=0.2, lw=0)
    buffer.set_yscale("log")
    buffer.set_title("The buffer (shaded: dampers that capture)", fontsize=15)
    refused = [d.target.axial_stroke * 1e3 for d in designs if not d.met]
    for axes in (force, buffer):
        for place in refused:
            note = "no buffer meets the target" if place == refused[0] else None
            axes.axvline(place, color=style.GREY, ls=":", lw=1.5, label=note)
        axes.set_xlabel("target axial stroke  [mm]")
        axes.legend(fontsize=12, loc="upper left", framealpha=1.0)
    force.set_ylim(0.0, 1.45 * force.get_ylim()[1])
    low_end, high_end = buffer.get_ylim()
    buffer.set_ylim(low_end, high_end * 8.0)
    return figure


_BOUNDARY = style.BLACK
# of the axes, as a person reads them: title, unit, how many to the SI unit
_SHOWN = (
    ("angle of the target", "deg", math.degrees(1.0)),
    ("lateral offset", "mm", 1e3),
    ("speed at the touch", "m/s", 1.0),
)


def draw_envelope(envelope: Envelope, marks: Sequence[ViewableRun] = ()) -> Figure:
    """Return the figure of a map: a panel for each slice.

    ``marks`` are runs of experiments; each is marked in the slice it belongs to (where it
    does not belong to one, in none), with what came of it.
    """
    slices = envelope.plan.slices
    columns = min(len(slices), 3)
    rows = math.ceil(len(slices) / columns)
    size = (1.5 + 5.6 * columns, 1.6 + 5.0 * rows)
    figure, panels = subplots(*size, rows, columns, grid=None, font=12.0)
    for number, panel in enumerate(panels.flat):
        if number < len(slices):
            _draw_slice(panel, envelope, number)
            _mark(panel, envelope, number, marks)
        else:
            panel.set_axis_off()
    patches = [
        Patch(color=look.colour, label=state.label) for state, look in style.VERDICTS.items()
    ]
    patches.append(Patch(color=_BOUNDARY, label="holds the boundary"))
    # no wider than one panel, where there is no more
    across = 5 if columns > 1 else 2
    figure.legend(handles=patches, loc="outside lower center", ncols=across, fontsize=12)
    title = f"Capture envelope of {envelope.plan.scene.name}: {len(envelope.rows)} runs"
    figure.suptitle(title, fontsize=16 if columns > 1 else 13)
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
        envelope.is_boundary(cell) and _hangs_on_tolerance(envelope, cell) for cell in cells
    ]
    if any(doubtful):
        x, y = outline[doubtful].mean(axis=1).T
        axes.plot(x, y, "x", color=style.VERMILION, ms=6, mew=1.6, label="ill-conditioned")
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
    return style.VERDICTS[CaptureState(verdicts[counts.argmax()])].colour


def _mark(axes: Axes, envelope: Envelope, number: int, marks: Sequence[ViewableRun]) -> None:
    plan = envelope.plan
    (across, _), (up, _) = plan.plane
    for run in marks:
        approach = approach_of(run.scene)
        if not math.isclose(approach[plan.sliced], plan.slices[number], rel_tol=1e-6, abs_tol=1e-9):
            continue
        x, y = (approach[axis] * _SHOWN[axis][2] for axis in (across, up))
        axes.plot(x, y, "o", mfc="white", mec=style.BLACK, ms=8, mew=1.8)
        axes.annotate(
            f"{run.scene.name}\n{verdict(run)}",
            (x, y),
            xytext=(0, 9),
            textcoords="offset points",
            ha="center",
            fontsize=10.5,
            bbox={"facecolor": "white", "edgecolor": "none", "alpha": 0.75, "pad": 1},
        )


def draw_tornado(found: Local) -> Figure:
    """Return a figure with a panel for each quantity: bars over each parameter's spread.

    A tick on a bar is what the derivative promises; a cross, that the derivative is
    ill-conditioned; a ring, that the verdict is another one at that end.
    """
    figure, panels = subplots(19.0, 12.0, 2, 3, grid="x", font=13.0)
    for q, (panel, quantity) in enumerate(zip(panels.flat, SMOOTH, strict=False)):
        _draw_bars(panel, found, q, quantity)
    marks = (
        ("|", 14, "by the derivative"),
        ("x", 9, "ill-conditioned"),
        ("o", 11, "verdict flips"),
    )
    panels[-1, -1].set_axis_off()
    panels[-1, -1].legend(
        handles=[
            Patch(color=_BELOW, label="parameter below by its spread"),
            Patch(color=_ABOVE, label="parameter above by its spread"),
            *(
                Line2D(
                    [], [], ls="", marker=marker, mfc="none", color="k", ms=size, mew=2, label=text
                )
                for marker, size, text in marks
            ),
        ],
        loc="center",
        fontsize=15,
    )
    return figure


def _draw_bars(axes: Axes, found: Local, q: int, quantity: Quantity) -> None:
    _, title, unit, factor = quantity
    low = (found.low[:, q] - found.base[q]) * factor
    high = (found.high[:, q] - found.base[q]) * factor
    order = np.argsort(np.maximum(np.abs(low), np.abs(high)))
    for place, p in enumerate(order):
        axes.barh(place, low[p], color=_BELOW, height=0.75)
        axes.barh(place, high[p], color=_ABOVE, height=0.75)
        derivative = found.derivatives[p][q]
        promised = derivative.value * factor
        if derivative.converged:
            axes.plot([-promised, promised], [place, place], "|", color="k", ms=12, mew=2)
        else:
            axes.plot(0.0, place, "x", color="k", ms=8, mew=2, zorder=3)
        for end, values in ((low[p], found.low), (high[p], found.high)):
            if values[p, -1] != found.base[-1]:
                axes.plot(end, place, "o", mfc="none", color="k", ms=10, mew=1.8, zorder=3)
    axes.set_yticks(range(len(order)), [_label(found.parameters[p]) for p in order], **_TIGHT)
    axes.axvline(0.0, color=style.BLACK, lw=0.8)
    reach = max(float(np.abs([low, high]).max()), 1e-12) * 1.15
    axes.set_xlim(-reach, reach)
    axes.set_xlabel(f"change  [{unit}]")
    axes.set_title(f"{title}: {found.base[q] * factor:.4g} {unit}", fontsize=14)


def _label(parameter: Parameter) -> str:
    name = parameter.name
    if len(name) > 24:  # two lines, or it takes the bars' room
        middle = name.rfind("_", 0, 20) + 1
        name = f"{name[:middle]}\n{name[middle:]}"
    return f"{name} ±{parameter.displayed_spread}"


def draw_indices(found: Global) -> Figure:
    """Return a figure of Morris' or Sobol's indices: a panel for each quantity."""
    figure, panels = subplots(19.0, 12.0, 2, 3, grid="x", font=13.0)
    morris = found.method == "morris"
    for q, (panel, (_, title, unit, factor)) in enumerate(
        zip(panels.flat, QUANTITIES, strict=True)
    ):
        indices = np.stack([found.total[:, q], found.first[:, q], found.confidence[:, q]])
        total, first, spread = indices * (factor if morris else 1.0)
        if np.isnan(total).all():
            panel.set_axis_off()
            panel.set_title(f"{title}: the same in every run", fontsize=14)
            continue
        order = np.argsort(total)
        places = np.arange(len(order))
        panel.barh(places, total[order], color=_BELOW, height=0.75, xerr=spread[order])
        panel.plot(first[order], places, "D", color=style.BLACK, ms=6)
        panel.set_yticks(places, [_label(found.parameters[p]) for p in order], **_TIGHT)
        panel.set_xlim(left=min(0.0, float(np.nanmin(first)) * 1.1))
        panel.set_xlabel(f"effect  [{unit}]" if morris else "share of the variance")
        panel.set_title(title, fontsize=14)
    what = (
        "bars: mean magnitude of the elementary effects, over the whole spread (95 %); "
        "diamonds: their scatter"
        if morris
        else "bars: total index (95 %); diamonds: first-order index"
    )
    figure.suptitle(f"{found.method.capitalize()}, {found.runs} runs; {what}", fontsize=15)
    return figure


_BEFORE = 0.05  # share of the window that is shown before the first contact


def draw_comparison(runs: Sequence[Comparable], labels: Sequence[str], window: float) -> Figure:
    """Draw what was measured in two runs over each other, and where the vehicles went.

    A touch lasts about a millisecond, so it is drawn as what was located: a stem up to its
    peak, with a bar under it that is as wide as the touch and whose area is its impulse.  Only
    where touches are not known the sampled force is drawn, with its samples.

    Parameters
    ----------
    runs, labels
        Two; first contact at t = 0.
    window
        s that are shown.
    """
    figure, all_axes = subplots(9.0, 11.5, 5, 1, font=11.5, sharex=True)
    force, impulse, stroke, torsion, relative = all_axes.flat
    first = -_BEFORE * window
    for run, name, colour, line, mark in zip(
        runs, labels, style.RUNS, ("-", "--"), ("o", "D"), strict=False
    ):
        measured = run.measured(force=True).shifted(-run.contact)
        look: dict[str, Any] = {"color": colour, "linestyle": line, "linewidth": 1.6}
        if run.touches is None:
            _draw_sampled_force(force, measured.force, run, name, (first, window), colour)
        else:
            touches = run.touches.within(run.contact, window)
            draw_touches(force, touches, name, colour, mark)
            t, total = impulse_so_far(touches, window)
            if np.isfinite(total).all():
                impulse.plot(t, total * 1e3, **look)
        for axes, series, quantity in (
            (stroke, measured.stroke, STROKE),
            (torsion, measured.torsion, TORSION),
        ):
            shown = (series.t >= first) & (series.t <= window)
            axes.plot(series.t[shown], series.values[shown] * quantity.factor, **look)
            axes.set_ylabel(f"{quantity.label}\n[{quantity.unit}]")
        chaser, target = measured.chaser, measured.target
        if chaser.t.size and target.t.size:
            t = chaser.t[(chaser.t >= first) & (chaser.t <= window)]
            gap, at_contact = (
                _x(target.t, target.values, at) - _x(chaser.t, chaser.values, at)
                for at in (t, np.zeros(1))
            )
            relative.plot(t, (gap - at_contact) * 1e3, **look)
    force.set_ylabel("peak of each touch\n[N]")
    force.set_ylim(bottom=0.0)
    force.legend(loc="upper right", frameon=False)
    impulse.set_ylabel("impulse so far\n[mN s]")
    if not impulse.lines:
        impulse.text(0.5, 0.5, "not known of either", ha="center", transform=impulse.transAxes)
    relative.set_ylabel("gap of the vehicles\nsince contact  [mm]")
    relative.set_xlabel("time after the first contact  [s]")
    relative.set_xlim(first, window)
    for axes, name in ((stroke, "stroke"), (torsion, "torsion"), (relative, "chaser")):
        sources = dict.fromkeys(run.sources[name] for run in runs if name in run.sources)
        axes.set_title(" and ".join(sources), loc="right", fontsize="small", color=style.DARK)
    for axes in figure.axes:
        axes.axvline(0.0, color=style.GREY, linewidth=0.8)
    figure.align_ylabels()
    return figure


def draw_touches(ax: Axes, touches: Touches, label: str, colour: str, mark: str) -> None:
    """Draw each touch as a stem up to its peak, and a bar whose area is its impulse."""
    ax.vlines(touches.peak_time, 0.0, touches.peak, color=colour, linewidth=1.2)
    look: dict[str, Any] = {"color": colour, "fillstyle": "none", "linestyle": "none"}
    ax.plot(touches.peak_time, touches.peak, mark, label=label, **look)
    known = touches.lasted > 0.0
    ax.bar(
        touches.start[known],
        touches.impulse[known] / touches.lasted[known],
        width=touches.lasted[known],
        align="edge",
        color=colour,
        alpha=0.25,
    )


def _draw_sampled_force(
    ax: Axes, series: Series, run: Comparable, name: str, shown: tuple[float, float], colour: str
) -> None:
    inside = (series.t >= shown[0]) & (series.t <= shown[1])
    label = f"{name}: no touches known"
    if inside.any():
        label = f"{name}: samples, {run.sources['force']}; touches between them do not show"
    ax.plot(series.t[inside], series.values[inside], ".", color=colour, label=label)


def impulse_so_far(touches: Touches, window: float) -> tuple[np.ndarray, np.ndarray]:
    """Return times and the impulse until then, N s; over a touch it grows evenly."""
    start, lasted = touches.start, np.maximum(touches.lasted, 1e-9)
    t = np.sort(np.concatenate([[0.0, window], start, start + lasted]))
    share = np.clip((t[:, None] - start) / lasted, 0.0, 1.0)
    return t, np.asarray(share @ touches.impulse)


def _x(t: np.ndarray, poses: np.ndarray, at: np.ndarray) -> np.ndarray:
    return np.interp(at, t, poses[:, 0])
