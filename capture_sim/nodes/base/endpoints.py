"""Topics as ROS has them: message classes, quality of service, names of nodes."""

from __future__ import annotations

import importlib
from copy import copy
from functools import cache
from typing import Any

from rclpy.duration import Infinite
from rclpy.qos import (
    DurabilityPolicy,
    HistoryPolicy,
    QoSCompatibility,
    QoSProfile,
    ReliabilityPolicy,
    qos_check_compatible,
)
from rclpy.serialization import deserialize_message

from capture_sim.errors import MessageError
from capture_sim.messages.topics import CLOCK, Topic

#: A node that is there is discovered, and its subscriptions are, within this long, s (wall), as a
#: rule: on a busy machine it can be seconds.
DISCOVERY_TIME = 0.3
#: A message that has been sent arrives within this long, s (wall), unless its reader is stalled.
TRANSIT_TIME = 0.5
#: The last message, for subscribers that come later.
TRANSIENT_LOCAL = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)


@cache
def message_class(type_name: str) -> Any:
    """Return the class of a message type given as ``package/msg/Name``."""
    package, _, name = type_name.split("/")
    return getattr(importlib.import_module(f"{package}.msg"), name)


def qos_of(topic: Topic, *, transient_local: bool | None = None) -> QoSProfile:
    """Return the quality of service of a topic as ROS has it, from the table of topics.

    ``transient_local``: False for a subscriber of a transient-local topic that wants only new
    messages, and all of these; as the topic unless given.
    """
    transient_local = topic.transient_local if transient_local is None else transient_local
    keeps_last = topic.keeps_last and transient_local == topic.transient_local
    return QoSProfile(
        history=HistoryPolicy.KEEP_LAST if keeps_last else HistoryPolicy.KEEP_ALL,
        depth=topic.depth,
        reliability=ReliabilityPolicy.RELIABLE if topic.reliable else ReliabilityPolicy.BEST_EFFORT,
        durability=DurabilityPolicy.TRANSIENT_LOCAL
        if transient_local
        else DurabilityPolicy.VOLATILE,
    )


def qos_problem(offered: QoSProfile, requested: QoSProfile) -> str:
    """Return why a reader gets nothing from a publisher, by their profiles; empty if it does.

    Durations that a profile leaves at their default, 0, are infinite once its publisher exists.
    """
    offered = copy(offered)
    for name in ("deadline", "liveliness_lease_duration"):
        if getattr(offered, name).nanoseconds == 0:
            setattr(offered, name, Infinite)
    compatibility, reason = qos_check_compatible(offered, requested)
    # equal, not the same: each call makes an object of its own
    return str(reason) if compatibility == QoSCompatibility.ERROR else ""


def is_own(topic: Topic) -> bool:
    """Return True if only nodes of this suite publish a topic: it is reliable then."""
    return topic is CLOCK or topic.type_name.startswith("capture_sim/")


def from_bytes(topic: Topic, data: bytes) -> Any:
    """Return the message of a topic that was taken raw; MessageError if the bytes are none."""
    try:
        return deserialize_message(data, message_class(topic.type_name))
    except RuntimeError:  # rclpy's RMWError, of several lines
        raise MessageError(f"{len(data)} bytes are not a {topic.type_name}") from None


def full_name(end: Any) -> str:
    """Return the full name of the node that an end of a topic belongs to."""
    return f"{end.node_namespace.rstrip('/')}/{end.node_name}"
