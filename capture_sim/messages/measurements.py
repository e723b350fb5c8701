"""Messages that the capture detector decides by, as its measurements."""

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
#: Below this norm a quaternion is no orientation about z.
_MIN_NORM = 1e-3

#: What a bench without simulator may measure; of each source the first topic that comes is used.
TOPICS_OF_SOURCE = {
    Source.CHASER: (CHASER_POSE, CHASER_ODOMETRY),
    Source.TARGET: (TARGET_POSE, TARGET_ODOMETRY),
    Source.BUFFER: (JOINT_STATES, BUFFER_STATE),
}
OF_A_BENCH = {topic: source for source, topics in TOPICS_OF_SOURCE.items() for topic in topics}


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
    """Reads the measurements in the messages of a topic of :data:`OF_A_BENCH`, from their bytes.

    Nodes and recordings share it.  ``store`` knows the message types; None for the types of this
    version.
    """

    def __init__(self, topic: Topic, store: Typestore | None = None) -> None:
        self._topic, self._store = topic, store or typestore()
        numbers = _NUMBERS.get(topic.type_name, ())
        self._numbers = Numbers(self._store, topic.type_name, *STAMP, *numbers)
        self._last: tuple[bytes, tuple[int, Values]] | None = None
        self._joints = JointReader(self._store) if topic is JOINT_STATES else None

    def __call__(self, data: bytes) -> tuple[int, Values]:
        """Return the stamp, ns, and the values of the topic's `Source`.

        MessageError if the bytes are no such message, NoJointsError if it has no such joints or
        waits for the message of another joint.
        """
        if self._last is None or data is not self._last[0]:  # several ask for the same message
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
    """The measurements for the detector, from the messages of a run.

    If the scene of a simulated run has motion capture, its poses are used, else those of the
    odometry.  On a bench without simulator, the first topic of each source that arrives is used.
    ``readers`` are, by topic, readers of a node that also reads the messages for another purpose.
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
        """The topics that are read, and the quantity that each of them measures."""
        return self._sources

    def read(self, topic: Topic, data: bytes) -> tuple[Source, int, Values] | None:
        """Return source, stamp (ns) and values of a message; None if it is not used.

        MessageError if the bytes are no such message.
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

    The heading is NaN without a quaternion about z: of norm 0, or upside down.
    """
    if qz * qz + qw * qw < _MIN_NORM**2:
        return x, y, math.nan
    return x, y, 2.0 * math.atan2(qz, qw)


def twist_values(theta: float, vx: float, vy: float, omega: float) -> Planar:
    """Transform velocity (m/s) and rate (rad/s) from the own frame to the world."""
    c, s = math.cos(theta), math.sin(theta)
    return c * vx - s * vy, s * vx + c * vy, omega
