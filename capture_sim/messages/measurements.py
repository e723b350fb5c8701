"""Messages that the capture detector decides by, as its measurements."""

from __future__ import annotations

import math
from typing import Any

from capture_sim.detection.measurements import Source, Values
from capture_sim.errors import MessageError
from capture_sim.messages.cdr import Numbers
from capture_sim.messages.convert import HINGE_JOINT, SLIDE_JOINT
from capture_sim.messages.definitions import decoded, typestore
from capture_sim.messages.topics import (
    BUFFER_STATE,
    CHASER_ODOMETRY,
    CHASER_POSE,
    JOINT_STATES,
    TARGET_ODOMETRY,
    TARGET_POSE,
    Topic,
)
from capture_sim.scene.parts import Scene

Planar = tuple[float, float, float]

#: What a bench without simulator may measure; of each source the first topic that comes is used.
OF_A_BENCH = {
    CHASER_ODOMETRY: Source.CHASER,
    CHASER_POSE: Source.CHASER,
    TARGET_ODOMETRY: Source.TARGET,
    TARGET_POSE: Source.TARGET,
    BUFFER_STATE: Source.BUFFER,
    JOINT_STATES: Source.BUFFER,
}


def detector_sources(scene: Scene) -> dict[Topic, Source]:
    """Return the topics that the detector decides by, and what each of them measures.

    Where the scene has motion capture, the poses are its; else those of the odometry.
    """
    if scene.sensors is not None and scene.sensors.motion_capture is not None:
        poses = {CHASER_POSE: Source.CHASER, TARGET_POSE: Source.TARGET}
    else:
        poses = {CHASER_ODOMETRY: Source.CHASER, TARGET_ODOMETRY: Source.TARGET}
    return {**poses, BUFFER_STATE: Source.BUFFER}


STAMP = ("header.stamp.sec", "header.stamp.nanosec")
#: What :func:`pose_values` and :func:`twist_values` take of geometry_msgs' Pose and Twist.
POSE = ("position.x", "position.y", "orientation.z", "orientation.w")
TWIST = ("linear.x", "linear.y", "angular.z")
#: Stroke (m), torsion (rad) and their rates in BufferState.
BUFFER = ("axial_stroke", "torsion", "axial_rate", "torsion_rate")
#: The numbers that a measurement is made of, by the type of its message.
_NUMBERS = {
    "nav_msgs/msg/Odometry": (
        *(f"pose.pose.{name}" for name in POSE),
        *(f"twist.twist.{name}" for name in TWIST),
    ),
    "geometry_msgs/msg/PoseStamped": tuple(f"pose.{name}" for name in POSE),
    "capture_sim/msg/BufferState": BUFFER,
}


class MeasurementReader:
    """Reads what the messages of a topic of :data:`OF_A_BENCH` measure, from their bytes alone."""

    def __init__(self, topic: Topic) -> None:
        self._topic = topic
        numbers = _NUMBERS.get(topic.type_name, ())
        self._numbers = Numbers(typestore(), topic.type_name, *STAMP, *numbers)

    def __call__(self, data: bytes) -> tuple[int, Values]:
        """Return the stamp, ns, and the values of the topic's `Source`.

        MessageError if the bytes are no such message, or it has no such joints.
        """
        sec, nanosec, *numbers = self._numbers(data).item()
        stamp = sec * 1_000_000_000 + nanosec
        if self._topic is JOINT_STATES:
            return stamp, _joints(decoded(self._topic, data))
        if self._topic is BUFFER_STATE:
            return stamp, tuple(numbers)
        pose = pose_values(*numbers[:4])
        return stamp, (*pose, *twist_values(pose[2], *numbers[4:])) if numbers[4:] else pose


def _joints(message: Any) -> Values:
    """Return what sensor_msgs/JointState says of the buffer; rates only where it has them."""
    try:
        slide, hinge = (list(message.name).index(name) for name in (SLIDE_JOINT, HINGE_JOINT))
        values: Values = (message.position[slide], message.position[hinge])
        if len(message.velocity):
            values += (message.velocity[slide], message.velocity[hinge])
    except (ValueError, IndexError):
        raise MessageError(f"joints: must be {SLIDE_JOINT} and {HINGE_JOINT}") from None
    return values


def pose_values(x: float, y: float, qz: float, qw: float) -> Planar:
    """Return x, y (m) and heading (rad) of a position and a quaternion about z."""
    return x, y, 2.0 * math.atan2(qz, qw)


def twist_values(theta: float, vx: float, vy: float, omega: float) -> Planar:
    """Return velocity (m/s) and rate (rad/s) in the world of those in the own frame."""
    c, s = math.cos(theta), math.sin(theta)
    return c * vx - s * vy, s * vx + c * vy, omega
