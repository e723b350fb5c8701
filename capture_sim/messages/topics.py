"""The topics of the bench: names, types, quality of service and publishers, as data.

Nodes make their publishers from this table and the recorder its channels, so both agree.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum, StrEnum
from typing import Any

# roles of nodes, whatever their names
SIMULATOR = "simulator"
LAUNCHER = "launcher"
CAPTURE_DETECTOR = "capture_detector"
RECORDER = "recorder"
PLAYER = "player"


class RunSource(StrEnum):
    """Source of a run, as announced in RunInfo."""

    SIMULATION = "simulation"
    REPLAY = "replay"
    TRIAL = "trial"  # of a real bench


#: Topic on which the launcher drives a real release, std_msgs/Bool; ``true`` means hold.  No other
#: node publishes it.
HOLD = "launcher/hold"
#: Input of the launcher, std_msgs/Bool: true while the bench's emergency stop is pressed.
EMERGENCY_STOP = "emergency_stop"


class Rate(Enum):
    """Occasion on which messages of a topic are sent."""

    STATE = "state"  # with every sample, scene.run.state_rate
    PERIODIC = "periodic"  # with every n-th sample, scene.run.rate
    SENSOR = "sensor"  # at the rate of the sensor, scene.sensors
    EVENT = "event"  # when something happens
    ONCE = "once"  # once a run and publisher
    CONTROL = "control"  # with every step of a control loop; only the newest ``depth`` are kept


class Stamp(Enum):
    """Position of the simulated time in a message of the topic."""

    HEADER = "header"  # std_msgs/Header, the first field
    CLOCK = "clock"  # builtin_interfaces/Time, the only field
    NONE = "none"


@dataclass(frozen=True, eq=False)  # each topic exists once: compared and hashed by identity
class Topic:
    """A topic with its quality of service.

    A stream keeps every message until it is read.
    """

    name: str  # relative to the namespace
    type_name: str  # message type as ``package/msg/Name``
    publishers: tuple[str, ...]  # nodes that send it
    rate: Rate
    depth: int = 1000  # messages that a topic with KEEP_LAST keeps
    reliable: bool = True  # lost messages are sent again; False: best effort
    transient_local: bool = False  # late subscribers get the last ``depth`` messages
    stamp: Stamp = Stamp.HEADER
    sequenced: bool = False  # a ``uint64 seq`` follows the header and counts from 0 without gaps

    @property
    def keeps_last(self) -> bool:
        """True for KEEP_LAST of ``depth`` messages, False for KEEP_ALL until they are read."""
        return self.transient_local or self.rate is Rate.CONTROL

    @property
    def holds_state(self) -> bool:
        """True if only the newest message matters; DDS may replace an older undelivered message."""
        return self.transient_local and self.depth == 1 and self.rate is Rate.EVENT

    @property
    def absolute_name(self) -> str:
        """Name in the root namespace, as used in bags."""
        return f"/{self.name.lstrip('/')}"


def _ours(
    name: str, message: str, publisher: str, rate: Rate = Rate.PERIODIC, **more: Any
) -> Topic:
    return Topic(name, f"capture_sim/msg/{message}", (publisher,), rate, **more)


_TRANSIENT_LOCAL: dict[str, Any] = {"depth": 1, "transient_local": True}
_NUMBERED: dict[str, Any] = {"sequenced": True}

CLOCK = Topic("clock", "rosgraph_msgs/msg/Clock", (SIMULATOR,), Rate.PERIODIC, stamp=Stamp.CLOCK)
RUN_INFO = _ours("bench/run_info", "RunInfo", SIMULATOR, Rate.ONCE, **_TRANSIENT_LOCAL)
BENCH_STATE = _ours("bench/state", "BenchState", SIMULATOR, Rate.STATE, **_NUMBERED)
# sent only if the scene requests it
CONTACT_TRACE = _ours("bench/contact_trace", "ContactTrace", SIMULATOR, Rate.EVENT, **_NUMBERED)
BUFFER_STATE = _ours("bench/buffer", "BufferState", SIMULATOR, **_NUMBERED)
CONTACT_STATE = _ours("bench/contact", "ContactState", SIMULATOR, **_NUMBERED)
STRING_STATE = _ours("bench/string", "StringState", SIMULATOR, **_NUMBERED)
BENCH_EVENT = _ours(
    "bench/event", "BenchEvent", SIMULATOR, Rate.EVENT, transient_local=True, **_NUMBERED
)
CHASER_ODOMETRY = Topic("chaser/odom", "nav_msgs/msg/Odometry", (SIMULATOR,), Rate.PERIODIC)
TARGET_ODOMETRY = Topic("target/odom", "nav_msgs/msg/Odometry", (SIMULATOR,), Rate.PERIODIC)
CONTACT_WRENCH = Topic(
    "contact/wrench", "geometry_msgs/msg/WrenchStamped", (SIMULATOR,), Rate.PERIODIC
)
JOINT_STATES = Topic("joint_states", "sensor_msgs/msg/JointState", (SIMULATOR,), Rate.PERIODIC)
# readings of the scene's sensors; not sent if the scene has none
CHASER_POSE = Topic(
    "motion_capture/chaser", "geometry_msgs/msg/PoseStamped", (SIMULATOR,), Rate.SENSOR
)
TARGET_POSE = Topic(
    "motion_capture/target", "geometry_msgs/msg/PoseStamped", (SIMULATOR,), Rate.SENSOR
)
LOAD_CELL = Topic("load_cell/wrench", "geometry_msgs/msg/WrenchStamped", (SIMULATOR,), Rate.SENSOR)
LAUNCH_COMMAND = _ours(
    "launcher/command", "LaunchCommand", LAUNCHER, Rate.EVENT, depth=10, transient_local=True
)
LAUNCHER_STATE = _ours("launcher/state", "LauncherState", LAUNCHER, **_NUMBERED)
# messages of launcher/state in which the state changes, for late subscribers
LAUNCHER_PHASE = _ours(
    "launcher/phase", "LauncherState", LAUNCHER, Rate.EVENT, **_TRANSIENT_LOCAL, **_NUMBERED
)
CAPTURE_CRITERIA = _ours(
    "capture/criteria", "CaptureCriteria", CAPTURE_DETECTOR, Rate.ONCE, **_TRANSIENT_LOCAL
)
CAPTURE_STATUS = _ours("capture/status", "CaptureStatus", CAPTURE_DETECTOR, **_NUMBERED)
CAPTURE_VERDICT = _ours(
    "capture/verdict",
    "CaptureStatus",
    CAPTURE_DETECTOR,
    Rate.EVENT,
    **_TRANSIENT_LOCAL,
    **_NUMBERED,
)
STREAM_COUNTS = Topic(
    "bench/stream_counts",
    "capture_sim/msg/StreamCounts",
    (SIMULATOR, LAUNCHER, CAPTURE_DETECTOR),
    Rate.ONCE,
    depth=10,
    transient_local=True,
    stamp=Stamp.NONE,
)

#: Reports of nodes on their participation in runs; not part of a run, so not recorded.  Only the
#: newest is kept, because a node that joins a trial would otherwise first receive reports on
#: earlier runs.
ROLL = Topic(
    "bench/roll",
    "capture_sim/msg/Roll",
    (),
    Rate.EVENT,
    **_TRANSIENT_LOCAL,
    stamp=Stamp.NONE,
)

# commands of a user's controller to the scene's thrusters; bench/state contains their effect
CHASER_CMD_WRENCH = Topic(
    "chaser/cmd_wrench", "geometry_msgs/msg/WrenchStamped", (), Rate.CONTROL, depth=10
)
TARGET_CMD_WRENCH = Topic(
    "target/cmd_wrench", "geometry_msgs/msg/WrenchStamped", (), Rate.CONTROL, depth=10
)

#: What shows the bench, for RViz and Foxglove: neither counted nor waited for.
ROBOT_DESCRIPTION = Topic(
    "robot_description",
    "std_msgs/msg/String",
    (),
    Rate.ONCE,
    **_TRANSIENT_LOCAL,
    stamp=Stamp.NONE,
)
TF_STATIC = Topic(
    "tf_static", "tf2_msgs/msg/TFMessage", (), Rate.ONCE, **_TRANSIENT_LOCAL, stamp=Stamp.NONE
)
TF = Topic("tf", "tf2_msgs/msg/TFMessage", (), Rate.CONTROL, depth=100, stamp=Stamp.NONE)
SHOWN: tuple[Topic, ...] = (ROBOT_DESCRIPTION, TF_STATIC, TF)

#: All topics of a run, in the order in which a sample's messages are sent.
TOPICS: tuple[Topic, ...] = (
    RUN_INFO,
    LAUNCH_COMMAND,
    BENCH_EVENT,
    BENCH_STATE,
    CONTACT_TRACE,
    CLOCK,
    BUFFER_STATE,
    CONTACT_STATE,
    STRING_STATE,
    CHASER_ODOMETRY,
    TARGET_ODOMETRY,
    CONTACT_WRENCH,
    JOINT_STATES,
    CHASER_POSE,
    TARGET_POSE,
    LOAD_CELL,
    LAUNCHER_STATE,
    LAUNCHER_PHASE,
    CAPTURE_CRITERIA,
    CAPTURE_STATUS,
    CAPTURE_VERDICT,
    STREAM_COUNTS,
)


def topics_of(publisher: str) -> tuple[Topic, ...]:
    """Return the topics that a node publishes, including bench/stream_counts."""
    return tuple(topic for topic in TOPICS if publisher in topic.publishers)


def topic_named(name: str) -> Topic | None:
    """Return the topic of a relative or absolute name; None if it is not in :data:`TOPICS`."""
    wanted = name.lstrip("/")
    for topic in TOPICS:
        if topic.name.lstrip("/") == wanted:
            return topic
    return None
