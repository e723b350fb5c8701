"""What the viewing needs of a run, wherever it comes from."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from capture_sim.detection.exact import CaptureStatus
from capture_sim.errors import CaptureSimError, SimulationError
from capture_sim.results import impact_speed, summarize
from capture_sim.samples import Event, EventKind, Extremes
from capture_sim.scene.parts import Scene, as_name
from capture_sim.simulation import Result, simulate

# samples over the length of each touch, and over a window that is asked for
_PER_TOUCH, _PER_WINDOW = 40, 4000


class ViewableRun(Protocol):
    """A run that can be drawn: a Result of the core, or a Run read from a file."""

    @property
    def scene(self) -> Scene:
        """What was on the bench."""

    @property
    def samples(self) -> np.ndarray:
        """(n,) of dtype SAMPLE, by time."""

    @property
    def touches(self) -> np.ndarray:
        """(m,) of dtype TOUCH, by their end."""

    @property
    def events(self) -> Sequence[Event]:
        """By time."""

    @property
    def extremes(self) -> Extremes | None:
        """Of the integrator's own steps, where they are known."""

    @property
    def trace(self) -> np.ndarray | None:
        """(k,) with the fields of TRACE, by time: the contact, where it was asked for."""

    @property
    def statuses(self) -> Sequence[CaptureStatus]:
        """The detector's judgements, by time."""

    @property
    def problems(self) -> Sequence[str]:
        """Why the run or its recording is incomplete, in lines; empty if it is complete."""


def verdict(run: ViewableRun) -> str:
    """Return the detector's last word, or that there is none."""
    if not run.statuses:
        return "no verdict"
    return run.statuses[-1].label


@dataclass(frozen=True)
class Opened:
    """A run to be looked at.

    Attributes
    ----------
    run
        To be drawn.
    label
        Its name, no other's of those opened with it: the recording's, or the experiment's.
    source
        Where it comes from, in words.
    software
        ``"name version"`` each, of what made it.
    wall_time
        s, that it took; None where that is not known.
    problems
        What is wrong with its recording.
    measured
        Known from measurements alone: it cannot be run again.
    """

    run: ViewableRun
    label: str
    source: str
    software: Sequence[str]
    wall_time: float | None = None
    problems: Sequence[str] = ()
    measured: bool = False


def summary_of(run: ViewableRun, wall_time: float | None) -> dict[str, Any]:
    """Return a run in a few numbers, as results.json has them."""
    bench = (run.scene, run.samples, run.touches, run.events)
    status = run.statuses[-1] if run.statuses else None
    return summarize(*bench, status, wall_time, run.extremes, run.problems)


def first_touch(run: ViewableRun) -> Event | None:
    """Return the event of the first touch."""
    return next((event for event in run.events if event.kind is EventKind.TOUCH), None)


def start_word(scene: Scene) -> str:
    """Return what a run of the scene begins with: bodies in free flight are not released."""
    return "release" if scene.string is not None else "start"


def distinct_names(names: Sequence[str]) -> list[str]:
    """Number names that occur more than once; no number makes one name another's."""
    taken, distinct = set(names), []
    for name in names:
        number = 0
        chosen = name
        while names.count(name) > 1 and chosen in taken:
            number += 1
            chosen = f"{name}_{number}"
        taken.add(chosen)
        distinct.append(chosen)
    return distinct


def every_touch(run: ViewableRun) -> np.ndarray:
    """Return the touches (m,) of dtype TOUCH, with those that a run broke off in the middle of.

    Those last to the last sample; their peak, which was not located, is that of the samples.
    """
    touches, samples = run.touches, run.samples
    began = [e for e in run.events if e.kind is EventKind.TOUCH and e.t <= samples["t"][-1]]
    broken_off = []
    for column, side in enumerate((1, -1)):
        if not samples["walls"][-1] & (1 << column):
            continue
        begun = [event.t for event in began if event.wall == side]
        if begun and not np.any(touches["end"][touches["wall"] == side] >= begun[-1]):
            within = samples[samples["t"] >= begun[-1]]
            force = np.nan_to_num(within["normal_force"][:, column])
            touch = np.zeros(1, touches.dtype)
            touch["wall"], touch["start"], touch["end"] = side, begun[-1], samples["t"][-1]
            touch["peak_time"] = within["t"][force.argmax()]
            touch["peak_force"] = force.max()
            broken_off.append(touch)
    return np.concatenate([touches, *broken_off])


def strongest(run: ViewableRun) -> tuple[float, float]:
    """Return when the tip was pressed most against a wall, s, and by how much, N; nan and 0."""
    touches = every_touch(run)
    if not touches.size:
        return math.nan, 0.0
    touch = touches[touches["peak_force"].argmax()]
    return float(touch["peak_time"]), float(touch["peak_force"])


def time_window(run: ViewableRun) -> tuple[float, float]:
    """Return from when to when something happens: shortly round contact and verdict, s.

    What has not been judged to its end, as a run that was broken off, is seen to its end.
    """
    t = run.samples["t"]
    touch = first_touch(run)
    if touch is None:
        return float(t[0]), float(t[-1])
    action = [touch.t, *every_touch(run)["end"].tolist()]
    action += [e.t for e in run.events if e.kind is EventKind.LATCHED]
    decided = decided_at(run)
    if decided is not None:
        action.append(decided)
    elif run.statuses:
        action.append(float(t[-1]))
    # a verdict may even fall before the touch
    margin = 0.12 * max(max(action) - min(action), 0.1)
    start, end = max(float(t[0]), min(action) - margin), min(float(t[-1]), max(action) + margin)
    # samples of a window that holds nothing of it
    return (start, end) if start < end else (float(t[0]), float(t[-1]))


