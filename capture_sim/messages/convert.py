"""Samples, events and statuses as ROS messages, whichever library makes the classes.

The generated classes of rclpy and the dataclasses of rosbags both take their fields as
keyword arguments, so the same code fills both, and a message published live and one
written offline are the same bytes.  Neither library is imported here: the caller hands
in a look-up from type name to class.

    offline:  Messages(typestore.types.__getitem__)
    in ROS:   Messages(rosidl_runtime_py.utilities.get_message, sequence=array.array)

Simulated time starts at 1 s, since a stamp of zero means 'not set' to ROS tools.
"""

from __future__ import annotations

import hashlib
import math
import platform
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from enum import IntEnum
from importlib.metadata import PackageNotFoundError, version
from typing import TYPE_CHECKING, Any

import numpy as np

from capture_sim.samples import SAMPLE, TRACE, Event, Phase

if TYPE_CHECKING:
    from capture_sim.detection.exact import CaptureStatus
    from capture_sim.launch.plan import LauncherStatus
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

_INTEGERS = ("phase", "walls", "at_rest", "touches")
_SCALARS = tuple(
    name for name in SAMPLE.names or () if SAMPLE[name].shape == () and name not in _INTEGERS
)
_VECTORS = tuple(name for name in SAMPLE.names or () if SAMPLE[name].shape != ())

# indices into q and v, see samples.COORDINATES
_CHASER = (0, 1, 2)
_TARGET = (5, 6, 7)
_THETA_S, _THETA_P, _H = 2, 3, 4

Message = Any
SequenceMaker = Callable[[str, Sequence[float]], Any]


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

    def take(self, sample: np.void) -> SinceLastMessage:
        """Return the sums up to and with this sample, and start anew."""
        impulse = float(sample["impulse"][0]) + float(sample["impulse"][1])
        touches = int(sample["touches"])
        since = SinceLastMessage(self._peak, impulse - self._impulse, touches - self._touches)
        self._peak = 0.0
        self._impulse = impulse
        self._touches = touches
        self._message_before = self._last_message
        self._last_message = float(sample["t"])
        return since


def _numpy_sequence(typecode: str, values: Sequence[float]) -> np.ndarray:
    return np.array(values, dtype=typecode)


