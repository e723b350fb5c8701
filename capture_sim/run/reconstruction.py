"""Reconstruction of a run's samples, touches and events from its measurements.

It needs the poses of both vehicles, the state of the buffer and the bench's geometry, and uses
forces if they were measured.  No topic of the simulator (BenchState, events) is needed.  Quantities
that cannot be measured, mostly energies, are NaN.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence

import numpy as np

from capture_sim.base.compiled.kernels import plain
from capture_sim.dynamics.samples import SAMPLE, TOUCH, Event, EventKind, Phase
from capture_sim.errors import SceneError
from capture_sim.run.series import NO_SERIES, Series
from capture_sim.run.touches import Touches, normal_force, unseen_impact
from capture_sim.scene.geometry import nearest_on_wall, tip_motion
from capture_sim.scene.launch_plan import travel_to_touch
from capture_sim.scene.parts import PlanarState, Scene, as_name

_tip_motion, _nearest_on_wall = plain(tip_motion), plain(nearest_on_wall)

#: Poses without measured rates get the mean rates over this time, s.
RATE_WINDOW = 0.2
#: Fields of SAMPLE that are integers, so they cannot be NaN.
_WHOLE_NUMBERS = ("phase", "walls", "at_rest", "touches")


class Aligned:
    """Measured series of several quantities, evaluated at common times ``t``, (n,), s.

    Rates that were not measured are computed.  Those of a vehicle are slopes of its poses over
    :data:`RATE_WINDOW`; those of the buffer are differences of successive values.
    """

    def __init__(self, t: np.ndarray, series: Mapping[str, Series]) -> None:
        self.t = t
        self._series = series

    def has(self, name: str) -> bool:
        """Return True if the series of a quantity has values."""
        return self._series.get(name, NO_SERIES).t.size > 0

    def at_times(self, name: str) -> np.ndarray:
        """Return a quantity at the times, (n,) or (n, m), by linear interpolation.

        The result is NaN if the quantity was not measured.
        """
        series = self._series.get(name, NO_SERIES)
        if not series.t.size:
            return np.full((self.t.size, *series.values.shape[1:]), np.nan)
        if series.values.ndim == 1:
            return np.interp(self.t, series.t, series.values)
        columns = [np.interp(self.t, series.t, column) for column in series.values.T]
        return np.stack(columns, axis=-1)

    def latest(self, name: str) -> np.ndarray:
        """Return the latest value of an integer quantity at each time, (n,).

        Before the first value of the series, the result is the first value.
        """
        series = self._series[name]
        before = np.searchsorted(series.t, self.t, side="right") - 1
        return np.asarray(series.values[np.maximum(before, 0)].astype(int))

    def rates_of(self, vehicle: str) -> np.ndarray:
        """Return a vehicle's rates, measured or computed, (n, 3), m/s, m/s and rad/s."""
        if self.has(f"{vehicle}_rate"):
            return self.at_times(f"{vehicle}_rate")
        slopes = {vehicle: _fitted_rates(self._series[vehicle])}
        return Aligned(self.t, slopes).at_times(vehicle)

    def rate_of(self, name: str) -> np.ndarray:
        """Return the rate of ``stroke``, m/s, or ``torsion``, rad/s, measured or computed, (n,).

        The result is NaN if it would have to be computed from fewer than two values.
        """
        if self.has(f"{name}_rate"):
            return self.at_times(f"{name}_rate")
        series = self._series[name]
        if series.t.size < 2:
            return np.full(self.t.size, np.nan)
        return np.interp(self.t, series.t, np.gradient(series.values, series.t))


