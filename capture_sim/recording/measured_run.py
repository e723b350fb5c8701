"""A run from the topics that a real bench has too: poses, buffer, and forces if measured.

No topic of the simulator (BenchState, events) is needed, only the bench's geometry.  Quantities
that cannot be measured, mostly energies, are NaN.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.integrate import trapezoid
from scipy.signal import savgol_filter

from capture_sim.detection.exact import CaptureStatus
from capture_sim.errors import RecordingError, SceneError
from capture_sim.kernels import plain
from capture_sim.messages import topics
from capture_sim.messages.convert import HINGE_JOINT, SLIDE_JOINT, StringPhase
from capture_sim.messages.topics import Topic
from capture_sim.model.equations import tip_motion
from capture_sim.model.geometry import nearest_on_wall
from capture_sim.recording.detect import detect_again
from capture_sim.recording.measured import (
    buffers_in,
    forces_on_tip,
    measured_sources,
    poses_of,
    rates_of,
    touches_of,
)
from capture_sim.recording.read import Run
from capture_sim.samples import SAMPLE, TOUCH, Event, EventKind, Phase
from capture_sim.scene.parts import PlanarState, Scene, as_name
from capture_sim.studies.measurements import Series
from capture_sim.studies.touches import Touches

_tip_motion, _nearest_on_wall = plain(tip_motion), plain(nearest_on_wall)

#: Rates of poses that come without are means over so long, s.
RATE_WINDOW = 0.2
#: Fields of SAMPLE that have no NaN for what is not known.
_WHOLE_NUMBERS = ("phase", "walls", "at_rest", "touches")


@dataclass(frozen=True)
class AlignedMeasurements:
    """What was measured at n instants; None where there is no such sensor."""

    t: np.ndarray  # (n,): s since the release
    chaser: np.ndarray  # (n, 3): x m, y m, theta rad in the world
    chaser_rate: np.ndarray  # (n, 3): m/s, m/s, rad/s in the world
    target: np.ndarray  # (n, 3): x m, y m, theta rad in the world
    target_rate: np.ndarray  # (n, 3): m/s, m/s, rad/s in the world
    buffer: np.ndarray  # (n, 2): axial stroke m, torsion rad
    buffer_rate: np.ndarray  # (n, 2): m/s, rad/s
    tip_force: np.ndarray | None = None  # (n, 2): N, on the tip in its own frame
    normal_force: np.ndarray | None = None  # (n, 2): N, of the +y and the -y wall
    # (n,): bits of the walls in touch, as in ContactState; else by the gaps
    walls: np.ndarray | None = None
    begun: np.ndarray | None = None  # (n,): touches begun since the instant before
    touches: Touches | None = None  # in the force, if it shows all; else by walls and begun
    peak_force: np.ndarray | None = None  # (n, 1): N, largest since the instant before
    # (n, 4): phase as in StringState, tension N, mass height m, mass speed m/s
    string: np.ndarray | None = None
    rate_window: float = 0.0  # s: over which the vehicles' rates are means


@dataclass(frozen=True)
class MeasuredRun:
    """A run known from measurements alone: a :class:`capture_sim.viewing.source.ViewableRun`."""

    scene: Scene
    samples: np.ndarray
    touches: np.ndarray
    events: Sequence[Event]
    statuses: Sequence[CaptureStatus]
    trace: np.ndarray | None = None
    extremes: None = None
    problems: Sequence[str] = ()  # of the recording


def samples_of(scene: Scene, measured: AlignedMeasurements) -> np.ndarray:
    """Return measurements as samples, (n,) of dtype SAMPLE, by the scene's buffer and cone."""
    n = len(measured.t)
    samples = np.zeros(n, dtype=SAMPLE)
    for name in SAMPLE.names or ():
        if name not in _WHOLE_NUMBERS:
            samples[name] = np.nan
    stroke, torsion = measured.buffer.T
    q, v = samples["q"], samples["v"]
    q[:, :3], q[:, 5:] = measured.chaser, measured.target
    v[:, :3], v[:, 5:] = measured.chaser_rate, measured.target_rate
    q[:, 3], q[:, 4] = measured.chaser[:, 2] + torsion, scene.rest_length + stroke
    v[:, 3] = measured.chaser_rate[:, 2] + measured.buffer_rate[:, 1]
    v[:, 4] = measured.buffer_rate[:, 0]
    samples["t"], samples["axial_stroke"], samples["torsion"] = measured.t, stroke, torsion
    turned = (f(q[:, k]) for k in (2, 3, 7) for f in (np.sin, np.cos))
    x, y, _, _ = _tip_motion((*q.T, *v.T), scene.buffer.hinge_offset, *turned)
    tip = np.stack([x + scene.cone.L_T, y], axis=-1)
    samples["tip_axial"], samples["tip_lateral"] = -tip[:, 0], tip[:, 1]
    samples["tip_distance"] = np.hypot(*tip.T)
    wall = scene.cone.wall
    distances = [
        [_nearest_on_wall(-x, side * y, *wall)[0] for side in (1, -1)] for x, y in tip.tolist()
    ]
    gaps = np.array(distances) - scene.probe.tip_radius
    samples["penetration"] = -gaps
    in_reach = (gaps < scene.detector.max_contact_gap) @ np.array([1, 2])
    if measured.touches is not None:
        samples["walls"] = _walls_during(measured.touches, measured.t)
    else:
        samples["walls"] = in_reach if measured.walls is None else measured.walls
    _fill_forces(samples, measured, gaps)
    if measured.string is not None:
        for i, name in enumerate(("string_tension", "mass_height", "mass_speed"), start=1):
            samples[name] = measured.string[:, i]
    samples["phase"] = _phases(samples, measured)
    starts = np.diff((samples["walls"] != 0).astype(int), prepend=0) > 0
    samples["touches"] = np.cumsum(starts)
    return samples


