"""Data of a run for plots, reports and rerun: its touches, its window, its captions."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Sequence

import numpy as np

from capture_sim.dynamics.samples import EventKind
from capture_sim.errors import CaptureSimError
from capture_sim.run.first_contact import first_touch, impact_speed
from capture_sim.run.run import Run
from capture_sim.run.simulation import RunError, applied_again, simulate
from capture_sim.scene.parts import Scene, as_name

#: Width of the drawn time of a run of one sample, s.
SHORTEST_WINDOW = 1e-3
#: Number of samples in each touch and in a window.
_PER_TOUCH, _PER_WINDOW = 40, 4000


def verdict(run: Run) -> str:
    """Return the label of the detector's last status, or ``no verdict``."""
    if not run.statuses:
        return "no verdict"
    return run.statuses[-1].label


def start_word(scene: Scene) -> str:
    """Return the word for t = 0: bodies in free flight are not released."""
    return "release" if scene.string is not None else "start"


def distinct_names(names: Sequence[str]) -> list[str]:
    """Number names that occur more than once, so that all differ."""
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
    """Return the touches (m,) of dtype TOUCH, including a touch in progress at the run's end.

    Such a touch ends at the last sample.  Its peak was not located, so it is the peak of the
    samples.
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
    """Return time, s, and peak force, N, of the strongest touch; NaN and 0 if none is known."""
    touches = every_touch(run)
    touches = touches[np.isfinite(touches["peak_force"])]
    if not touches.size:
        return math.nan, 0.0
    touch = touches[touches["peak_force"].argmax()]
    return float(touch["peak_time"]), float(touch["peak_force"])


def time_window(run: Run) -> tuple[float, float]:
    """Return start and end of the time around contact and verdict, s.

    A run without a verdict, e.g. one that ended early, is shown to its end.
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
    # a verdict may even precede the touch
    margin = 0.12 * max(max(times) - min(times), 0.1)
    start, end = max(float(t[0]), min(times) - margin), min(float(t[-1]), max(times) + margin)
    # the samples may be of a window without any of it
    return (start, end) if start < end else whole


def normal_force_with_peaks(run: Run) -> tuple[np.ndarray, np.ndarray]:
    """Return times (n,), s, and normal force of both walls (n,), N, with every touch in it.

    Start, located peak and end of each touch are inserted between the samples, because most
    touches are shorter than a sample period.  So is the trace if the run has one.
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
    """Return False if no contact force was measured, or no sensor of it is used."""
    return bool(np.isfinite(run.samples["normal_force"]).any())


def headline(run: Run, label: str | None = None, width: int = 95) -> str:
    """Return a line with name, verdict and impact speed, then lines of changes and problems.

    The name is the label, with the scene's name after it unless it contains that; without a label
    the scene's.  Lines of more than ``width`` letters are wrapped or shortened.
    """
    scene = run.drawn_scene.name
    name = scene if label is None else label
    if not as_name(name).startswith(scene) and f"-{scene}" not in name:
        name += f" ({scene})"
    speed = impact_speed(run.events)
    impact = "no touch" if speed is None else f"impact at {speed:.3f} m/s"
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
    """Return whether the tip touches at each sample or before the next, (n,) bool.

    So touches shorter than a sample period count.
    """
    t = run.samples["t"]
    touching: np.ndarray = run.samples["walls"] != 0
    for touch in run.touches:
        first = int(np.searchsorted(t, touch["start"], side="right")) - 1
        last = int(np.searchsorted(t, touch["end"], side="left"))
        touching[max(first, 0) : last] = True
    return touching


def decided_at(run: Run) -> float | None:
    """Return the time of the verdict, s since the release; None without one."""
    return next((status.t for status in run.statuses if status.state.is_verdict), None)


def resolved(run: Run, window: tuple[float, float] | None = None) -> Run:
    """Return a run with samples in every touch: its scene is simulated again.

    With a window (start and end, s since the release) only that part is returned, with about 4000
    further samples.  CaptureSimError if the window is empty, or if this version of the simulator
    gives touches that differ from the run's.
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
    """Return the run resolved, or unchanged if it cannot be simulated again."""
    if not run.is_exact:
        return run
    try:
        return resolved(run)
    except CaptureSimError:
        return run


def _are_equal(touches_a: np.ndarray, touches_b: np.ndarray) -> bool:
    """Return True if the touches of two runs are equal to 1 us."""
    return len(touches_a) == len(touches_b) and bool(
        np.array_equal(touches_a["wall"], touches_b["wall"])
        and np.allclose(touches_a["start"], touches_b["start"], rtol=0.0, atol=1e-6)
    )
