"""Plots of studies: the paper's design flow, and two runs compared."""

from __future__ import annotations

import math
from collections.abc import Sequence
from contextlib import suppress
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from capture_sim.errors import CaptureSimError
from capture_sim.run.run import Run
from capture_sim.run.series import NO_SERIES, Series
from capture_sim.run.touches import Touches
from capture_sim.studies.search.paper_flow import FirstContactDesign
from capture_sim.viewing import source, style
from capture_sim.viewing.canvas import subplots
from capture_sim.viewing.curves import STROKE, TORSION

if TYPE_CHECKING:
    from capture_sim.studies.compare.compare import Side


def draw_first_contact_design(design: FirstContactDesign) -> Figure:
    """Return a figure of the paper's design flow.

    The left panel has the relative error of both strokes in each run of the search for springs.
    The right panel has the closest approach to BE over the damping, coloured by the verdict.  If no
    damper meets a limit of the force, it has the peak force instead.
    """
    figure, [[strokes, dampers]] = subplots(13.0, 5.6, 1, 2)
    _draw_strokes(strokes, design)
    _draw_dampers(dampers, design)
    return figure


def _draw_strokes(axes: Axes, design: FirstContactDesign) -> None:
    target = design.target
    runs = [trial for trial in design.history if trial.verdict is None]
    number = np.arange(1, len(runs) + 1)
    for values, name, colour in (
        ([run.axial_stroke / target.axial_stroke for run in runs], "axial", style.BLUE),
        ([run.torsion / target.torsion for run in runs], "torsional", style.VERMILION),
    ):
        error = np.maximum(np.abs(np.array(values) - 1.0), 1e-6)
        axes.plot(number, error, "o-", color=colour, label=f"{name} stroke")
    axes.set_yscale("log")
    axes.set_xlabel("run")
    axes.set_ylabel("error of the stroke, relative")
    axes.set_title("Springs for the strokes of the first contact", fontsize=15)
    axes.legend(fontsize=12.5)


