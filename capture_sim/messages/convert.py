"""Samples, events and statuses as ROS messages, whichever library makes the classes.

The generated classes of rclpy and the dataclasses of rosbags have the same fields, so the
same code fills both, and a message published live and one written offline carry the same
values.  Neither library is imported here: the caller hands in a look-up from type name to
class, and what serialises a message.

    offline:  Messages(typestore.types.__getitem__, serialise)
    in ROS:   Messages(get_message, serialize_message, sequence=array.array)

Simulated time starts at 1 s, since a stamp of zero means 'not set' to ROS tools.
"""

from __future__ import annotations

import hashlib
import math
import platform
from collections import namedtuple
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from enum import IntEnum
from importlib.metadata import PackageNotFoundError, version
from typing import TYPE_CHECKING, Any

import numpy as np

from capture_sim.samples import SAMPLE, TRACE, Event, Phase
from capture_sim.scene.paths import RENAMED

if TYPE_CHECKING:
    from capture_sim.detection.exact import CaptureStatus
    from capture_sim.launch.plan import LaunchPlan
    from capture_sim.launch.watch import LauncherStatus
    from capture_sim.scene.parts import Detector, Scene

#: Stamp of the release, t = 0, in ns.
EPOCH_NS = 1_000_000_000

WORLD = "world"
CHASER_FRAME = "chaser/base_link"
TIP_FRAME = "chaser/tip"
TARGET_FRAME = "target/base_link"
CONE_FRAME = "target/cone"
HINGE_JOINT = "buffer_hinge"
SLIDE_JOINT = "buffer_slide"

#: Packages whose version decides about a run's numbers or its file.
_SOFTWARE = ("capture_sim", "numpy", "numba", "mcap", "rosbags")

#: Fields of CaptureCriteria, and those of a scene's ``detector``, which were called so before.
CRITERIA = {
    name.removeprefix("detector."): field
    for name, field in RENAMED.items()
    if name.startswith("detector.")
}

# indices into q and v, see samples.COORDINATES
_CHASER = slice(0, 3)
_TARGET = slice(5, 8)
_THETA_S, _THETA_P, _H = 2, 3, 4

Message = Any
SequenceMaker = Callable[[str, Sequence[float]], Any]
#: A sample as plain Python numbers, by the names of SAMPLE, see :func:`row_of`.
Row = Any
_Row = namedtuple("_Row", SAMPLE.names or ())  # type: ignore[misc]  # the names are data


class StringPhase(IntEnum):
    """Values of ``phase`` in msg/StringState.msg."""

    HELD = 0
    TAUT = 1
    SLACK = 2


class LaunchAction(IntEnum):
    """Values of ``action`` in msg/LaunchCommand.msg."""

    ARM = 1
    RELEASE = 2
    ABORT = 3


def stamp_ns(t: float) -> int:
    """Return the stamp of a time since the release: ns for s."""
    return EPOCH_NS + round(t * 1e9)


def stamp_seconds(stamp: int) -> float:
    """Return the time since the release of a stamp: s for ns."""
    return (stamp - EPOCH_NS) / 1e9


def software_versions() -> tuple[str, ...]:
    """Return ``"name version"`` of Python and of each installed package that counts."""
    found = [f"python {platform.python_version()}"]
    for name in _SOFTWARE:
        try:
            found.append(f"{name} {version(name)}")
        except PackageNotFoundError:
            continue
    return tuple(found)


def row_of(sample: np.void) -> Row:
    """Return a sample as plain Python numbers; its arrays stay NumPy's."""
    return _Row._make(sample.item())


@dataclass(frozen=True)
class RunDescription:
    """Everything needed to run a run again; the content of msg/RunInfo.msg.

    Attributes
    ----------
    run_id
        Unique to this run.
    name
        Of the experiment.
    scene
        The resolved scene, YAML.
    software
        ``"name version"`` each.
    state_rate
        Of BenchState, Hz.
    rate
        Of all other periodic topics, Hz.
    publishers
        Nodes whose StreamCounts end the run.
    consumers
        Nodes that take part, and read what the others publish.
    """

    run_id: str
    name: str
    scene: str
    software: tuple[str, ...]
    state_rate: float
    rate: float
    publishers: tuple[str, ...]
    consumers: tuple[str, ...] = ()

    @classmethod
    def of(
        cls,
        scene: Scene,
        run_id: str,
        publishers: Sequence[str],
        software: Sequence[str] | None = None,
        consumers: Sequence[str] = (),
    ) -> RunDescription:
        """Describe a run of a scene; the software is that of this process unless given."""
        return cls(
            run_id=run_id,
            name=scene.name,
            scene=scene.to_yaml(),
            software=tuple(software_versions() if software is None else software),
            state_rate=scene.run.state_rate,
            rate=scene.run.rate,
            publishers=tuple(publishers),
            consumers=tuple(consumers),
        )

    @property
    def scene_sha256(self) -> str:
        """Hash of the scene's text, hexadecimal."""
        return hashlib.sha256(self.scene.encode()).hexdigest()


