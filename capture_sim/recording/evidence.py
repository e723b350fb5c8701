"""Takes the sensors' measurements from a recording, for the rules of plausibility."""

from __future__ import annotations

from contextlib import suppress

import numpy as np

from capture_sim.errors import CaptureSimError
from capture_sim.messages import topics
from capture_sim.messages.convert import HINGE_JOINT, SLIDE_JOINT
from capture_sim.messages.topics import Topic
from capture_sim.plausibility.measured import Deflections, Forces, Measured, Poses
from capture_sim.recording.bag import Bag
from capture_sim.recording.clock import stamps_of
from capture_sim.recording.recorded_topics import Columns

#: Topics of chaser and target that go together.
_PAIRS = (
    (topics.CHASER_POSE, topics.TARGET_POSE),
    (topics.CHASER_ODOMETRY, topics.TARGET_ODOMETRY),
)
_BUFFERS = (topics.BUFFER_STATE, topics.JOINT_STATES)


def evidence_in(bag: Bag) -> tuple[Measured, ...]:
    """Return the sensors' measurements in a recording, one Measured for each pair of pose topics.

    A pair is chaser and target by motion capture, or both by odometry.  If motion capture gives
    only one vehicle, odometry gives the other one of its pair.  Without any poses there is one
    Measured, with buffer and force.
    Empty for a simulated run, in which one clock and one program have made everything.
    """
    if bag.is_simulated:
        return ()
    origin = min((int(t[0]) for t in map(bag.log_times, _all_topics(bag)) if t.size), default=0)
    buffer = next((topic for topic in _BUFFERS if bag.holds(topic)), None)
    deflections = None if buffer is None else _deflections(bag, buffer, origin)
    force = _force(bag, origin)
    release = 0.0
    with suppress(CaptureSimError):  # without poses or stamps
        release = -float(bag.clock.since(np.array([origin]))[0])
    pairs = []
    for chaser, target in _PAIRS:
        of_c, of_t = (_poses(bag, topic, origin) for topic in (chaser, target))
        if of_c is not None or of_t is not None:
            pairs.append((of_c, of_t))
    if len(pairs) == 2 and None in pairs[0]:  # one vehicle by each: they are a pair
        other = pairs[1]
        merged = (pairs[0][0] or other[0], pairs[0][1] or other[1])
        pairs = [merged] if None in other else [merged, other]
    return tuple(
        Measured(of_c, of_t, deflections, force, origin=origin, release=release)
        for of_c, of_t in pairs or [(None, None)]
    )


def _all_topics(bag: Bag) -> list[Topic]:
    known = (*(topic for pair in _PAIRS for topic in pair), *_BUFFERS, topics.LOAD_CELL)
    return [topic for topic in known if bag.holds(topic)]


def _readable(bag: Bag, topic: Topic) -> tuple[Columns, np.ndarray] | None:
    """Return columns and log times, ns, of a topic; None if no message can be read."""
    if bag.holds(topic):
        with suppress(CaptureSimError):  # reported where the messages themselves are used
            columns, log_times = bag.readable(topic)
            if log_times.size:
                return columns, log_times
    return None


def _times(columns: Columns, log_times: np.ndarray, origin: int) -> tuple[np.ndarray, np.ndarray]:
    """Return stamps and arrivals (log times) of messages, (n,) each, s after ``origin``, ns."""
    return (stamps_of(columns) - origin) / 1e9, (log_times - origin) / 1e9


def _frames(columns: Columns) -> tuple[str, ...]:
    return tuple(dict.fromkeys(columns["header.frame_id"].tolist()))


def _stack(columns: Columns, prefix: str, names: str) -> np.ndarray:
    return np.stack([np.asarray(columns[f"{prefix}.{name}"], float) for name in names], axis=1)


def _poses(bag: Bag, topic: Topic, origin: int) -> Poses | None:
    if (found := _readable(bag, topic)) is None:
        return None
    columns = found[0]
    pose = "pose.pose" if topic.type_name.endswith("Odometry") else "pose"
    return Poses(
        topic.absolute_name,
        *_times(*found, origin),
        _frames(columns),
        _stack(columns, f"{pose}.position", "xyz"),
        _stack(columns, f"{pose}.orientation", "xyzw"),
    )


def _deflections(bag: Bag, topic: Topic, origin: int) -> Deflections | None:
    if topic is topics.JOINT_STATES and (found := _joints(bag, origin)) is not None:
        return found
    with suppress(CaptureSimError):
        stamps, values, log_times = bag.measured(topic)
        if not stamps.size:
            nothing = np.zeros(0)
            return Deflections(
                topic.absolute_name,
                nothing,
                unused=bag.unused(topic),
                stroke=nothing,
                torsion=nothing,
            )
        if stamps.size:
            t, arrival = (stamps - origin) / 1e9, (log_times - origin) / 1e9
            return Deflections(topic.absolute_name, t, arrival, (), "", *values[:, :2].T)
    return None


def _joints(bag: Bag, origin: int) -> Deflections | None:
    """Return the buffer's deflections from joint states that all list the same joints.

    Such messages are read together, which is fast.  None if they differ, or if they do not list
    both joints of the buffer once.
    """
    if (found := _readable(bag, topics.JOINT_STATES)) is None:
        return None
    columns, names = found[0], found[0]["name"].tolist()
    position = columns["position"]
    wanted = (SLIDE_JOINT, HINGE_JOINT)
    is_same = position.ndim == 2 and all(each == names[0] for each in names)
    if not is_same or any(names[0].count(name) != 1 for name in wanted):
        return None
    if position.shape[1] != len(names[0]):
        return None
    stroke, torsion = (position[:, names[0].index(name)] for name in wanted)
    topic = topics.JOINT_STATES.absolute_name
    return Deflections(topic, *_times(*found, origin), (), "", stroke, torsion)


def _force(bag: Bag, origin: int) -> Forces | None:
    if (found := _readable(bag, topics.LOAD_CELL)) is None:
        return None
    columns = found[0]
    return Forces(
        topics.LOAD_CELL.absolute_name,
        *_times(*found, origin),
        _frames(columns),
        _stack(columns, "wrench.force", "xyz"),
    )
