"""What a recording holds of measurements, read off the standard topics.

These are the topics that a real bench has too: the vehicles' odometry, the buffer's state,
the contact's wrench.
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from capture_sim.errors import RecordingError
from capture_sim.launch.plan import LaunchPlan, plan_launch
from capture_sim.messages import topics
from capture_sim.messages.convert import EPOCH_NS, HINGE_JOINT, SLIDE_JOINT, LaunchAction
from capture_sim.messages.measurements import BUFFER, POSE, TWIST, pose_values, twist_values
from capture_sim.messages.topics import Topic
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

#: The first pose comes so long after the release at most, ns, if both are of one clock.
LATE_POSE = 1_000_000_000
#: So many poses tell how the bench's clock is ahead of their arrival.
NEAR = 20


def stamps_of(columns: Columns) -> np.ndarray:
    """Return the stamps of a topic's messages, (n,) int64, ns."""
    path = "clock" if "clock.sec" in columns else "header.stamp"
    stamps = np.asarray(columns[f"{path}.sec"]).astype(np.int64) * 1_000_000_000
    return stamps + np.asarray(columns[f"{path}.nanosec"]).astype(np.int64)


def poses_of(columns: Columns, at: str) -> np.ndarray:
    """Return the poses that stand at a path, (n, 3): x, y (m), heading (rad)."""
    numbers = (columns[f"{at}.{name}"].tolist() for name in POSE)
    return np.array(list(map(pose_values, *numbers)))


def rates_of(odometry: Columns, heading: np.ndarray) -> np.ndarray:
    """Return the rates of an odometry's poses in the world, (n, 3): m/s, m/s, rad/s."""
    numbers = (odometry[f"twist.twist.{name}"].tolist() for name in TWIST)
    return np.array(list(map(twist_values, heading.tolist(), *numbers)))


def series_of(columns: Columns, release: int, values: np.ndarray) -> Series:
    """Return what a topic's messages measure, (n,) or (n, m) values, as a series.

    What is no number, or comes twice with one stamp, is left out.
    """
    t = _since(columns, release)
    finite = np.isfinite(values.reshape(len(t), -1)).all(axis=1)
    t, first = np.unique(t[finite], return_index=True)
    return Series(t, values[finite][first])


def release_of(run: Run, after: float | None = None) -> int:
    """Return the stamp of the release on the clock of the poses, ns.

    As :func:`release_recorded` has it.  On a bench with a clock of its own, when the release, or
    where none was given the trial's announcement, arrived; where neither is recorded, the first
    pose's.

    Parameters
    ----------
    run
        The recording.
    after
        s after the first pose, where it is known better; None where it is not.

    Raises
    ------
    RecordingError
        That is behind the last pose.
    """
    if after is not None:
        return _after_first_pose(run, after)
    recorded = release_recorded(run)
    if recorded is not None:
        return recorded
    poses, reference = _poses(run), _reference_event(run)
    if poses is None:
        return EPOCH_NS
    return int(poses[0].min()) if reference is None else reference.arrival + _clock_offset_ns(run)


def release_recorded(run: Run) -> int | None:
    """Return the stamp of the release, ns, where the recording holds it; else None.

    That is the launcher's, else that of simulated runs, if it is of the clock of the poses.
    """
    reference, poses = _reference_event(run), _poses(run)
    if reference is None or poses is None:
        return reference and reference.stamp
    if run.announced is not None and topics.SIMULATOR in run.announced.publishers:
        return reference.stamp  # one clock for all, however late a recording begins
    first, last = int(poses[0].min()), int(poses[0].max())
    return reference.stamp if first - LATE_POSE <= reference.stamp <= last else None


def times_of(run: Run, topic: str | Topic) -> np.ndarray:
    """Return when a topic's messages were stamped, where they have no stamp arrived, (n,).

    Times are s since the release, whichever clock stamps are of: the bench's, or the trial's, which
    the launcher goes by until it knows the bench's.
    """
    columns, release = run.columns(topic), release_of(run)
    if not {"clock.sec", "header.stamp.sec"} & set(columns):
        return (run.log_times(topic) - (release - _clock_offset_ns(run))) / 1e9
    stamps, reference = stamps_of(columns), _reference_event(run)
    trial_release = release if reference is None else reference.stamp
    is_nearer = np.abs(stamps - trial_release) < np.abs(stamps - release)
    return (stamps - np.where(is_nearer, trial_release, release)) / 1e9


class _ReferenceEvent(NamedTuple):
    """The release, else the announcement of the run."""

    stamp: int  # ns
    arrival: int  # ns


def _clock_offset_ns(run: Run) -> int:
    """Return the stamps of the poses less their arrivals, ns; 0 without poses.

    Of the poses nearest to the release: a bench's clock may run slow or fast.
    """
    poses, reference = _poses(run), _reference_event(run)
    if poses is None:
        return 0
    stamps, arrivals = poses
    since = arrivals - (arrivals[0] if reference is None else reference.arrival)
    near = np.argsort(np.abs(since), kind="stable")[:NEAR]
    return int(np.median((stamps - arrivals)[near]))


def _reference_event(run: Run) -> _ReferenceEvent | None:
    """Return the release, else the run's announcement; None if neither is recorded."""
    commands = run.columns(topics.LAUNCH_COMMAND)
    if commands:
        released = np.flatnonzero(commands["action"] == LaunchAction.RELEASE)
        if released.size:
            stamps, arrivals = stamps_of(commands), run.log_times(topics.LAUNCH_COMMAND)
            return _ReferenceEvent(int(stamps[released[0]]), int(arrivals[released[0]]))
    for topic in (topics.RUN_INFO, topics.BENCH_STATE):
        if run.raw(topic):
            return _ReferenceEvent(EPOCH_NS, int(run.log_times(topic)[0]))
    return None


