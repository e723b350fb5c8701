"""Operators see live which measurements are not used: by source and reason, in each status."""

import math

from geometry_msgs.msg import PoseStamped
from sensor_msgs.msg import JointState

from capture_sim.base.resources import message_dir
from capture_sim.detection.measurements import Reason, Source
from capture_sim.messages.topics import (
    CAPTURE_STATUS,
    CHASER_POSE,
    JOINT_STATES,
    TARGET_POSE,
)
from capture_sim.nodes.base.endpoints import qos_of
from tests.nodes.bench_client import wait_until

N = 300  # instants of a bench at 100 Hz


def stamped(message, k):
    message.header.stamp.sec, message.header.stamp.nanosec = divmod((k + 10**5) * 10**7, 10**9)
    return message


def pose(x, k):
    message = stamped(PoseStamped(), k)
    message.pose.position.x = x
    message.pose.orientation.w = 1.0
    return message


def test_order_of_reasons_is_in_the_message():
    text = (message_dir() / "CaptureStatus.msg").read_text(encoding="utf-8")
    _, _, comment = text.partition("by reason:")
    places = [comment.index(reason.value) for reason in Reason]
    assert places == sorted(places)
    for source in Source:
        assert f"uint32[{len(Reason)}] {source.value}_rejected" in text


def test_rejected_measurements_are_counted_live(start, client):
    start("capture_detector", scene="tilt_0").wait_for("evaluated by tilt_0")
    found = client.listen(CAPTURE_STATUS)
    chaser, target = (
        client.node.create_publisher(PoseStamped, topic.name, qos_of(topic))
        for topic in (CHASER_POSE, TARGET_POSE)
    )
    buffer = client.node.create_publisher(JointState, JOINT_STATES.name, qos_of(JOINT_STATES))
    client.await_answers_of("/capture_detector")
    for k in range(N):
        if k == 50:  # the detector reads in batches: the first status is from before
            wait_until(lambda: found)
        chaser.publish(pose(math.nan if k in (50, 60, 70) else 1e-4 * k, k))
        target.publish(pose(0.66, k))
        if k in (80, 90):
            target.publish(pose(0.66, k))  # with the same stamp
        joints = stamped(JointState(name=["buffer_slide", "buffer_hinge"]), k)
        joints.position = [1e-6 * (k % 7), 0.0]
        buffer.publish(joints)
    reasons = list(Reason)

    def counted(field, reason):
        return found and getattr(found[-1], f"{field}_rejected")[reasons.index(reason)]

    wait_until(lambda: counted("target", Reason.LATE) == 2)
    wait_until(lambda: counted("chaser", Reason.NOT_FINITE) == 3)
    assert sum(found[0].chaser_rejected) == 0
    assert sum(found[-1].buffer_rejected) == 0
