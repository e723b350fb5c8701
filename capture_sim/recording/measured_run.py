"""A run out of the topics that a real bench has as well: poses, buffer, forces where measured.

Nothing of the simulator's own (BenchState, events, the scene) is needed but the bench's geometry.
What cannot be measured (energies, mostly) is not a number.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.integrate import trapezoid

from capture_sim.detection.align import observed
from capture_sim.detection.exact import CaptureStatus
from capture_sim.detection.noisy import NoisyDetector
from capture_sim.errors import RecordingError, SceneError
from capture_sim.messages import topics
from capture_sim.messages.convert import HINGE_JOINT, SLIDE_JOINT, StringPhase
from capture_sim.messages.topics import Topic
from capture_sim.recording.measured import buffers_in, poses_of, release_of, stamps_of
from capture_sim.recording.read import Columns, Run
from capture_sim.samples import SAMPLE, TOUCH, Event, EventKind, Phase
from capture_sim.scene.parts import PlanarState, Scene, as_name

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
    peak_force: np.ndarray | None = None  # (n,): N, largest since the instant before
    # (n, 4): phase as in StringState, tension N, mass height m, mass speed m/s
    string: np.ndarray | None = None


@dataclass(frozen=True)
class MeasuredRun:
    """A run known from measurements alone; fits :class:`capture_sim.viewing.source.ViewableRun`."""

    scene: Scene
    samples: np.ndarray
    touches: np.ndarray
    events: Sequence[Event]
    statuses: Sequence[CaptureStatus]
    trace: np.ndarray | None = None
    extremes: None = None


def samples_of(scene: Scene, measured: AlignedMeasurements) -> np.ndarray:
    """Return measurements as samples, (n,) of dtype SAMPLE.

    Parameters
    ----------
    scene
        The geometry of buffer and cone.
    measured
        n instants.
    """
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
    tip = _tip_in_cone(scene, q)
    samples["tip_axial"], samples["tip_lateral"] = -tip[:, 0], tip[:, 1]
    samples["tip_distance"] = np.hypot(*tip.T)
    gaps = np.stack([_gap(scene, tip, side) for side in (1, -1)], axis=-1)
    samples["penetration"] = -gaps
    in_reach = (gaps < scene.detector.max_contact_gap) @ np.array([1, 2])
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
    """Return measurements as a run that can be drawn.

    Parameters
    ----------
    name
        Of the run.
    scene
        The geometry of buffer and cone.
    measured
        At least one instant.
    statuses
        Of the detector.
    """
    samples = samples_of(scene, measured)
    touches = _touches(samples, measured)
    events = []
    for touch in touches:
        first = int(np.searchsorted(samples["t"], touch["start"]))
        q, v = samples["q"][first], samples["v"][max(first - 1, 0)]
        wall, seen = int(touch["wall"]), "seen in the measurements"
        events.append(Event(EventKind.TOUCH, float(touch["start"]), q, v, wall, seen))
    return MeasuredRun(_placed(scene, name, samples), samples, touches, events, statuses)


def _tip_in_cone(scene: Scene, q: np.ndarray) -> np.ndarray:
    """Return the tip's centre in the cone's frame, (n, 2), m."""
    heading = np.stack([np.cos(q[:, 2]), np.sin(q[:, 2])], axis=-1)
    probe = np.stack([np.cos(q[:, 3]), np.sin(q[:, 3])], axis=-1)
    offset = q[:, :2] + scene.buffer.hinge_offset * heading + q[:, 4, None] * probe - q[:, 5:7]
    c, s = np.cos(q[:, 7]), np.sin(q[:, 7])
    along = c * offset[:, 0] + s * offset[:, 1] + scene.cone.L_T
    return np.stack([along, c * offset[:, 1] - s * offset[:, 0]], axis=-1)


def _gap(scene: Scene, tip: np.ndarray, side: int) -> np.ndarray:
    """Return the gap between the tip and a wall, (n,), m."""
    cone = scene.cone
    inner = np.array([0.0, side * cone.R_c])
    along = np.array([-np.cos(cone.half_angle), side * np.sin(cone.half_angle)])
    reach = np.clip((tip - inner) @ along, 0.0, cone.L_c)
    return np.asarray(
        np.linalg.norm(tip - inner - reach[:, None] * along, axis=1) - scene.probe.tip_radius
    )


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
        samples["normal_force"] = 0.0
        samples["normal_force"][np.arange(len(samples)), nearer] = force


def _phases(samples: np.ndarray, measured: AlignedMeasurements) -> np.ndarray:
    phase = np.where(samples["walls"] != 0, int(Phase.CONTACT), int(Phase.FREE))
    if measured.string is not None:
        known = measured.string[:, 0]
        phase[known == StringPhase.HELD] = int(Phase.HELD)
        phase[known == StringPhase.TAUT] = int(Phase.TAUT)
    return phase


def _touches(samples: np.ndarray, measured: AlignedMeasurements) -> np.ndarray:
    """Return the intervals of samples in touch, (m,) of dtype TOUCH."""
    near = (samples["walls"] != 0).astype(np.int8)
    if measured.begun is not None:
        # touches that were over before the next instant
        near |= measured.begun > 0
        near[:-1] |= measured.begun[1:] > 0
    ends = np.flatnonzero(np.diff(np.concatenate([[0], near, [0]])))
    t = samples["t"]
    force = np.nan_to_num(samples["normal_force"].sum(axis=1))
    if measured.peak_force is not None:
        force = np.maximum(force, np.nan_to_num(measured.peak_force))
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
        return scene  # a start that the simulator would refuse


def run_from_bag(run: Run, scene: Scene, released: float | None = None) -> MeasuredRun:
    """Read a run from its measurements, on the stamps of the chaser's poses.

    Parameters
    ----------
    run
        Holds the poses of chaser and target, and the buffer's state or the joints'.
    scene
        The geometry of buffer and cone, and the detector's criteria: where the recording holds no
        statuses, the detector decides now.
    released
        When, s after the first pose; None where it is recorded, see
        :func:`capture_sim.recording.measured.release_of`.

    Raises
    ------
    RecordingError
        A topic is missing, or the release lies outside the recording.
    """
    chaser, target = _needed(run, topics.CHASER_ODOMETRY), _needed(run, topics.TARGET_ODOMETRY)
    stamps, first = np.unique(stamps_of(chaser), return_index=True)
    release = release_of(run, released)
    t = (stamps - release) * 1e-9
    poses, rates = zip(*(_planar(odometry) for odometry in (chaser, target)), strict=True)
    buffers = buffers_in(run)
    if not buffers:
        raise RecordingError(
            f"{run.name}: holds neither {topics.BUFFER_STATE.absolute_name} nor "
            f"{topics.JOINT_STATES.absolute_name} with {HINGE_JOINT} and {SLIDE_JOINT}: the place "
            "of the tip is not known"
        )
    topic, buffer = next(iter(buffers.items()))
    buffer_stamps = stamps_of(run.columns(topic))

    def at(columns_stamps: np.ndarray, values: np.ndarray) -> np.ndarray:
        """Return values at the chaser's stamps, linear between their own."""
        since = (columns_stamps - stamps[0]) * 1e-9
        wanted = (stamps - stamps[0]) * 1e-9
        return np.stack([np.interp(wanted, since, column) for column in values.T], axis=-1)

    def held(columns_stamps: np.ndarray, values: np.ndarray) -> np.ndarray:
        """Return states at the chaser's stamps, each holding until the next."""
        before = np.searchsorted(columns_stamps, stamps, side="right") - 1
        return np.asarray(values[np.maximum(before, 0)].astype(int))

    measured = AlignedMeasurements(
        t=t,
        chaser=poses[0][first],
        chaser_rate=rates[0][first],
        target=at(stamps_of(target), poses[1]),
        target_rate=at(stamps_of(target), rates[1]),
        buffer=at(buffer_stamps, _stacked(buffer, "stroke", "torsion")),
        buffer_rate=at(buffer_stamps, _stacked(buffer, "stroke_rate", "torsion_rate")),
        **_optional(run, at, held),
    )
    statuses: Sequence[CaptureStatus] = run.statuses
    if statuses:
        # a recording counts them from a stamp of 1 s, the run from the release
        first_status = (stamps_of(run.columns(topics.CAPTURE_STATUS))[0] - release) * 1e-9
        late = statuses[0].t - float(first_status)
        statuses = [status._replace(t=status.t - late) for status in statuses]
    else:
        statuses = _detect(scene, measured)
    return measured_run(run.name, scene, measured, statuses)


