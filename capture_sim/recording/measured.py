"""What a recording holds of measurements, read off the standard topics.

These are the topics that a real bench has too: the vehicles' odometry, the buffer's state,
the contact's wrench.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from capture_sim.analysis.identification import Touches
from capture_sim.analysis.measurements import Measurements, Series
from capture_sim.launching import LaunchPlan, plan_launch
from capture_sim.messaging.messages import EPOCH_NS, HINGE_JOINT, SLIDE_JOINT, LaunchAction
from capture_sim.messaging.topics import (
    BENCH_STATE,
    BUFFER_STATE,
    CHASER_ODOMETRY,
    CHASER_POSE,
    CONTACT_STATE,
    CONTACT_WRENCH,
    JOINT_STATES,
    LAUNCH_COMMAND,
    RUN_INFO,
    TARGET_ODOMETRY,
    TARGET_POSE,
)
from capture_sim.recording.reader import Columns, Run
from capture_sim.results import first_cluster
from capture_sim.samples import EventKind
from capture_sim.scene import Scene

#: Force on the tip that counts as contact where no topic tells of it, N.
CONTACT_FORCE = 1.0


def measurements(run: Run) -> Measurements:
    """Return what was measured; times are s since the release, see :func:`release_of`.

    What is no number, or comes twice with one stamp, is left out.
    """
    found: dict[str, Series] = {}
    release = release_of(run)
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

    From the located event, else from the contact's topic, else from a force above 1 N.
    """
    for event in run.events:
        if event.kind is EventKind.TOUCH:
            return event.t
    columns = run.columns(CONTACT_STATE)
    if columns:
        met = np.flatnonzero(columns["in_touch"].astype(bool) | (columns["touches"] > 0))
        return float(_since(columns, release_of(run))[met[0]]) if met.size else None
    force = measurements(run).force
    above = np.flatnonzero(force.values > CONTACT_FORCE)
    return float(force.t[above[0]]) if above.size else None


def first_touches(run: Run, count: int, start_noise: float, peak_noise: float) -> Touches | None:
    """Return the first touches of a run, as events tell them; None where there are none.

    Parameters
    ----------
    run, count
        How many of which run.
    start_noise, peak_noise
        Standard deviations of a touch's start (s) and peak force (N).
    """
    touches = run.touches[np.argsort(run.touches["start"], kind="stable")][:count]
    if not touches.size:
        return None
    return Touches(touches["start"], touches["peak_force"], start_noise, peak_noise)


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


def stamps_of(columns: Columns) -> np.ndarray:
    """Return the stamps of a topic's messages, (n,) ns."""
    path = "clock" if "clock.sec" in columns else "header.stamp"
    stamps = np.asarray(columns[f"{path}.sec"]).astype(np.int64) * 1_000_000_000
    return stamps + np.asarray(columns[f"{path}.nanosec"]).astype(np.int64)


def release_of(run: Run) -> int:
    """Return the stamp of the release, ns: the launcher's, else that of simulated runs.

    Where neither is recorded, as on a bench whose clock is the wall's, the first pose's.
    """
    commands = run.columns(LAUNCH_COMMAND)
    if commands:
        released = np.flatnonzero(commands["action"] == LaunchAction.RELEASE)
        if released.size:
            return int(stamps_of(commands)[released[0]])
    if run.raw(RUN_INFO) or run.raw(BENCH_STATE):
        return EPOCH_NS
    for topic in (CHASER_POSE, CHASER_ODOMETRY, TARGET_POSE, TARGET_ODOMETRY):
        if poses := run.columns(topic):
            return int(stamps_of(poses).min())
    return EPOCH_NS


def _since(columns: Columns, release: int) -> np.ndarray:
    return (stamps_of(columns) - release) / 1e9


def _series(columns: Columns, release: int, values: np.ndarray) -> Series:
    t = _since(columns, release)
    finite = np.isfinite(values.reshape(len(t), -1)).all(axis=1)
    t, first = np.unique(t[finite], return_index=True)
    return Series(t, values[finite][first])


def _pose(columns: Columns, at: str = "pose.pose") -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    z, w = (columns[f"{at}.orientation.{axis}"].tolist() for axis in "zw")
    # by math, as the detector's node does it: NumPy's differ in the last bit
    theta = 2.0 * np.array(list(map(math.atan2, z, w)))
    return columns[f"{at}.position.x"], columns[f"{at}.position.y"], theta
