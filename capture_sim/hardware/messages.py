"""Messages of the loop: commanded position, measured position, and wrench of the tip."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from capture_sim.errors import MessageError
from capture_sim.hardware.law import TipState, Wrench
from capture_sim.messages.cdr import Columns
from capture_sim.messages.convert import (
    CONE_FRAME,
    TIP_FRAME,
    Messages,
    odometry,
    stamp_columns,
    stamp_in,
    stamp_seconds,
    stamps_ns,
)
from capture_sim.messages.measurements import pose_values, twist_values
from capture_sim.messages.topics import Rate, Topic

CONTACT_RIG = "contact_rig"
LOOP_SIMULATOR = "loop_simulator"

#: Commanded state of the tip in the frame target/cone.
TIP = Topic("loop/tip", "nav_msgs/msg/Odometry", (LOOP_SIMULATOR,), Rate.CONTROL, depth=1)
#: Wrench on the tip, with the stamp of the position that it answers.
TIP_WRENCH = Topic(
    "loop/wrench", "geometry_msgs/msg/WrenchStamped", (CONTACT_RIG,), Rate.CONTROL, depth=1
)
#: Measured state of the rig's tip at the reading of a wrench, with that wrench's stamp; optional.
RIG_TIP = Topic("loop/rig_tip", "nav_msgs/msg/Odometry", (CONTACT_RIG,), Rate.CONTROL, depth=1)

#: Reason for which the rig must hold its position; empty while the loop runs.
HOLD = Topic(
    "loop/hold", "std_msgs/msg/String", (LOOP_SIMULATOR,), Rate.ONCE, depth=1, transient_local=True
)


def stamp_of(message: Any) -> float:
    """Return the stamp of a message with a header, s since the loop's start."""
    return stamp_seconds(stamp_in(message))


def tip_message(make: Messages, t: float, tip: TipState) -> bytes:
    """Return the tip's state as Odometry: pose in target/cone, twist in the tip's own axes.

    ``t`` is the stamp, s.
    """
    columns = odometry(
        np.array([[tip.x, tip.y, tip.theta]]), np.array([[tip.vx, tip.vy, tip.omega]])
    )
    return _stamped(make, "nav_msgs/msg/Odometry", t, columns, child_frame_id=TIP_FRAME)


def wrench_message(make: Messages, t: float, wrench: Wrench) -> bytes:
    """Return a wrench as WrenchStamped: on the tip, about its centre, in the axes of target/cone.

    ``t`` is the stamp, s.
    """
    names = [f"wrench.{kind}.{axis}" for kind in ("force", "torque") for axis in "xyz"]
    columns = {name: np.array([value]) for name, value in zip(names, wrench, strict=True)}
    return _stamped(make, "geometry_msgs/msg/WrenchStamped", t, columns)


def _stamped(make: Messages, type_name: str, t: float, columns: Columns, **fixed: str) -> bytes:
    columns = {**stamp_columns("header.stamp", stamps_ns(np.array([t]))), **columns}
    return next(make.many(type_name, columns, **fixed, **{"header.frame_id": CONE_FRAME}))


def tip_of(message: Any) -> TipState:
    """Return the tip's state from Odometry, with the velocity turned into the axes of target/cone.

    Raise MessageError if the frame is not target/cone or a value is not finite.
    """
    _check_frame(message)
    pose, twist = message.pose.pose, message.twist.twist
    planar = pose_values(pose.position.x, pose.position.y, pose.orientation.z, pose.orientation.w)
    rates = twist_values(planar[2], twist.linear.x, twist.linear.y, twist.angular.z)
    tip = TipState(stamp_of(message), *planar, *rates)
    if not all(math.isfinite(value) for value in tip):
        raise MessageError(f"tip = {tuple(tip)}: must be finite")
    return tip


def wrench_of(message: Any) -> Wrench:
    """Return the wrench from WrenchStamped; raise MessageError if the frame is not target/cone."""
    _check_frame(message)
    force, torque = message.wrench.force, message.wrench.torque
    return Wrench(force.x, force.y, force.z, torque.x, torque.y, torque.z)


def _check_frame(message: Any) -> None:
    frame = message.header.frame_id
    if frame != CONE_FRAME:
        raise MessageError(f"header.frame_id = {frame!r}: must be {CONE_FRAME}")
