"""Time series and detector measurements in a recording, of a simulated run or a real bench."""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Mapping
from contextlib import suppress
from functools import partial
from itertools import repeat

import numpy as np

from capture_sim.detection.measurements import Source
from capture_sim.errors import MessageError, RecordingError
from capture_sim.messages import topics
from capture_sim.messages.measurements import DetectorInput
from capture_sim.messages.topics import Topic
from capture_sim.plausibility.axes import FORCE_FRAMES, frame_of
from capture_sim.plausibility.motion import MeasuredMotion
from capture_sim.recording.bag import Bag
from capture_sim.run.lazy import Deferred, LazyMapping
from capture_sim.run.series import NO_SERIES, QUANTITIES, Series, SeriesBySource, series_in
from capture_sim.run.verdict import TICK, LiveConditions, Received
from capture_sim.scene.launch_plan import LaunchPlan, plan_launch
from capture_sim.scene.parts import Scene

#: Column of the heading in poses.
_HEADING = 2
#: Series of ``bench/contact`` and ``bench/string``, by quantity: topic and field.
_FIELDS = {
    "in_touch": (topics.CONTACT_STATE, "in_touch"),
    "walls": (topics.CONTACT_STATE, "walls"),
    "touches_begun": (topics.CONTACT_STATE, "touches"),
    "normal_force": (topics.CONTACT_STATE, "normal_force"),
    "peak_force": (topics.CONTACT_STATE, "peak_force"),
    "string_phase": (topics.STRING_STATE, "phase"),
    "string_tension": (topics.STRING_STATE, "tension"),
    "mass_height": (topics.STRING_STATE, "mass_height"),
    "mass_speed": (topics.STRING_STATE, "mass_speed"),
}
#: Motion capture comes before the odometry that is made of it.
_VEHICLES = (
    ("chaser", topics.CHASER_POSE, topics.CHASER_ODOMETRY),
    ("target", topics.TARGET_POSE, topics.TARGET_ODOMETRY),
)
_BUFFERS = (topics.BUFFER_STATE, topics.JOINT_STATES)
_BUFFER_QUANTITIES = ("stroke", "torsion", "stroke_rate", "torsion_rate")


def series_of(bag: Bag) -> SeriesBySource:
    """Return the time series of a recording by quantity and source.

    The source of a series is the name of its topic; the topic is decoded when the series is first
    used.  The quantities are:

    - those of :func:`capture_sim.run.series.series_in`;
    - ``tip_force`` and ``cone_force``, the force on the tip, (n, 2), N, in the axes of the tip and
      of the cone;
    - from ``bench/contact``: in_touch, walls, touches_begun, normal_force and peak_force;
    - from ``bench/string``: string_phase, string_tension, mass_height and mass_speed.

    A quantity is absent if none of its topics has messages.  If a topic has messages of another
    type than the bench's, the use of its series raises RecordingError; ``bench/state`` and
    ``capture/status`` of another type give no series.
    """
    makers: dict[str, dict[str, Callable[[], Series]]] = {}

    def add(quantity: str, topic: Topic, make: Callable[[], Series]) -> None:
        if bag.has(topic):
            makers.setdefault(quantity, {})[topic.name] = make

    if bag.holds(topics.BENCH_STATE):
        exact = Deferred(partial(_exact_series, bag))
        for quantity in QUANTITIES:
            add(quantity, topics.BENCH_STATE, partial(_exact, exact, quantity))
    for vehicle, pose, odometry in _VEHICLES:
        add(vehicle, pose, partial(_poses, bag, pose))
        add(vehicle, odometry, partial(_poses, bag, odometry))
        add(f"{vehicle}_rate", odometry, partial(_rates, bag, odometry))
    for column, quantity in enumerate(_BUFFER_QUANTITIES):
        for topic in _BUFFERS:
            add(quantity, topic, partial(_buffer, bag, topic, column))
    for topic, quantity in (
        (topics.CONTACT_WRENCH, "tip_force"),
        (topics.LOAD_CELL, "cone_force"),
    ):
        add(quantity, topic, partial(_force, bag, topic))
        add("force", topic, partial(_magnitude, bag, topic))
    for quantity, (topic, field) in _FIELDS.items():
        add(quantity, topic, partial(_field, bag, topic, field))
    if bag.holds(topics.CAPTURE_STATUS):
        add("distance", topics.CAPTURE_STATUS, partial(_distances, bag))
    return {quantity: LazyMapping(sources) for quantity, sources in makers.items()}


