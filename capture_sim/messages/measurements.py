"""Reading of the capture detector's measurements from messages."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping

from rosbags.typesys.store import Typestore

from capture_sim.detection.measurements import Source, Values
from capture_sim.messages.cdr import Numbers
from capture_sim.messages.definitions import typestore
from capture_sim.messages.joints import JointReader
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
#: If z and w of a quaternion have a smaller norm than this, it is no rotation about z.
_MIN_NORM = 1e-3

#: Topics that a bench without simulator may publish, by source.  Of each source, the first topic
#: that arrives is used.
TOPICS_OF_SOURCE = {
    Source.CHASER: (CHASER_POSE, CHASER_ODOMETRY),
    Source.TARGET: (TARGET_POSE, TARGET_ODOMETRY),
    Source.BUFFER: (JOINT_STATES, BUFFER_STATE),
}
OF_A_BENCH = {topic: source for source, topics in TOPICS_OF_SOURCE.items() for topic in topics}


STAMP = ("header.stamp.sec", "header.stamp.nanosec")
#: Fields of geometry_msgs' Pose and Twist that :func:`pose_values` and :func:`twist_values` need.
POSE = ("position.x", "position.y", "orientation.z", "orientation.w")
TWIST = ("linear.x", "linear.y", "angular.z")
#: Stroke (m), torsion (rad) and their rates in BufferState.
BUFFER = ("axial_stroke", "torsion", "axial_rate", "torsion_rate")
#: Paths of the numbers in a measurement, by the type of its message.
_NUMBERS = {
    "nav_msgs/msg/Odometry": (
        *(f"pose.pose.{name}" for name in POSE),
        *(f"twist.twist.{name}" for name in TWIST),
    ),
    "geometry_msgs/msg/PoseStamped": tuple(f"pose.{name}" for name in POSE),
    "capture_sim/msg/BufferState": BUFFER,
}


class MeasurementReader:
    """Reader of the measurements in serialised messages of a topic of :data:`OF_A_BENCH`.

    Nodes and recordings both use it.  ``store`` contains the message types; None uses the types of
    this version.
    """

    def __init__(self, topic: Topic, store: Typestore | None = None) -> None:
        self._topic, self._store = topic, store or typestore()
        numbers = _NUMBERS.get(topic.type_name, ())
        self._numbers = Numbers(self._store, topic.type_name, *STAMP, *numbers)
        self._last: tuple[bytes, tuple[int, Values]] | None = None
        self._joints = JointReader(self._store) if topic is JOINT_STATES else None

    def __call__(self, data: bytes) -> tuple[int, Values]:
        """Return the stamp, ns, and the values of the topic's `Source`.

        MessageError is raised if the bytes do not fit the topic's type.  NoJointsError is raised if
        the message has no joints of the buffer, or needs a message of the other joint.
        """
        if self._last is None or data is not self._last[0]:  # several callers read one message
            self._last = data, self._read(data)
        return self._last[1]

    def _read(self, data: bytes) -> tuple[int, Values]:
        if self._joints is not None:
            return self._joints(data)
        sec, nanosec, *numbers = self._numbers(data).item()
        stamp = sec * 1_000_000_000 + nanosec
        if self._topic is BUFFER_STATE:
            return stamp, tuple(numbers)
        pose = pose_values(*numbers[:4])
        return stamp, (*pose, *twist_values(pose[2], *numbers[4:])) if numbers[4:] else pose


class DetectorInput:
    """Selection and reading of the detector's measurements in the messages of a run.

    If the scene of a simulated run has motion capture, the poses are from motion capture,
    otherwise from odometry.  On a bench without simulator, the first topic of each source that
    arrives is used.  ``readers`` are the readers of a node, by topic, if it reads the messages for
    other purposes too.
    """

    def __init__(
        self,
        scene: Scene | None,
        *,
        is_simulated: bool,
        store_of: Callable[[str], Typestore] = lambda _: typestore(),
        readers: Mapping[Topic, MeasurementReader] | None = None,
    ) -> None:
        self._sources = dict(OF_A_BENCH)
        self._is_simulated = is_simulated
        if is_simulated:
            sensors = None if scene is None else scene.sensors
            is_noisy = sensors is not None and sensors.motion_capture is not None
            others = (CHASER_ODOMETRY, TARGET_ODOMETRY) if is_noisy else (CHASER_POSE, TARGET_POSE)
            for topic in (*others, JOINT_STATES):
                del self._sources[topic]
        self._readers = readers or {
            topic: MeasurementReader(topic, store_of(topic.type_name)) for topic in self._sources
        }

    @property
    def topics(self) -> dict[Topic, Source]:
        """Topics that are read, with the source of measurements that each belongs to."""
        return self._sources

    def read(self, topic: Topic, data: bytes) -> tuple[Source, int, Values] | None:
        """Return source, stamp (ns) and values of a message; None if its topic is not used.

        MessageError is raised if the bytes do not fit the topic's type.
        """
        source = self._sources.get(topic)
        if source is None:
            return None
        stamp, values = self._readers[topic](data)
        if not self._is_simulated:
            rivals = [other for other, kind in self._sources.items() if kind is source]
            for other in rivals:
                if other is not topic:
                    del self._sources[other]
        return source, stamp, values


def pose_values(x: float, y: float, qz: float, qw: float) -> Planar:
    """Return x, y (m) and heading (rad) of a position and a quaternion about z.

    The heading is NaN if the quaternion is no rotation about z: its norm is 0, or it turns the
    body upside down.
    """
    if qz * qz + qw * qw < _MIN_NORM**2:
        return x, y, math.nan
    return x, y, 2.0 * math.atan2(qz, qw)


def twist_values(theta: float, vx: float, vy: float, omega: float) -> Planar:
    """Rotate a velocity (m/s) from a body's frame, at heading theta (rad), to the world."""
    c, s = math.cos(theta), math.sin(theta)
    return c * vx - s * vy, s * vx + c * vy, omega
