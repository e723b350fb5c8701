"""A bench without code of capture_sim: cameras, encoders and a load cell, in plain rclpy.

It shows what your driver must do: publish its measurements, and obey launcher/hold. Copy it, and
put your hardware in the place of FakeChaser. disturbed_rig.py adds the faults of real sensors.
"""

import contextlib
import math
import time
from random import gauss

import rclpy
from fake_chaser import FakeChaser
from geometry_msgs.msg import PoseStamped, WrenchStamped
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile
from sensor_msgs.msg import JointState
from std_msgs.msg import Bool


class FakeRig(Node):
    def __init__(self, **options):
        super().__init__("fake_rig", **options)
        self.chaser = FakeChaser(self.declare_parameter("outcomes", ["captured"]).value)
        self.dt = 1.0 / self.declare_parameter("rate", 100.0).value  # s; Hz
        self.pace = self.declare_parameter("pace", 1.0).value  # s of the bench in a second
        self.hold_timeout = self.declare_parameter("hold_timeout", 0.5).value  # s
        self.last_hold, self.armed = -math.inf, False  # armed: a true was heard since a silence
        transient_local = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self.create_subscription(Bool, "launcher/hold", self.on_hold, transient_local)
        self.open_sensors()
        self.began, self.epoch = time.monotonic(), self.get_clock().now().nanoseconds * 1e-9
        self.create_timer(self.dt / self.pace, self.step)

    def open_sensors(self):
        vehicles = ("motion_capture/chaser", "motion_capture/target")
        self.cameras = [self.create_publisher(PoseStamped, name, 10) for name in vehicles]
        self.encoders = self.create_publisher(JointState, "joint_states", 10)
        self.cell = self.create_publisher(WrenchStamped, "load_cell/wrench", 10)

    def on_hold(self, message):
        self.last_hold = time.monotonic()
        self.armed = self.armed or message.data
        if self.armed and not message.data:
            self.chaser.let_go()
        else:
            self.chaser.hold()

    def step(self):
        """Move and measure; in real time, so often that no sample is left out."""
        if self.pace != 1.0:  # only tests hurry: their bench may be slower than its pace
            self.step_once()
        while self.pace == 1.0 and self.chaser.t < time.monotonic() - self.began:
            self.step_once()

    def step_once(self):
        if time.monotonic() - self.last_hold > self.hold_timeout:
            self.armed = False  # the launcher is gone, or the network is
            self.chaser.hold()
        self.chaser.move(self.dt)
        self.measure()

    def measure(self):
        for camera, pose in zip(self.cameras, self.chaser.poses, strict=True):
            noisy = [gauss(value, 1e-5) for value in pose]  # m, m, rad: as of any camera
            self.send(camera, pose_message(PoseStamped(), *noisy))
        names, positions = ["buffer_hinge", "buffer_slide"], [0.0, -self.chaser.stroke]
        self.send(self.encoders, JointState(name=names, position=positions))
        wrench = WrenchStamped()
        wrench.header.frame_id = "target/cone"  # the axes in which the cell measures
        wrench.wrench.force.x = self.chaser.force
        self.send(self.cell, wrench)

    def send(self, publisher, message):
        publisher.publish(stamped(message, self.epoch + self.chaser.t))


def pose_message(message, x, y, yaw):
    pose = message.pose if isinstance(message, PoseStamped) else message.pose.pose
    pose.position.x, pose.position.y = x, y
    pose.orientation.z, pose.orientation.w = math.sin(0.5 * yaw), math.cos(0.5 * yaw)
    return message


def stamped(message, t):
    """Stamp a message: t s by the ROS clock, as all sources of a bench and this computer have."""
    seconds, nanoseconds = divmod(round(t * 1e9), 10**9)
    message.header.stamp.sec, message.header.stamp.nanosec = seconds, nanoseconds
    return message


def run(rig):
    with contextlib.suppress(KeyboardInterrupt, rclpy.executors.ExternalShutdownException):
        rclpy.init()
        rclpy.spin(rig())


if __name__ == "__main__":
    run(FakeRig)