def _detect(scene: Scene, measured: AlignedMeasurements) -> list[CaptureStatus]:
    """Return what the capture detector makes of measurements."""
    detector = NoisyDetector(scene)
    m = measured
    pairs = ((m.chaser, m.chaser_rate), (m.target, m.target_rate), (m.buffer, m.buffer_rate))
    rows = zip(m.t.tolist(), *(np.hstack(pair).tolist() for pair in pairs), strict=True)
    return [*(detector.update(observed(*row)) for row in rows), *detector.finish()]


def _needed(run: Run, topic: Topic) -> Columns:
    found = run.columns(topic)
    if not found:
        raise RecordingError(f"{run.name}: holds no {topic.absolute_name}, nothing to draw")
    return found


def _planar(odometry: Columns) -> tuple[np.ndarray, np.ndarray]:
    """Return poses (n, 3) and their rates in the world (n, 3), from nav_msgs/Odometry."""
    poses = poses_of(odometry, "pose.pose")
    poses[:, 2] = np.unwrap(poses[:, 2])
    c, s = np.cos(poses[:, 2]), np.sin(poses[:, 2])
    # the twist is in the vehicle's own frame
    vx, vy = odometry["twist.twist.linear.x"], odometry["twist.twist.linear.y"]
    rates = (c * vx - s * vy, s * vx + c * vy, odometry["twist.twist.angular.z"])
    return poses, np.stack(rates, axis=-1)


def _stacked(columns: Columns, *names: str) -> np.ndarray:
    return np.stack([columns[name] for name in names], axis=-1)


def _optional(run: Run, at: Any, held: Any) -> dict[str, np.ndarray]:
    """Return what else was measured."""
    found: dict[str, np.ndarray] = {}
    if wrench := run.columns(topics.CONTACT_WRENCH):
        force = _stacked(wrench, "wrench.force.x", "wrench.force.y")
        found["tip_force"] = at(stamps_of(wrench), force)
    if contact := run.columns(topics.CONTACT_STATE):
        stamps = stamps_of(contact)
        found["normal_force"] = at(stamps, contact["normal_force"])
        found["peak_force"] = at(stamps, contact["peak_force"][:, None])[:, 0]
        found["walls"] = held(stamps, contact["walls"])
        found["begun"] = held(stamps, contact["touches"])
    if string := run.columns(topics.STRING_STATE):
        stamps = stamps_of(string)
        values = at(stamps, _stacked(string, "tension", "mass_height", "mass_speed"))
        found["string"] = np.column_stack([held(stamps, string["phase"]), values])
    return found