def measured_samples(
    scene: Scene, t: np.ndarray, series: Mapping[str, Series], touches: Touches | None = None
) -> np.ndarray:
    """Return samples, (n,) of dtype SAMPLE, that are reconstructed from measurements.

    Parameters
    ----------
    scene
        Geometry of buffer and cone, and ``detector.max_contact_gap``.
    t
        Times of the samples, (n,), s since the release.
    series
        Series by quantity; required are ``chaser``, ``target``, ``stroke`` and ``torsion``.
    touches
        All touches of the run.  If they are None, the walls in touch come from the series
        ``walls``, or else from the computed gap between tip and wall.
    """
    aligned = Aligned(t, series)
    samples = np.zeros(len(t), dtype=SAMPLE)
    for name in SAMPLE.names or ():
        if name not in _WHOLE_NUMBERS:
            samples[name] = np.nan
    stroke, torsion = aligned.at_times("stroke"), aligned.at_times("torsion")
    q, v = samples["q"], samples["v"]
    q[:, :3], q[:, 5:] = aligned.at_times("chaser"), aligned.at_times("target")
    v[:, :3], v[:, 5:] = aligned.rates_of("chaser"), aligned.rates_of("target")
    q[:, 3], q[:, 4] = q[:, 2] + torsion, scene.rest_length + stroke
    v[:, 3], v[:, 4] = v[:, 2] + aligned.rate_of("torsion"), aligned.rate_of("stroke")
    samples["t"], samples["axial_stroke"], samples["torsion"] = t, stroke, torsion
    turned = (f(q[:, k]) for k in (2, 3, 7) for f in (np.sin, np.cos))
    x, y, _, _ = _tip_motion((*q.T, *v.T), scene.buffer.hinge_offset, *turned)
    tip = np.stack([x + scene.cone.L_T, y], axis=-1)
    samples["tip_axial"], samples["tip_lateral"] = -tip[:, 0], tip[:, 1]
    samples["tip_distance"] = np.hypot(*tip.T)
    wall = scene.cone.wall
    distances = [
        [_nearest_on_wall(-x, side * y, *wall)[0] for side in (1, -1)] for x, y in tip.tolist()
    ]
    gaps = np.array(distances).reshape(-1, 2) - scene.probe.tip_radius
    samples["penetration"] = -gaps
    if touches is not None:
        samples["walls"] = _walls_during(touches, t)
    elif aligned.has("walls"):
        samples["walls"] = aligned.latest("walls")
    else:
        samples["walls"] = (gaps < scene.detector.max_contact_gap) @ np.array([1, 2])
    _fill_forces(scene, samples, aligned, gaps, touches)
    for name in ("string_tension", "mass_height", "mass_speed"):
        if aligned.has(name):
            samples[name] = aligned.at_times(name)
    samples["phase"] = _phases(samples, aligned)
    starts = np.diff((samples["walls"] != 0).astype(int), prepend=0) > 0
    samples["touches"] = np.cumsum(starts)
    return samples


def _fill_forces(
    scene: Scene,
    samples: np.ndarray,
    aligned: Aligned,
    gaps: np.ndarray,
    touches: Touches | None,
) -> None:
    """Set contact force (world axes) and normal forces in ``samples``, if a force was measured."""
    # index in q of the attitude of the body whose axes the force is in: the tip, or the target
    sensor, angle = ("tip_force", 3) if aligned.has("tip_force") else ("cone_force", 7)
    if aligned.has(sensor):
        c, s = np.cos(samples["q"][:, angle]), np.sin(samples["q"][:, angle])
        fx, fy = aligned.at_times(sensor).T
        samples["contact_force"] = np.stack([c * fx - s * fy, s * fx + c * fy], axis=-1)
    if aligned.has("normal_force"):
        samples["normal_force"] = aligned.at_times("normal_force")
    elif aligned.has(sensor):
        # one sensor measures both walls, so its force counts for the nearer wall
        attitude = samples["q"][:, angle] - samples["q"][:, 7]
        force = normal_force(aligned.at_times(sensor), attitude, scene.cone)
        force = np.maximum(force, 0.0)
        nearer = np.argmin(gaps, axis=1)
        if touches is not None:
            # between the touches the sensor reads its bias and noise
            force = np.where(samples["walls"] != 0, force, 0.0)
            nearer = (samples["walls"] == 2).astype(int)  # an unknown wall counts as +y
        samples["normal_force"] = 0.0
        samples["normal_force"][np.arange(len(samples)), nearer] = force


