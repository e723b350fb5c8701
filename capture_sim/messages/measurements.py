"""Messages that the capture detector decides by, as its measurements."""

from __future__ import annotations

import math
from typing import Any

from capture_sim.detection.align import Planar, Source, Values
from capture_sim.messages.cdr import Numbers
from capture_sim.messages.definitions import typestore
from capture_sim.messages.topics import (
    BUFFER_STATE,
    CHASER_ODOMETRY,
    CHASER_POSE,
    TARGET_ODOMETRY,
    TARGET_POSE,
    Topic,
)
from capture_sim.scene.parts import Scene


def detector_sources(scene: Scene) -> dict[Topic, Source]:
    """Return the topics that the detector decides by, and what each of them measures.

    Where the scene has motion capture, the poses are its; else those of the odometry.
    """
    if scene.sensors is not None and scene.sensors.motion_capture is not None:
        poses = {CHASER_POSE: Source.CHASER, TARGET_POSE: Source.TARGET}
    else:
        poses = {CHASER_ODOMETRY: Source.CHASER, TARGET_ODOMETRY: Source.TARGET}
    return {**poses, BUFFER_STATE: Source.BUFFER}


_POSE = ("position.x", "position.y", "orientation.z", "orientation.w")
_TWIST = ("linear.x", "linear.y", "angular.z")
#: The numbers that a measurement is made of, by the type of its message.
_NUMBERS = {
    "nav_msgs/msg/Odometry": (
        *(f"pose.pose.{name}" for name in _POSE),
        *(f"twist.twist.{name}" for name in _TWIST),
    ),
    "geometry_msgs/msg/PoseStamped": tuple(f"pose.{name}" for name in _POSE),
    "capture_sim/msg/BufferState": ("axial_stroke", "torsion", "axial_rate", "torsion_rate"),
}


class MeasurementReader:
    """Reads what a topic's messages measure, one after another, from their bytes alone.

    Parameters
    ----------
    topic
        Of the detector, see :func:`detector_sources`.
    """

    def __init__(self, topic: Topic) -> None:
        self._of_buffer = topic is BUFFER_STATE
        stamp = ("header.stamp.sec", "header.stamp.nanosec")
        self._numbers = Numbers(typestore(), topic.type_name, *stamp, *_NUMBERS[topic.type_name])

    def __call__(self, data: bytes) -> tuple[int, Values]:
        """Return the stamp, ns, and the values, see :class:`capture_sim.detection.align.Source`.

        Raises
        ------
        MessageError
            The bytes are no such message.
        """
        sec, nanosec, *numbers = self._numbers(data).item()
        stamp = sec * 1_000_000_000 + nanosec
        if self._of_buffer:
            return stamp, tuple(numbers)
        pose = pose_values(*numbers[:4])
        return stamp, (*pose, *twist_values(pose[2], *numbers[4:])) if numbers[4:] else pose


def measured(source: Source, message: Any) -> Values:
    """Return what a message measures, see :class:`capture_sim.detection.align.Source`.

    Parameters
    ----------
    source
        Of the message.
    message
        nav_msgs/Odometry, geometry_msgs/PoseStamped or capture_sim/BufferState, of any
        library.
    """
    if source is Source.BUFFER:
        return (message.axial_stroke, message.torsion, message.axial_rate, message.torsion_rate)
    if not hasattr(message, "twist"):
        return _planar(message.pose)
    pose, twist = _planar(message.pose.pose), message.twist.twist
    return (*pose, *twist_values(pose[2], twist.linear.x, twist.linear.y, twist.angular.z))


def pose_values(x: float, y: float, qz: float, qw: float) -> Planar:
    """Return x, y (m) and heading (rad) of a position and a quaternion about z."""
    return x, y, 2.0 * math.atan2(qz, qw)


def twist_values(theta: float, vx: float, vy: float, omega: float) -> Planar:
    """Return velocity (m/s) and rate (rad/s) in the world of those in the own frame."""
    c, s = math.cos(theta), math.sin(theta)
    return c * vx - s * vy, s * vx + c * vy, omega


def _planar(pose: Any) -> Planar:
    return pose_values(pose.position.x, pose.position.y, pose.orientation.z, pose.orientation.w)
