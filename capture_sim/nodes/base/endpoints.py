"""Topics in terms of ROS: message classes, quality of service, names of nodes."""

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

#: A running node and its subscriptions are normally discovered within this time, s (wall).  On a
#: busy machine discovery can take seconds.
DISCOVERY_TIME = 0.3
#: A sent message arrives within this time, s (wall), unless its reader is stalled.
TRANSIT_TIME = 0.5
#: Quality of service that keeps the last message for late subscribers.
TRANSIENT_LOCAL = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
#: Quality of service that no publisher's excludes: best effort and volatile.
ANYONE = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
BOOL = "std_msgs/msg/Bool"


@cache
def message_class(type_name: str) -> Any:
    """Return the class of a message type given as ``package/msg/Name``."""
    package, _, name = type_name.split("/")
    return getattr(importlib.import_module(f"{package}.msg"), name)


def qos_of(topic: Topic, *, transient_local: bool | None = None) -> QoSProfile:
    """Return the ROS quality of service of a topic from the table of topics.

    ``transient_local``: False for a subscriber of a transient-local topic that needs every new
    message and no earlier ones.  Default: as in the table.
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
    """Return why two profiles prevent a reader from receiving; empty if they are compatible.

    Durations that a profile leaves at their default, 0, are infinite once its publisher exists.
    """
    offered = copy(offered)
    for name in ("deadline", "liveliness_lease_duration"):
        if getattr(offered, name).nanoseconds == 0:
            setattr(offered, name, Infinite)
    compatibility, reason = qos_check_compatible(offered, requested)
    # compared by ==, not by identity: each call returns a new object
    return str(reason) if compatibility == QoSCompatibility.ERROR else ""


def is_own(topic: Topic) -> bool:
    """Return True if only nodes of this suite publish a topic, so that it is reliable."""
    return topic is CLOCK or topic.type_name.startswith("capture_sim/")


def from_bytes(topic: Topic, data: bytes) -> Any:
    """Return the message of a topic from its bytes; MessageError if they are no such message."""
    try:
        return deserialize_message(data, message_class(topic.type_name))
    except RuntimeError:  # rclpy's RMWError, of several lines
        raise MessageError(f"{len(data)} bytes are not a {topic.type_name}") from None


def full_name(end: Any) -> str:
    """Return the full name of the node that a publisher or subscription belongs to.

    ``end``: TopicEndpointInfo of rclpy.
    """
    return f"{end.node_namespace.rstrip('/')}/{end.node_name}"