def _phases(samples: np.ndarray, aligned: Aligned) -> np.ndarray:
    phase = np.where(samples["walls"] != 0, int(Phase.CONTACT), int(Phase.FREE))
    if aligned.has("string_phase"):
        string_phase = aligned.latest("string_phase")
        for held in (Phase.HELD, Phase.TAUT):
            phase[string_phase == held] = int(held)
    return phase


def _walls_during(touches: Touches, t: np.ndarray) -> np.ndarray:
    """Return the walls in touch at times (n,), s, as bits: 1 for +y, 2 for -y, both if unknown."""
    walls = np.zeros(len(t), dtype=int)
    for start, lasted, wall in zip(touches.start, touches.lasted, touches.wall, strict=True):
        walls[(t >= start) & (t <= start + lasted)] = {1: 1, -1: 2}.get(int(wall), 3)
    return walls


def touches_in_force(found: Touches) -> np.ndarray:
    """Return touches that were found in a force as records, (m,) of dtype TOUCH.

    The approach speed, the dissipated energy and the rate ratio are NaN, because they were not
    measured.  An unknown wall is 0.
    """
    touches = np.zeros(len(found.start), dtype=TOUCH)
    touches["start"], touches["end"] = found.start, found.start + found.lasted
    touches["peak_force"], touches["peak_time"] = found.peak, found.peak_time
    touches["impulse"], touches["wall"] = found.impulse, found.wall
    touches["approach_speed"] = touches["dissipated"] = touches["rate_ratio"] = np.nan
    return touches


