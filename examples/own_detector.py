"""A detector of your own: a plain rclpy node.  The simulator waits for it, so it misses no sample.

python examples/own_detector.py
capture-sim-simulator --ros-args -p "wait_for:=[own_detector]" -p rtf:=0.0
"""

import rclpy
from capture_sim.msg import BenchState
from rclpy.node import Node
from rclpy.qos import HistoryPolicy, QoSProfile, ReliabilityPolicy

KEEP_ALL = QoSProfile(
    history=HistoryPolicy.KEEP_ALL, depth=1, reliability=ReliabilityPolicy.RELIABLE
)
RADIUS, DWELL = 0.005, 0.2  # m, s


class OwnDetector(Node):
    def __init__(self):
        super().__init__("own_detector")
        self.since = None  # s, since when the tip is within the radius
        self.count = 0
        self.create_subscription(BenchState, "bench/state", self.receive, KEEP_ALL)

    def receive(self, state):
        self.count += 1
        self.since = (self.since or state.t) if state.tip_distance < RADIUS else None
        if self.since is not None and state.t - self.since >= DWELL:
            self.get_logger().info(f"captured since {self.since:.3f} s; sample {self.count}")
            raise SystemExit


if __name__ == "__main__":
    rclpy.init()
    rclpy.spin(OwnDetector())