def normal_force_with_peaks(run: ViewableRun) -> tuple[np.ndarray, np.ndarray]:
    """Return times (n,), s, and normal force of both walls (n,), N, with every touch in it.

    Start, located peak and end of each touch are put in between the samples: most touches are
    shorter than the distance of two samples and would not be seen.  So is the trace, where the
    run has one.
    """
    touches, samples = run.touches, run.samples
    trace = samples[:0] if run.trace is None else run.trace
    nothing = np.zeros(len(touches))
    sampled = [samples["normal_force"].sum(axis=1), trace["normal_force"].sum(axis=1)]
    t = np.concatenate(
        [samples["t"], trace["t"], touches["start"], touches["peak_time"], touches["end"]]
    )
    force = np.concatenate([*sampled, nothing, touches["peak_force"], nothing])
    t, first = np.unique(t, return_index=True)
    return t, force[first]


def headline(run: ViewableRun, label: str | None = None, width: int = 95) -> str:
    """Return name, verdict and impact speed in one line, and what was changed or is missing below.

    Parameters
    ----------
    run
        Of which.
    label
        Its name; None for its scene's.  One without the scene's name gets it behind it.
    width
        Letters in a line: what does not fit goes on in another, or is cut.
    """
    scene = run.scene.name
    name = scene if label is None else label
    if not as_name(name).startswith(scene) and f"-{scene}" not in name:
        name += f" ({scene})"
    speed = impact_speed(run.events)
    impact = "no touch" if speed is None else f"impact at {speed:.3f} m/s"
    lines = [f"{name}: {verdict(run)}, {impact}"]
    if len(lines[0]) > width:
        # a long name is broken anywhere
        lines = [*textwrap.wrap(f"{name}:", width), f"{verdict(run)}, {impact}"]
    changed = run.scene.title.partition("; with ")[2]
    if changed:
        lines.append("with " + textwrap.shorten(changed, width - 5, placeholder=" ..."))
    if run.problems:
        incomplete = f"INCOMPLETE: {run.problems[0]}"
        lines.append(textwrap.shorten(incomplete, width, placeholder=" ..."))
    return "\n".join(lines)


def in_contact(run: ViewableRun) -> np.ndarray:
    """Return whether the tip touches at or right after each sample, (n,) bool.

    Touches shorter than the distance of two samples count.
    """
    t = run.samples["t"]
    touching: np.ndarray = run.samples["walls"] != 0
    for touch in run.touches:
        first = int(np.searchsorted(t, touch["start"], side="right")) - 1
        last = int(np.searchsorted(t, touch["end"], side="left"))
        touching[max(first, 0) : last] = True
    return touching


def decided_at(run: ViewableRun) -> float | None:
    """Return when the detector came to a verdict, s since the release; None if it did not."""
    return next((status.t for status in run.statuses if status.state.is_verdict), None)


def resolved(run: ViewableRun, window: tuple[float, float] | None = None) -> Result:
    """Run a run's scene again and sample every touch by the integrator's dense output.

    Parameters
    ----------
    run
        With the scene that made it.
    window
        From when to when, s since the start: only this is returned, in some 4000 samples more.
        None keeps the whole run.

    Returns
    -------
    Result
        The same motion, touches and events as the run's.

    Raises
    ------
    CaptureSimError
        This version of the simulator gives other touches than the run has.
    """
    grid, touches = np.asarray(run.samples["t"]), run.touches
    start, end = (float(grid[0]), float(grid[-1])) if window is None else window
    times = [grid[(grid >= start) & (grid <= end)]]
    for touch in touches[(touches["end"] >= start) & (touches["start"] <= end)]:
        times.append(np.linspace(touch["start"], touch["end"], _PER_TOUCH))
        times.append(touch["peak_time"][None])
    if window is not None:
        times.append(np.linspace(start, end, _PER_WINDOW))
    wanted = np.unique(np.concatenate(times))
    wanted = wanted[(wanted >= start) & (wanted <= min(end, grid[-1]))]
    if not wanted.size:
        raise CaptureSimError(
            f"{run.scene.name}: no motion from {start:g} to {end:g} s; it lasts to {grid[-1]:g} s"
        )
    try:
        again = simulate(run.scene, t_eval=wanted)
    except SimulationError as error:
        if error.result is None:
            raise
        again = error.result
    if not _same(again.touches, touches):
        raise CaptureSimError(
            f"{run.scene.name}: this version of the simulator gives other touches than the run "
            "has; it can only be drawn as it was sampled"
        )
    return again


def resolved_or_not(run: ViewableRun) -> ViewableRun:
    """Return the run resolved, or as it is where it cannot be run again as it was."""
    if not np.isfinite(run.samples["kinetic"]).any():
        return run  # measured
    try:
        return resolved(run)
    except CaptureSimError:
        return run


def _same(touches: np.ndarray, others: np.ndarray) -> bool:
    """Return whether two runs have the same touches, to 1 us."""
    return len(touches) == len(others) and bool(
        np.array_equal(touches["wall"], others["wall"])
        and np.allclose(touches["start"], others["start"], rtol=0.0, atol=1e-6)
    )
