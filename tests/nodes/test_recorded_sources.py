"""What recorder and detector make of a rig's drivers: their QoS, stamps, gaps, silence."""

import itertools
import threading
import time

import pytest
from capture_sim.action import RunTrial
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped, WrenchStamped
from rclpy.qos import DurabilityPolicy, QoSProfile, qos_profile_sensor_data
from rig_session import Goal, actions_of
from sensor_msgs.msg import JointState
from std_msgs.msg import Bool
from threads import Client, threads, wait_until

from capture_sim.messages.convert import HINGE_JOINT, SLIDE_JOINT
from capture_sim.messages.topics import CAPTURE_STATUS
from capture_sim.recording.bag import read_bag


@pytest.fixture
def start():
    with threads() as start:
        yield start


class Drivers:
    """Drivers of a rig in a thread: each publishes at 100 Hz, with stamps of its own clock."""

    def __init__(self, client, **kinds):
        node = client.node
        self.stamps, self.sent = [], []  # of the messages; s (wall) of each
        self._publishers = {
            name: (kind, node.create_publisher(kind, name.replace("__", "/"), qos))
            for name, (kind, qos) in kinds.items()
        }
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._publish, daemon=True)

    def __enter__(self):
        self._thread.start()
        return self

    def __exit__(self, *error):
        self._stop.set()
        self._thread.join()

    def _publish(self):
        k = 0
        while not self._stop.wait(0.01):
            sec, nanosec = divmod(1_763_900_000_123_456_789 + k * 10_000_019, 10**9)
            self.stamps.append((sec, nanosec))
            for kind, publisher in self._publishers.values():
                message = kind()
                message.header.stamp.sec, message.header.stamp.nanosec = sec, nanosec
                if kind is PoseStamped:
                    message.pose.orientation.w = 1.0
                elif kind is JointState:
                    message.name, message.position = [HINGE_JOINT, SLIDE_JOINT], [0.0, 0.3]
                publisher.publish(message)
            self.sent.append(time.time())
            k += 1

    def sent_between(self, begin, end):
        """Return how many messages of each kind were sent in a time, s (wall)."""
        return sum(begin < t <= end for t in self.sent)


def test_best_effort_driver_is_read_and_an_empty_topic_is_named_first(start, tmp_path):
    topics = "[/cell/raw, /load_cell/wrench, /motion_capture/chaser, /launcher/hold, /nobody]"
    latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    with Client("drivers") as client:
        client.node.create_publisher(PoseStamped, "motion_capture/chaser", qos_profile_sensor_data)
        client.node.create_publisher(Bool, "launcher/hold", latched).publish(Bool(data=True))
        drivers = Drivers(
            client,
            cell__raw=(WrenchStamped, qos_profile_sensor_data),
            load_cell__wrench=(WrenchStamped, qos_profile_sensor_data),
        )
        found = []
        client.node.create_subscription(DiagnosticArray, "diagnostics", found.append, 10)
        with drivers:
            recorder = start("recorder", out=tmp_path, topics=topics)
            recorder.wait_for("/load_cell/wrench: read best effort")
            time.sleep(1.0)  # the others are looked for twice a second
            start("launcher", actuator="none", scene="tilt_0").wait_for("ready")
            goal = Goal(actions_of(client))
            goal.await_phase(RunTrial.Feedback.APPROACH)
            time.sleep(1.5)
            goal.cancel()
            _, result = goal.result()
            assert not result.complete
            assert any("/nobody: no message" in problem for problem in result.problems)
            recorder.wait_for(".mcap: ")
        assert recorder.end() == 1
    lines = recorder.lines[
        next(i for i, x in enumerate(recorder.lines) if "recording in" in x) + 1 :
    ]
    assert lines[0] == "error: tilt_0: /nobody: no message"
    assert any("motion_capture/chaser: no message" in line for line in lines)
    assert any("INCOMPLETE" in line for line in lines)
    assert recorder.text.count("read best effort") == 3  # once a topic
    run = read_bag(tmp_path / "tilt_0.mcap")
    for name in ("cell/raw", "load_cell/wrench"):
        assert len(run.raw(name)) > 50
    assert len(run.raw("launcher/hold")) == 1
    statuses = {status.name: status for message in found for status in message.status}
    values = {v.key: v.value for v in statuses["recorder: /load_cell/wrench"].values}
    reported = [  # s (wall) and Hz
        (message.header.stamp.sec + 1e-9 * message.header.stamp.nanosec, float(value.value))
        for message in found
        for status in message.status
        for value in status.values
        if (status.name, value.key) == ("recorder: /load_cell/wrench", "rate [Hz]")
    ]
    # the rates are those of what was sent, whatever a busy machine's driver comes to
    counted = sum((b[0] - a[0]) * b[1] for a, b in itertools.pairwise(reported))
    sent = drivers.sent_between(reported[0][0], reported[-1][0])
    assert sent > 100
    assert counted == pytest.approx(sent, rel=0.1, abs=10)
    assert values["published by /drivers"] == "best effort, volatile"
    assert statuses["recorder: /motion_capture/chaser"].message == "no message"


def test_stamps_of_the_detector_are_those_of_the_poses(start):
    """To the nanosecond, though its clock shows 1.7e9 s: synchronisers compare for equality."""
    with Client("drivers") as client:
        found = client.listen(CAPTURE_STATUS)
        drivers = Drivers(
            client,
            motion_capture__chaser=(PoseStamped, 10),
            motion_capture__target=(PoseStamped, 10),
            joint_states=(JointState, 10),
        )
        with drivers:
            start("capture_detector", scene="tilt_0")
            wait_until(lambda: len(found) > 50)
    stamps = {(m.header.stamp.sec, m.header.stamp.nanosec) for m in found}
    assert stamps <= set(drivers.stamps)