def _draw_dampers(axes: Axes, design: FirstContactDesign) -> None:
    trials = [trial for trial in design.history if trial.verdict is not None]
    limit = design.target.peak_force
    # captures that exceed the limit of the force: the distance would not show why there is none
    by_force = limit is not None and not design.met and any(t.verdict == "captured" for t in trials)
    for verdict, (colour, marker, _) in style.VERDICTS.items():
        matching_trials = [trial for trial in trials if trial.verdict == verdict]
        if matching_trials:
            axes.plot(
                [trial.c_A for trial in matching_trials],
                [t.peak_force if by_force else t.nearest * 1e3 for t in matching_trials],
                marker,
                color=colour,
                label=verdict,
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
    if by_force and limit is not None:
        label = f"limit of the force: {limit:.4g} N"
        axes.axhline(limit, color=style.BLACK, ls="--", lw=1.5, label=label)
    quantity = "peak normal force  [N]" if by_force else "closest approach to BE  [mm]"
    axes.set_ylabel(quantity)
    title = "Damper by the verdict" if design.met else "No damper meets the target"
    axes.set_title(title, fontsize=15)
    if trials:
        axes.legend(fontsize=12.5)


_BEFORE = 0.05  # share of the window that is shown before the first contact


def draw_comparison(runs: Sequence[Side], labels: Sequence[str], window: float) -> Figure:
    """Draw the measurements of two runs in common axes; the first contact of each is at t = 0.

    The panels are the touches, the impulse so far (N s, newton seconds), stroke, torsion, and the
    change of the distance in x between the vehicles since the first contact.

    A touch is too short (less than 1 ms) for a curve.  It is drawn as a stem up to its peak, with a
    bar that is as wide as the touch and whose area is its impulse.  If the touches of a run are not
    known, the samples of its force are drawn instead.

    Parameters
    ----------
    runs, labels
        Two runs, and one name for each.
    window
        Drawn time after the first contact, s; 5 % of it is also drawn before the first contact.
    """
    figure, all_axes = subplots(9.0, 11.5, 5, 1, font=11.5, sharex=True)
    force, impulse, stroke, torsion, relative = all_axes.flat
    first = -_BEFORE * window
    for run, name, colour, line, mark in zip(
        runs, labels, style.RUNS, ("-", "--"), ("o", "D"), strict=False
    ):
        measured = {
            quantity: series._replace(t=series.t - run.contact)
            for quantity, series in run.series.items()
        }
        look: dict[str, Any] = {"color": colour, "linestyle": line, "linewidth": 1.6}
        if run.touches is None:
            _draw_sampled_force(
                force, measured.get("force", NO_SERIES), run, name, (first, window), colour
            )
        else:
            touches = run.touches.within(run.contact, window)
            draw_touches(force, touches, name, colour, mark)
            t, total = impulse_so_far(touches, window)
            if np.isfinite(total).all():
                impulse.plot(t, total, drawstyle="steps-post", **look)
        for axes, key, quantity in ((stroke, "stroke", STROKE), (torsion, "torsion", TORSION)):
            series = measured.get(key, NO_SERIES)
            shown = (series.t >= first) & (series.t <= window)
            axes.plot(series.t[shown], series.values[shown] * quantity.factor, **look)
            axes.set_ylabel(f"{quantity.label}\n[{quantity.unit}]")
        if "chaser" in measured and "target" in measured:
            chaser, target = measured["chaser"], measured["target"]
            t = chaser.t[(chaser.t >= first) & (chaser.t <= window)]
            gap, at_contact = (
                _x(target.t, target.values, at) - _x(chaser.t, chaser.values, at)
                for at in (t, np.zeros(1))
            )
            relative.plot(t, (gap - at_contact) * 1e3, **look)
    for axes, key, quantity in ((stroke, "stroke", STROKE), (torsion, "torsion", TORSION)):
        _draw_difference(axes, runs, key, quantity.factor, (first, window))
    figure.suptitle(
        "\n".join(_headline(name, side.run) for name, side in zip(labels, runs, strict=True))
    )
    force.set_ylabel("peak of each touch\n[N]")
    if any(run.touches is not None for run in runs):
        text = "bar under a stem: as wide as the touch, its area is the impulse"
        force.set_title(text, loc="left", fontsize="small", color=style.DARK)
    force.set_ylim(bottom=0.0)
    force.legend(loc="upper right", frameon=False)
    impulse.set_ylabel("impulse so far\n[N s]")
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


def _headline(name: str, run: Run) -> str:
    """Return the name of a run and its verdict, if its measurements give one."""
    with suppress(CaptureSimError):  # without a scene, or with doubts that refuse it
        return f"{name}: {source.verdict(run)}"
    return name


def _draw_difference(
    axes: Axes, runs: Sequence[Side], key: str, factor: float, shown: tuple[float, float]
) -> None:
    """Draw a series of the second run less that of the first, if both have it."""
    if not all(key in side.series for side in runs):
        return
    a, b = ((side.series[key].t - side.contact, side.series[key].values) for side in runs)
    low, high = max(shown[0], a[0][0], b[0][0]), min(shown[1], a[0][-1], b[0][-1])
    t = a[0][(a[0] >= low) & (a[0] <= high)]
    difference = np.interp(t, *b) - np.interp(t, *a)
    axes.plot(t, difference * factor, color=style.GREY, linewidth=1.0, label="B - A")
    axes.legend(loc="lower left", frameon=False, fontsize="small")


def draw_touches(ax: Axes, touches: Touches, label: str, colour: str, mark: str) -> None:
    """Draw each touch as a stem up to its peak (N), and as a bar whose area is its impulse (N s).

    A touch of unknown duration has no bar.
    """
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
    ax: Axes, series: Series, run: Side, name: str, shown: tuple[float, float], colour: str
) -> None:
    inside = (series.t >= shown[0]) & (series.t <= shown[1])
    label = f"{name}: no touches known"
    if inside.any():
        label = f"{name}: samples, {run.sources['force']}; touches between them do not show"
    ax.plot(series.t[inside], series.values[inside], ".", color=colour, label=label)


def impulse_so_far(touches: Touches, window: float) -> tuple[np.ndarray, np.ndarray]:
    """Return times (m,), s, ascending, and the impulse of all touches up to each time, (m,), N s.

    Within a touch the impulse grows linearly.  If the impulse or the duration of a touch is unknown
    (NaN), the impulses are NaN.
    """
    start, lasted = touches.start, np.maximum(touches.lasted, 1e-9)
    t = np.sort(np.concatenate([[0.0, window], start, start + lasted]))
    share = np.clip((t[:, None] - start) / lasted, 0.0, 1.0)
    return t, np.asarray(share @ touches.impulse)


def _x(t: np.ndarray, poses: np.ndarray, at: np.ndarray) -> np.ndarray:
    return np.interp(at, t, poses[:, 0])
