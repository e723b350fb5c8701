"""What a recording holds of measurements, read off the standard topics.

These are the topics that a real bench has too: the vehicles' odometry, the buffer's state,
the contact's wrench.
"""

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
    RESOLVED,
    Touches,
    first_above,
    in_force,
    in_messages,
    located,
)


def poses_of(columns: Columns, at: str) -> np.ndarray:
    """Return the poses that stand at a path, (n, 3): x, y (m), heading (rad)."""
    numbers = (columns[f"{at}.{name}"].tolist() for name in POSE)
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
    found: dict[str, dict[str, Series]] = {}
    for name, pose, odometry in (
        ("chaser", topics.CHASER_POSE, topics.CHASER_ODOMETRY),
        ("target", topics.TARGET_POSE, topics.TARGET_ODOMETRY),
    ):
        for source, at in ((pose, "pose"), (odometry, "pose.pose")):
            if columns := run.columns(source):
                series = run.clock.series(columns, poses_of(columns, at))
                found.setdefault(name, {})[source.name] = series
    for topic, buffer in buffers_in(run).items():
        for name in ("stroke", "torsion"):
            series = run.clock.series(run.columns(topic), buffer[name])
            found.setdefault(name, {})[topic.name] = series
    for topic in (topics.CONTACT_WRENCH, topics.LOAD_CELL):
        if run.columns(topic):
            t, force = forces_in(run, topic)
            found.setdefault("force", {})[topic.name] = Series(t, np.hypot(*force.T))
    return found


def first_contact(run: Run) -> tuple[float, Topic] | None:
    """Return when the tip first met the cone, s, and in which topic; None if it never did.

    From the located event, else from the contact's topic, else from a force above its noise.
    """
    for event in run.events:
        if event.kind is EventKind.TOUCH:
            return event.t - run.clock.t_release, topics.BENCH_EVENT
    columns = run.columns(topics.CONTACT_STATE)
    if columns:
        met = np.flatnonzero(columns["in_touch"].astype(bool) | (columns["touches"] > 0))
        t = run.times(topics.CONTACT_STATE)
        return (float(t[met[0]]), topics.CONTACT_STATE) if met.size else None
    topic = topics.CONTACT_WRENCH if run.columns(topics.CONTACT_WRENCH) else topics.LOAD_CELL
    met_at = first_above(*forces_in(run, topic))
    return None if met_at is None else (met_at, topic)


def touches_of(run: Run, scene: Scene | None = None) -> tuple[Touches | None, str]:
    """Return the touches of a run, and what they were found in; None, and why there are none.

    As events located them; else as ``bench/contact`` counted them, with the peaks between its
    messages, or as a sampled force shows them, whichever comes more often.

    Parameters
    ----------
    run
        The recording.
    scene
        With the cone: peaks are then those of the normal force, not of its magnitude.
    """
    if run.touches.size:
        return located(run.touches).later(-run.clock.t_release), topics.BENCH_EVENT.name
    forces = (topics.CONTACT_STATE, topics.CONTACT_WRENCH, *(() if scene else (topics.LOAD_CELL,)))
    tried = []
    for topic in sorted(forces, key=lambda topic: -len(run.raw(topic))):
        columns = run.columns(topic)
        if not columns:
            continue
        if topic is topics.CONTACT_STATE:
            t = run.times(topic)
            touches = in_messages(t, *(columns[n] for n in ("touches", "peak_force", "in_touch")))
        else:
            t, force = forces_in(run, topic)
            seen = () if scene is None else (_attitude(measurements(run), t), scene.cone)
            touches = in_force(t, force, *seen)
        interval = Series(t, t).interval
        limit = "as long as each message counts one"
        if topic is not topics.CONTACT_STATE:
            limit = f"which may miss those below {RESOLVED * interval * 1e3:.3g} ms"
        source = f"{topic.name}, {1.0 / interval:.4g} Hz" if interval else topic.name
        if touches is not None:
            return touches, f"{source}, {limit}"
        tried.append(source)
    return None, f"{' and '.join(tried)}: too slow to show touches" if tried else "no force"


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


def buffers_in(run: Run) -> dict[Topic, Columns]:
    """Return stroke (m), torsion (rad) and their rates, (n,) each, by the topics that hold them."""
    names = ("stroke", "torsion", "stroke_rate", "torsion_rate")
    found: dict[Topic, Columns] = {}
    if state := run.columns(topics.BUFFER_STATE):
        values = (state[field] for field in BUFFER)
        found[topics.BUFFER_STATE] = dict(zip(names, values, strict=True))
    joints = run.columns(topics.JOINT_STATES)
    known = list(joints["name"][0]) if joints else []
    if {HINGE_JOINT, SLIDE_JOINT} <= set(known) and joints["position"].ndim == 2:
        position, velocity = joints["position"], joints["velocity"]
        if velocity.shape != position.shape:  # a bench may leave them empty
            velocity = np.gradient(position, stamps_of(joints) / 1e9, axis=0)
        both = [known.index(SLIDE_JOINT), known.index(HINGE_JOINT)]
        values = (column for columns in (position, velocity) for column in columns[:, both].T)
        found[topics.JOINT_STATES] = dict(zip(names, values, strict=True))
    return found


def _attitude(seen: Measurements, t: np.ndarray) -> np.ndarray:
    """Return the tip's attitude in the cone, (n,), rad; what was not measured counts as zero."""
    angle = np.zeros(t.size)
    for sign, series in ((1.0, seen.chaser), (-1.0, seen.target), (1.0, seen.torsion)):
        if series.t.size:
            values = series.values if series.values.ndim == 1 else series.values[:, 2]
            angle += sign * np.interp(t, series.t, np.unwrap(values))
    return angle
