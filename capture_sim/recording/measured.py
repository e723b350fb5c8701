"""The measurements in a recording: from the topics that a real bench publishes too."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from capture_sim.launch.plan import LaunchPlan, plan_launch
from capture_sim.messages import topics
from capture_sim.messages.convert import HINGE_JOINT, SLIDE_JOINT
from capture_sim.messages.measurements import BUFFER, POSE, TWIST, pose_values, twist_values
from capture_sim.messages.topics import Topic
from capture_sim.recording.clock import stamps_of
from capture_sim.recording.read import Columns, Run
from capture_sim.samples import EventKind
from capture_sim.scene.parts import Scene
from capture_sim.studies.measurements import Measurements, Series
from capture_sim.studies.touches import (
    MIN_SAMPLES,
    Touches,
    first_above,
    in_force,
    in_messages,
    located,
)


def poses_of(columns: Columns, path: str) -> np.ndarray:
    """Return the poses at a path in the message, (n, 3): x, y (m), heading (rad)."""
    numbers = (columns[f"{path}.{name}"].tolist() for name in POSE)
    return np.array(list(map(pose_values, *numbers)))


def rates_of(odometry: Columns, heading: np.ndarray) -> np.ndarray:
    """Return the rates of an odometry's poses in the world, (n, 3): m/s, m/s, rad/s."""
    numbers = (odometry[f"twist.twist.{name}"].tolist() for name in TWIST)
    return np.array(list(map(twist_values, heading.tolist(), *numbers)))


def measurements(run: Run) -> Measurements:
    """Return what was measured, of every quantity the first source of :func:`measured_sources`."""
    sources = measured_sources(run)
    return Measurements(**{name: next(iter(series.values())) for name, series in sources.items()})


def measured_sources(run: Run) -> dict[str, dict[str, Series]]:
    """Return every series of a quantity, by the quantity's name and the topic's.

    Motion capture comes before the odometry that is made of it.  The names are those of
    :class:`~capture_sim.studies.measurements.Measurements`; what was not measured is absent.
    Times are s since the release.
    """
    sources: dict[str, dict[str, Series]] = {}
    for name, pose, odometry in (
        ("chaser", topics.CHASER_POSE, topics.CHASER_ODOMETRY),
        ("target", topics.TARGET_POSE, topics.TARGET_ODOMETRY),
    ):
        for topic, path in ((pose, "pose"), (odometry, "pose.pose")):
            if columns := run.columns(topic):
                series = run.clock.series(columns, poses_of(columns, path))
                sources.setdefault(name, {})[topic.name] = series
    for topic, buffer in buffers_in(run).items():
        for name in ("stroke", "torsion"):
            series = run.clock.series(run.columns(topic), buffer[name])
            sources.setdefault(name, {})[topic.name] = series
    for topic in (topics.CONTACT_WRENCH, topics.LOAD_CELL):
        if run.columns(topic):
            t, force = forces_in(run, topic)
            sources.setdefault("force", {})[topic.name] = Series(t, np.hypot(*force.T))
    return sources


def first_contact(run: Run) -> tuple[float, Topic] | None:
    """Return the time of the first contact, s, and the topic that shows it; None without one.

    That is the located event, else ``bench/contact``, else a force above its noise.
    """
    for event in run.events:
        if event.kind is EventKind.TOUCH:
            return event.t - run.clock.t_release, topics.BENCH_EVENT
    columns = run.columns(topics.CONTACT_STATE)
    if columns:
        touching = np.flatnonzero(columns["in_touch"].astype(bool) | (columns["touches"] > 0))
        t = run.times(topics.CONTACT_STATE)
        return (float(t[touching[0]]), topics.CONTACT_STATE) if touching.size else None
    topic = topics.CONTACT_WRENCH if run.columns(topics.CONTACT_WRENCH) else topics.LOAD_CELL
    first = first_above(*forces_in(run, topic))
    return None if first is None else (first, topic)


