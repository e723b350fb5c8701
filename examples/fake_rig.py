"""A bench without code of capture_sim: cameras, encoders and a load cell, in plain rclpy.

It shows what your driver must do: publish its measurements, and obey launcher/hold.
disturbed_rig.py is the same bench with the faults of real sensors.
"""

import contextlib
import math
import time

import rclpy
from geometry_msgs.msg import PoseStamped, WrenchStamped
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile
from sensor_msgs.msg import JointState
from std_msgs.msg import Bool

TARGET, STOP, SPEED, DROP = 0.66, 0.2125, 0.105, 0.1  # m, of the chaser at the cone; m/s after m
BACK, ASIDE, RETURNED = 0.5, 0.12, 0.4  # m/s pulled back; m of a miss; speed after by before
CONTACT, STROKE, MASS = 0.1, 0.003, 22.0  # s, m and kg
CLOCK = 1.2e9  # s, by the bench's clock at its start


class FakeRig(Node):
    def __init__(self, **options):
        super().__init__("fake_rig", **options)
        self.declare_parameter("outcomes", ["captured"])  # of the releases in turn: captured,
        self.declare_parameter("rate", 100.0)  # ... rebound, missed; Hz
        self.declare_parameter("pace", 1.0)  # s of the bench in a second: saves waiting in tests
        self.declare_parameter("hold_timeout", 0.5)  # s without launcher/hold: holds then
        self.pace, self.dt = (
            self.get_parameter("pace").value,
            1.0 / self.get_parameter("rate").value,
        )
        self.t = self.x = self.y = self.speed = 0.0
        self.released, self.held, self.trial, self.last_hold = None, -1.0, 0, -math.inf
        self.armed = False  # a true was heard since the start, and since the last silence
        transient_local = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self.create_subscription(Bool, "launcher/hold", self.on_hold, transient_local)
        self.open_sensors()
        self.create_timer(self.dt / self.pace, self.step)

    def open_sensors(self):
        vehicles = ("motion_capture/chaser", "motion_capture/target")
        self.cameras = [self.create_publisher(PoseStamped, name, 10) for name in vehicles]
        self.encoders = self.create_publisher(JointState, "joint_states", 10)
        self.cell = self.create_publisher(WrenchStamped, "load_cell/wrench", 10)

    def on_hold(self, message):
        self.last_hold = time.monotonic()
        self.armed = self.armed or message.data
        self.set_hold(message.data or not self.armed)

    def set_hold(self, hold):
        if not hold and self.released is None:
            self.released, self.x = self.t, 0.0
        elif hold and self.released is not None:  # the brake stops a chaser that moves
            self.released, self.held, self.trial = None, self.t, self.trial + 1

    def step(self):
        if time.monotonic() - self.last_hold > self.get_parameter("hold_timeout").value:
            self.armed = False  # the launcher is gone, or the network is
            self.set_hold(True)
        self.t += self.dt
        self.move()
        self.measure()

    def move(self):
        outcomes = self.get_parameter("outcomes").value
        outcome = outcomes[self.trial % len(outcomes)]
        self.speed, self.since_contact = 0.0, -1.0
        if self.released is not None:
            going, sinking = self.t - self.released, 2.0 * DROP / SPEED  # s, of the mass
            self.speed = SPEED * min(1.0, going / sinking)
            self.x = 0.5 * self.speed * min(going, sinking) + SPEED * max(0.0, going - sinking)
            if self.x >= STOP and outcome != "missed":
                self.since_contact = (self.x - STOP) / SPEED
                self.speed = -RETURNED * SPEED if outcome == "rebound" else 0.0
                self.x = STOP + self.speed * self.since_contact
        elif self.t > self.held + 0.5:  # somebody pulls it back
            self.x = max(0.0, self.x - BACK * self.dt)
            self.y = ASIDE if outcome == "missed" else 0.0
        # of a half sine in the contact, 0 to 1
        self.push = max(0.0, math.sin(math.pi * min(1.0, self.since_contact / CONTACT)))

    def measure(self):
        vehicles = ((self.x + STROKE * self.push, self.y, 0.0), (TARGET, 0.0, 0.0))
        for camera, pose in zip(self.cameras, vehicles, strict=True):
            self.send(camera, pose_message(PoseStamped(), *pose))
        joints = JointState(name=["buffer_hinge", "buffer_slide"])
        joints.position = [0.0, -STROKE * self.push]
        self.send(self.encoders, joints)
        wrench = WrenchStamped()
        wrench.wrench.force.x = self.push * 0.5 * math.pi * MASS * SPEED / CONTACT
        self.send(self.cell, wrench)

    def send(self, publisher, message):
        publisher.publish(stamped(message, self.t))


def pose_message(message, x, y, yaw):
    pose = message.pose if isinstance(message, PoseStamped) else message.pose.pose
    pose.position.x, pose.position.y = x, y
    pose.orientation.z, pose.orientation.w = math.sin(0.5 * yaw), math.cos(0.5 * yaw)
    return message


def stamped(message, t):
    seconds, nanoseconds = divmod(round((CLOCK + t) * 1e9), 10**9)
    message.header.stamp.sec, message.header.stamp.nanosec = seconds, nanoseconds
    return message


def run(rig):
    with contextlib.suppress(KeyboardInterrupt, rclpy.executors.ExternalShutdownException):
        rclpy.init()
        rclpy.spin(rig())


if __name__ == "__main__":
    run(FakeRig)