@dataclass(frozen=True)
class SinceLastMessage:
    """What the contact did between two ContactState messages."""

    peak_force: float  # N, largest normal force
    impulse: float  # N s, normal impulse of both walls
    touches: int  # touches begun


class ContactInterval:
    """Sums up the contact from one ContactState message to the next.

    Feed it with every event and every sample in order, then :meth:`take` at a message.

    A touch's located peak is known when the touch ends.  When that is after the message
    of the interval it lies in, it is reported by the next one, at most one message late;
    a touch that goes on for longer than that is represented by the samples' forces there
    and by its lift_off event.  So the result depends on what was known at the time only,
    and is the same however the run is cut into blocks.
    """

    def __init__(self) -> None:
        self._peak = 0.0
        self._impulse = 0.0
        self._touches = 0
        self._last_message = -math.inf
        self._message_before = -math.inf

    def add_event(self, event: Event) -> None:
        """Take in an event; those that end a touch count."""
        if event.touch is not None and event.touch["peak_time"] > self._message_before:
            self._peak = max(self._peak, float(event.touch["peak_force"]))

    def add_samples(self, samples: np.ndarray) -> None:
        """Take in samples, (n,) of dtype SAMPLE."""
        if len(samples):
            self._peak = max(self._peak, float(samples["normal_force"].max()))

    def take(self, row: Row) -> SinceLastMessage:
        """Return the sums up to and with this sample, and start anew."""
        impulse = float(row.impulse[0]) + float(row.impulse[1])
        since = SinceLastMessage(self._peak, impulse - self._impulse, row.touches - self._touches)
        self._peak = 0.0
        self._impulse = impulse
        self._touches = row.touches
        self._message_before = self._last_message
        self._last_message = row.t
        return since


def _numpy_sequence(typecode: str, values: Sequence[float]) -> np.ndarray:
    return np.array(values, dtype=typecode)


