"""Poses of a driver that publishes TransformStamped, a topic for each body, as PoseStamped.

python examples/relay_transform.py --ros-args -p chaser:=vicon/chaser/base
"""

import contextlib
from functools import partial

import rclpy
from geometry_msgs.msg import PoseStamped, TransformStamped
from rclpy.node import Node
from rclpy.qos import qos_profile_sensor_data  # reads best-effort and reliable drivers


class RelayTransform(Node):
    def __init__(self, **options):
        super().__init__("relay_transform", **options)
        for body in ("chaser", "target"):
            topic = self.declare_parameter(body, f"vicon/{body}/{body}").value
            out = self.create_publisher(PoseStamped, f"motion_capture/{body}", 10)
            relay = partial(self.relay, out)
            self.create_subscription(TransformStamped, topic, relay, qos_profile_sensor_data)

    def relay(self, out, message):
        out.publish(pose_of(message))


def pose_of(message):
    pose = PoseStamped(header=message.header)  # the driver's stamp and frame
    at = message.transform.translation
    pose.pose.position.x, pose.pose.position.y, pose.pose.position.z = at.x, at.y, at.z
    pose.pose.orientation = message.transform.rotation
    return pose


if __name__ == "__main__":
    with contextlib.suppress(KeyboardInterrupt, rclpy.executors.ExternalShutdownException):
        rclpy.init()
        rclpy.spin(RelayTransform())
