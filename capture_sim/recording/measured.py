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
from capture_sim.messaging.messages import EPOCH_NS
from capture_sim.messaging.topics import (
    BUFFER_STATE,
    CHASER_ODOMETRY,
    CONTACT_STATE,
    CONTACT_WRENCH,
    JOINT_STATES,
    LAUNCH_COMMAND,
    TARGET_ODOMETRY,
)
from capture_sim.recording.reader import Columns, Run
from capture_sim.results import first_cluster
from capture_sim.samples import EventKind
from capture_sim.scene import Scene

#: Force on the tip that counts as contact where no topic tells of it, N.
CONTACT_FORCE = 1.0


def measurements(run: Run) -> Measurements:
    """Return what was measured; times are s since the release (stamp - 1 s)."""
    found: dict[str, Series] = {}
    for name, topic in (("chaser", CHASER_ODOMETRY), ("target", TARGET_ODOMETRY)):
        # what motion capture saw comes before what an odometry made of it
        for source, at in ((f"motion_capture/{name}", "pose"), (topic.name, "pose.pose")):
            columns = run.columns(source)
            if columns:
                found[name] = Series(_times(columns), np.stack(_pose(columns, at), axis=1))
                break
    columns = run.columns(BUFFER_STATE.name)
    if columns:
        found["stroke"] = Series(_times(columns), columns["axial_stroke"])
        found["torsion"] = Series(_times(columns), columns["torsion"])
    elif joints := run.columns(JOINT_STATES.name):
        position = joints["position"]
        if position.ndim == 2 and position.shape[1] == 2:  # hinge, slide
            found["stroke"] = Series(_times(joints), position[:, 1])
            found["torsion"] = Series(_times(joints), position[:, 0])
    columns = run.columns(CONTACT_WRENCH.name)
    if columns:
        force = np.hypot(columns["wrench.force.x"], columns["wrench.force.y"])
        found["force"] = Series(_times(columns), force)
    return Measurements(**found)


def first_contact(run: Run) -> float | None:
    """Return when the tip first met the cone, s; None if it never did.

    From the located event, else from the contact's topic, else from a force above 1 N.
    """
    for event in run.events:
        if event.kind is EventKind.TOUCH:
            return event.t
    columns = run.columns(CONTACT_STATE.name)
    if columns:
        met = np.flatnonzero(columns["in_touch"].astype(bool) | (columns["touches"] > 0))
        return float(_times(columns)[met[0]]) if met.size else None
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
    columns = run.columns(LAUNCH_COMMAND.name)
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
        told = run.columns(CONTACT_STATE.name)
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


def _times(columns: Columns) -> np.ndarray:
    return (stamps_of(columns) - EPOCH_NS) / 1e9


def _pose(columns: Columns, at: str = "pose.pose") -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    z, w = (columns[f"{at}.orientation.{axis}"].tolist() for axis in "zw")
    # by math, as the detector's node does it: NumPy's differ in the last bit
    theta = 2.0 * np.array(list(map(math.atan2, z, w)))
    return columns[f"{at}.position.x"], columns[f"{at}.position.y"], theta
