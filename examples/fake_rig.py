"""A bench that knows nothing of capture_sim: cameras, encoders and a load cell, in plain rclpy.

launcher/hold, a Bool, lets the chaser go.  Own clock; stamps jitter by 1 ms, 1 % is lost.
"""

import contextlib
import math
import random

import rclpy
from geometry_msgs.msg import PoseStamped, WrenchStamped
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile
from sensor_msgs.msg import JointState
from std_msgs.msg import Bool

RATE, CLOCK, SPEED, DROP = 100.0, 1.2e9, 0.105, 0.1  # Hz; s, its zero; m/s, reached after m
START, STOP, TARGET = 0.0, 0.2125, 0.66  # m, x of the chaser, and of the target


class FakeRig(Node):
    def __init__(self):
        super().__init__("fake_rig")
        self.chaser = self.create_publisher(PoseStamped, "motion_capture/chaser", 10)
        self.target = self.create_publisher(PoseStamped, "motion_capture/target", 10)
        self.joints = self.create_publisher(JointState, "joint_states", 10)
        self.cell = self.create_publisher(WrenchStamped, "load_cell/wrench", 10)
        latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self.create_subscription(Bool, "launcher/hold", self.hold, latched)
        self.t, self.released, self.held = 0.0, math.inf, 0.0
        self.create_timer(1.0 / RATE, self.measure)

    def hold(self, message):
        self.released, self.held = (self.released, self.t) if message.data else (self.t, math.inf)

    def measure(self):
        self.t += 1.0 / RATE
        going = max(0.0, self.t - self.released)
        if self.t > self.held + 1.0:  # held again, the chaser is pulled back
            going, self.released = 0.0, math.inf
        ramp = min(going, 2.0 * DROP / SPEED)  # s, while the mass sinks
        x = START + 0.25 * SPEED**2 / DROP * ramp**2 + SPEED * (going - ramp)
        self.send(self.chaser, PoseStamped(), x=min(x, STOP))
        self.send(self.target, PoseStamped(), x=TARGET)
        self.send(
            self.joints, JointState(name=["buffer_hinge", "buffer_slide"], position=[0.0, 0.0])
        )
        self.send(self.cell, WrenchStamped())

    def send(self, publisher, message, x=None):
        if x is not None:
            message.pose.position.x = x + random.gauss(0.0, 1e-5)
            message.pose.orientation.w = 1.0
        stamp = round((CLOCK + self.t + random.uniform(0.0, 1e-3)) * 1e9)
        message.header.stamp.sec, message.header.stamp.nanosec = divmod(stamp, 10**9)
        if random.random() > 0.01:
            publisher.publish(message)


with contextlib.suppress(KeyboardInterrupt, rclpy.executors.ExternalShutdownException):
    rclpy.init()
    rclpy.spin(FakeRig())