def measured_run(
    name: str, scene: Scene, measured: AlignedMeasurements, statuses: Sequence[CaptureStatus]
) -> MeasuredRun:
    """Return measurements of at least one instant as a run that can be drawn.

    The scene gives the geometry of buffer and cone.
    """
    samples = samples_of(scene, measured)
    if measured.touches is None:
        touches = _touches(samples, measured)
    else:
        touches = _touches_in_force(measured.touches)
    events = []
    for touch in touches:
        before = touch["start"] - 0.5 * measured.rate_window
        first, free = np.searchsorted(samples["t"], [touch["start"], before])
        q, v = samples["q"][min(first, len(samples) - 1)], samples["v"][max(free - 1, 0)]
        wall, detail = int(touch["wall"]), "found in the measurements"
        events.append(Event(EventKind.TOUCH, float(touch["start"]), q, v, wall, detail))
    return MeasuredRun(_placed(scene, name, samples), samples, touches, events, statuses)


def _fill_forces(samples: np.ndarray, measured: AlignedMeasurements, gaps: np.ndarray) -> None:
    if measured.tip_force is not None:
        c, s = np.cos(samples["q"][:, 3]), np.sin(samples["q"][:, 3])
        fx, fy = measured.tip_force.T
        samples["contact_force"] = np.stack([c * fx - s * fy, s * fx + c * fy], axis=-1)
    if measured.normal_force is not None:
        samples["normal_force"] = measured.normal_force
    elif measured.tip_force is not None:
        # one sensor for both walls: its force counts for the nearer one
        force = np.linalg.norm(measured.tip_force, axis=1)
        nearer = np.argmin(gaps, axis=1)
        if measured.touches is not None:
            # between the touches the sensor reads its bias and noise
            force = np.where(samples["walls"] != 0, force, 0.0)
            nearer = (samples["walls"] == 2).astype(int)  # of one that is not known, the first
        samples["normal_force"] = 0.0
        samples["normal_force"][np.arange(len(samples)), nearer] = force


def _phases(samples: np.ndarray, measured: AlignedMeasurements) -> np.ndarray:
    phase = np.where(samples["walls"] != 0, int(Phase.CONTACT), int(Phase.FREE))
    if measured.string is not None:
        string_phase = measured.string[:, 0]
        phase[string_phase == StringPhase.HELD] = int(Phase.HELD)
        phase[string_phase == StringPhase.TAUT] = int(Phase.TAUT)
    return phase


def _walls_during(touches: Touches, t: np.ndarray) -> np.ndarray:
    """Return the walls in touch at times (n,), as bits; both where a touch does not tell which."""
    walls = np.zeros(len(t), dtype=int)
    for start, lasted, wall in zip(touches.start, touches.lasted, touches.wall, strict=True):
        walls[(t >= start) & (t <= start + lasted)] = {1: 1, -1: 2}.get(int(wall), 3)
    return walls


