"""Conversion of samples, events and statuses to serialised ROS messages.

The contents of every field are defined here once, as columns.  For n samples, a field is an array
(n, ...) under its path in the message, e.g. ``"header.stamp.sec"``.  Live and offline messages are
made in the same way from the definitions, without rclpy.  Making many messages at once takes a
twentieth of the time that rclpy's classes need for making them one by one.

Simulated time starts at 1 s, because a stamp of zero means 'not set' to ROS tools.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, fields
from enum import IntEnum
from typing import TYPE_CHECKING, Any

import numpy as np

from capture_sim.base.software import scene_hash, software_versions
from capture_sim.detection.measurements import Counts, Reason, Source
from capture_sim.dynamics.samples import SAMPLE, TRACE, Event, Phase
from capture_sim.errors import MessageError
from capture_sim.messages.cdr import Columns, Template, fill
from capture_sim.messages.definitions import blank, typestore
from capture_sim.messages.topics import RunSource

if TYPE_CHECKING:
    from capture_sim.detection.criteria import CaptureStatus
    from capture_sim.launcher.state_machine import LauncherStatus
    from capture_sim.scene.launch_plan import LaunchPlan
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

#: Maximum number of names in a list of RunInfo, and maximum number of characters of a name.
MAX_NAMES, LONGEST_NAME = 100, 200
#: Maximum number of message templates that are kept.
MAX_KINDS = 200

#: Fields of CaptureCriteria, and the fields of a scene's ``detector`` that they report.
CRITERIA = {
    "radius": "capture_radius",
    "dwell": "min_dwell",
    "contact_gap": "max_contact_gap",
    "leave": "min_retreat",
    "still_speed": "max_still_speed",
    "still_time": "min_still_time",
    "delay": "max_delay",
    "gap": "max_data_gap",
}

# indices into q and v, see samples.COORDINATES
CHASER, TARGET = slice(0, 3), slice(5, 8)
_THETA_S, _THETA_P, _H = 2, 3, 4

Message = Any


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
    """Return the stamp, ns, of a time since the release, s."""
    return EPOCH_NS + round(t * 1e9)


def stamp_in(message: Any) -> int:
    """Return the stamp of a message with a header, ns."""
    stamp = message.header.stamp
    return int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec)


def stamp_seconds(stamp: int) -> float:
    """Return the time since the release, s, of a stamp, ns."""
    return (stamp - EPOCH_NS) / 1e9


#: Fields of RunInfo that are lists.
_LISTS = ("software", "publishers", "waived", "participants")


@dataclass(frozen=True)
class RunDescription:
    """Everything needed to repeat a run: the contents of msg/RunInfo.msg."""

    run_id: str  # unique to this run
    name: str  # name of the experiment
    scene: str  # the resolved scene, YAML
    software: tuple[str, ...]  # packages, each as ``"name version"``
    state_rate: float  # rate of BenchState, Hz
    rate: float  # rate of all other periodic topics, Hz
    publishers: tuple[str, ...]  # roles whose StreamCounts end the run
    source: str = RunSource.SIMULATION
    announcer: str = ""  # participant that announces the run
    participants: tuple[str, ...] = ()  # nodes of the roll that the run waits for
    note: str = ""  # the operator's note on a trial
    expected: str = ""  # verdict that the operator of a trial expects; empty: none
    waived: tuple[str, ...] = ()  # rules before the release that a laboratory waives, by name

    @classmethod
    def of(
        cls,
        scene: Scene,
        run_id: str,
        publishers: Sequence[str],
        software: Sequence[str] | None = None,
        *,
        source: str = RunSource.SIMULATION,
        announcer: str = "",
        participants: Sequence[str] = (),
    ) -> RunDescription:
        """Return the description of a run of a scene.

        ``software`` defaults to the versions that this process uses.
        """
        return cls(
            run_id=run_id,
            name=scene.name,
            scene=scene.to_yaml(),
            software=tuple(software_versions() if software is None else software),
            state_rate=scene.run.state_rate,
            rate=scene.run.rate,
            publishers=tuple(publishers),
            source=str(source),
            announcer=announcer,
            participants=tuple(participants),
        )

    @classmethod
    def of_message(cls, info: Any) -> RunDescription:
        """Return the description of a run from its RunInfo message, made by any library.

        MessageError is raised if a rate is not positive and finite, or if a list has more than
        :data:`MAX_NAMES` names or a name of more than :data:`LONGEST_NAME` characters.
        """
        values: dict[str, Any] = {f.name: getattr(info, f.name) for f in fields(cls)}
        for name in ("state_rate", "rate"):
            values[name] = value = float(values[name])
            if not 0.0 < value < math.inf:
                raise MessageError(f"RunInfo.{name} = {value:g} Hz: must be above 0")
        values |= {name: tuple(values[name]) for name in _LISTS}
        for name in _LISTS:
            longest = max(map(len, values[name]), default=0)
            if len(values[name]) > MAX_NAMES or longest > LONGEST_NAME:
                raise MessageError(
                    f"RunInfo.{name} = {len(values[name])} texts of up to {longest} characters: "
                    f"must be at most {MAX_NAMES} of {LONGEST_NAME}"
                )
        return cls(**values)

    @property
    def scene_sha256(self) -> str:
        """Hash of the scene's text, hexadecimal."""
        return scene_hash(self.scene)


