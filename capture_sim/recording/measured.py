"""What a recording holds of measurements, read off the standard topics.

These are the topics that a real bench has too: the vehicles' odometry, the buffer's state,
the contact's wrench.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from capture_sim.analysis.measurements import Measurements, Series
from capture_sim.analysis.touches import (
    Touches,
    quiet_before_contact,
    stretches_above,
    touches_in_force,
    touches_told,
)
from capture_sim.launching import LaunchPlan, plan_launch
from capture_sim.messaging.bench_columns import headings_of, release_of, stamps_of
from capture_sim.messaging.messages import HINGE_JOINT, SLIDE_JOINT
from capture_sim.messaging.topics import (
    BENCH_EVENT,
    BUFFER_STATE,
    CHASER_ODOMETRY,
    CHASER_POSE,
    CONTACT_STATE,
    CONTACT_WRENCH,
    JOINT_STATES,
    LAUNCH_COMMAND,
    TARGET_ODOMETRY,
    TARGET_POSE,
)
from capture_sim.recording.reader import Columns, Run
from capture_sim.results import first_cluster
from capture_sim.samples import EventKind
from capture_sim.scene import Scene


def measurements(run: Run, released: float | None = None) -> Measurements:
    """Return what was measured; times are s since the release.

    What is no number, or comes twice with one stamp, is left out.

    Parameters
    ----------
    run
        The recording.
    released
        When, s after the first pose; None where the recording tells, see
        :func:`capture_sim.messaging.bench_columns.release_of`.

    Raises
    ------
    RecordingError
        The release lies outside the recording.
    """
    found: dict[str, Series] = {}
    release = release_of(run, released)
    for name, pose, odometry in (
        ("chaser", CHASER_POSE, CHASER_ODOMETRY),
        ("target", TARGET_POSE, TARGET_ODOMETRY),
    ):
        # what motion capture saw comes before what an odometry made of it
        for source, at in ((pose, "pose"), (odometry, "pose.pose")):
            columns = run.columns(source)
            if columns:
                found[name] = _series(columns, release, np.stack(_pose(columns, at), axis=1))
                break
    columns = run.columns(BUFFER_STATE)
    if columns:
        found["stroke"] = _series(columns, release, columns["axial_stroke"])
        found["torsion"] = _series(columns, release, columns["torsion"])
    elif joints := run.columns(JOINT_STATES):
        position, names = joints["position"], list(joints["name"][0])
        if position.ndim == 2 and {HINGE_JOINT, SLIDE_JOINT} <= set(names):
            found["stroke"] = _series(joints, release, position[:, names.index(SLIDE_JOINT)])
            found["torsion"] = _series(joints, release, position[:, names.index(HINGE_JOINT)])
    columns = run.columns(CONTACT_WRENCH)
    if columns:
        force = np.hypot(columns["wrench.force.x"], columns["wrench.force.y"])
        found["force"] = _series(columns, release, force)
    return Measurements(**found)


def first_contact(run: Run) -> float | None:
    """Return when the tip first met the cone, s; None if it never did.

    From the located event, else from the contact's topic, else from a force above its noise.
    """
    for event in run.events:
        if event.kind is EventKind.TOUCH:
            return event.t
    columns = run.columns(CONTACT_STATE)
    if columns:
        met = np.flatnonzero(columns["in_touch"].astype(bool) | (columns["touches"] > 0))
        return float(_since(columns, release_of(run))[met[0]]) if met.size else None
    t, force = _wrench(run, release_of(run))
    quiet = quiet_before_contact(force)
    if quiet is None:
        return None
    above = stretches_above(np.hypot(*(force - quiet.bias).T), quiet.threshold)
    return float(t[above[0].first]) if above else None


def first_touches(
    run: Run,
    scene: Scene,
    count: int,
    start_noise: float,
    peak_noise: float,
    released: float | None = None,
) -> tuple[Touches | None, str]:
    """Return the first touches of a run, and the topic that tells of them; None where none does.

    Events tell them exactly; else they are found in ``contact/wrench`` or in the peaks of
    ``bench/contact``, whichever comes more often.

    Parameters
    ----------
    run, scene
        The recording, and the cone in it.
    count
        Touches at most.
    start_noise, peak_noise
        Standard deviations of a touch's start (s) and peak force (N).
    released
        See :func:`measurements`.
    """
    touches = run.touches[np.argsort(run.touches["start"], kind="stable")][:count]
    if touches.size:
        release = (release_of(run, released) - release_of(run)) / 1e9
        found = Touches(touches["start"] - release, touches["peak_force"], start_noise, peak_noise)
        return found, BENCH_EVENT.name
    sources = (CONTACT_WRENCH, CONTACT_STATE)
    for topic in sorted(sources, key=lambda topic: -len(run.raw(topic))):
        columns = run.columns(topic)
        if not columns:
            continue
        if topic is CONTACT_STATE:
            found_or_not = touches_told(
                _since(columns, release_of(run, released)),
                columns["touches"],
                columns["peak_force"],
                columns["in_touch"],
                count,
                start_noise,
                peak_noise,
            )
        else:
            seen = measurements(run, released)
            t, force = _wrench(run, release_of(run, released))
            found_or_not = touches_in_force(
                t, force, _attitude(seen, t), scene.cone, count, start_noise, peak_noise
            )
        if found_or_not is not None:
            return found_or_not, topic.name
    return None, ""


def launch_of(run: Run, scene: Scene) -> LaunchPlan:
    """Return the launch as it was commanded; as the scene plans it where none was recorded."""
    plan = plan_launch(scene)
    columns = run.columns(LAUNCH_COMMAND)
    if not columns or scene.string is None:
        return plan
    return replace(
        plan,
        hanging_mass=float(columns["hanging_mass"][-1]),
        drop_height=float(columns["drop_height"][-1]),
    )


def characteristics(run: Run) -> dict[str, float]:
    """Return the run in a few numbers, by name with the unit; what was not measured is absent.

    Peaks are those located between samples where the recording holds them, else the largest
    sample.
    """
    found: dict[str, float] = {}
    met = first_contact(run)
    if met is not None:
        found["first contact, s"] = met
    touches = first_cluster(run.touches)
    if touches.size:
        lasted = float(touches["end"].max() - touches["start"].min())
        found["first contact lasts, ms"] = lasted * 1e3
        found["peak force of first contact, N"] = float(touches["peak_force"].max())
        found["largest force, N"] = float(run.touches["peak_force"].max())
        found["touches"] = float(run.touches.size)
        found["normal impulse, N s"] = float(run.touches["impulse"].sum())
    else:
        told = run.columns(CONTACT_STATE)
        force = told["peak_force"] if told else measurements(run).force.values
        if len(force):
            found["largest force, N"] = float(np.max(force))
    seen = measurements(run)
    if seen.stroke.t.size:
        found["largest stroke inwards, mm"] = -float(seen.stroke.values.min()) * 1e3
        found["largest stroke outwards, mm"] = float(seen.stroke.values.max()) * 1e3
    if seen.torsion.t.size:
        found["largest torsion, mrad"] = float(np.abs(seen.torsion.values).max()) * 1e3
    if run.statuses:
        found["nearest to BE, mm"] = run.statuses[-1].nearest_distance * 1e3
    return found


def _since(columns: Columns, release: int) -> np.ndarray:
    return (stamps_of(columns) - release) / 1e9


def _wrench(run: Run, release: int) -> tuple[np.ndarray, np.ndarray]:
    """Return times (n,), s, and force on the tip in its own frame (n, 2), N."""
    columns = run.columns(CONTACT_WRENCH)
    if not columns:
        return np.zeros(0), np.zeros((0, 2))
    force = np.stack([columns["wrench.force.x"], columns["wrench.force.y"]], axis=1)
    series = _series(columns, release, force)
    return series.t, series.values


def _attitude(seen: Measurements, t: np.ndarray) -> np.ndarray:
    """Return the tip's attitude in the cone, (n,), rad; what was not measured counts as zero."""
    angle = np.zeros(t.size)
    for sign, series in ((1.0, seen.chaser), (-1.0, seen.target), (1.0, seen.torsion)):
        if series.t.size:
            values = series.values if series.values.ndim == 1 else series.values[:, 2]
            angle += sign * np.interp(t, series.t, np.unwrap(values))
    return angle


def _series(columns: Columns, release: int, values: np.ndarray) -> Series:
    t = _since(columns, release)
    finite = np.isfinite(values.reshape(len(t), -1)).all(axis=1)
    t, first = np.unique(t[finite], return_index=True)
    return Series(t, values[finite][first])


def _pose(columns: Columns, at: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    return columns[f"{at}.position.x"], columns[f"{at}.position.y"], headings_of(columns, at)
