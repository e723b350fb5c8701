"""Data of a run that plots, report and rerun need: touches, time to draw, captions."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Sequence

import numpy as np

from capture_sim.detection.criteria import CaptureState
from capture_sim.dynamics.samples import EventKind
from capture_sim.errors import CaptureSimError
from capture_sim.run.first_contact import first_touch, impact_speed
from capture_sim.run.run import Run
from capture_sim.run.simulation import RunError, applied_again, simulate
from capture_sim.scene.parts import Scene, as_name

#: Shortest time that is drawn, s: a run may have one sample only.
SHORTEST_WINDOW = 1e-3
#: Number of samples in each touch and in a window.
_PER_TOUCH, _PER_WINDOW = 40, 4000


def verdict(run: Run) -> str:
    """Return the label of the detector's last status, or ``no verdict`` if it has given none."""
    if not run.statuses:
        return "no verdict"
    return run.statuses[-1].label


def start_word(scene: Scene) -> str:
    """Return the word for t = 0 in texts: ``release``, or ``start`` if the scene has no string.

    Without a string the bodies fly freely from the start, so nothing is released.
    """
    return "release" if scene.string is not None else "start"


def distinct_names(names: Sequence[str]) -> list[str]:
    """Return the names with ``_1``, ``_2`` ... added to those that occur more than once.

    All returned names differ, and none of the added ones is a name that was given.
    """
    taken, distinct = set(names), []
    for name in names:
        number, numbered = 0, name
        while names.count(name) > 1 and numbered in taken:
            number += 1
            numbered = f"{name}_{number}"
        taken.add(numbered)
        distinct.append(numbered)
    return distinct


def every_touch(run: Run) -> np.ndarray:
    """Return all touches (m,) of dtype TOUCH, including a touch in progress at the last sample.

    ``run.touches`` may lack such a touch, e.g. if the recording was truncated.  It is given the
    last sample's time as its end.  Its peak was not located, so it is the largest force of the
    samples in it.
    """
    touches, samples = run.touches, run.samples
    t_end = samples["t"][-1]
    begins = [e for e in run.events if e.kind is EventKind.TOUCH and e.t <= t_end]
    unfinished = []
    for column, side in enumerate((1, -1)):
        starts = [event.t for event in begins if event.wall == side]
        if not starts or not samples["walls"][-1] & (1 << column):
            continue
        start = starts[-1]
        if not np.any(touches["end"][touches["wall"] == side] >= start):
            during = samples[samples["t"] >= start]
            force = np.nan_to_num(during["normal_force"][:, column])
            touch = np.zeros(1, touches.dtype)
            touch["wall"], touch["start"], touch["end"] = side, start, t_end
            touch["peak_time"] = during["t"][force.argmax()]
            touch["peak_force"] = force.max()
            unfinished.append(touch)
    return np.concatenate([touches, *unfinished])


def strongest(run: Run) -> tuple[float, float]:
    """Return the time, s since the release, and the force, N, of the highest peak of all touches.

    They are NaN and 0.0 if no touch has a known peak force.
    """
    touches = every_touch(run)
    touches = touches[np.isfinite(touches["peak_force"])]
    if not touches.size:
        return math.nan, 0.0
    touch = touches[touches["peak_force"].argmax()]
    return float(touch["peak_time"]), float(touch["peak_force"])


#: Times of the loads that pictures name.
_NAMED = tuple(f"max_{name}_time" for name in ("axial_stroke_in", "axial_stroke_out", "torsion"))
#: By how much they may lengthen the time that is drawn.
_LONGER = 4.0


def time_window(run: Run) -> tuple[float, float]:
    """Return the start and end of the time that is drawn by default, s since the release.

    It contains the touches, the latch's closing, the verdict and the largest strokes and torsion
    (unless these make it :data:`_LONGER` times as long), with a margin of 12 % (at least 12 ms) on
    either side, as far as there are samples.  If the detector has given statuses but no
    verdict, e.g. because the run ended early, it extends to the last sample.  Of a run without a
    touch, or without samples in this time, it is the time of all samples.
    """
    t = run.samples["t"]
    touch = first_touch(run.events)
    whole = float(t[0]), max(float(t[-1]), float(t[0]) + SHORTEST_WINDOW)
    if touch is None:
        return whole
    times = [touch.t, *every_touch(run)["end"].tolist()]
    times += [e.t for e in run.events if e.kind is EventKind.LATCHED]
    decided = decided_at(run)
    if decided is not None:
        times.append(decided)
    elif run.statuses:
        times.append(float(t[-1]))
    limit = min(times) + _LONGER * max(max(times) - min(times), 0.1)
    times += [at for at in map(run.loads.get, _NAMED) if at is not None and min(times) < at < limit]
    # a verdict may even precede the touch
    margin = 0.12 * max(max(times) - min(times), 0.1)
    start, end = max(float(t[0]), min(times) - margin), min(float(t[-1]), max(times) + margin)
    # the samples may be of a window without any of it
    return (start, end) if start < end else whole


def normal_force_with_peaks(run: Run) -> tuple[np.ndarray, np.ndarray]:
    """Return times (n,), s since the release, and the sum of both walls' normal forces (n,), N.

    The start, located peak and end of each touch are inserted between the samples, because most
    touches are shorter than a sample period.  If the run has a trace, i.e. the contact at the
    integrator's own steps (``run.trace``), the trace is inserted too.
    """
    touches, samples = run.touches, run.samples
    trace = run.trace
    zeros = np.zeros(len(touches))
    sampled = [samples["normal_force"].sum(axis=1), trace["normal_force"].sum(axis=1)]
    t = np.concatenate(
        [samples["t"], trace["t"], touches["start"], touches["peak_time"], touches["end"]]
    )
    force = np.concatenate([*sampled, zeros, touches["peak_force"], zeros])
    t, first = np.unique(t, return_index=True)
    return t, force[first]


