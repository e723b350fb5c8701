"""A controller of a free-flying chaser: PD on attitude and offset, 0.1 m/s along the axis.

python examples/docking_controller.py
capture-sim-simulator --ros-args -p "scenes:=[examples/free_flyer.yaml]" -p rtf:=0.0 \
    -p "wait_for:=[docking_controller]"
"""

import math
from functools import partial
from operator import attrgetter

#: What a controller reads of a vehicle's odometry.
POSE = ("position.x", "position.y", "orientation.z", "orientation.w")
TWIST = ("linear.x", "linear.y", "angular.z")
NAMES = (*(f"pose.pose.{name}" for name in POSE), *(f"twist.twist.{name}" for name in TWIST))
CONTACT, FRAME = "bench/contact", "chaser/base_link"
SPEED = 0.1  # m/s
STIFFNESS, DAMPING, ALONG = 6.0, 40.0, 60.0  # N/m, N s/m: across the axis, and along it
TURN, SPIN = 2.0, 4.0  # N m/rad, N m s/rad


def command(chaser, target, has_touched):
    """Return force (N, N) and moment (N m) in the chaser's axes; none after the contact."""
    if has_touched:
        return 0.0, 0.0, 0.0
    (x, y, z, w, u, v, spin), (x_T, y_T, z_T, w_T, u_T, v_T, spin_T) = chaser, target
    heading, heading_T = 2.0 * math.atan2(z, w), 2.0 * math.atan2(z_T, w_T)
    turn = math.remainder(heading - heading_T, math.tau)
    c_T, s_T, c, s = math.cos(heading_T), math.sin(heading_T), math.cos(turn), math.sin(turn)
    across = c_T * (y - y_T) - s_T * (x - x_T)  # m, off the target's axis
    along_rate, across_rate = c * u - s * v - u_T, s * u + c * v - v_T
    f_along = ALONG * (SPEED - along_rate)
    f_across = -STIFFNESS * across - DAMPING * across_rate
    moment = -TURN * turn - SPIN * (spin - spin_T)
    return c * f_along + s * f_across, c * f_across - s * f_along, moment


def main():
    import rclpy
    from capture_sim.msg import ContactState
    from geometry_msgs.msg import WrenchStamped
    from nav_msgs.msg import Odometry
    from rclpy.node import Node
    from rclpy.qos import HistoryPolicy, QoSProfile

    keep_all = QoSProfile(history=HistoryPolicy.KEEP_ALL, depth=1)  # reliable
    read = attrgetter(*NAMES)

    class DockingController(Node):
        def __init__(self):
            super().__init__("docking_controller")
            self.parts, self.has_touched = {}, False
            self.publisher = self.create_publisher(WrenchStamped, "chaser/cmd_wrench", 10)
            kinds = {"chaser/odom": Odometry, "target/odom": Odometry, CONTACT: ContactState}
            for topic, kind in kinds.items():
                self.create_subscription(kind, topic, partial(self.receive, topic), keep_all)

        def receive(self, topic, message):
            now = (message.header.stamp.sec, message.header.stamp.nanosec)
            parts = self.parts.setdefault(now, {})
            parts[topic] = message
            if len(parts) < 3:
                return
            self.parts = {t: kept for t, kept in self.parts.items() if t > now}
            touches, is_first = parts[CONTACT].touches, parts[CONTACT].seq == 0
            self.has_touched = (self.has_touched and not is_first) or touches > 0
            answer = WrenchStamped()
            answer.header.stamp, answer.header.frame_id = message.header.stamp, FRAME
            bodies = [read(parts[f"{vehicle}/odom"]) for vehicle in ("chaser", "target")]
            force, torque = answer.wrench.force, answer.wrench.torque
            force.x, force.y, torque.z = command(*bodies, self.has_touched)
            self.publisher.publish(answer)

    rclpy.init()
    rclpy.spin(DockingController())


if __name__ == "__main__":
    main()
