"""Recordings as laboratories make them: the faults that public reports of rigs describe.

All begin with a simulated run with cameras and a load cell, of which only what a rig measures is
kept: poses at 100 Hz with 1 mm of noise, joint states and the load cell's wrench, stamped by the
wall clock.  ``CHANGES`` are faults of the contents, ``FILES`` those of the file; ``TRUE`` is what
happened in the run.  A test takes a fault by its name and writes the file that it needs::

    path = dirty.write(tmp_path, "poses_in_mm")
"""

from __future__ import annotations

import shutil
import struct
import tempfile
from collections.abc import Callable, Iterable
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import yaml
import zstandard
from mcap.writer import CompressionType
from mcap.writer import Writer as McapWriter
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as BagWriter

import capture_sim
from capture_sim.messages.convert import RunDescription
from capture_sim.messages.definitions import typestore
from capture_sim.recording.offline import PUBLISHERS, run_stream

CHASER, TARGET = "/motion_capture/chaser", "/motion_capture/target"
JOINTS, CELL = "/joint_states", "/load_cell/wrench"
#: Time of the stamps' zero on the wall clock, ns; the bench releases a second after it.
WALL = 1_760_000_000_000_000_000
RELEASE = WALL + 1_000_000_000
#: A message is logged so much later than it is stamped, ns.
DELAY = 2_000_000


class Record(NamedTuple):
    """A message of a recording."""

    topic: str
    type_name: str
    log_time: int  # ns
    data: bytes  # serialised

    @property
    def stamp(self) -> int:
        """The message's stamp, ns."""
        sec, nanosec = struct.unpack_from("<iI", self.data, 4)
        return sec * 10**9 + nanosec

    @property
    def t(self) -> float:
        """Time of the stamp, s since the release."""
        return (self.stamp - RELEASE) / 1e9

    def stamped(self, stamp: int) -> Record:
        """Return the message with another stamp, ns."""
        head = struct.pack("<iI", *divmod(stamp, 10**9))
        return self._replace(data=self.data[:4] + head + self.data[12:])


Records = list[Record]


class Truth(NamedTuple):
    """What happened in a run; times are s since the release, lengths m."""

    verdict: str
    first_contact: float
    latched: float
    nearest: float


# Of tilt_p10; the same as in a run without sensors.
TRUE = Truth("captured", 2.594, 3.211, 1.79e-3)


@cache
def clean(scene: str = "tilt_p10", *changes: str, seed: int = 3) -> tuple[Record, ...]:
    """Return what a rig would record of a scene, in the order of the log times.

    ``changes`` are overrides of the scene, e.g. ``sensors.motion_capture.position_noise=0``.
    """
    sensors = ("sensors.motion_capture={}", "sensors.load_cell={}", f"sensors.seed={seed}")
    result = capture_sim.simulate(scene, [*sensors, *changes])
    run = RunDescription.of(result.scene, "", PUBLISHERS)
    records = []
    for topic, stamp, data in run_stream(result, run):
        if topic.absolute_name in (CHASER, TARGET, JOINTS, CELL):
            record = Record(topic.absolute_name, topic.type_name, stamp + WALL + DELAY, data)
            records.append(record.stamped(stamp + WALL))
    return tuple(sorted(records, key=lambda record: record.log_time))


def decoded(record: Record) -> Any:
    """Return the message of a record, of rosbags' classes."""
    return typestore().deserialize_cdr(record.data, record.type_name)


def encoded(record: Record, message: Any) -> Record:
    """Return a record with another message."""
    data = bytes(typestore().serialize_cdr(message, record.type_name))
    return record._replace(data=data)


def changed(
    records: Iterable[Record], topics: str | tuple[str, ...], change: Callable[[Any, float], None]
) -> Records:
    """Return the records with the messages of some topics changed.

    ``change(message, t)`` changes a message; t is its time, s since the release.
    """
    found = []
    for record in records:
        if record.topic in topics:
            message = decoded(record)
            change(message, record.t)
            record = encoded(record, message)
        found.append(record)
    return found


def restamped(
    records: Iterable[Record], topics: str | tuple[str, ...], stamp: Callable[[int], int]
) -> Records:
    """Return the records with the stamps of some topics, ns, changed by a function."""
    return [r.stamped(stamp(r.stamp)) if r.topic in topics else r for r in records]


# poses


def _scaled(factor: float) -> Callable[[Any, float], None]:
    def change(message: Any, _: float) -> None:
        for axis in "xyz":
            value = getattr(message.pose.position, axis)
            setattr(message.pose.position, axis, factor * value)

    return change