class Messages:
    """Makes messages from the bench's own data.

    What is sent with every sample is filled into the same object again, as making one costs
    more than filling it: serialise a message before the next of its kind is made.

    Parameters
    ----------
    classes
        Returns the message class of a type name, ``package/msg/Name``.
    serialise
        Returns the bytes of a message.
    sequence
        Makes an unbounded number field from a typecode (``"d"``, ``"Q"``) and
        values: ``array.array`` for rclpy, a NumPy array (the default) for rosbags.
    """

    def __init__(
        self,
        classes: Callable[[str], Callable[..., Message]],
        serialise: Callable[[Message], bytes],
        sequence: SequenceMaker = _numpy_sequence,
    ) -> None:
        self.serialise = serialise
        self._sequence = sequence
        self._classes = classes
        self._made: dict[str, Message] = {}  # what is filled again, by type and frame

    def new(self, type_name: str, **fields: Any) -> Message:
        """Return a new message of a type, ``package/msg/Name``."""
        return self._classes(type_name)(**fields)

    def stamp(self, t: float) -> Message:
        """Return builtin_interfaces/Time of a time since the release, s."""
        sec, nanosec = divmod(stamp_ns(t), 1_000_000_000)
        return self.new("builtin_interfaces/msg/Time", sec=sec, nanosec=nanosec)

    def header(self, t: float, frame_id: str) -> Message:
        """Return std_msgs/Header of a time since the release, s."""
        return self.new("std_msgs/msg/Header", stamp=self.stamp(t), frame_id=frame_id)

    def clock(self, t: float) -> Message:
        """Return rosgraph_msgs/Clock of a time since the release, s."""
        return self.new("rosgraph_msgs/msg/Clock", clock=self.stamp(t))

    def bench_states(self, first_seq: int, samples: np.ndarray) -> Iterator[Message]:
        """Yield BenchState of each sample, (n,) of dtype SAMPLE; the first has ``first_seq``."""
        names = SAMPLE.names or ()
        # by whole columns: item access on NumPy records is slow
        columns = [
            samples[name].tolist() if SAMPLE[name].shape == () else list(samples[name])
            for name in names
        ]
        message: Message = None
        for seq, row in enumerate(zip(*columns, strict=True), first_seq):
            if message is None:
                fields = dict(zip(names, row, strict=True))
                message = self.new(
                    "capture_sim/msg/BenchState",
                    header=self.header(row[0], WORLD),
                    seq=seq,
                    **fields,
                )
                stamp = message.header.stamp
                # the properties of rclpy's classes cost more than what they set
                slots = {f"_{name}" for name in names} & set(getattr(message, "__slots__", ()))
                names = tuple(f"_{name}" if f"_{name}" in slots else name for name in names)
            else:
                _set_stamp(stamp, row[0])
                message.seq = seq
                for name, value in zip(names, row, strict=True):
                    setattr(message, name, value)
            yield message

    def buffer_state(self, seq: int, row: Row) -> Message:
        """Return BufferState of one sample."""
        return self._stamped(
            "capture_sim/msg/BufferState",
            row.t,
            CHASER_FRAME,
            seq=seq,
            axial_stroke=row.axial_stroke,
            axial_rate=float(row.v[_H]),
            axial_force=row.axial_force,
            torsion=row.torsion,
            torsion_rate=_torsion_rate(row),
            torsion_torque=row.torsion_torque,
        )

    def contact_state(self, seq: int, row: Row, since: SinceLastMessage) -> Message:
        """Return ContactState of one sample and of what happened since the last message."""
        return self._stamped(
            "capture_sim/msg/ContactState",
            row.t,
            CONE_FRAME,
            seq=seq,
            in_touch=row.walls != 0,
            walls=row.walls,
            penetration=row.penetration,
            penetration_rate=row.penetration_rate,
            normal_force=row.normal_force,
            friction_force=row.friction_force,
            peak_force=since.peak_force,
            impulse=since.impulse,
            touches=since.touches,
        )

    def contact_trace(self, seq: int, t: float, points: np.ndarray) -> Message:
        """Return ContactTrace of points, (n,) with the fields of TRACE, stamped t, s."""
        return self.new(
            "capture_sim/msg/ContactTrace",
            header=self.header(t, CONE_FRAME),
            seq=seq,
            **{
                name: self._sequence("B" if name == "walls" else "d", points[name].ravel().tolist())
                for name in TRACE.names or ()
            },
        )

    def string_state(self, seq: int, row: Row, scene: Scene) -> Message:
        """Return StringState of one sample of a scene; without a string it counts as slack."""
        return self._stamped(
            "capture_sim/msg/StringState",
            row.t,
            WORLD,
            seq=seq,
            phase=int(string_phase(row, scene)),
            tension=row.string_tension,
            mass_height=row.mass_height,
            mass_speed=row.mass_speed,
            chaser_speed=speed_along_rail(row, scene),
        )

    def bench_event(self, seq: int, event: Event) -> Message:
        """Return BenchEvent; the touch's numbers are zero when the event ends none."""
        names = ("approach_speed", "peak_force", "peak_time", "impulse", "dissipated")
        touch = event.touch
        return self.new(
            "capture_sim/msg/BenchEvent",
            header=self.header(event.t, WORLD),
            seq=seq,
            t=float(event.t),
            kind=event.kind.label,
            detail=event.detail,
            wall=int(event.wall if touch is None else touch["wall"]),
            q=np.ascontiguousarray(event.q, dtype=float),
            v=np.ascontiguousarray(event.v, dtype=float),
            touch_start=0.0 if touch is None else float(touch["start"]),
            **{name: 0.0 if touch is None else float(touch[name]) for name in names},
        )

    def chaser_odometry(self, row: Row) -> Message:
        """Return Odometry of the chaser's centre of mass; twist in its own frame."""
        return self._planar_odometry(row, _CHASER, CHASER_FRAME)

    def target_odometry(self, row: Row) -> Message:
        """Return Odometry of the target's centre of mass; twist in its own frame."""
        return self._planar_odometry(row, _TARGET, TARGET_FRAME)

    def odometry(
        self,
        t: float,
        frame: str,
        child: str,
        pose: tuple[float, float, float],
        rates: tuple[float, float, float],
    ) -> Message:
        """Return Odometry of a body in a frame.

        Parameters
        ----------
        t
            s since the release.
        frame, child
            That the pose is given in, and the body's own, which the twist is given in.
        pose
            x, y (m), heading (rad).
        rates
            Of the pose, in the frame, m/s and rad/s.
        """
        message = self._made.get(child)
        if message is None:
            message = self._made[child] = self.new(
                "nav_msgs/msg/Odometry",
                header=self.header(t, frame),
                child_frame_id=child,
                pose=self.new(
                    "geometry_msgs/msg/PoseWithCovariance",
                    pose=self._pose(),
                    covariance=np.zeros(36),
                ),
                twist=self.new(
                    "geometry_msgs/msg/TwistWithCovariance",
                    twist=self.new(
                        "geometry_msgs/msg/Twist", linear=self._vector(), angular=self._vector()
                    ),
                    covariance=np.zeros(36),
                ),
            )
        _set_stamp(message.header.stamp, t)
        _set_pose(message.pose.pose, pose)
        vx, vy, omega = rates
        cos, sin = math.cos(pose[2]), math.sin(pose[2])
        linear = message.twist.twist.linear
        linear.x, linear.y = cos * vx + sin * vy, cos * vy - sin * vx
        message.twist.twist.angular.z = omega
        return message

    def contact_wrench(self, row: Row) -> Message:
        """Return WrenchStamped on the tip, latches included, in the tip's own frame."""
        fx, fy = (row.contact_force + row.latch_force).tolist()
        theta = float(row.q[_THETA_P])
        cos, sin = math.cos(theta), math.sin(theta)
        force = (cos * fx + sin * fy, cos * fy - sin * fx, row.contact_torque)
        return self.wrench(row.t, TIP_FRAME, force)

    def wrench(self, t: float, frame: str, wrench: tuple[float, float, float]) -> Message:
        """Return WrenchStamped in a frame: force along x and y (N), torque about z (N m)."""
        made = f"wrench in {frame}"
        message = self._made.get(made)
        if message is None:
            message = self._made[made] = self.new(
                "geometry_msgs/msg/WrenchStamped",
                header=self.header(t, frame),
                wrench=self.new(
                    "geometry_msgs/msg/Wrench", force=self._vector(), torque=self._vector()
                ),
            )
        _set_stamp(message.header.stamp, t)
        force = message.wrench.force
        force.x, force.y, message.wrench.torque.z = wrench
        return message

    def sensed_pose(self, t: float, pose: tuple[float, float, float]) -> Message:
        """Return PoseStamped of what motion capture sees: x, y (m), heading (rad), world."""
        message = self._made.get("pose")
        if message is None:
            message = self._made["pose"] = self.new(
                "geometry_msgs/msg/PoseStamped", header=self.header(t, WORLD), pose=self._pose()
            )
        _set_stamp(message.header.stamp, t)
        _set_pose(message.pose, pose)
        return message

    def joint_states(self, row: Row) -> Message:
        """Return JointState of the buffer's hinge (rad) and slide (m)."""
        return self._stamped(
            "sensor_msgs/msg/JointState",
            row.t,
            "",
            name=[HINGE_JOINT, SLIDE_JOINT],
            position=self._sequence("d", [row.torsion, row.axial_stroke]),
            velocity=self._sequence("d", [_torsion_rate(row), float(row.v[_H])]),
            effort=self._sequence("d", [row.torsion_torque, row.axial_force]),
        )

    def capture_status(self, seq: int, t: float, status: CaptureStatus) -> Message:
        """Return CaptureStatus of the sample at a time since the release, s."""
        return self._stamped(
            "capture_sim/msg/CaptureStatus",
            t,
            CONE_FRAME,
            seq=seq,
            state=int(status.state),
            final=bool(status.final),
            distance=float(status.distance),
            axial_offset=float(status.axial_offset),
            lateral_offset=float(status.lateral_offset),
            relative_attitude=float(status.relative_attitude),
            relative_speed=float(status.relative_speed),
            nearest_distance=float(status.nearest_distance),
            time_in_state=float(status.time_in_state),
            reason=status.reason,
        )

    def capture_criteria(self, run_id: str, limits: Detector) -> Message:
        """Return CaptureCriteria, stamped with the release: the limits of a run's detector."""
        return self.new(
            "capture_sim/msg/CaptureCriteria",
            header=self.header(0.0, CONE_FRAME),
            run_id=run_id,
            **{name: getattr(limits, field) for name, field in CRITERIA.items()},
        )

    def launcher_state(self, seq: int, t: float, status: LauncherStatus) -> Message:
        """Return LauncherState at a time since the release, s."""
        return self._stamped(
            "capture_sim/msg/LauncherState",
            t,
            WORLD,
            seq=seq,
            state=int(status.state),
            hanging_mass=float(status.hanging_mass),
            drop_height=float(status.drop_height),
            wanted_speed=float(status.wanted_speed),
            landing_speed=float(status.landing_speed),
            measured_speed=float(status.measured_speed),
            reason=status.reason,
        )

    def launch_command(
        self, t: float, run_id: str, action: LaunchAction, plan: LaunchPlan
    ) -> Message:
        """Return LaunchCommand that follows a plan."""
        return self.new(
            "capture_sim/msg/LaunchCommand",
            header=self.header(t, WORLD),
            run_id=run_id,
            action=int(action),
            hanging_mass=float(plan.hanging_mass),
            drop_height=float(plan.drop_height),
            impact_speed=float(plan.impact_speed),
        )

    def run_info(self, run: RunDescription) -> Message:
        """Return RunInfo, stamped with the release."""
        return self.new(
            "capture_sim/msg/RunInfo",
            header=self.header(0.0, WORLD),
            run_id=run.run_id,
            name=run.name,
            scene=run.scene,
            scene_sha256=run.scene_sha256,
            software=list(run.software),
            state_rate=float(run.state_rate),
            rate=float(run.rate),
            publishers=list(run.publishers),
            consumers=list(run.consumers),
        )

    def stream_counts(
        self,
        publisher: str,
        run_id: str,
        counts: dict[str, int],
        *,
        complete: bool = True,
        reason: str = "",
    ) -> Message:
        """Return StreamCounts of one publisher: messages sent by topic name."""
        return self.new(
            "capture_sim/msg/StreamCounts",
            publisher=publisher,
            run_id=run_id,
            complete=complete,
            reason=reason,
            topics=list(counts),
            counts=self._sequence("Q", list(counts.values())),
        )

    def _stamped(self, type_name: str, t: float, frame: str, **fields: Any) -> Message:
        """Return the message of a type with a header, its fields filled."""
        message = self._made.get(type_name)
        if message is None:
            message = self.new(type_name, header=self.header(t, frame), **fields)
            self._made[type_name] = message
            return message
        _set_stamp(message.header.stamp, t)
        for name, value in fields.items():
            setattr(message, name, value)
        return message

    def _planar_odometry(self, row: Row, body: slice, frame: str) -> Message:
        return self.odometry(row.t, WORLD, frame, row.q[body].tolist(), row.v[body].tolist())

    def _pose(self) -> Message:
        return self.new(
            "geometry_msgs/msg/Pose",
            position=self.new("geometry_msgs/msg/Point", x=0.0, y=0.0, z=0.0),
            orientation=self.new("geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=0.0, w=1.0),
        )

    def _vector(self) -> Message:
        return self.new("geometry_msgs/msg/Vector3", x=0.0, y=0.0, z=0.0)


def string_phase(row: Row, scene: Scene) -> StringPhase:
    """Return the phase of the string in a sample; without a string it counts as slack."""
    if scene.string is None:
        return StringPhase.SLACK
    known = {Phase.HELD: StringPhase.HELD, Phase.TAUT: StringPhase.TAUT}
    return known.get(Phase(row.phase), StringPhase.SLACK)


def speed_along_rail(row: Row, scene: Scene) -> float:
    """Return the chaser's speed along the scene's rail, m/s."""
    heading = scene.initial.chaser.theta
    return float(row.v[0]) * math.cos(heading) + float(row.v[1]) * math.sin(heading)


def _torsion_rate(row: Row) -> float:
    return float(row.v[_THETA_P]) - float(row.v[_THETA_S])


def _set_stamp(stamp: Message, t: float) -> None:
    stamp.sec, stamp.nanosec = divmod(stamp_ns(t), 1_000_000_000)


def _set_pose(message: Message, pose: tuple[float, float, float]) -> None:
    message.position.x, message.position.y, theta = pose
    message.orientation.z, message.orientation.w = math.sin(theta / 2.0), math.cos(theta / 2.0)