def _touches_in_force(found: Touches) -> np.ndarray:
    """Return the touches found in a force, (m,) of dtype TOUCH; a wall that is not known is 0."""
    touches = np.zeros(len(found.start), dtype=TOUCH)
    touches["start"], touches["end"] = found.start, found.start + found.lasted
    touches["peak_force"], touches["peak_time"] = found.peak, found.peak_time
    touches["impulse"], touches["wall"] = found.impulse, found.wall
    touches["approach_speed"] = touches["dissipated"] = np.nan
    return touches


def _touches(samples: np.ndarray, measured: AlignedMeasurements) -> np.ndarray:
    """Return the intervals of samples in touch, (m,) of dtype TOUCH.

    Without a measured force their peaks and impulses are NaN.
    """
    near = (samples["walls"] != 0).astype(np.int8)
    if measured.begun is not None:
        # touches that were over before the next instant
        near |= measured.begun > 0
        near[:-1] |= measured.begun[1:] > 0
    ends = np.flatnonzero(np.diff(np.concatenate([[0], near, [0]])))
    t = samples["t"]
    has_force = measured.peak_force is not None or np.isfinite(samples["normal_force"]).any()
    force = np.nan_to_num(samples["normal_force"].sum(axis=1))
    if measured.peak_force is not None:
        force = np.maximum(force, np.nan_to_num(measured.peak_force[:, 0]))
    touches = np.zeros(len(ends) // 2, dtype=TOUCH)
    for touch, first, end in zip(touches, ends[::2], ends[1::2], strict=True):
        last = min(end, len(t) - 1)
        # a peak comes with the first message after it
        peak = first + int(np.argmax(force[first : last + 1]))
        touch["start"], touch["end"] = t[first], t[last]
        wider = samples["penetration"][first : last + 1].max(axis=0)
        touch["wall"] = 1 if wider[0] > wider[1] else -1
        touch["peak_force"], touch["peak_time"] = force[peak], t[peak]
        touch["impulse"] = trapezoid(force[first : last + 1], t[first : last + 1])
        touch["approach_speed"] = touch["dissipated"] = np.nan
        if not has_force:
            touch["peak_force"] = touch["impulse"] = np.nan
    return touches


def _placed(scene: Scene, name: str, samples: np.ndarray) -> Scene:
    """Return the scene with the run's name, and its vehicles where they were measured first."""
    q = samples["q"][0]
    scene = dataclasses.replace(scene, name=as_name(name), title=f"Measured; drawn as {scene.name}")
    chaser, target = (PlanarState(*part.tolist()) for part in (q[:3], q[5:]))
    initial = dataclasses.replace(scene.initial, chaser=chaser, target=target)
    try:
        return dataclasses.replace(scene, initial=initial)
    except SceneError:
        return scene  # a start that the simulator would reject


def run_from_bag(run: Run, scene: Scene) -> MeasuredRun:
    """Read a run from its measurements, at the stamps of the chaser's poses.

    The scene gives the geometry of buffer and cone, and the detector's criteria: if the recording
    contains no statuses, the detector evaluates it now.  RecordingError if the poses of a vehicle,
    or both the buffer's state and the joints', are missing, or if the release is outside of the
    recording.
    """
    measured = _aligned(run)
    t_release = run.clock.t_release
    statuses = run.statuses or detect_again(run, scene)
    since_release = [status._replace(t=status.t - t_release) for status in statuses]
    drawn = measured_run(run.name, scene, measured, since_release)
    return dataclasses.replace(drawn, problems=run.problems)


def _aligned(run: Run) -> AlignedMeasurements:
    """Return what a bag measures, at the stamps of the chaser's poses; RecordingError without."""

    def series(topic: Topic, *values: np.ndarray) -> Series:
        return run.clock.series(run.columns(topic), np.column_stack(values))

    sources = measured_sources(run)

    def body(name: str, odometry: Topic) -> tuple[Series, Series]:
        pose_series = [poses for poses in sources.get(name, {}).values() if poses.t.size]
        if not pose_series:
            raise RecordingError(
                f"{run.path}: contains no finite pose of the {name} (/motion_capture/{name} or "
                f"{odometry.absolute_name}); --remap reads it from another topic"
            )
        poses = _unwrapped(pose_series[0])
        if columns := run.columns(odometry):
            heading = poses_of(columns, "pose.pose")[:, 2]
            return poses, series(odometry, rates_of(columns, heading))
        return poses, _fitted_rates(poses)

    has_twist = all(map(run.raw, (topics.CHASER_ODOMETRY, topics.TARGET_ODOMETRY)))
    chaser, chaser_rate = body("chaser", topics.CHASER_ODOMETRY)
    target, target_rate = body("target", topics.TARGET_ODOMETRY)
    buffers = buffers_in(run)
    if not buffers:
        raise RecordingError(
            f"{run.path}: contains neither {topics.BUFFER_STATE.absolute_name} nor "
            f"{topics.JOINT_STATES.absolute_name} with {HINGE_JOINT} and {SLIDE_JOINT}, so the "
            "position of the tip is unknown"
        )
    topic, buffer = next(iter(buffers.items()))
    t = chaser.t

    def interpolated(source: Series) -> np.ndarray:
        """Return values at the chaser's stamps, linear between their own; NaN without any."""
        if not source.t.size:
            return np.full((t.size, source.values.shape[1]), np.nan)
        return np.stack([np.interp(t, source.t, column) for column in source.values.T], axis=-1)

    def latest(source: Series) -> np.ndarray:
        """Return states at the chaser's stamps, each kept until the next."""
        before = np.searchsorted(source.t, t, side="right") - 1
        return np.asarray(source.values[np.maximum(before, 0), 0].astype(int))

    stroke_and_torsion = interpolated(series(topic, buffer["stroke"], buffer["torsion"]))
    target_poses = interpolated(target)
    optional: dict[str, Any] = {}
    if run.columns(topics.CONTACT_WRENCH):
        optional["tip_force"] = interpolated(forces_on_tip(run, topics.CONTACT_WRENCH))
    elif run.columns(topics.LOAD_CELL):
        # from the target's axes to the tip's
        attitude = chaser.values[:, 2] + stroke_and_torsion[:, 1] - target_poses[:, 2]
        c, s = np.cos(attitude), np.sin(attitude)
        x, y = interpolated(forces_on_tip(run, topics.LOAD_CELL)).T
        optional["tip_force"] = np.stack([c * x + s * y, c * y - s * x], axis=-1)
    if not run.columns(topics.CONTACT_STATE):
        touches, _ = touches_of(run)
        if touches is not None and touches.all_found:
            optional["touches"] = touches
    if contact := run.columns(topics.CONTACT_STATE):
        for name in ("normal_force", "peak_force"):
            optional[name] = interpolated(series(topics.CONTACT_STATE, contact[name]))
        for name, field in (("walls", "walls"), ("begun", "touches")):
            optional[name] = latest(series(topics.CONTACT_STATE, contact[field]))
    if string := run.columns(topics.STRING_STATE):
        names = ("tension", "mass_height", "mass_speed")
        values = interpolated(series(topics.STRING_STATE, *(string[name] for name in names)))
        phase = latest(series(topics.STRING_STATE, string["phase"]))
        optional["string"] = np.column_stack([phase, values])
    return AlignedMeasurements(
        t=t,
        chaser=chaser.values,
        chaser_rate=interpolated(chaser_rate),
        target=target_poses,
        target_rate=interpolated(target_rate),
        buffer=stroke_and_torsion,
        buffer_rate=interpolated(series(topic, buffer["stroke_rate"], buffer["torsion_rate"])),
        rate_window=0.0 if has_twist else RATE_WINDOW,
        **optional,
    )


def _fitted_rates(poses: Series) -> Series:
    """Return the rates of poses without twist: slopes of lines fitted over RATE_WINDOW.

    After Savitzky and Golay (1964).
    """
    count = len(poses.t)
    t = np.linspace(poses.t[0], poses.t[-1], count)
    step = (t[-1] - t[0]) / max(count - 1, 1)
    window = 2 * int(0.5 * RATE_WINDOW / step) + 1 if step > 0.0 else count + 1
    if not 3 <= window <= count:
        return Series(poses.t[:0], poses.values[:0])
    uniform = np.stack([np.interp(t, poses.t, column) for column in poses.values.T], axis=-1)
    return Series(t, savgol_filter(uniform, window, 1, deriv=1, delta=step, axis=0))


def _unwrapped(poses: Series) -> Series:
    return poses._replace(
        values=np.column_stack([poses.values[:, :2], np.unwrap(poses.values[:, 2])])
    )