def _y_up(message: Any, _: float) -> None:
    position, turn = message.pose.position, message.pose.orientation
    position.y, position.z = 0.1, -position.y
    turn.y, turn.z = turn.z, 0.0


def _w_first(message: Any, _: float) -> None:
    turn = message.pose.orientation
    turn.x, turn.y, turn.z, turn.w = turn.w, turn.x, turn.y, turn.z


def _no_quaternion(message: Any, _: float) -> None:
    turn = message.pose.orientation
    turn.x = turn.y = turn.z = turn.w = 0.0


def _not_tracked(message: Any, t: float) -> None:
    _scaled(0.0)(message, t)
    _no_quaternion(message, t)


def _degrees(message: Any, _: float) -> None:
    """Write the heading as a quaternion of degrees taken for radians."""
    turn = message.pose.orientation
    heading = np.degrees(2.0 * np.arctan2(turn.z, turn.w))
    turn.z, turn.w = float(np.sin(heading / 2.0)), float(np.cos(heading / 2.0))


def _swapped(records: Iterable[Record]) -> Records:
    other = {CHASER: TARGET, TARGET: CHASER}
    return [r._replace(topic=other.get(r.topic, r.topic)) for r in records]


def _one_body_on_both(records: Iterable[Record]) -> Records:
    records = list(records)
    chaser = iter([r for r in records if r.topic == CHASER])
    return [next(chaser)._replace(topic=TARGET) if r.topic == TARGET else r for r in records]


def _in_frame(name: str) -> Callable[[Any, float], None]:
    def change(message: Any, _: float) -> None:
        message.header.frame_id = name

    return change


# joints


def _no_names(message: Any, _: float) -> None:
    message.name = []


def _nan_joints(message: Any, _: float) -> None:
    message.position = np.full(len(message.name), np.nan)


def _no_positions(message: Any, _: float) -> None:
    message.position = np.zeros(0)


def _prefixed(message: Any, _: float) -> None:
    message.name = [f"rig/{name}" for name in message.name]


def _joints_exchanged(message: Any, _: float) -> None:
    message.name = list(message.name[::-1])


def joints_times(slide: float, hinge: float) -> Callable[[Any, float], None]:
    def change(message: Any, _: float) -> None:
        factors = [slide if name == "buffer_slide" else hinge for name in message.name]
        message.position = message.position * factors
        message.velocity = message.velocity * factors

    return change


def off_zero(stroke: float, torsion: float) -> Callable[[Any, float], None]:
    """Return a change that adds to what the encoders of the buffer show, m and rad."""

    def change(message: Any, _: float) -> None:
        offsets = [stroke if name == "buffer_slide" else torsion for name in message.name]
        message.position = message.position + offsets

    return change


def scaled_stroke(factor: float) -> Callable[[Any, float], None]:
    """Return a change that scales the stroke."""

    def change(message: Any, _: float) -> None:
        factors = [factor if name == "buffer_slide" else 1.0 for name in message.name]
        message.position = message.position * factors

    return change


def _stuck(since: float) -> Callable[[Any, float], None]:
    def change(message: Any, t: float) -> None:
        if t >= since:
            message.position = np.zeros(len(message.name))
            message.velocity = np.zeros(len(message.name))

    return change


def one_joint_a_message(records: Iterable[Record], apart: int = 0) -> Records:
    """Send each joint by itself, the second stamped ``apart`` ns after the first."""
    found = []
    for record in records:
        if record.topic != JOINTS:
            found.append(record)
            continue
        for k in range(2):
            message = decoded(record)
            for name in ("name", "position", "velocity", "effort"):
                setattr(message, name, getattr(message, name)[k : k + 1])
            part = encoded(record, message).stamped(record.stamp + k * apart)
            found.append(part._replace(log_time=record.log_time + k * 1_000_000))
    return found


# force


def _force(change: Callable[[float, float], float]) -> Callable[[Any, float], None]:
    """Change both components of the force by a function of value (N) and time (s)."""

    def apply(message: Any, t: float) -> None:
        force = message.wrench.force
        force.x, force.y = float(change(force.x, t)), float(change(force.y, t))

    return apply


def _drifting(message: Any, t: float) -> None:
    message.wrench.force.x += 0.05 * t


BODIES = (CHASER, TARGET)


#: Faults of the contents: functions of the records.
def _set_pose(message: Any, pose: Any) -> None:
    message.pose = pose