class Messages:
    """Makes message objects from the bench's own data.

    Parameters
    ----------
    classes
        Returns the message class of a type name, ``package/msg/Name``.
    sequence
        Makes an unbounded number field from a typecode (``"d"``, ``"Q"``) and
        values: ``array.array`` for rclpy, a NumPy array (the default) for rosbags.
    """

    def __init__(
        self,
        classes: Callable[[str], Callable[..., Message]],
        sequence: SequenceMaker = _numpy_sequence,
    ) -> None:
        self._sequence = sequence

        def ours(name: str) -> Callable[..., Message]:
            return classes(f"capture_sim/msg/{name}")

        self._bench_state = ours("BenchState")
        self._buffer_state = ours("BufferState")
        self._contact_state = ours("ContactState")
        self._contact_trace = ours("ContactTrace")
        self._string_state = ours("StringState")
        self._bench_event = ours("BenchEvent")
        self._capture_status = ours("CaptureStatus")
        self._capture_criteria = ours("CaptureCriteria")
        self._launcher_state = ours("LauncherState")
        self._launch_command = ours("LaunchCommand")
        self._run_info = ours("RunInfo")
        self._stream_counts = ours("StreamCounts")
        self._stream_ack = ours("StreamAck")
        self._time = classes("builtin_interfaces/msg/Time")
        self._header = classes("std_msgs/msg/Header")
        self._clock = classes("rosgraph_msgs/msg/Clock")
        self._odometry = classes("nav_msgs/msg/Odometry")
        self._wrench_stamped = classes("geometry_msgs/msg/WrenchStamped")
        self._wrench = classes("geometry_msgs/msg/Wrench")
        self._vector3 = classes("geometry_msgs/msg/Vector3")
        self._pose_stamped = classes("geometry_msgs/msg/PoseStamped")
        self._point = classes("geometry_msgs/msg/Point")
        self._quaternion = classes("geometry_msgs/msg/Quaternion")
        self._pose = classes("geometry_msgs/msg/Pose")
        self._pose_with_covariance = classes("geometry_msgs/msg/PoseWithCovariance")
        self._twist = classes("geometry_msgs/msg/Twist")
        self._twist_with_covariance = classes("geometry_msgs/msg/TwistWithCovariance")
        self._joint_state = classes("sensor_msgs/msg/JointState")
        self._no_covariance = np.zeros(36)

    def stamp(self, t: float) -> Message:
        """Return builtin_interfaces/Time of a time since the release, s."""
        sec, nanosec = divmod(stamp_ns(t), 1_000_000_000)
        return self._time(sec=sec, nanosec=nanosec)

    def header(self, t: float, frame_id: str) -> Message:
        """Return std_msgs/Header of a time since the release, s."""
        return self._header(stamp=self.stamp(t), frame_id=frame_id)

    def clock(self, t: float) -> Message:
        """Return rosgraph_msgs/Clock of a time since the release, s."""
        return self._clock(clock=self.stamp(t))

    def bench_states(self, first_seq: int, samples: np.ndarray) -> Iterator[Message]:
        """Yield BenchState of each sample, (n,) of dtype SAMPLE; the first has ``first_seq``."""
        names = (*_INTEGERS, *_SCALARS)
        # plain Python numbers by whole columns: item access on NumPy records is slow
        columns = [samples[name].tolist() for name in names]
        vectors = [samples[name] for name in _VECTORS]
        times = samples["t"].tolist()
        for i, numbers in enumerate(zip(*columns, strict=True)):
            fields = dict(zip(names, numbers, strict=True))
            for name, vector in zip(_VECTORS, vectors, strict=True):
                fields[name] = vector[i]
            yield self._bench_state(
                header=self.header(times[i], WORLD), seq=first_seq + i, **fields
            )

    def bench_state(self, seq: int, sample: np.void) -> Message:
        """Return BenchState of one sample."""
        return next(self.bench_states(seq, np.asarray(sample).reshape(1)))

    def buffer_state(self, seq: int, sample: np.void) -> Message:
        """Return BufferState of one sample."""
        v = sample["v"]
        return self._buffer_state(
            header=self.header(float(sample["t"]), CHASER_FRAME),
            seq=seq,
            axial_stroke=float(sample["axial_stroke"]),
            axial_rate=float(v[_H]),
            axial_force=float(sample["axial_force"]),
            torsion=float(sample["torsion"]),
            torsion_rate=_torsion_rate(v),
            torsion_torque=float(sample["torsion_torque"]),
        )

    def contact_state(self, seq: int, sample: np.void, since: SinceLastMessage) -> Message:
        """Return ContactState of one sample and of what happened since the last message."""
        walls = int(sample["walls"])
        return self._contact_state(
            header=self.header(float(sample["t"]), CONE_FRAME),
            seq=seq,
            in_touch=walls != 0,
            walls=walls,
            penetration=sample["penetration"],
            penetration_rate=sample["penetration_rate"],
            normal_force=sample["normal_force"],
            friction_force=sample["friction_force"],
            peak_force=since.peak_force,
            impulse=since.impulse,
            touches=since.touches,
        )

    def contact_trace(self, seq: int, t: float, points: np.ndarray) -> Message:
        """Return ContactTrace of points, (n,) with the fields of TRACE, told at a time, s."""
        fields = {name: points[name].ravel().tolist() for name in TRACE.names or ()}
        return self._contact_trace(
            header=self.header(t, CONE_FRAME),
            seq=seq,
            **{
                name: self._sequence("B" if name == "walls" else "d", values)
                for name, values in fields.items()
            },
        )

    def string_state(
        self, seq: int, sample: np.void, *, has_string: bool, rail_heading: float
    ) -> Message:
        """Return StringState of one sample.

        Parameters
        ----------
        seq
            Number of the message.
        sample
            Of dtype SAMPLE.
        has_string
            Whether the scene has one; without, it counts as slack.
        rail_heading
            Direction of the rail in the world, rad.
        """
        phase = string_phase(sample, has_string=has_string)
        return self._string_state(
            header=self.header(float(sample["t"]), WORLD),
            seq=seq,
            phase=int(phase),
            tension=float(sample["string_tension"]),
            mass_height=float(sample["mass_height"]),
            mass_speed=float(sample["mass_speed"]),
            chaser_speed=speed_along(rail_heading, sample["v"]),
        )

    def bench_event(self, seq: int, event: Event) -> Message:
        """Return BenchEvent; the touch's numbers are zero when the event ends none."""
        touch = event.touch
        ended = {
            "touch_start": 0.0 if touch is None else float(touch["start"]),
            "approach_speed": 0.0 if touch is None else float(touch["approach_speed"]),
            "peak_force": 0.0 if touch is None else float(touch["peak_force"]),
            "peak_time": 0.0 if touch is None else float(touch["peak_time"]),
            "impulse": 0.0 if touch is None else float(touch["impulse"]),
            "dissipated": 0.0 if touch is None else float(touch["dissipated"]),
        }
        return self._bench_event(
            header=self.header(event.t, WORLD),
            seq=seq,
            t=float(event.t),
            kind=event.kind.label,
            detail=event.detail,
            wall=int(event.wall if touch is None else touch["wall"]),
            q=np.ascontiguousarray(event.q, dtype=float),
            v=np.ascontiguousarray(event.v, dtype=float),
            **ended,
        )

    def chaser_odometry(self, sample: np.void) -> Message:
        """Return Odometry of the chaser's centre of mass; twist in its own frame."""
        return self._odometry_of(sample, _CHASER, CHASER_FRAME)

    def target_odometry(self, sample: np.void) -> Message:
        """Return Odometry of the target's centre of mass; twist in its own frame."""
        return self._odometry_of(sample, _TARGET, TARGET_FRAME)

    def contact_wrench(self, sample: np.void) -> Message:
        """Return WrenchStamped on the tip, latches included, in the tip's own frame."""
        contact, latch = sample["contact_force"], sample["latch_force"]
        fx = float(contact[0]) + float(latch[0])
        fy = float(contact[1]) + float(latch[1])
        theta = float(sample["q"][_THETA_P])
        cos, sin = math.cos(theta), math.sin(theta)
        return self._wrench_stamped(
            header=self.header(float(sample["t"]), TIP_FRAME),
            wrench=self._wrench(
                force=self._vector3(x=cos * fx + sin * fy, y=cos * fy - sin * fx, z=0.0),
                torque=self._vector3(x=0.0, y=0.0, z=float(sample["contact_torque"])),
            ),
        )

    def sensed_pose(self, t: float, pose: tuple[float, float, float]) -> Message:
        """Return PoseStamped of what motion capture sees: x, y (m), heading (rad), world."""
        x, y, theta = pose
        return self._pose_stamped(
            header=self.header(t, WORLD),
            pose=self._pose(
                position=self._point(x=x, y=y, z=0.0),
                orientation=self._quaternion(
                    x=0.0, y=0.0, z=math.sin(theta / 2.0), w=math.cos(theta / 2.0)
                ),
            ),
        )

    def sensed_wrench(self, t: float, wrench: tuple[float, float, float]) -> Message:
        """Return WrenchStamped of the load cell: force (N) and torque (N m), target's frame."""
        fx, fy, torque = wrench
        return self._wrench_stamped(
            header=self.header(t, TARGET_FRAME),
            wrench=self._wrench(
                force=self._vector3(x=fx, y=fy, z=0.0),
                torque=self._vector3(x=0.0, y=0.0, z=torque),
            ),
        )

    def joint_states(self, sample: np.void) -> Message:
        """Return JointState of the buffer's hinge (rad) and slide (m)."""
        v = sample["v"]
        return self._joint_state(
            header=self.header(float(sample["t"]), ""),
            name=[HINGE_JOINT, SLIDE_JOINT],
            position=self._sequence("d", [float(sample["torsion"]), float(sample["axial_stroke"])]),
            velocity=self._sequence("d", [_torsion_rate(v), float(v[_H])]),
            effort=self._sequence(
                "d", [float(sample["torsion_torque"]), float(sample["axial_force"])]
            ),
        )

    def capture_status(self, seq: int, t: float, status: CaptureStatus) -> Message:
        """Return CaptureStatus of the sample at a time since the release, s."""
        return self._capture_status(
            header=self.header(t, CONE_FRAME),
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
        """Return CaptureCriteria, stamped with the release: what a run is judged by."""
        return self._capture_criteria(
            header=self.header(0.0, CONE_FRAME), run_id=run_id, **asdict(limits)
        )

    def launcher_state(self, seq: int, t: float, status: LauncherStatus) -> Message:
        """Return LauncherState at a time since the release, s."""
        return self._launcher_state(
            header=self.header(t, WORLD),
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
        self,
        t: float,
        run_id: str,
        action: LaunchAction,
        *,
        hanging_mass: float,
        drop_height: float,
        impact_speed: float,
    ) -> Message:
        """Return LaunchCommand; kg, m and m/s."""
        return self._launch_command(
            header=self.header(t, WORLD),
            run_id=run_id,
            action=int(action),
            hanging_mass=float(hanging_mass),
            drop_height=float(drop_height),
            impact_speed=float(impact_speed),
        )

    def run_info(self, run: RunDescription) -> Message:
        """Return RunInfo, stamped with the release."""
        return self._run_info(
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
        return self._stream_counts(
            publisher=publisher,
            run_id=run_id,
            complete=complete,
            reason=reason,
            topics=list(counts),
            counts=self._sequence("Q", list(counts.values())),
        )

    def stream_ack(self, consumer: str, run_id: str, received: int) -> Message:
        """Return StreamAck: the consumer has taken in so many samples of the run."""
        return self._stream_ack(consumer=consumer, run_id=run_id, received=received)

    def _odometry_of(self, sample: np.void, body: tuple[int, int, int], frame: str) -> Message:
        x, y, theta = (float(sample["q"][i]) for i in body)
        vx, vy, omega = (float(sample["v"][i]) for i in body)
        # math, not NumPy: its result does not depend on how a run is cut into blocks
        cos, sin = math.cos(theta), math.sin(theta)
        return self._odometry(
            header=self.header(float(sample["t"]), WORLD),
            child_frame_id=frame,
            pose=self._pose_with_covariance(
                pose=self._pose(
                    position=self._point(x=x, y=y, z=0.0),
                    orientation=self._quaternion(
                        x=0.0, y=0.0, z=math.sin(theta / 2.0), w=math.cos(theta / 2.0)
                    ),
                ),
                covariance=self._no_covariance,
            ),
            twist=self._twist_with_covariance(
                twist=self._twist(
                    linear=self._vector3(x=cos * vx + sin * vy, y=cos * vy - sin * vx, z=0.0),
                    angular=self._vector3(x=0.0, y=0.0, z=omega),
                ),
                covariance=self._no_covariance,
            ),
        )


def string_phase(sample: np.void, *, has_string: bool) -> StringPhase:
    """Return the phase of the string in a sample; without a string it counts as slack."""
    if not has_string:
        return StringPhase.SLACK
    known = {Phase.HELD: StringPhase.HELD, Phase.TAUT: StringPhase.TAUT}
    return known.get(Phase(int(sample["phase"])), StringPhase.SLACK)


def speed_along(heading: float, v: np.ndarray) -> float:
    """Return the chaser's speed along a direction of the world.

    Parameters
    ----------
    heading
        rad.
    v
        Rates as in BenchState, (8,), m/s and rad/s.

    Returns
    -------
    float
        m/s.
    """
    return float(v[0]) * math.cos(heading) + float(v[1]) * math.sin(heading)


def _torsion_rate(v: np.ndarray) -> float:
    return float(v[_THETA_P]) - float(v[_THETA_S])
