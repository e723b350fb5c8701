"""The series in a bag: from the topics that a real bench publishes too."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np

from capture_sim.launch.plan import LaunchPlan, plan_launch
from capture_sim.messages import topics
from capture_sim.messages.convert import HINGE_JOINT, SLIDE_JOINT
from capture_sim.messages.measurements import BUFFER, POSE, TWIST, pose_values, twist_values
from capture_sim.messages.topics import Topic
from capture_sim.recording.bag import Bag, Columns
from capture_sim.scene.parts import Scene
from capture_sim.series import (
    QUANTITIES,
    Deferred,
    LazyMapping,
    Series,
    SeriesBySource,
    series_in,
)

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
_BUFFER_QUANTITIES = ("stroke", "torsion", "stroke_rate", "torsion_rate")


def series_of(bag: Bag) -> SeriesBySource:
    """Return every series of a bag by quantity and source; topics are decoded at their first use.

    The source of a series is the name of its topic.  Quantities are those of
    :func:`capture_sim.series.series_in`, and ``tip_force`` and ``cone_force`` (N, on the tip, in
    the axes of the tip and of the cone), those of ``bench/contact`` (in_touch, walls,
    touches_begun, normal_force, peak_force) and ``bench/string`` (string_phase, string_tension,
    mass_height, mass_speed).  A quantity that was not measured is absent.
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
        add(vehicle, pose, partial(_poses, bag, pose, "pose"))
        add(vehicle, odometry, partial(_poses, bag, odometry, "pose.pose"))
        add(f"{vehicle}_rate", odometry, partial(_rates, bag, odometry))
    for column, quantity in enumerate(_BUFFER_QUANTITIES):
        for topic in (topics.BUFFER_STATE, topics.JOINT_STATES):
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


def commanded_launch(bag: Bag, scene: Scene | None) -> LaunchPlan | None:
    """Return the launch as it was commanded; None if it was not recorded."""
    if scene is None or scene.string is None or not bag.holds(topics.LAUNCH_COMMAND):
        return None
    columns = bag.columns(topics.LAUNCH_COMMAND)
    return replace(
        plan_launch(scene),
        hanging_mass=float(columns["hanging_mass"][-1]),
        drop_height=float(columns["drop_height"][-1]),
    )


def _exact_series(bag: Bag) -> dict[str, Series]:
    return series_in(bag.samples)


def _exact(exact: Deferred[dict[str, Series]], quantity: str) -> Series:
    return exact.value[quantity]


def _poses(bag: Bag, topic: Topic, path: str) -> Series:
    """Return poses (n, 3): x, y (m), heading (rad)."""
    return bag.series(topic, lambda columns: _pose_values(columns, path), angle=_HEADING)


def _rates(bag: Bag, topic: Topic) -> Series:
    """Return the rates of an odometry's poses in the world, (n, 3): m/s, m/s, rad/s."""

    def values(odometry: Columns) -> np.ndarray:
        heading = _pose_values(odometry, "pose.pose")[:, _HEADING]
        numbers = (odometry[f"twist.twist.{name}"].tolist() for name in TWIST)
        return np.array(list(map(twist_values, heading.tolist(), *numbers)))

    return bag.series(topic, values)


def _pose_values(columns: Columns, path: str) -> np.ndarray:
    numbers = (columns[f"{path}.{name}"].tolist() for name in POSE)
    return np.array(list(map(pose_values, *numbers)))


def _buffer(bag: Bag, topic: Topic, column: int) -> Series:
    """Return stroke (m), torsion (rad) or one of their rates, (n,)."""
    if topic is topics.BUFFER_STATE:
        return _field(bag, topic, BUFFER[column])
    return bag.series(topic, lambda joints: _buffer_joints(joints)[:, column])


def _buffer_joints(joints: Columns) -> np.ndarray:
    """Return positions and velocities of slide and hinge, (n, 4); NaN without them.

    Other nodes may publish other joints on the same topic.
    """
    values = np.full((len(joints["name"]), 4), np.nan)
    columns = (joints[field] for field in ("name", "position", "velocity"))
    for row, (names, positions, velocities) in zip(values, zip(*columns, strict=True), strict=True):
        if SLIDE_JOINT in names and HINGE_JOINT in names and len(positions) == len(names):
            order = [names.index(SLIDE_JOINT), names.index(HINGE_JOINT)]
            row[:2] = positions[order]
            if len(velocities) == len(names):
                row[2:] = velocities[order]
    return values


def _force(bag: Bag, topic: Topic) -> Series:
    """Return the force on the tip, (n, 2), N; the load cell reads the opposite."""
    sign = -1.0 if topic is topics.LOAD_CELL else 1.0
    names = ("wrench.force.x", "wrench.force.y")
    return bag.series(topic, lambda c: sign * np.stack([c[name] for name in names], axis=1))


def _magnitude(bag: Bag, topic: Topic) -> Series:
    force = _force(bag, topic)
    return force._replace(values=np.hypot(*force.values.T))


def _field(bag: Bag, topic: Topic, field: str) -> Series:
    return bag.series(topic, lambda columns: np.asarray(columns[field], dtype=float))


def _distances(bag: Bag) -> Series:
    """Return the closest approach so far, of the path that the detector estimates, (n,), m."""
    statuses = [s for s in bag.statuses if np.isfinite([s.t, s.nearest_distance]).all()]
    t, values = (
        np.array([getattr(s, name) for s in statuses]) for name in ("t", "nearest_distance")
    )
    return Series(t, values)
