"""Poses of a driver that publishes its bodies on /tf, as PoseStamped.

python examples/relay_tf.py --ros-args -p chaser:=chaser_body -p target:=target_body
"""

import contextlib

import rclpy
from geometry_msgs.msg import PoseStamped
from rclpy.node import Node
from rclpy.qos import qos_profile_sensor_data  # reads best-effort and reliable drivers

from tf2_msgs.msg import TFMessage


class RelayTf(Node):
    def __init__(self, **options):
        super().__init__("relay_tf", **options)
        self.outputs = {}  # by the body's frame; both must be in one parent frame
        for body in ("chaser", "target"):
            frame = self.declare_parameter(body, body).value
            out = self.create_publisher(PoseStamped, f"motion_capture/{body}", 10)
            self.outputs[frame] = out
        self.create_subscription(TFMessage, "tf", self.relay, qos_profile_sensor_data)

    def relay(self, message):
        for each in message.transforms:
            if each.child_frame_id in self.outputs:
                pose, at = PoseStamped(header=each.header), each.transform.translation
                pose.pose.position.x, pose.pose.position.y, pose.pose.position.z = at.x, at.y, at.z
                pose.pose.orientation = each.transform.rotation
                self.outputs[each.child_frame_id].publish(pose)


if __name__ == "__main__":
    with contextlib.suppress(KeyboardInterrupt, rclpy.executors.ExternalShutdownException):
        rclpy.init()
        rclpy.spin(RelayTf())
