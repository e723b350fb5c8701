"""The relays in examples/: a trial of a bench whose cameras publish another type."""

import sys
from pathlib import Path

import pytest
from geometry_msgs.msg import PoseArray, TransformStamped, WrenchStamped
from rig_session import PACE, RATE, SUCCEEDED, FakeRig, Goal, Session, rig
from sensor_msgs.msg import JointState
from visualization_msgs.msg import InteractiveMarkerPose, InteractiveMarkerUpdate

from capture_sim.nodes.trials.bench import RELAYS
from tests.nodes.bench_client import wait_until
from tf2_msgs.msg import TFMessage

sys.path.append(str(Path(__file__).parents[2] / "examples"))
from fake_rig import stamped
from relay_pose_array import RelayPoseArray
from relay_rigid_bodies import RelayRigidBodies
from relay_tf import RelayTf
from relay_transform import RelayTransform

EXAMPLES = Path(__file__).parents[2] / "examples"


def transform(body, pose):
    message = TransformStamped(child_frame_id=body)
    at, to = pose.position, message.transform.translation
    to.x, to.y, to.z = at.x, at.y, at.z
    message.transform.rotation = pose.orientation
    return message


class CamerasOfAnotherType(FakeRig):
    """The example's bench; its cameras publish both bodies in another way."""

    def open_sensors(self):
        self.cameras = ["chaser", "target"]
        self.encoders = self.create_publisher(JointState, "joint_states", 10)
        self.cell = self.create_publisher(WrenchStamped, "load_cell/wrench", 10)
        self.poses, self.others = {}, self.open_others()

    def send(self, publisher, message):
        if publisher not in self.cameras:
            super().send(publisher, message)
            return
        self.poses[publisher] = message.pose
        if publisher == "target":
            self.publish_both(self.epoch + self.chaser.t)


class Transforms(CamerasOfAnotherType):
    def open_others(self):
        names = [f"vicon/{body}/{body}" for body in ("chaser", "target")]
        return [self.create_publisher(TransformStamped, name, 10) for name in names]

    def publish_both(self, t):
        for out, (body, pose) in zip(self.others, self.poses.items(), strict=True):
            out.publish(stamped(transform(body, pose), t))


class Tf(CamerasOfAnotherType):
    def open_others(self):
        return self.create_publisher(TFMessage, "tf", 10)

    def publish_both(self, t):
        both = [stamped(transform(body, pose), t) for body, pose in self.poses.items()]
        self.others.publish(TFMessage(transforms=both))


class Array(CamerasOfAnotherType):
    def open_others(self):
        return self.create_publisher(PoseArray, "poses", 10)

    def publish_both(self, t):
        self.others.publish(stamped(PoseArray(poses=list(self.poses.values())), t))


class NamedBodies(CamerasOfAnotherType):
    """A list of named poses, as in the messages of motion capture drivers."""

    def open_others(self):
        return self.create_publisher(InteractiveMarkerUpdate, "poses", 10)

    def publish_both(self, t):
        both = [
            stamped(InteractiveMarkerPose(name=body, pose=pose), t)
            for body, pose in self.poses.items()
        ]
        self.others.publish(InteractiveMarkerUpdate(poses=both))


NAMED = {"type": "visualization_msgs/msg/InteractiveMarkerUpdate"}
WAYS = [(RelayTransform, Transforms, {}), (RelayTf, Tf, {}), (RelayPoseArray, Array, {})]
WAYS += [(RelayRigidBodies, NamedBodies, NAMED)]


def test_trials_through_every_relay(start, client, tmp_path):
    session = Session(start, client, tmp_path)
    bench_parameters = {"pace": PACE, "rate": RATE, "hold_timeout": 60.0}
    for relay, bench, parameters in WAYS:
        parts = (
            rig(relay, parameters),
            rig(bench, bench_parameters),
        )
        with parts[0], parts[1] as node:
            wait_until(lambda node=node: node.armed)
            status, result = Goal(session.actions, name=relay.__name__).result()
            assert (status, result.verdict) == (SUCCEEDED, "captured"), result.reason
            assert result.complete, list(result.problems)


def test_a_refusal_names_the_relay(start, client, tmp_path):
    session = Session(start, client, tmp_path)
    client.node.create_publisher(TransformStamped, "motion_capture/chaser", 10)
    words = (
        "publishes geometry_msgs/msg/TransformStamped, not geometry_msgs/msg/PoseStamped: relay it"
    )
    Goal(session.actions).refusal(f"{words}, as in examples/relay_transform.py")


@pytest.mark.parametrize("name", sorted(set(RELAYS.values())))
def test_relays_are_short_examples(name):
    assert len((EXAMPLES / name).read_text(encoding="utf-8").splitlines()) <= 50
