"""The two messages of the loop: where the tip is, and what acts on it."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from capture_sim.errors import MessageError
from capture_sim.hardware.walls import TipState, Wrench
from capture_sim.messages.cdr import Columns
from capture_sim.messages.convert import (
    CONE_FRAME,
    TIP_FRAME,
    Messages,
    odometry,
    stamp_columns,
    stamp_seconds,
    stamps_ns,
    wrenches,
)
from capture_sim.messages.measurements import pose_values, twist_values


def stamp_of(message: Any) -> float:
    """Return the stamp of a message with a header, s since the loop's start."""
    stamp = message.header.stamp
    return stamp_seconds(int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec))


def tip_message(make: Messages, tip: TipState) -> bytes:
    """Return Odometry of the tip against the cone: pose in its frame, twist in the tip's."""
    columns = odometry(
        np.array([[tip.x, tip.y, tip.theta]]), np.array([[tip.vx, tip.vy, tip.omega]])
    )
    return _one(make, "nav_msgs/msg/Odometry", tip.t, columns, child_frame_id=TIP_FRAME)


def wrench_message(make: Messages, t: float, wrench: Wrench) -> bytes:
    """Return WrenchStamped on the tip, about its centre, in the axes of target/cone.

    ``t`` is the time of the tip's place that it answers, s.
    """
    return _one(make, "geometry_msgs/msg/WrenchStamped", t, wrenches(np.array([wrench])))


def _one(make: Messages, type_name: str, t: float, columns: Columns, **fixed: str) -> bytes:
    columns = {**stamp_columns("header.stamp", stamps_ns(np.array([t]))), **columns}
    return next(make.many(type_name, columns, **fixed, **{"header.frame_id": CONE_FRAME}))


def tip_of(message: Any) -> TipState:
    """Return what a message says of the tip.

    Raises
    ------
    MessageError
        It is given in another frame than target/cone, or in numbers that are not finite.
    """
    _check_frame(message)
    pose, twist = message.pose.pose, message.twist.twist
    place = pose_values(pose.position.x, pose.position.y, pose.orientation.z, pose.orientation.w)
    rates = twist_values(place[2], twist.linear.x, twist.linear.y, twist.angular.z)
    tip = TipState(stamp_of(message), *place, *rates)
    if not all(math.isfinite(value) for value in tip):
        raise MessageError(f"{tip}: must be finite numbers")
    return tip


def wrench_of(message: Any) -> Wrench:
    """Return the wrench that a message says.

    Raises
    ------
    MessageError
        It is given in another frame than target/cone.
    """
    _check_frame(message)
    force, torque = message.wrench.force, message.wrench.torque
    return force.x, force.y, torque.z


def _check_frame(message: Any) -> None:
    frame = message.header.frame_id
    if frame != CONE_FRAME:
        raise MessageError(f"header.frame_id = {frame!r}: must be {CONE_FRAME}")