# fields of one message


def bench_event(event: Event) -> dict[str, Any]:
    """Return the fields of BenchEvent; those of a touch are 0 unless the event ends a touch."""
    names = ("approach_speed", "peak_force", "peak_time", "impulse", "dissipated")
    touch = event.touch
    return {
        "t": float(event.t),
        "kind": event.kind.label,
        "detail": event.detail,
        "wall": int(event.wall if touch is None else touch["wall"]),
        "q": np.ascontiguousarray(event.q, dtype=float),
        "v": np.ascontiguousarray(event.v, dtype=float),
        "touch_start": 0.0 if touch is None else float(touch["start"]),
        **{name: 0.0 if touch is None else float(touch[name]) for name in names},
    }


def contact_trace(points: np.ndarray) -> dict[str, Any]:
    """Return the fields of ContactTrace, from points (n,) with the fields of TRACE."""
    return {name: points[name] for name in TRACE.names or ()}


def capture_criteria(run_id: str, limits: Detector) -> dict[str, Any]:
    """Return the fields of CaptureCriteria: the thresholds of a run's detector."""
    return {"run_id": run_id, **{name: getattr(limits, field) for name, field in CRITERIA.items()}}


def launch_command(run_id: str, action: LaunchAction, plan: LaunchPlan) -> dict[str, Any]:
    """Return the fields of LaunchCommand for an action, with the values of a launch plan."""
    names = ("hanging_mass", "drop_height", "impact_speed")
    return {
        "run_id": run_id,
        "action": int(action),
        **{name: float(getattr(plan, name)) for name in names},
    }


# columns of n messages


def stamps_ns(t: np.ndarray) -> np.ndarray:
    """Return the stamps (n,), ns, of times since the release (n,), s."""
    return np.asarray(EPOCH_NS + np.rint(t * 1e9).astype(np.int64))


def stamp_columns(path: str, stamps: np.ndarray) -> Columns:
    """Return the columns of stamps (n,), ns, of the field at a path."""
    sec, nanosec = np.divmod(stamps, 1_000_000_000)
    return {f"{path}.sec": sec, f"{path}.nanosec": nanosec}


def bench_states(samples: np.ndarray) -> Columns:
    """Return the columns of BenchState, from samples (n,) of dtype SAMPLE."""
    return {name: samples[name] for name in SAMPLE.names or ()}


def buffer_states(samples: np.ndarray) -> Columns:
    """Return the columns of BufferState."""
    return {
        "axial_stroke": samples["axial_stroke"],
        "axial_rate": samples["v"][:, _H],
        "axial_force": samples["axial_force"],
        "torsion": samples["torsion"],
        "torsion_rate": _torsion_rates(samples),
        "torsion_torque": samples["torsion_torque"],
    }