def _standing(topics: str | tuple[str, ...]) -> Callable[[Iterable[Record]], Records]:
    """Return a change that repeats the first pose of some topics for ever."""

    def change(records: Iterable[Record]) -> Records:
        found = list(records)
        for topic in (topics,) if isinstance(topics, str) else topics:
            first = next(decoded(r).pose for r in found if r.topic == topic)
            found = changed(found, topic, lambda message, _, pose=first: _set_pose(message, pose))
        return found

    return change


def repeated(records: Iterable[Record], times: int) -> Records:
    """Send each pose ``times`` times, each with its own stamp, as an upsampling driver does."""
    found = []
    for record in records:
        for k in range(times if record.topic in BODIES else 1):
            later = k * 10_000_000 // times
            again = record.stamped(record.stamp + later)
            found.append(again._replace(log_time=record.log_time + later))
    return sorted(found, key=lambda record: record.log_time)


def _two_trials(records: Iterable[Record]) -> Records:
    """Begin with a trial that is aborted after 1.5 s, and the whole one 20 s later."""
    whole = list(records)
    later = [r.stamped(r.stamp + 20 * 10**9) for r in whole]
    again = [r._replace(log_time=r.log_time + 20 * 10**9) for r in later]
    return [*(r for r in whole if r.t < 1.5), *again]


def turned(degrees: float) -> Callable[[Any, float], None]:
    """Return a change that turns the force about z."""
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))

    def change(message: Any, _: float) -> None:
        force = message.wrench.force
        force.x, force.y = c * force.x - s * force.y, s * force.x + c * force.y

    return change


def thinned(records: Iterable[Record], every: int) -> Records:
    """Keep each ``every``-th sample of the cell."""
    found, count = [], 0
    for record in records:
        count += record.topic == CELL
        if record.topic != CELL or count % every == 0:
            found.append(record)
    return found


def _repeats_when_loaded(records: Iterable[Record]) -> Records:
    last = [0.0, 0.0]

    def change(message: Any, _: float) -> None:
        force = message.wrench.force
        if np.hypot(force.x, force.y) > 3.0:
            force.x, force.y = last
        last[:] = force.x, force.y

    return changed(records, CELL, change)


CHANGES: dict[str, Callable[[Iterable[Record]], Records]] = {
    "plain": list,
    "poses_in_mm": lambda r: changed(r, BODIES, _scaled(1e3)),
    "poses_in_inch": lambda r: changed(r, BODIES, _scaled(1.0 / 0.0254)),
    "headings_in_degrees": lambda r: changed(r, BODIES, _degrees),
    "y_up": lambda r: changed(r, BODIES, _y_up),
    "w_first": lambda r: changed(r, BODIES, _w_first),
    "no_quaternion": lambda r: changed(r, BODIES, _no_quaternion),
    "target_not_tracked": lambda r: changed(r, TARGET, _not_tracked),
    "poses_an_hour_ahead": lambda r: restamped(r, BODIES, lambda ns: ns + 3600 * 10**9),
    "poses_120_ms_ahead": lambda r: restamped(r, BODIES, lambda ns: ns + 120_000_000),
    "chaser_drifts_by_500_ppm": lambda r: restamped(
        r, CHASER, lambda ns: ns + round(5e-4 * (ns - WALL))
    ),
    "poses_on_a_steady_clock": lambda r: restamped(r, BODIES, lambda ns: ns - WALL + 777 * 10**9),
    "stamps_zero": lambda r: restamped(r, BODIES, lambda _: 0),
    "bodies_swapped": _swapped,
    "one_body_on_both": _one_body_on_both,
    "frames_differ": lambda r: changed(r, TARGET, _in_frame("optitrack")),
    "joints_without_names": lambda r: changed(r, JOINTS, _no_names),
    "one_joint_a_message": one_joint_a_message,
    "one_joint_a_message_apart": lambda r: one_joint_a_message(r, 1_000_000),
    "joints_nan": lambda r: changed(r, JOINTS, _nan_joints),
    "joints_without_positions": lambda r: changed(r, JOINTS, _no_positions),
    "joints_prefixed": lambda r: changed(r, JOINTS, _prefixed),
    "encoder_in_mm": lambda r: changed(r, JOINTS, joints_times(1e3, 1.0)),
    "encoder_inverted": lambda r: changed(r, JOINTS, joints_times(-1.0, 1.0)),
    "joints_exchanged": lambda r: changed(r, JOINTS, _joints_exchanged),
    "hole_at_contact": lambda r: [each for each in r if not 2.3 < each.t < 3.3],
    "encoder_off_zero": lambda r: changed(r, JOINTS, off_zero(-3e-3, 30e-3)),
    "stroke_halved": lambda r: changed(r, JOINTS, scaled_stroke(0.5)),
    "stroke_doubled": lambda r: changed(r, JOINTS, scaled_stroke(2.0)),
    "encoder_stuck": lambda r: changed(r, JOINTS, _stuck(-np.inf)),
    "encoder_stuck_in_flight": lambda r: changed(r, JOINTS, _stuck(1.5)),
    "cell_drifts": lambda r: changed(r, CELL, _drifting),
    "cell_offset": lambda r: changed(r, CELL, _force(lambda f, _: f + 8.0)),
    "cell_inverted": lambda r: changed(r, CELL, _force(lambda f, _: -f)),
    "target_stands": _standing(TARGET),
    "both_stand": _standing(BODIES),
    "poses_twice": lambda r: repeated(r, 2),
    "poses_ten_times": lambda r: repeated(r, 10),
    "two_trials": _two_trials,
    "hinge_a_turn_off": lambda r: changed(r, JOINTS, off_zero(0.0, 2.0 * np.pi)),
    "cell_turned_by_45": lambda r: changed(r, CELL, turned(45.0)),
    "cell_turned_by_90": lambda r: changed(thinned(r, 4), CELL, turned(90.0)),
    "cell_inverted_at_250_hz": lambda r: changed(thinned(r, 4), CELL, turned(180.0)),
    "cell_in_counts": lambda r: changed(
        thinned(r, 4), CELL, _force(lambda f, _: 1e3 * f + 20_000.0)
    ),
    "cell_repeats_when_loaded": _repeats_when_loaded,
    "cell_saturated": lambda r: changed(r, CELL, _force(lambda f, _: np.clip(f, -5.0, 5.0))),
}