def without_zero(series: SeriesBySource, motion: Deferred[MeasuredMotion | None]) -> SeriesBySource:
    """Return series with the zero of the buffer subtracted, see :attr:`MeasuredMotion.zero`.

    ``motion`` has that buffer; it is used when stroke or torsion are.
    """
    changed = dict(series)
    for k, quantity in enumerate(("stroke", "torsion")):
        if sources := series.get(quantity):
            makers = {name: partial(_less_zero, sources, name, motion, k) for name in sources}
            changed[quantity] = LazyMapping(makers)
    return changed


def _less_zero(
    sources: Mapping[str, Series], name: str, of: Deferred[MeasuredMotion | None], k: int
) -> Series:
    found, motion = sources[name], of.value
    if motion is None or motion.buffer is None or motion.buffer.topic.lstrip("/") != name:
        return found
    return found._replace(values=found.values - motion.zero[k]) if motion.zero[k] else found


def commanded_launch(bag: Bag, scene: Scene | None) -> LaunchPlan | None:
    """Return the scene's launch plan with hanging mass and drop height of the last LaunchCommand.

    None if no LaunchCommand is recorded, or if there is no scene or it has no string.
    """
    if scene is None or scene.string is None or not bag.holds(topics.LAUNCH_COMMAND):
        return None
    columns = bag.columns(topics.LAUNCH_COMMAND)
    return plan_launch(scene)._replace(
        hanging_mass=float(columns["hanging_mass"][-1]),
        drop_height=float(columns["drop_height"][-1]),
    )


def _exact_series(bag: Bag) -> dict[str, Series]:
    return series_in(bag.samples)


def _exact(exact: Deferred[dict[str, Series]], quantity: str) -> Series:
    return exact.value[quantity]


def live_conditions(bag: Bag) -> LiveConditions:
    """Return the conditions under which the live detector evaluated the recorded run.

    Of a real bench with a final status, the last instant to evaluate is the time of that status.
    The run counts as ended early where the chaser was held again: a verdict must have come before.
    """
    last = math.inf
    if not bag.is_simulated and bag.holds(topics.CAPTURE_STATUS) and bag.statuses[-1].final:
        last = bag.statuses[-1].t + TICK
    is_cut = bag.cut or bag.held_again is not None
    return LiveConditions(bag.is_simulated, last, is_cut=is_cut, has_end=bag.has_end)


def received_in(bag: Bag, scene: Scene | None) -> list[Received]:
    """Return the measurements that the live detector has received, in the order of log times.

    The scene decides which topics of a simulated run the detector reads.  Of a real bench, messages
    logged before the announcement of the trial (RunInfo), after the detector's final status or
    after the chaser was held again are left out, because the live detector ignores them; as each
    node receives these messages at a slightly different time, the selection may differ from the
    detector's by a few messages.
    Messages that cannot be decoded or have the stamp 0 are left out.

    RecordingError if one of the sources (chaser, target, buffer) has no message, or none that
    gives a measurement.
    """
    begin, end = 0, sys.maxsize  # ns
    if not bag.is_simulated:
        announced = bag.log_times(topics.RUN_INFO)[:1]
        begin = int(announced[0]) if announced.size else begin
        if bag.holds(topics.CAPTURE_STATUS) and bag.statuses[-1].final:
            end = int(bag.log_times(topics.CAPTURE_STATUS)[-1])
        end = min(end, bag.held_again or end)
    reader = DetectorInput(scene, is_simulated=bag.is_simulated, store_of=bag.store_for)
    messages: list[tuple[int, Topic, bytes]] = []
    for topic in reader.topics:
        if bag.has(topic):
            bag.store_of_topic(topic)  # RecordingError if its definition lacks a field
            messages += zip(bag.log_times(topic).tolist(), repeat(topic), bag.raw(topic))
    present = {reader.topics[topic] for _, topic, _ in messages}
    for source in Source:
        names = [topic.name for topic, of in reader.topics.items() if of is source]
        if names and source not in present:
            raise RecordingError(
                f"{bag.path}: contains no {' or '.join(names)}, which the detector needs; --remap "
                "reads it from another topic"
            )
    for source in Source:
        used = [topic for topic, of in reader.topics.items() if of is source and bag.has(topic)]
        lines = [f"{topic.name}: {bag.unused(topic)}" for topic in used if not bag.measures(topic)]
        if lines and len(lines) == len(used):
            raise RecordingError(f"{bag.path}: {'; '.join(lines)}")
    received = []
    for log_time, topic, data in sorted(messages, key=lambda message: message[0]):
        if not begin <= log_time <= end:
            continue
        with suppress(MessageError):  # as in the node
            if measurement := reader.read(topic, data):
                source, stamp, values = measurement
                if stamp == 0:  # not set
                    continue
                arrival = None if bag.is_simulated else log_time - bag.clock.log_time
                received.append(Received(source, stamp - bag.clock.release, values, arrival))
    return received


