"""The bench of fake_rig.py with the faults of real sensors: noise, loss, delay, odd clocks.

python examples/disturbed_rig.py --ros-args -p preset:=hard -p loss:=0.0
"""

import heapq
import math
from random import gauss, randint, random
from types import SimpleNamespace

from fake_rig import FakeRig, pose_message, run, stamped
from geometry_msgs.msg import PoseStamped, WrenchStamped
from nav_msgs.msg import Odometry
from rclpy.duration import Duration
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import JointState

PARAMETERS = {  # name: its default, or those of the presets clean, standard, hard
    "noise": (1e-5, 5e-5, 3e-4),  # m, white; of the yaw by a baseline of 0.15 m
    "moving_noise": (0.0, 2e-3, 1e-2),  # s: m of noise per m/s
    "slow_noise": (0.0, 1e-4, 3e-4),  # m, Gauss-Markov with a time constant of 10 s
    "latency": (0.0, 0.007, 0.025),  # s, rounded up to whole frames; its jitter is a sixth
    "stamp_at_receipt": (False, False, True),  # else at exposure
    "loss": (0.01, 0.001, 0.001),  # share of single frames that are lost
    "burst_loss": (0.0, 0.0, 0.02),  # share of frames that are lost in bursts of 5 to 20
    "hidden": (0.0, 0.1, 0.5),  # s from the contact on in which the cameras lose both vehicles
    "lost_as": ("silence", "silence", "frozen"),  # silence, void (NaN) or frozen
    "repeated": (0.0, 0.0, 0.01),  # share of messages that come twice
    "step_back": (0.0, 0.0, 0.02),  # s, of the cameras' clock for one frame, 1 s after a release
    "best_effort": (False, False, True),  # with a deadline; else reliable
    "cell_rate": (1e3, 1e3, 50.0),  # Hz; below `rate`, samples are repeated
    "cell_noise": (0.0, 0.1, 0.5),  # N
    "cell_bias": (0.0, 0.5, 2.0),  # N, and its drift in 50 s
    "cell_bandwidth": (1e3, 200.0, 50.0),  # Hz, low-pass of first order
    "odometry": False,  # nav_msgs/Odometry in chaser/odom in place of PoseStamped
    "encoder_offset": 0.0,  # s, clock of the encoders less that of the cameras
    "encoder_end": math.inf,  # s after a release, when the encoders fall silent for good
    "camera_end": math.inf,  # ... and the cameras
    "camera_begin": -math.inf,  # s after a release, when the cameras begin to measure in it
}
PRESETS = ["clean", "standard", "hard"]


class DisturbedRig(FakeRig):
    def open_sensors(self):
        column = PRESETS.index(self.declare_parameter("preset", "clean").value)
        rows = [(n, v[column] if isinstance(v, tuple) else v) for n, v in PARAMETERS.items()]
        self.p = SimpleNamespace(**{d.name: d.value for d in self.declare_parameters("", rows)})
        qos = QoSProfile(depth=10)
        if self.p.best_effort:
            qos.reliability, qos.deadline = ReliabilityPolicy.BEST_EFFORT, Duration(seconds=0.1)
        self.kind, name = PoseStamped, "motion_capture/{}"
        if self.p.odometry:
            self.kind, name = Odometry, "{}/odom"
        names = [name.format(vehicle) for vehicle in ("chaser", "target")]
        self.cameras = [self.create_publisher(self.kind, name, qos) for name in names]
        self.encoders = self.create_publisher(JointState, "joint_states", qos)
        self.cell = self.create_publisher(WrenchStamped, "load_cell/wrench", qos)
        self.slow, self.poses, self.under_way = [0.0, 0.0], [None, None], []
        self.force = self.sample = self.burst = 0.0
        self.lost = {self.cameras[0]: False, self.cameras[1]: False, self.encoders: False}

    def measure(self):
        self.is_back = False
        if (going := self.chaser.going) is not None:
            self.is_back = 0.0 <= going - 1.0 < self.dt
            ends = (self.p.camera_end, self.p.camera_end, self.p.encoder_end)
            self.lost = {s: e < going or self.lost[s] for s, e in zip(self.lost, ends, strict=True)}
        self.burst = randint(5, 20) if random() < self.p.burst_loss / 12.5 else self.burst - 1
        is_hidden = 0.0 <= self.chaser.since_contact < self.p.hidden
        self.is_unseen = self.burst > 0 or is_hidden or random() < self.p.loss
        super().measure()
        while self.under_way and self.under_way[0][0] <= self.chaser.t:
            _, _, publisher, message = heapq.heappop(self.under_way)
            publisher.publish(message)

    def send(self, publisher, message):
        going = self.chaser.going
        is_early = going is not None and going < self.p.camera_begin
        if self.lost.get(publisher) or (is_early and publisher in self.cameras):
            return
        offset = 0.0
        if publisher in self.cameras:
            message = self.photograph(self.cameras.index(publisher), message)
            offset = -self.p.step_back * self.is_back
        elif publisher is self.encoders:
            offset = self.p.encoder_offset
        else:
            message.wrench.force.x = self.filtered(message.wrench.force.x)
        if message is not None:
            self.dispatch(publisher, message, offset)

    def photograph(self, i, true):
        p, dt, at = self.p, self.dt, true.pose.position
        self.slow[i] += gauss(0.0, p.slow_noise * (dt / 5.0) ** 0.5) - self.slow[i] * dt / 10.0
        sigma = math.hypot(p.noise, p.moving_noise * self.chaser.speed * (1 - i))
        yaw = gauss(0.0, math.sqrt(2.0) * p.noise / 0.15)
        pose = [gauss(at.x + self.slow[i], sigma), gauss(at.y, sigma), yaw]
        if self.is_unseen:
            pose = {"silence": None, "void": [math.nan] * 3, "frozen": self.poses[i]}[p.lost_as]
        if pose is None:
            return None
        self.poses[i] = pose
        return pose_message(self.kind(), *pose)

    def filtered(self, force):
        p = self.p
        share = 1.0 - math.exp(-math.tau * p.cell_bandwidth * self.dt)
        self.force += share * (force - self.force)
        t = self.chaser.t
        if int(t * p.cell_rate) > int((t - self.dt) * p.cell_rate):
            self.sample = gauss(self.force + p.cell_bias * (1.0 + t / 50.0), p.cell_noise)
        return self.sample

    def dispatch(self, publisher, message, offset):
        delay = max(0.0, gauss(self.p.latency, self.p.latency / 6.0))
        stamped(message, self.epoch + self.chaser.t + offset + self.p.stamp_at_receipt * delay)
        for _ in range(2 if random() < self.p.repeated else 1):
            heapq.heappush(self.under_way, (self.chaser.t + delay, random(), publisher, message))


if __name__ == "__main__":
    run(DisturbedRig)