# files


def write_mcap(
    path: Path,
    records: Iterable[Record],
    *,
    definitions: bool = True,
    finish: bool = True,
    encoding: str = "cdr",
    **options: Any,
) -> Path:
    """Write an MCAP file; ``options`` are those of mcap's writer."""
    with path.open("wb") as file:
        writer = McapWriter(file, **options)
        writer.start(profile="ros2", library="rig")
        channels: dict[str, int] = {}
        for topic, type_name, log_time, data in records:
            if topic not in channels:
                text = _definition(type_name) if definitions else ""
                schema = writer.register_schema(type_name, "ros2msg", text.encode())
                channels[topic] = writer.register_channel(topic, encoding, schema)
            writer.add_message(channels[topic], log_time, data, log_time)
        if finish:
            writer.finish()
    return path


@cache
def _definition(type_name: str) -> str:
    return typestore().generate_msgdef(type_name, ros_version=2)[0]


def write_bag(
    path: Path,
    records: Iterable[Record],
    mode: CompressionMode | None = None,
    storage: StoragePlugin = StoragePlugin.MCAP,
) -> Path:
    """Write a bag's folder as rosbag2 does, compressed by message, file or chunk."""
    shutil.rmtree(path, ignore_errors=True)
    writer = BagWriter(path, version=9, storage_plugin=storage)
    if mode is not None:
        writer.set_compression(mode, CompressionFormat.ZSTD)
    with writer:
        connections: dict[str, Any] = {}
        for topic, type_name, log_time, data in records:
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, type_name, typestore=typestore())
            writer.write(connections[topic], log_time, data)
    return path


def _killed(folder: Path, records: Records) -> Path:
    """Without end mark, until 3.2 s after the release, when the tip still moves."""
    early = [record for record in records if record.t < 3.2]
    how = {"finish": False, "compression": CompressionType.NONE, "use_chunking": False}
    return write_mcap(folder / "recorder_killed.mcap", early, **how)


def _first_at_zero(folder: Path, records: Records) -> Path:
    """Of a recorder that had no clock yet."""
    first = [record._replace(log_time=0) for record in records[:60]]
    return write_mcap(folder / "first_logged_at_zero.mcap", [*first, *records[60:]])


def _one_wrapped(folder: Path, records: Records) -> Path:
    first = records[0]._replace(log_time=2**64 - 5)
    path = folder / "one_log_time_wrapped.mcap"
    return write_mcap(path, [first, *records[1:]], chunk_size=100_000)