def touches_in_samples(samples: np.ndarray, series: Mapping[str, Series]) -> np.ndarray:
    """Return each sequence of successive samples (n,) in touch as a record, (m,) of dtype TOUCH.

    Two series add detail if they exist.  ``touches_begun`` shows touches that began and ended
    between two samples, and ``peak_force`` has the largest force since the sample before.  Without
    a measured force, peaks and impulses are NaN, and quantities that are never measured always are.
    """
    t = samples["t"]
    aligned = Aligned(t, series)
    near = (samples["walls"] != 0).astype(np.int8)
    if aligned.has("touches_begun"):
        # touches that were over before the next instant
        begun = aligned.latest("touches_begun")
        near |= begun > 0
        near[:-1] |= begun[1:] > 0
    ends = np.flatnonzero(np.diff(np.concatenate([[0], near, [0]])))
    has_force = aligned.has("peak_force") or np.isfinite(samples["normal_force"]).any()
    force = np.nan_to_num(samples["normal_force"].sum(axis=1))
    if aligned.has("peak_force"):
        force = np.maximum(force, np.nan_to_num(aligned.at_times("peak_force")))
    touches = np.zeros(len(ends) // 2, dtype=TOUCH)
    for touch, first, end in zip(touches, ends[::2], ends[1::2], strict=True):
        last = min(end, len(t) - 1)
        # a peak comes with the first message after it
        peak = first + int(np.argmax(force[first : last + 1]))
        touch["start"], touch["end"] = t[first], t[last]
        wider = samples["penetration"][first : last + 1].max(axis=0)
        touch["wall"] = 1 if wider[0] > wider[1] else -1
        touch["peak_force"], touch["peak_time"] = force[peak], t[peak]
        touch["impulse"] = _trapezoid(t[first : last + 1], force[first : last + 1])
        touch["approach_speed"] = touch["dissipated"] = touch["rate_ratio"] = np.nan
        if not has_force:
            touch["peak_force"] = touch["impulse"] = np.nan
    return touches


def events_of(
    scene: Scene, samples: np.ndarray, touches: np.ndarray, series: Mapping[str, Series]
) -> tuple[Event, ...]:
    """Return a TOUCH event for each touch, with ``q`` and ``v`` from the samples.

    The rates ``v`` are those just before the touch.  If the poses have a gap there, in which the
    vehicles moved too far, the rates are NaN and ``detail`` gives the reason.  ``series`` are the
    series from which the samples were made.
    """
    poses = [series["chaser"].t, series["target"].t]
    has_twist = "chaser_rate" in series and "target_rate" in series
    # a mean over a window is free of the touch if it ends half a window before it
    lead = 0.0 if has_twist else 0.5 * RATE_WINDOW
    events: list[Event] = []
    for touch in touches:
        start, wall = float(touch["start"]), int(touch["wall"])
        end, unseen = _end_of_approach(scene, samples, poses, start, is_first=not events)
        at, before = np.searchsorted(samples["t"], [start, end - lead])
        q = samples["q"][min(at, len(samples) - 1)]
        v = samples["v"][min(before, len(samples) - 1)]
        detail = unseen_impact(unseen)
        if detail:
            v = np.full_like(v, np.nan)
        detail = detail or "found in the measurements"
        events.append(Event(EventKind.TOUCH, start, q, v, wall, detail))
    return tuple(events)


def _end_of_approach(
    scene: Scene, samples: np.ndarray, poses: Sequence[np.ndarray], start: float, *, is_first: bool
) -> tuple[float, float]:
    """Return the last time with poses of both vehicles before a touch, s, and the travel since, m.

    If the tip may have met the cone in an earlier gap of the poses, the first touch that was found
    may not be the first contact.  The time is then the beginning of that gap, and the travel is the
    distance from there to the cone.
    """
    gaps = [
        (t[k], t[k + 1] - t[k])
        for t in poses
        for k in np.flatnonzero(np.diff(t) > scene.detector.max_data_gap)
        if is_first and t[k] < start
    ]
    for begin, duration in sorted(gaps):
        sample = samples[max(int(np.searchsorted(samples["t"], begin, "right")) - 1, 0)]
        q = sample["q"]
        travel = travel_to_touch(placed(scene, scene.name, [q[:3], q[5:]]))
        if travel <= _speed(sample["v"]) * duration:
            return float(begin), travel
    end = min(float(t[max(int(np.searchsorted(t, start)) - 1, 0)]) for t in poses)
    sample = samples[min(int(np.searchsorted(samples["t"], end)), len(samples) - 1)]
    return end, _speed(sample["v"]) * (start - end)


def _speed(v: np.ndarray) -> float:
    return math.hypot(v[0] - v[5], v[1] - v[6])


def placed(scene: Scene, name: str, poses: Sequence[np.ndarray]) -> Scene:
    """Return the scene with a run's name, and chaser and target at rest at poses (3,).

    If the scene's rules reject these poses, the start of the scene is unchanged.
    """
    scene = dataclasses.replace(scene, name=as_name(name), title=f"Measured; drawn as {scene.name}")
    chaser, target = (PlanarState(*pose.tolist()) for pose in poses)
    initial = dataclasses.replace(scene.initial, chaser=chaser, target=target)
    try:
        return dataclasses.replace(scene, initial=initial)
    except SceneError:
        return scene  # the simulator would reject this start


def _fitted_rates(poses: Series) -> Series:
    """Return rates computed from poses: slopes of lines fitted over windows of RATE_WINDOW.

    The method is that of Savitzky and Golay (1964): the slope of a line through evenly spaced
    values is their mean weighted with their times.  The result is empty if there are too few poses
    for one window.
    """
    count = len(poses.t)
    t = np.linspace(poses.t[0], poses.t[-1], count)
    step = (t[-1] - t[0]) / max(count - 1, 1)
    half = int(0.5 * RATE_WINDOW / step) if step > 0.0 else count
    if not 3 <= 2 * half + 1 <= count:
        return Series(poses.t[:0], poses.values[:0])
    uniform = np.stack([np.interp(t, poses.t, column) for column in poses.values.T], axis=-1)
    offsets = step * np.arange(-half, half + 1)
    weights = offsets / (offsets @ offsets)
    slopes = np.stack([np.correlate(column, weights, "valid") for column in uniform.T], axis=-1)
    # up to half a window from the ends, the rate is the slope of the first or last full window
    return Series(t, np.pad(slopes, ((half, half), (0, 0)), mode="edge"))


def _trapezoid(t: np.ndarray, values: np.ndarray) -> float:
    return float(0.5 * (values[1:] + values[:-1]) @ np.diff(t))