def _poses(bag: Bag, topic: Topic) -> Series:
    """Return the poses in a topic, (n, 3): x, y (m) and heading (rad, without jumps by a turn)."""
    stamps, values, log_times = bag.measured(topic)
    return bag.in_order(stamps, values[:, :3], log_times, angle=_HEADING)


def _rates(bag: Bag, topic: Topic) -> Series:
    """Return the velocities in an odometry topic, (n, 3): x, y (m/s) in the world, yaw (rad/s)."""
    stamps, values, log_times = bag.measured(topic)
    return bag.in_order(stamps, values[:, 3:], log_times)


def _buffer(bag: Bag, topic: Topic, column: int) -> Series:
    """Return one quantity of the buffer, (n,), SI units.

    ``column`` is its index in :data:`_BUFFER_QUANTITIES`.
    """
    stamps, values, log_times = bag.measured(topic)
    return bag.in_order(stamps, values[:, column], log_times)


def _force(bag: Bag, topic: Topic) -> Series:
    """Return the force on the tip, (n, 2), N.

    A load cell measures the opposite force, the one on the cone, so its sign is changed.  The
    result of a load cell is in the cone's axes, that of another topic in the tip's axes.  A force
    whose ``frame_id`` names other axes is rotated by the measured headings and torsion, each taken
    as 0 where it was not measured; an empty ``frame_id`` means the axes of the result.  The series
    is empty if the ``frame_id`` is unknown, or not equal in all messages.
    """
    sign = -1.0 if topic is topics.LOAD_CELL else 1.0
    names = ("wrench.force.x", "wrench.force.y")
    series = bag.series(topic, lambda c: sign * np.stack([c[name] for name in names], axis=1))
    frame_ids = tuple(dict.fromkeys(bag.readable(topic)[0]["header.frame_id"].tolist()))
    axes = "target/cone" if topic is topics.LOAD_CELL else "chaser/tip"
    frame = frame_of(frame_ids) if any(frame_ids) else axes
    if frame is None:
        return NO_SERIES._replace(values=np.zeros((0, 2)))
    turns = [(1.0, name) for name in FORCE_FRAMES[frame]]
    turns += [(-1.0, name) for name in FORCE_FRAMES[axes]]
    angle = np.zeros(series.t.size)
    for sign, name in turns:
        if (-sign, name) not in turns:
            angle += sign * _angle(bag, name, series.t)
    if not angle.any():
        return series
    c, s = np.cos(angle), np.sin(angle)
    x, y = series.values.T
    return series._replace(values=np.stack([c * x - s * y, s * x + c * y], axis=1))


def _angle(bag: Bag, name: str, t: np.ndarray) -> np.ndarray:
    """Return the torsion, or the heading of a vehicle, (n,), rad, at times (n,), s.

    ``name`` is ``torsion``, ``chaser`` or ``target``.  The angle is interpolated between
    measurements, and 0 if it was not measured.
    """
    if name == "torsion":
        column = _BUFFER_QUANTITIES.index(name)
        found = [_buffer(bag, b, column) for b in _BUFFERS if bag.holds(b)]
    else:
        of_vehicle = next(topics for vehicle, *topics in _VEHICLES if vehicle == name)
        found = [_poses(bag, topic) for topic in of_vehicle if bag.holds(topic)]
    for series in found:
        if series.t.size:
            values = series.values if series.values.ndim == 1 else series.values[:, _HEADING]
            return np.interp(t, series.t, values)
    return np.zeros(t.size)


def _magnitude(bag: Bag, topic: Topic) -> Series:
    force = _force(bag, topic)
    return force._replace(values=np.hypot(*force.values.T))


def _field(bag: Bag, topic: Topic, field: str) -> Series:
    return bag.series(topic, lambda columns: np.asarray(columns[field], dtype=float))


def _distances(bag: Bag) -> Series:
    """Return the smallest distance so far from the tip's centre to the centre of BE, (n,), m.

    The values are the detector's, at the times of its statuses.
    """
    statuses = [s for s in bag.statuses if np.isfinite([s.t, s.nearest_distance]).all()]
    t, values = (
        np.array([getattr(s, name) for s in statuses]) for name in ("t", "nearest_distance")
    )
    return Series(t, values)
