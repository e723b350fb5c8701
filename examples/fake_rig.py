"""A bench that knows nothing of capture_sim: cameras, encoders and a load cell, in plain rclpy.

launcher/hold, a Bool, lets the chaser go.  `--ros-args -p preset:=hard -p loss:=0.0` disturbs it.
"""

import contextlib
import heapq
import math
from random import gauss, randint, random
from types import SimpleNamespace

import rclpy
from geometry_msgs.msg import PoseStamped, WrenchStamped
from nav_msgs.msg import Odometry
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import JointState
from std_msgs.msg import Bool

PARAMETERS = {  # name: its default, or those of the presets clean, standard, hard
    "rate": (100.0, 120.0, 100.0),  # Hz, cameras, encoders and the output of the load cell
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
    "outcomes": ["captured"],  # of the releases in turn: captured, rebound, missed
    "odometry": False,  # nav_msgs/Odometry in chaser/odom in place of PoseStamped
    "encoder_offset": 0.0,  # s, clock of the encoders less that of the cameras
    "encoder_end": math.inf,  # s after a release, when the encoders fall silent for good
    "pace": 1.0,  # s of the bench in a second: a fast bench saves waiting in tests
}
TARGET, STOP, SPEED, DROP = 0.66, 0.2125, 0.105, 0.1  # m, of the chaser at the cone; m/s after m
BACK, ASIDE, RETURNED = 0.5, 0.12, 0.4  # m/s pulled back; m of a miss; speed after by before
JOINTS, PRESETS = ["buffer_hinge", "buffer_slide"], ["clean", "standard", "hard"]
CONTACT, STROKE, MASS, CLOCK = 0.1, 0.003, 22.0, 1.2e9  # s; m; kg; s, the bench's at its start


class FakeRig(Node):
    def __init__(self):
        super().__init__("fake_rig")
        column = PRESETS.index(self.declare_parameter("preset", "clean").value)
        rows = [(n, v[column] if isinstance(v, tuple) else v) for n, v in PARAMETERS.items()]
        self.p = SimpleNamespace(**{d.name: d.value for d in self.declare_parameters("", rows)})
        qos = QoSProfile(depth=10)
        if self.p.best_effort:
            qos.reliability, qos.deadline = ReliabilityPolicy.BEST_EFFORT, Duration(seconds=0.1)
        self.kind = Odometry if self.p.odometry else PoseStamped
        name, vehicles = "{}/odom" if self.p.odometry else "motion_capture/{}", ("chaser", "target")
        self.cameras = [self.create_publisher(self.kind, name.format(v), qos) for v in vehicles]
        self.encoders = self.create_publisher(JointState, "joint_states", qos)
        self.cell = self.create_publisher(WrenchStamped, "load_cell/wrench", qos)
        latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self.create_subscription(Bool, "launcher/hold", self.hold, latched)
        self.dt, self.released, self.held, self.trial = 1.0 / self.p.rate, None, -1.0, 0
        self.t = self.x = self.y = self.force = self.sample = self.burst = 0.0
        self.slow, self.poses, self.under_way, self.end = [0.0, 0.0], [None, None], [], math.inf
        self.create_timer(self.dt / self.p.pace, self.measure)

    def hold(self, message):
        if not message.data and self.released is None:
            self.released, self.x, self.end = self.t, 0.0, self.t + self.p.encoder_end
        elif message.data and self.released is not None:
            self.released, self.held, self.trial = None, self.t, self.trial + 1

    def move(self):
        outcome = self.p.outcomes[self.trial % len(self.p.outcomes)]
        self.speed, self.since_contact = 0.0, -1.0
        if self.released is not None:
            going, sinking = self.t - self.released, 2.0 * DROP / SPEED  # s, of the mass
            self.speed = SPEED * min(1.0, going / sinking)
            self.x = 0.5 * self.speed * min(going, sinking) + SPEED * max(0.0, going - sinking)
            if self.x >= STOP and outcome != "missed":
                self.since_contact = (self.x - STOP) / SPEED
                self.speed = -RETURNED * SPEED if outcome == "rebound" else 0.0
                self.x = STOP + self.speed * self.since_contact
        elif self.t > self.held + 0.5:
            self.x = max(0.0, self.x - BACK * self.dt)
            self.y = ASIDE if outcome == "missed" else 0.0

    def measure(self):
        p, self.t = self.p, self.t + self.dt
        self.move()
        pressed = max(0.0, math.sin(math.pi * min(1.0, self.since_contact / CONTACT)))
        self.photograph((self.x + STROKE * pressed, TARGET), (self.y, 0.0))
        if self.t < self.end:
            joints = JointState(name=JOINTS, position=[0.0, -STROKE * pressed])
            self.send(self.encoders, joints, p.encoder_offset)
        share = 1.0 - math.exp(-math.tau * p.cell_bandwidth * self.dt)
        self.force += share * (pressed * 0.5 * math.pi * MASS * SPEED / CONTACT - self.force)
        if int(self.t * p.cell_rate) > int((self.t - self.dt) * p.cell_rate):
            self.sample = gauss(self.force + p.cell_bias * (1.0 + self.t / 50.0), p.cell_noise)
        wrench = WrenchStamped()
        wrench.wrench.force.x = self.sample
        self.send(self.cell, wrench)
        while self.under_way and self.under_way[0][0] <= self.t:
            _, _, publisher, message = heapq.heappop(self.under_way)
            publisher.publish(message)

    def photograph(self, x, y):
        p, dt = self.p, self.dt
        self.burst = randint(5, 20) if random() < p.burst_loss / 12.5 else self.burst - 1
        is_lost = self.burst > 0 or 0.0 <= self.since_contact < p.hidden or random() < p.loss
        is_back = self.released is not None and 0.0 <= self.t - self.released - 1.0 < dt
        for i, publisher in enumerate(self.cameras):
            self.slow[i] += gauss(0.0, p.slow_noise * (dt / 5.0) ** 0.5) - self.slow[i] * dt / 10.0
            sigma = math.hypot(p.noise, p.moving_noise * self.speed * (1 - i))
            half_yaw = gauss(0.0, math.sqrt(0.5) * p.noise / 0.15)
            pose = [gauss(x[i] + self.slow[i], sigma), gauss(y[i], sigma), half_yaw, 1.0]
            if is_lost:
                pose = {"silence": None, "void": [math.nan] * 4, "frozen": self.poses[i]}[p.lost_as]
            if pose is not None:
                self.poses[i], message = pose, self.kind()
                at = message.pose.pose if p.odometry else message.pose
                at.position.x, at.position.y, at.orientation.z, at.orientation.w = pose
                self.send(publisher, message, -p.step_back if is_back else 0.0)

    def send(self, publisher, message, offset=0.0):
        delay = max(0.0, gauss(self.p.latency, self.p.latency / 6.0))
        stamp = round((CLOCK + self.t + offset + self.p.stamp_at_receipt * delay) * 1e9)
        message.header.stamp.sec, message.header.stamp.nanosec = divmod(stamp, 10**9)
        for _ in range(2 if random() < self.p.repeated else 1):
            heapq.heappush(self.under_way, (self.t + delay, random(), publisher, message))


with contextlib.suppress(KeyboardInterrupt, rclpy.executors.ExternalShutdownException):
    rclpy.init()
    rclpy.spin(FakeRig())
