"""What the detector wants of a message, straight from its bytes.

Making an Odometry object in Python takes ten times as long as judging by it.
"""

from __future__ import annotations

import struct
from collections.abc import Callable

from rclpy.serialization import deserialize_message

from capture_sim.detection.align import Source, Values
from capture_sim.messages.convert import stamp_seconds
from capture_sim.messages.measurements import measured, pose_values, twist_values
from capture_sim.messages.topics import Topic
from capture_sim.nodes.running import message_class

_LITTLE_ENDIAN = b"\x00\x01"
_HEADER = 4  # encapsulation; places are counted from behind it
_STAMP = struct.Struct("<iI")
_LENGTH = struct.Struct("<I")
_POSE = struct.Struct("<7d")
_TWIST = struct.Struct("<6d")
_BUFFER = struct.Struct("<Q6d")
_COVARIANCE = 36 * 8


def decoder(topic: Topic, source: Source) -> Callable[[bytes], tuple[float, Values]]:
    """Return what gives time (s) and values of a serialised message of a topic.

    Parameters
    ----------
    topic
        Of nav_msgs/Odometry, geometry_msgs/PoseStamped or capture_sim/BufferState.
    source
        What it measures, see :class:`capture_sim.detection.align.Source`.
    """
    kind = message_class(topic.type_name)
    decode = {
        "nav_msgs/msg/Odometry": _odometry,
        "geometry_msgs/msg/PoseStamped": _pose,
        "capture_sim/msg/BufferState": _buffer,
    }[topic.type_name]

    def read(data: bytes) -> tuple[float, Values]:
        if data[:2] != _LITTLE_ENDIAN:  # of a machine of another kind
            message = deserialize_message(data, kind)
            stamp = message.header.stamp
            return _seconds(stamp.sec, stamp.nanosec), measured(source, message)
        return _seconds(*_STAMP.unpack_from(data, _HEADER)), decode(data)

    return read


def _seconds(sec: int, nanosec: int) -> float:
    return stamp_seconds(sec * 1_000_000_000 + nanosec)


def _behind_text(data: bytes, place: int) -> int:
    """Return the place behind a text that begins at ``place`` or at the next multiple of 4."""
    place = (place + 3) & ~3
    (length,) = _LENGTH.unpack_from(data, _HEADER + place)
    return int(place + 4 + length)


def _numbers(place: int) -> int:
    """Return the index of numbers of 8 bytes that come next."""
    return _HEADER + ((place + 7) & ~7)


def _odometry(data: bytes) -> Values:
    at = _numbers(_behind_text(data, _behind_text(data, 8)))
    x, y, _, _, _, qz, qw = _POSE.unpack_from(data, at)
    vx, vy, _, _, _, omega = _TWIST.unpack_from(data, at + _POSE.size + _COVARIANCE)
    pose = pose_values(x, y, qz, qw)
    return (*pose, *twist_values(pose[2], vx, vy, omega))


def _pose(data: bytes) -> Values:
    x, y, _, _, _, qz, qw = _POSE.unpack_from(data, _numbers(_behind_text(data, 8)))
    return pose_values(x, y, qz, qw)


def _buffer(data: bytes) -> Values:
    found = _BUFFER.unpack_from(data, _numbers(_behind_text(data, 8)))
    _, stroke, stroke_rate, _, torsion, torsion_rate, _ = found
    return (stroke, torsion, stroke_rate, torsion_rate)
