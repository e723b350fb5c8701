"""What recorder and detector make of a rig's drivers: their QoS, stamps, gaps, silence."""

import threading
from contextlib import contextmanager

from capture_sim.action import RunTrial
from geometry_msgs.msg import PoseStamped, WrenchStamped
from rclpy.qos import qos_profile_sensor_data
from rig_session import Goal, actions_of
from sensor_msgs.msg import JointState
from std_msgs.msg import Bool

from capture_sim.messages.convert import HINGE_JOINT, SLIDE_JOINT
from capture_sim.messages.topics import CAPTURE_STATUS, ROLL
from capture_sim.nodes.base.endpoints import TRANSIENT_LOCAL
from capture_sim.recording.bag import read_bag
from tests.nodes.bench_client import Client, wait_until


@contextmanager
def drivers(client, **kinds):
    """Let drivers of a rig publish, with stamps of their own clock; yield these."""
    publishers = [
        (kind, client.node.create_publisher(kind, name.replace("__", "/"), qos))
        for name, (kind, qos) in kinds.items()
    ]
    stamps, over = [], threading.Event()

    def publish():
        while not over.wait(0.01):
            stamp = divmod(1_763_900_000_123_456_789 + len(stamps) * 10_000_019, 10**9)
            stamps.append(stamp)
            for kind, publisher in publishers:
                message = kind()
                message.header.stamp.sec, message.header.stamp.nanosec = stamp
                if kind is PoseStamped:
                    message.pose.orientation.w = 1.0
                elif kind is JointState:
                    message.name, message.position = [HINGE_JOINT, SLIDE_JOINT], [0.0, 0.3]
                publisher.publish(message)

    thread = threading.Thread(target=publish, daemon=True)
    thread.start()
    try:
        yield stamps
    finally:
        over.set()
        thread.join()


def test_best_effort_driver_is_read_and_an_empty_topic_is_named_first(start, tmp_path):
    topics = "[/cell/raw, /load_cell/wrench, /motion_capture/chaser, /launcher/hold, /nobody]"
    best_effort = (WrenchStamped, qos_profile_sensor_data)
    with Client("drivers") as client:
        client.node.create_publisher(PoseStamped, "motion_capture/chaser", qos_profile_sensor_data)
        client.node.create_publisher(Bool, "launcher/hold", TRANSIENT_LOCAL).publish(
            Bool(data=True)
        )
        statuses = {}

        def take(message):
            statuses.update((status.name, status) for status in message.status)

        client.subscribe("diagnostic_msgs/msg/DiagnosticArray", "diagnostics", take)
        parts = client.listen(ROLL)
        with drivers(client, cell__raw=best_effort, load_cell__wrench=best_effort) as stamps:
            recorder = start("recorder", out=tmp_path, topics=topics)
            # the topics of others are looked for twice a second
            wait_until(lambda: recorder.text.count("read best effort") == 3)
            wait_until(lambda: "recorder: /launcher/hold" in statuses)
            start("launcher", actuator="none", scene="tilt_0").wait_for("ready")
            # a trial counts on the recorders that its launcher has heard
            wait_until(
                lambda: any(
                    part.role == "launcher" and any("/recorder#" in each for each in part.heard)
                    for part in parts
                )
            )
            goal = Goal(actions_of(client))
            goal.await_phase(RunTrial.Feedback.APPROACH)
            begin = len(stamps)
            wait_until(lambda: len(stamps) > begin + 100)
            goal.cancel()
            _, result = goal.result()
            assert not result.complete
            assert any("/nobody: no message" in problem for problem in result.problems), result
            recorder.wait_for(".mcap: ")
        assert recorder.end() == 1
    begin = next(k for k, line in enumerate(recorder.lines) if "recording in" in line)
    lines = recorder.lines[begin + 1 :]
    assert lines[0].endswith("[recorder]: tilt_0: /nobody: no message\n")
    assert any("motion_capture/chaser: no message" in line for line in lines)
    assert any("INCOMPLETE" in line for line in lines)
    assert recorder.text.count("read best effort") == 3  # once a topic
    run = read_bag(tmp_path / "tilt_0.mcap")
    for name in ("cell/raw", "load_cell/wrench"):
        assert len(run.raw(name)) > 10  # of 100 that may get lost
    assert len(run.raw("launcher/hold")) == 1
    values = {v.key: v.value for v in statuses["recorder: /load_cell/wrench"].values}
    assert values["published by /drivers"] == "best effort, volatile"
    assert statuses["recorder: /motion_capture/chaser"].message == "no message"


def test_stamps_of_the_detector_are_those_of_the_poses(start):
    """To the nanosecond, though its clock shows 1.7e9 s: synchronisers compare for equality."""
    with Client("drivers") as client:
        found = client.listen(CAPTURE_STATUS)
        poses, joints = (PoseStamped, 10), (JointState, 10)
        kinds = {"motion_capture__chaser": poses, "motion_capture__target": poses}
        with drivers(client, **kinds, joint_states=joints) as stamps:
            start("capture_detector", scene="tilt_0")
            wait_until(lambda: len(found) > 50)
    assert {(m.header.stamp.sec, m.header.stamp.nanosec) for m in found} <= set(stamps)
