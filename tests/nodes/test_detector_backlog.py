"""A detector that has fallen behind works off what waits, with the verdict of `detect`."""

import signal
import time

import numpy as np
from injections import STAMP_OF_RELEASE, STANDARD, stream

from capture_sim.detection.measurements import Source
from capture_sim.messages.definitions import blank, typestore
from capture_sim.messages.topics import (
    BUFFER_STATE,
    CAPTURE_STATUS,
    CHASER_ODOMETRY,
    TARGET_ODOMETRY,
)
from capture_sim.nodes.base.endpoints import message_class, qos_of
from capture_sim.run.verdict import LiveConditions, Received, detect_received
from tests.nodes.bench_client import Client, wait_until

TOPICS = {
    Source.CHASER: CHASER_ODOMETRY,
    Source.TARGET: TARGET_ODOMETRY,
    Source.BUFFER: BUFFER_STATE,
}
RATE, HALT = 240.0, 1.0


def serialised(source, stamp, values):
    topic = TOPICS[source]
    message = blank(topic.type_name)
    message.header.stamp.sec, message.header.stamp.nanosec = divmod(stamp, 10**9)
    if source is Source.BUFFER:
        message.axial_stroke, message.torsion = values
    else:
        pose = message.pose.pose
        pose.position.x, pose.position.y = values[:2]
        pose.orientation.z, pose.orientation.w = np.sin(values[2] / 2), np.cos(values[2] / 2)
    return bytes(typestore().serialize_cdr(message, topic.type_name))


def test_a_detector_that_was_stopped_gives_the_verdict_of_all_messages(start):
    """It is stopped for a second in the approach; nothing is lost, and it catches up."""
    measured = stream("tilt_0", STANDARD, RATE, np.random.default_rng(1))
    received = list(measured.measurements())
    halted = STAMP_OF_RELEASE + int((measured.verdict.t - HALT - 0.2) * 1e9)
    detector = start("capture_detector", scene="tilt_0")
    with Client() as client:
        senders = {
            source: client.node.create_publisher(
                message_class(topic.type_name), topic.name, qos_of(topic)
            )
            for source, topic in TOPICS.items()
        }
        statuses = client.listen(CAPTURE_STATUS)
        wait_until(lambda: all(s.get_subscription_count() for s in senders.values()))
        client.await_answers_of("/capture_detector")
        stopped, zero = 0.0, received[0][1]
        begun = time.monotonic()
        for source, stamp, values in received:
            time.sleep(max(0.0, begun + (stamp - zero) / 1e9 - time.monotonic()))
            if not stopped and stamp >= halted:
                stopped = time.monotonic()
                detector.process.send_signal(signal.SIGSTOP)
            elif stopped and time.monotonic() > stopped + HALT:
                detector.process.send_signal(signal.SIGCONT)
            senders[source].publish(serialised(source, stamp, values))
        detector.process.send_signal(signal.SIGCONT)
        assert stopped
        expected = detect_received(
            [Received(source, stamp - STAMP_OF_RELEASE, v) for source, stamp, v in received],
            measured.scene,
            LiveConditions(is_simulated=False),
        )
        # the last instants are evaluated at the end
        live = [s for s in expected if s.state is expected[-1].state]
        wait_until(lambda: len(statuses) >= len(expected) - 0.4 * RATE, detector.text)
        assert detector.end() == 0
        wait_until(lambda: len(statuses) >= len(expected), detector.text)
    since = statuses[-1].header.stamp.sec + statuses[-1].header.stamp.nanosec * 1e-9
    since += -statuses[-1].time_in_state - STAMP_OF_RELEASE * 1e-9
    assert (statuses[-1].state, statuses[-1].reason) == (live[-1].state, live[-1].reason)
    assert abs(since - (live[-1].t - live[-1].time_in_state)) < 1e-3
    assert sum(statuses[-1].chaser_rejected) == 0