def _poses(run: Run) -> tuple[np.ndarray, np.ndarray] | None:
    """Return stamps and times of arrival of the poses, (n,) int64, ns."""
    for topic in (
        topics.CHASER_POSE,
        topics.CHASER_ODOMETRY,
        topics.TARGET_POSE,
        topics.TARGET_ODOMETRY,
    ):
        with suppress(RecordingError):  # of another type: refused where it is drawn or judged
            if poses := run.columns(topic):
                return stamps_of(poses), run.log_times(topic)
    return None


def _after_first_pose(run: Run, after: float) -> int:
    poses = _poses(run)
    if poses is None:
        raise RecordingError(f"release = {after:g} s: counts from the first pose: there is none")
    first, last = int(poses[0].min()), int(poses[0].max())
    if not 0.0 <= after <= (last - first) / 1e9:
        raise RecordingError(
            f"release = {after:g} s: must be 0 to {(last - first) / 1e9:g} s, from the first "
            "pose to the last"
        )
    return first + round(after * 1e9)


def measurements(run: Run, released: float | None = None) -> Measurements:
    """Return what was measured; times are s since the release.

    What is no number, or comes twice with one stamp, is left out.

    Parameters
    ----------
    run
        The recording.
    released
        When, s after the first pose; None where it is recorded, see
        :func:`release_of`.

    Raises
    ------
    RecordingError
        The release lies outside the recording.
    """
    sources = measured_sources(run, release_of(run, released))
    return Measurements(**{name: next(iter(series.values())) for name, series in sources.items()})


def measured_sources(run: Run, release: int) -> dict[str, dict[str, Series]]:
    """Return every series of a quantity, by the quantity's name and the topic's.

    What motion capture saw comes before what an odometry made of it.  The names are those of
    :class:`~capture_sim.studies.measurements.Measurements`; what was not measured is absent.

    Parameters
    ----------
    run
        The recording.
    release
        Stamp at which time begins, ns.
    """
    found: dict[str, dict[str, Series]] = {}
    for name, pose, odometry in (
        ("chaser", topics.CHASER_POSE, topics.CHASER_ODOMETRY),
        ("target", topics.TARGET_POSE, topics.TARGET_ODOMETRY),
    ):
        for source, at in ((pose, "pose"), (odometry, "pose.pose")):
            if columns := run.columns(source):
                found.setdefault(name, {})[source.name] = series_of(
                    columns, release, poses_of(columns, at)
                )
    for topic, buffer in buffers_in(run).items():
        for name in ("stroke", "torsion"):
            series = series_of(run.columns(topic), release, buffer[name])
            found.setdefault(name, {})[topic.name] = series
    for topic in (topics.CONTACT_WRENCH, topics.LOAD_CELL):
        if run.columns(topic):
            t, force = forces_in(run, topic, release)
            found.setdefault("force", {})[topic.name] = Series(t, np.hypot(*force.T))
    return found


def first_contact(run: Run) -> tuple[float, Topic] | None:
    """Return when the tip first met the cone, s, and in which topic; None if it never did.

    From the located event, else from the contact's topic, else from a force above its noise.
    """
    for event in run.events:
        if event.kind is EventKind.TOUCH:
            return event.t, topics.BENCH_EVENT
    columns = run.columns(topics.CONTACT_STATE)
    if columns:
        met = np.flatnonzero(columns["in_touch"].astype(bool) | (columns["touches"] > 0))
        at = _since(columns, release_of(run))
        return (float(at[met[0]]), topics.CONTACT_STATE) if met.size else None
    topic = topics.CONTACT_WRENCH if run.columns(topics.CONTACT_WRENCH) else topics.LOAD_CELL
    met_at = first_above(*forces_in(run, topic, release_of(run)))
    return None if met_at is None else (met_at, topic)


def touches_of(
    run: Run, released: float | None = None, scene: Scene | None = None
) -> tuple[Touches | None, str]:
    """Return the touches of a run, and what they were found in; None, and why there are none.

    As events located them; else as ``bench/contact`` counted them, with the peaks between its
    messages, or as a sampled force shows them, whichever comes more often.

    Parameters
    ----------
    run
        The recording.
    released
        See :func:`measurements`.
    scene
        With the cone: peaks are then those of the normal force, not of its magnitude.
    """
    release = release_of(run, released)
    if run.touches.size:
        found = located(run.touches)
        return found.later((release_of(run) - release) / 1e9), topics.BENCH_EVENT.name
    forces = (topics.CONTACT_STATE, topics.CONTACT_WRENCH, *(() if scene else (topics.LOAD_CELL,)))
    tried = []
    for topic in sorted(forces, key=lambda topic: -len(run.raw(topic))):
        columns = run.columns(topic)
        if not columns:
            continue
        if topic is topics.CONTACT_STATE:
            t = _since(columns, release)
            touches = in_messages(t, *(columns[n] for n in ("touches", "peak_force", "in_touch")))
        else:
            t, force = forces_in(run, topic, release)
            seen = () if scene is None else (_attitude(measurements(run, released), t), scene.cone)
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


def _since(columns: Columns, release: int) -> np.ndarray:
    return (stamps_of(columns) - release) / 1e9


def forces_in(run: Run, topic: Topic, release: int) -> Series:
    """Return the force of a topic's wrenches, (n, 2), N, in the frame of the message."""
    columns = run.columns(topic)
    if not columns:
        return Series(np.zeros(0), np.zeros((0, 2)))
    force = np.stack([columns["wrench.force.x"], columns["wrench.force.y"]], axis=1)
    return series_of(columns, release, force)


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