def touches_of(run: Run, scene: Scene | None = None) -> tuple[Touches | None, str]:
    """Return the touches of a run and their source; None and the reason if there are none.

    They are those of the located events, else those that ``bench/contact`` counted, with the peaks
    between its messages, or those in a sampled force, whichever was published more often.  With a
    scene, peaks are those of the force normal to its cone, not of the magnitude.
    """
    if run.touches.size:
        return located(run.touches).later(-run.clock.t_release), topics.BENCH_EVENT.name
    forces = (topics.CONTACT_STATE, topics.CONTACT_WRENCH, *(() if scene else (topics.LOAD_CELL,)))
    slow_sources = []
    for topic in sorted(forces, key=lambda topic: -len(run.raw(topic))):
        columns = run.columns(topic)
        if not columns:
            continue
        if topic is topics.CONTACT_STATE:
            t = run.times(topic)
            touches = in_messages(t, *(columns[n] for n in ("touches", "peak_force", "in_touch")))
        else:
            t, force = forces_on_tip(run, topic)
            if scene is None:
                touches = in_force(t, force)
            else:
                touches = in_force(t, force, _attitude(measurements(run), t), scene.cone)
        interval = Series(t, t).interval
        limit = "as long as each message counts one"
        if topic is not topics.CONTACT_STATE:
            limit = f"which may miss those below {MIN_SAMPLES * interval * 1e3:.3g} ms"
        source = f"{topic.name}, {1.0 / interval:.4g} Hz" if interval else topic.name
        if touches is not None:
            return touches, f"{source}, {limit}"
        slow_sources.append(source)
    if slow_sources:
        return None, f"{' and '.join(slow_sources)}: too slow to show touches"
    return None, "no force"


def launch_of(run: Run, scene: Scene) -> LaunchPlan:
    """Return the launch as it was commanded; as the scene plans it where none was recorded."""
    plan = plan_launch(scene)
    columns = run.columns(topics.LAUNCH_COMMAND)
    if not columns or scene.string is None:
        return plan
    return replace(
        plan,
        hanging_mass=float(columns["hanging_mass"][-1]),
        drop_height=float(columns["drop_height"][-1]),
    )


def forces_in(run: Run, topic: Topic) -> Series:
    """Return the force of a topic's wrenches, (n, 2), N, in the frame of the message."""
    columns = run.columns(topic)
    if not columns:
        return Series(np.zeros(0), np.zeros((0, 2)))
    force = np.stack([columns["wrench.force.x"], columns["wrench.force.y"]], axis=1)
    return run.clock.series(columns, force)


def forces_on_tip(run: Run, topic: Topic) -> Series:
    """Return the force on the tip, (n, 2), N; the load cell reads the opposite."""
    t, force = forces_in(run, topic)
    return Series(t, -force if topic is topics.LOAD_CELL else force)


def buffers_in(run: Run) -> dict[Topic, Columns]:
    """Return stroke (m), torsion (rad) and their rates, (n,) each, by the topics that hold them."""
    names = ("stroke", "torsion", "stroke_rate", "torsion_rate")
    buffers: dict[Topic, Columns] = {}
    if state := run.columns(topics.BUFFER_STATE):
        values = (state[field] for field in BUFFER)
        buffers[topics.BUFFER_STATE] = dict(zip(names, values, strict=True))
    joints = run.columns(topics.JOINT_STATES)
    position, velocity = _buffer_joints(joints) if joints else (np.zeros(0), np.zeros(0))
    is_measured = np.isfinite(position)
    if is_measured.any():
        if not np.isfinite(velocity).any():  # a bench may leave them empty
            rows = is_measured.all(axis=1)
            velocity[rows] = _gradient(position[rows], stamps_of(joints)[rows] / 1e9)
        columns = (*position.T, *velocity.T)
        buffers[topics.JOINT_STATES] = dict(zip(names, columns, strict=True))
    return buffers


def _buffer_joints(joints: Columns) -> tuple[np.ndarray, np.ndarray]:
    """Return positions and velocities of slide and hinge, (n, 2) each; NaN without them.

    Other nodes may publish other joints on the same topic.
    """
    n = len(joints["name"])
    position, velocity = np.full((n, 2), np.nan), np.full((n, 2), np.nan)
    columns = (joints[field] for field in ("name", "position", "velocity"))
    for i, (names, positions, velocities) in enumerate(zip(*columns, strict=True)):
        if SLIDE_JOINT in names and HINGE_JOINT in names and len(positions) == len(names):
            order = [names.index(SLIDE_JOINT), names.index(HINGE_JOINT)]
            position[i] = positions[order]
            if len(velocities) == len(names):
                velocity[i] = velocities[order]
    return position, velocity


def _gradient(values: np.ndarray, t: np.ndarray) -> np.ndarray:
    """Return the rates of values (n, m) at times (n,), s; NaN if all are of one time."""
    t, first, index = np.unique(t, return_index=True, return_inverse=True)
    if t.size < 2:
        return np.full(values.shape, np.nan)
    return np.gradient(values[first], t, axis=0)[index]


def _attitude(measured: Measurements, t: np.ndarray) -> np.ndarray:
    """Return the tip's attitude in the cone at times (n,), rad; unmeasured angles count as 0."""
    angle = np.zeros(t.size)
    for sign, series in ((1.0, measured.chaser), (-1.0, measured.target), (1.0, measured.torsion)):
        if series.t.size:
            values = series.values if series.values.ndim == 1 else series.values[:, 2]
            angle += sign * np.interp(t, series.t, np.unwrap(values))
    return angle
