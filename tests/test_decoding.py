"""Numbers read from a message's bytes are those of the message."""

import math

import numpy as np
import pytest
from rclpy.serialization import serialize_message

from capture_sim.detection.align import Source
from capture_sim.messages.measurements import measured
from capture_sim.messages.topics import BUFFER_STATE, CHASER_ODOMETRY, CHASER_POSE, TARGET_ODOMETRY
from capture_sim.nodes.decoding import decoder
from capture_sim.nodes.running import message_class

TOPICS = {
    CHASER_ODOMETRY: Source.CHASER,
    TARGET_ODOMETRY: Source.TARGET,
    CHASER_POSE: Source.CHASER,
    BUFFER_STATE: Source.BUFFER,
}


def fill(message, rng):
    """Fill all numbers of a message with chance, deep down."""
    for name, kind in message.get_fields_and_field_types().items():
        if kind == "double":
            setattr(message, name, rng.normal())
        elif kind == "double[36]":
            setattr(message, name, rng.normal(size=36))
        elif kind.startswith(("geometry_msgs/", "std_msgs/")):
            fill(getattr(message, name), rng)


@pytest.mark.parametrize("topic", TOPICS, ids=lambda topic: topic.name)
@pytest.mark.parametrize("length", range(9))
def test_bytes_give_what_the_message_gives(topic, length):
    """For texts of every length: what follows them is aligned."""
    rng = np.random.default_rng(length)
    message = message_class(topic.type_name)()
    fill(message, rng)
    message.header.frame_id = "f" * length
    if hasattr(message, "child_frame_id"):
        message.child_frame_id = "c" * (2 * length + 1)
    message.header.stamp.sec, message.header.stamp.nanosec = 12, 345_000_000
    t, values = decoder(topic, TOPICS[topic])(serialize_message(message))
    assert t == pytest.approx(11.345, abs=1e-12)  # simulated time begins at a stamp of 1 s
    assert values == measured(TOPICS[topic], message)
    if topic is not BUFFER_STATE:
        pose = message.pose.pose if hasattr(message, "twist") else message.pose
        heading = 2.0 * math.atan2(pose.orientation.z, pose.orientation.w)
        assert values[:3] == (pose.position.x, pose.position.y, heading)


@pytest.mark.parametrize("topic", TOPICS, ids=lambda topic: topic.name)
def test_bytes_of_a_big_endian_machine_are_read_too(topic):
    from rosbags.typesys import Stores, get_typestore

    if topic is BUFFER_STATE:
        pytest.skip("not among the types of the library that writes such bytes")
    store = get_typestore(Stores.ROS2_JAZZY)
    rng = np.random.default_rng(0)
    message = message_class(topic.type_name)()
    fill(message, rng)
    theirs = store.deserialize_cdr(serialize_message(message), topic.type_name)
    data = bytes(store.serialize_cdr(theirs, topic.type_name, little_endian=False))
    assert data[1] == 0
    _, values = decoder(topic, TOPICS[topic])(data)
    assert values == measured(TOPICS[topic], message)