def has_force(run: Run) -> bool:
    """Return True if at least one sample has a contact force, simulated or measured."""
    return bool(np.isfinite(run.samples["normal_force"]).any())


def headline(run: Run, label: str | None = None, width: int = 95) -> str:
    """Return a caption: a line with name, verdict and impact speed, then up to two further lines.

    The name is ``label``, followed by the scene's name in brackets unless the label begins with
    that name or has it after a hyphen.  Without a label it is the scene's name.  The further lines
    list the values that were changed in the scene, and the first problem of an incomplete run.
    Lines of more than ``width`` letters are wrapped or shortened.
    """
    scene = run.drawn_scene.name
    name = scene if label is None else label
    if not as_name(name).startswith(scene) and f"-{scene}" not in name:
        name += f" ({scene})"
    speed = impact_speed(run.events)
    impact = "no touch" if speed is None else f"impact at {speed:.3f} m/s"
    if speed is None and verdict(run) == CaptureState.UNDECIDED.label:
        impact = "ended before a contact"
    if speed is not None and math.isnan(speed):
        impact = "impact speed not measured"
    lines = [f"{name}: {verdict(run)}, {impact}"]
    if len(lines[0]) > width:
        # a long name is wrapped at any letter
        lines = [*textwrap.wrap(f"{name}:", width), f"{verdict(run)}, {impact}"]
    changed = run.scene.title.partition("; with ")[2]
    if changed:
        lines.append("with " + textwrap.shorten(changed, width - 5, placeholder=" ..."))
    if run.problems:
        incomplete = f"INCOMPLETE: {run.problems[0]}"
        lines.append(textwrap.shorten(incomplete, width, placeholder=" ..."))
    return "\n".join(lines)


def in_contact(run: Run) -> np.ndarray:
    """Return for each sample whether the tip touches the cone then or before the next one.

    The result is (n,) bool.  A touch that is shorter than a sample period thus counts as contact
    at the sample before it.
    """
    t = run.samples["t"]
    touching: np.ndarray = run.samples["walls"] != 0
    for touch in run.touches:
        first = int(np.searchsorted(t, touch["start"], side="right")) - 1
        last = int(np.searchsorted(t, touch["end"], side="left"))
        touching[max(first, 0) : last] = True
    return touching


def decided_at(run: Run) -> float | None:
    """Return the time of the first verdict, s since the release; None if there is no verdict."""
    return next((status.t for status in run.statuses if status.state.is_verdict), None)


def resolved(run: Run, window: tuple[float, float] | None = None) -> Run:
    """Return a copy of a simulated run with additional samples in every touch.

    The samples come from a new simulation of the run's scene; the touches, events and statuses
    remain those of the run.  With a window (start and end, s since the release), the samples are
    only those in the window, with 4000 further ones evenly spread over it.

    Raises
    ------
    CaptureSimError
        The window contains no time of the run, or the new simulation has other touches than the
        run, e.g. because another version of the simulator has made the run, or the run's thrusters
        were commanded by a controller, which is not available to repeat the run.
    """
    if run.is_exact and applied_again(run) is not None:
        raise CaptureSimError(
            f"{run.scene.name}: flown by a controller; only its samples are drawn"
        )
    grid, touches = np.asarray(run.samples["t"]), run.touches
    start, end = (float(grid[0]), float(grid[-1])) if window is None else window
    times = [grid[(grid >= start) & (grid <= end)]]
    for touch in touches[(touches["end"] >= start) & (touches["start"] <= end)]:
        times.append(np.linspace(touch["start"], touch["end"], _PER_TOUCH))
        times.append(touch["peak_time"][None])
    if window is not None:
        times.append(np.linspace(start, end, _PER_WINDOW))
    t_eval = np.unique(np.concatenate(times))
    t_eval = t_eval[(t_eval >= start) & (t_eval <= min(end, grid[-1]))]
    if not t_eval.size:
        raise CaptureSimError(
            f"{run.scene.name}: no motion from {start:g} to {end:g} s; it lasts to {grid[-1]:g} s"
        )
    try:
        again = simulate(run.scene, t_eval=t_eval)
    except RunError as error:
        again = error.result
    if not _are_equal(again.touches, touches):
        raise CaptureSimError(
            f"{run.scene.name}: this version of the simulator computes other touches than the run "
            "has; only its samples can be drawn"
        )
    # the detector evaluated the run's own samples
    return run.replaced(samples=again.samples, statuses=run.statuses)


def resolved_or_not(run: Run) -> Run:
    """Return the run as :func:`resolved` does, or the run itself if that is not possible.

    It is not possible for a measured run, and where :func:`resolved` raises CaptureSimError.
    """
    if not run.is_exact:
        return run
    try:
        return resolved(run)
    except CaptureSimError:
        return run


def _are_equal(touches_a: np.ndarray, touches_b: np.ndarray) -> bool:
    """Return True if two runs touch the same walls in the same order, with starts equal to 1 us."""
    return len(touches_a) == len(touches_b) and bool(
        np.array_equal(touches_a["wall"], touches_b["wall"])
        and np.allclose(touches_a["start"], touches_b["start"], rtol=0.0, atol=1e-6)
    )