def contact_states(samples: np.ndarray, since: Columns) -> Columns:
    """Return the columns of ContactState.

    ``since`` are the columns peak_force, impulse and touches since the previous message.
    """
    names = ("walls", "penetration", "penetration_rate", "normal_force", "friction_force")
    columns = {name: samples[name] for name in names}
    return {"in_touch": samples["walls"] != 0, **columns, **since}


def string_states(samples: np.ndarray, scene: Scene) -> Columns:
    """Return the columns of StringState."""
    return {
        "phase": string_phases(samples, scene),
        "tension": samples["string_tension"],
        "mass_height": samples["mass_height"],
        "mass_speed": samples["mass_speed"],
        "chaser_speed": speeds_along_rail(samples, scene),
    }


def odometry(pose: np.ndarray, rates: np.ndarray) -> Columns:
    """Return the columns of Odometry, from poses (n, 3), x, y (m) and heading (rad), and rates.

    ``rates`` (n, 3) are in the frame of the poses, m/s and rad/s.  The twist is in the body's own
    frame.
    """
    vx, vy, omega = rates.T
    along, across = _turned(vx, vy, pose[:, 2])
    return {
        **_pose("pose.pose", pose),
        "twist.twist.linear.x": along,
        "twist.twist.linear.y": across,
        "twist.twist.angular.z": omega,
    }


def sensed_poses(pose: np.ndarray) -> Columns:
    """Return the columns of PoseStamped, from x, y (m) and heading (rad), (n, 3)."""
    return _pose("pose", pose)


def contact_wrenches(samples: np.ndarray) -> Columns:
    """Return the columns of WrenchStamped: the wrench on the tip in the tip's frame.

    It includes the force of the latches.
    """
    fx, fy = (samples["contact_force"] + samples["latch_force"]).T
    along, across = _turned(fx, fy, samples["q"][:, _THETA_P])
    return wrenches(np.stack([along, across, samples["contact_torque"]], axis=1))


def wrenches(wrench: np.ndarray) -> Columns:
    """Return the columns of WrenchStamped, from force x and y (N), torque about z (N m), (n, 3)."""
    names = ("wrench.force.x", "wrench.force.y", "wrench.torque.z")
    return dict(zip(names, wrench.T, strict=True))


def joint_states(samples: np.ndarray) -> Columns:
    """Return the columns of JointState of the buffer's hinge (rad) and slide (m)."""
    pairs = {
        "position": (samples["torsion"], samples["axial_stroke"]),
        "velocity": (_torsion_rates(samples), samples["v"][:, _H]),
        "effort": (samples["torsion_torque"], samples["axial_force"]),
    }
    return {name: np.stack(pair, axis=1) for name, pair in pairs.items()}


def statuses(statuses: Sequence[CaptureStatus] | Sequence[LauncherStatus], *names: str) -> Columns:
    """Return the named fields of statuses as columns."""
    return {name: np.array([getattr(status, name) for status in statuses]) for name in names}


def rejected(counts: Counts) -> dict[str, list[int]]:
    """Return the fields of CaptureStatus that count rejected measurements, by reason."""
    return {
        f"{source.value}_rejected": [counts.rejected[source, reason] for reason in Reason]
        for source in Source
    }


def string_phases(samples: np.ndarray, scene: Scene) -> np.ndarray:
    """Return the string's phase in each sample, (n,); the phase is SLACK if there is no string."""
    phases = np.full(len(samples), int(StringPhase.SLACK))
    if scene.string is not None:
        phases[samples["phase"] == Phase.HELD] = StringPhase.HELD
        phases[samples["phase"] == Phase.TAUT] = StringPhase.TAUT
    return phases


def speeds_along_rail(samples: np.ndarray, scene: Scene) -> np.ndarray:
    """Return the chaser's speed along the scene's rail, (n,), m/s."""
    heading = scene.initial.chaser.theta
    v = samples["v"]
    return np.asarray(v[:, 0] * math.cos(heading) + v[:, 1] * math.sin(heading))


