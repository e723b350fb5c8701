"""A robot between loop_simulator and your controller: frames, hold, heartbeat.

`Robot` is a perfect one in place of your controller; it meets no wall.  Replace its methods and the
constants, and keep the rest.  Start this first, then `loop_simulator`.

The loop begins with a position at rest and repeats it: this robot drives there slowly.  Then the
positions run up to the vehicles' first speed and continue with each step.  The robot holds if the
loop sends a reason on loop/hold, if positions stop, and if a position is too far from the robot.
"""

import contextlib
import math
import time

import rclpy
from geometry_msgs.msg import WrenchStamped
from nav_msgs.msg import Odometry
from rclpy.executors import ExternalShutdownException
from rclpy.qos import DurabilityPolicy, QoSProfile
from std_msgs.msg import String

#: target/cone in the robot's base: x, y (m) and yaw (rad), from a measurement of your cone.
CONE_X, CONE_Y, CONE_YAW = 0.8, 0.1, math.pi
#: The robot holds if no position has arrived for this time, s: some steps of the loop.
HEARTBEAT = 0.02
#: Largest distance of a position that it follows, m.
MAX_JUMP = 0.01
#: Speed of the motion to the first position, m/s.
HOMING_SPEED = 0.05


class Robot:
    """Moves the tip's centre; in place of your controller."""

    def __init__(self):
        self.place = [0.6, 0.0, 0.0]  # x, y (m), yaw (rad) in the base

    def move_to(self, place):
        """Send a position to the controller."""
        self.place = list(place)

    def measured(self):
        """Return where the encoders have the tip: x, y, yaw."""
        return self.place

    def wrench(self):
        """Return force (N) and torque (N m) on the tip's centre, in the base's axes.

        Without weight and inertia of the parts between cell and tip.
        """
        return (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)

    def hold(self):
        """Stop within the robot's own limits, and stay."""


def turned(x, y, angle):
    """Return a vector in axes that are turned back by an angle."""
    c, s = math.cos(angle), math.sin(angle)
    return c * x - s * y, s * x + c * y


class Adapter:
    """Positions from the cone's frame to the base, measurements the other way."""

    def __init__(self, node, robot):
        self.node, self.robot = node, robot
        self.hold_reason = "no position yet"
        self.first_stamp, self.last_arrival = None, math.inf
        qos = QoSProfile(depth=1)  # reliable, keep last
        self.tips = node.create_publisher(Odometry, "loop/rig_tip", qos)
        self.wrenches = node.create_publisher(WrenchStamped, "loop/wrench", qos)
        node.create_subscription(Odometry, "loop/tip", self.follow, qos)
        transient_local = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        node.create_subscription(
            String, "loop/hold", lambda text: self.hold(text.data), transient_local
        )
        node.create_timer(0.25 * HEARTBEAT, self.watch)

    def hold(self, reason):
        """Hold for this reason; an empty one begins a new loop."""
        if reason:
            self.robot.hold()
            self.node.get_logger().info(f"hold: {reason}")
        else:
            self.first_stamp = None
        self.hold_reason, self.last_arrival = reason, math.inf

    def watch(self):
        """Hold if positions stay away."""
        if not self.hold_reason and time.monotonic() > self.last_arrival + HEARTBEAT:
            self.hold(f"no position for {HEARTBEAT:g} s")

    def follow(self, command):
        """Move to a position and answer it."""
        if self.hold_reason:
            return
        stamp = command.header.stamp.sec, command.header.stamp.nanosec
        is_first = self.first_stamp in (None, stamp)
        if is_first:
            self.first_stamp = stamp
        pose = command.pose.pose
        x, y = turned(pose.position.x, pose.position.y, CONE_YAW)
        yaw = CONE_YAW + 2.0 * math.atan2(pose.orientation.z, pose.orientation.w)
        place = [CONE_X + x, CONE_Y + y, yaw]
        away = math.dist(place[:2], self.robot.measured()[:2])
        if is_first and away > 1e-6:
            # one step on the way to rest; positions at rest come every 5 ms
            share = min(1.0, HOMING_SPEED * 0.005 / away)
            now = self.robot.measured()
            place = [a + share * (b - a) for a, b in zip(now, place, strict=True)]
        elif away > MAX_JUMP:
            self.hold(f"position {away * 1e3:.3g} mm away: must be <= {MAX_JUMP * 1e3:g}")
            return
        self.robot.move_to(place)
        self.last_arrival = math.inf if is_first else time.monotonic()
        self.answer(command)

    def answer(self, command):
        """Send where the tip is and what acts on it, with the position's stamp."""
        x, y, yaw = self.robot.measured()
        tip = Odometry(header=command.header, child_frame_id=command.child_frame_id)
        position, orientation = tip.pose.pose.position, tip.pose.pose.orientation
        position.x, position.y = turned(x - CONE_X, y - CONE_Y, -CONE_YAW)
        half = 0.5 * (yaw - CONE_YAW)
        orientation.z, orientation.w = math.sin(half), math.cos(half)
        tip.twist = command.twist  # instead: your encoders
        wrench = WrenchStamped(header=command.header)
        force, torque = self.robot.wrench()
        on_tip = wrench.wrench.force, wrench.wrench.torque
        for vector, value in zip(on_tip, (force, torque), strict=True):
            vector.x, vector.y = turned(value[0], value[1], -CONE_YAW)
            vector.z = value[2]
        self.tips.publish(tip)  # before the wrench: the loop pairs them when that comes
        self.wrenches.publish(wrench)


if __name__ == "__main__":
    rclpy.init()
    node = rclpy.create_node("robot_adapter")
    adapter = Adapter(node, Robot())
    with contextlib.suppress(KeyboardInterrupt, ExternalShutdownException):  # Ctrl-C
        rclpy.spin(node)
    adapter.robot.hold()
