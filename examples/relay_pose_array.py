"""Poses of a driver that publishes all bodies as one PoseArray, as PoseStamped.

python examples/relay_pose_array.py --ros-args -p topic:=mocap/poses -p chaser:=0 -p target:=1

The driver must keep the order of its bodies: an array of another length is left out.
"""

import contextlib

import rclpy
from geometry_msgs.msg import PoseArray, PoseStamped
from rclpy.node import Node
from rclpy.qos import qos_profile_sensor_data  # reads best-effort and reliable drivers


class RelayPoseArray(Node):
    def __init__(self, **options):
        super().__init__("relay_pose_array", **options)
        self.bodies = self.declare_parameter("bodies", 2).value  # length of a whole array
        self.outputs = {}  # by the place in the array
        for place, body in enumerate(("chaser", "target")):
            place = self.declare_parameter(body, place).value
            self.outputs[place] = self.create_publisher(PoseStamped, f"motion_capture/{body}", 10)
        topic = self.declare_parameter("topic", "poses").value
        self.create_subscription(PoseArray, topic, self.relay, qos_profile_sensor_data)

    def relay(self, message):
        if len(message.poses) == self.bodies:  # else one is lost: which one is not known
            for place, out in self.outputs.items():
                out.publish(PoseStamped(header=message.header, pose=message.poses[place]))


if __name__ == "__main__":
    with contextlib.suppress(KeyboardInterrupt, rclpy.executors.ExternalShutdownException):
        rclpy.init()
        rclpy.spin(RelayPoseArray())