def _torsion_rates(samples: np.ndarray) -> np.ndarray:
    return np.asarray(samples["v"][:, _THETA_P] - samples["v"][:, _THETA_S])


def _cos_sin(angle: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    # with math's functions, as nodes use them for a single message: NumPy's differ in the last bit
    angles = angle.tolist()
    return np.array([math.cos(a) for a in angles]), np.array([math.sin(a) for a in angles])


def _turned(x: np.ndarray, y: np.ndarray, angle: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the components of vectors in axes that are rotated by an angle, rad."""
    cos, sin = _cos_sin(angle)
    return cos * x + sin * y, cos * y - sin * x


def _pose(path: str, pose: np.ndarray) -> Columns:
    w, z = _cos_sin(pose[:, 2] / 2.0)
    return {
        f"{path}.position.x": pose[:, 0],
        f"{path}.position.y": pose[:, 1],
        f"{path}.orientation.z": z,
        f"{path}.orientation.w": w,
    }


class Messages:
    """Factory of messages; it keeps a template of each kind, in which only the numbers vary."""

    def __init__(self) -> None:
        self._store = typestore()  # loaded now, so that the first message is not delayed
        self._templates: dict[tuple[Any, ...], Template] = {}

    def new(self, type_name: str, **fields: Any) -> Message:
        """Return a new message of a type, ``package/msg/Name``, with values of fields by path."""
        message = blank(type_name)
        for path, value in fields.items():
            fill(message, path, value)
        return message

    def header(self, t: float, frame_id: str, zero_ns: int = EPOCH_NS) -> Message:
        """Return std_msgs/Header for time ``t``, s; ``zero_ns`` is the stamp of t = 0, ns."""
        sec, nanosec = divmod(stamp_ns(t) - EPOCH_NS + zero_ns, 1_000_000_000)
        stamp = {"stamp.sec": sec, "stamp.nanosec": nanosec}
        return self.new("std_msgs/msg/Header", frame_id=frame_id, **stamp)

    def run_info(self, run: RunDescription) -> Message:
        """Return RunInfo, stamped with the time of the release."""
        texts = {name: list(getattr(run, name)) for name in _LISTS}
        names = ["run_id", "name", "source", "announcer", "scene", "scene_sha256"]
        names += ["state_rate", "rate"]
        return self.new(
            "capture_sim/msg/RunInfo",
            header=self.header(0.0, WORLD),
            **{name: getattr(run, name) for name in names},
            **texts,
        )

    def stream_counts(
        self,
        publisher: str,
        run_id: str,
        counts: Mapping[str, int],
        *,
        complete: bool = True,
        reason: str = "",
        extremes: str = "",
    ) -> Message:
        """Return StreamCounts of one publisher; ``counts`` are messages sent, by topic name."""
        return self.new(
            "capture_sim/msg/StreamCounts",
            publisher=publisher,
            run_id=run_id,
            complete=complete,
            reason=reason,
            topics=list(counts),
            counts=list(counts.values()),
            extremes=extremes,
        )

    def many(self, type_name: str, columns: Columns, **fixed: Any) -> Iterator[bytes]:
        """Yield n serialised messages of a type.

        ``columns`` are the fields that vary between the messages, ``fixed`` the constant fields.
        """
        if not len(next(iter(columns.values()))):
            return iter(())
        shapes = ((path, column.shape[1:]) for path, column in columns.items())
        key = (type_name, *map(str, fixed.items()), *shapes)
        template = self._templates.get(key)
        if template is None:
            template = Template(self._store, self.new(type_name, **fixed), columns)
            if len(self._templates) < MAX_KINDS:
                self._templates[key] = template
        return template.filled(columns)

    def serialise(self, message: Message) -> bytes:
        """Return the serialised bytes of a message."""
        return bytes(self._store.serialize_cdr(message, message.__msgtype__))