def _clock_set(folder: Path, records: Records) -> Path:
    """Log times that jump by three years in the middle: the recorder's clock was set."""
    years = 3 * 365 * 86_400 * 10**9
    half = len(records) // 2
    early = [record._replace(log_time=record.log_time - years) for record in records[:half]]
    return write_mcap(folder / "log_times_jump.mcap", [*early, *records[half:]])


def _split(folder: Path, name: str, records: Records, n: int, last: bytes | None = None) -> Path:
    """Write a folder of n files; ``last`` are the bytes of one more."""
    path = folder / name
    path.mkdir()
    size = len(records) // n + 1
    for k in range(n):
        write_mcap(path / f"part_{k}.mcap", records[k * size : (k + 1) * size])
    if last is not None:
        (path / f"part_{n}.mcap").write_bytes(last)
    return path


def _unlisted(folder: Path, records: Records) -> Path:
    """Write a folder whose metadata.yaml lacks the last file, as of a recorder that was killed."""
    path = _split(folder, "last_part_unlisted", records, 3)
    listed = {"relative_file_paths": [f"part_{k}.mcap" for k in range(2)]}
    (path / "metadata.yaml").write_text(yaml.safe_dump({"rosbag2_bagfile_information": listed}))
    return path


def _twice(folder: Path, records: Records) -> Path:
    """Write a folder with a copy of its file."""
    path = _split(folder, "file_twice", records, 1)
    shutil.copy(path / "part_0.mcap", path / "part_0 (copy).mcap")
    return path


def _zstd(folder: Path, name: str, records: Records) -> Path:
    with tempfile.TemporaryDirectory() as plain:
        data = write_mcap(Path(plain) / "x.mcap", records, chunk_size=100_000).read_bytes()
    path = folder / name
    path.write_bytes(zstandard.compress(data))
    return path


def _metadata_cut(folder: Path, records: Records) -> Path:
    path = write_bag(folder / "metadata_cut", records)
    text = (path / "metadata.yaml").read_bytes()
    (path / "metadata.yaml").write_bytes(text[: len(text) // 3])
    return path


def _no_metadata(folder: Path, records: Records) -> Path:
    path = write_bag(folder / "no_metadata", records, CompressionMode.MESSAGE)
    (path / "metadata.yaml").unlink()
    return path


_MESSAGE, _FILE = CompressionMode.MESSAGE, CompressionMode.FILE
_SQLITE = StoragePlugin.SQLITE3
#: Faults, or kinds, of the file: functions of the folder and the records.
FILES: dict[str, Callable[[Path, Records], Path]] = {
    "no_definitions": lambda f, r: write_mcap(f / "no_definitions.mcap", r, definitions=False),
    "recorder_killed": _killed,
    "first_logged_at_zero": _first_at_zero,
    "one_log_time_wrapped": _one_wrapped,
    "log_times_jump": _clock_set,
    "compressed_messages": lambda f, r: write_bag(f / "compressed_messages", r, _MESSAGE),
    "compressed_file": lambda f, r: write_bag(f / "compressed_file", r, _FILE),
    "lz4_chunks": lambda f, r: write_mcap(
        f / "lz4.mcap", r, compression=CompressionType.LZ4, chunk_size=100_000
    ),
    "sqlite": lambda f, r: write_bag(f / "sqlite", r, None, _SQLITE),
    "sqlite_compressed_messages": lambda f, r: write_bag(
        f / "sqlite_message", r, _MESSAGE, _SQLITE
    ),
    "sqlite_compressed_file": lambda f, r: write_bag(f / "sqlite_file", r, _FILE, _SQLITE),
    "lone_zstd": lambda f, r: _zstd(f, "run.mcap.zst", r),
    "lone_zstd_long_name": lambda f, r: _zstd(f, "run.mcap.zstd", r),
    "last_part_empty": lambda f, r: _split(f, "last_part_empty", r, 3, b""),
    "last_part_unlisted": _unlisted,
    "file_twice": _twice,
    "metadata_cut": _metadata_cut,
    "no_metadata_compressed_messages": _no_metadata,
    "json": lambda f, r: write_mcap(f / "json.mcap", r, encoding="json"),
}
#: All kinds.
KINDS = (*CHANGES, *FILES)


def write(folder: Path, kind: str, records: Iterable[Record] | None = None) -> Path:
    """Write a recording with a fault of :data:`KINDS` into a folder; return its path.

    ``records`` are those of :func:`clean` of tilt_p10 by default.
    """
    given = list(clean() if records is None else records)
    if kind in FILES:
        return FILES[kind](folder, given)
    return write_mcap(folder / f"{kind}.mcap", CHANGES[kind](given))
