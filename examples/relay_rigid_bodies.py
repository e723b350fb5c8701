"""Poses of a driver that publishes named rigid bodies in one message, as PoseStamped.

python examples/relay_rigid_bodies.py --ros-args -p topic:=rigid_bodies \
    -p type:=mocap4r2_msgs/msg/RigidBodies -p list:=rigidbodies -p name:=rigid_body_name

The defaults are those of motion_capture_tracking.
"""

import contextlib
from importlib import import_module

import rclpy
from geometry_msgs.msg import PoseStamped
from rclpy.node import Node
from rclpy.qos import qos_profile_sensor_data  # reads best-effort and reliable drivers


class RelayRigidBodies(Node):
    def __init__(self, **options):
        super().__init__("relay_rigid_bodies", **options)
        kind = "motion_capture_tracking_interfaces/msg/NamedPoseArray"
        defaults = {"topic": "poses", "type": kind, "list": "poses", "name": "name"}
        defaults |= {"chaser": "chaser", "target": "target"}  # names of the bodies
        self.p = {name: self.declare_parameter(name, v).value for name, v in defaults.items()}
        self.outputs = {
            self.p[body]: self.create_publisher(PoseStamped, f"motion_capture/{body}", 10)
            for body in ("chaser", "target")
        }
        package, _, kind = self.p["type"].split("/")
        kind = getattr(import_module(f"{package}.msg"), kind)
        self.create_subscription(kind, self.p["topic"], self.relay, qos_profile_sensor_data)

    def relay(self, message):
        for body in getattr(message, self.p["list"]):
            if (name := getattr(body, self.p["name"])) in self.outputs:
                header = getattr(message, "header", None) or body.header
                self.outputs[name].publish(PoseStamped(header=header, pose=body.pose))


if __name__ == "__main__":
    with contextlib.suppress(KeyboardInterrupt, rclpy.executors.ExternalShutdownException):
        rclpy.init()
        rclpy.spin(RelayRigidBodies())
