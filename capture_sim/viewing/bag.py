"""A run out of the topics that a real bench has as well: poses, buffer, forces.

Nothing of the simulator's own (BenchState, events, the scene) is needed but the bench's geometry.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Protocol

import numpy as np

from capture_sim.detection.align import Observation
from capture_sim.detection.exact import CaptureStatus
from capture_sim.detection.noisy import NoisyDetector
from capture_sim.errors import RecordingError
from capture_sim.messages.bench_columns import Columns, headings_of, release_of, stamps_of
from capture_sim.messages.convert import HINGE_JOINT, SLIDE_JOINT
from capture_sim.messages.topics import (
    BUFFER_STATE,
    CAPTURE_STATUS,
    CHASER_ODOMETRY,
    CONTACT_STATE,
    CONTACT_WRENCH,
    JOINT_STATES,
    STRING_STATE,
    TARGET_ODOMETRY,
    Topic,
)
from capture_sim.scene.parts import Scene
from capture_sim.viewing.measured import AlignedMeasurements, MeasuredRun, measured_run


class Bag(Protocol):
    """A recording, as :class:`capture_sim.recording.Run`."""

    @property
    def name(self) -> str:
        """Of the run."""

    @property
    def statuses(self) -> Sequence[CaptureStatus]:
        """The detector's judgements, if it was recorded."""

    def columns(self, topic: str | Topic) -> Columns:
        """Return a topic's fields by path; empty without messages."""


def run_from_bag(bag: Bag, scene: Scene, released: float | None = None) -> MeasuredRun:
    """Read a run from its measurements, on the stamps of the chaser's poses.

    Parameters
    ----------
    bag
        Holds the poses of chaser and target, and the buffer's state or the joints'.
    scene
        The geometry of buffer and cone, and the detector's criteria: where the bag holds no
        judgements, the detector judges now.
    released
        When, s after the first pose; None where the bag tells, see
        :func:`capture_sim.messages.bench_columns.release_of`.

    Raises
    ------
    RecordingError
        A topic is missing, or the release lies outside the recording.
    """
    chaser, target = _needed(bag, CHASER_ODOMETRY), _needed(bag, TARGET_ODOMETRY)
    stamps, first = np.unique(stamps_of(chaser), return_index=True)
    release = release_of(bag, released)
    t = (stamps - release) * 1e-9
    poses, rates = zip(*(_planar(odometry) for odometry in (chaser, target)), strict=True)
    buffer, buffer_rate, buffer_stamps = _buffer(bag)

    def at(columns_stamps: np.ndarray, values: np.ndarray) -> np.ndarray:
        """Return values at the chaser's stamps, linear between their own."""
        since = (columns_stamps - stamps[0]) * 1e-9
        wanted = (stamps - stamps[0]) * 1e-9
        return np.stack([np.interp(wanted, since, column) for column in values.T], axis=-1)

    def held(columns_stamps: np.ndarray, values: np.ndarray) -> np.ndarray:
        """Return states at the chaser's stamps, each holding until the next."""
        before = np.searchsorted(columns_stamps, stamps, side="right") - 1
        return np.asarray(values[np.maximum(before, 0)].astype(int))

    measured = AlignedMeasurements(
        t=t,
        chaser=poses[0][first],
        chaser_rate=rates[0][first],
        target=at(stamps_of(target), poses[1]),
        target_rate=at(stamps_of(target), rates[1]),
        buffer=at(buffer_stamps, buffer),
        buffer_rate=at(buffer_stamps, buffer_rate),
        **_optional(bag, at, held),
    )
    statuses: Sequence[CaptureStatus] = bag.statuses
    if statuses:
        # a recording counts them from a stamp of 1 s, the run from the release
        first_status = (stamps_of(bag.columns(CAPTURE_STATUS))[0] - release) * 1e-9
        late = statuses[0].t - float(first_status)
        statuses = [status._replace(t=status.t - late) for status in statuses]
    else:
        statuses = judge(scene, measured)
    return measured_run(bag.name, scene, measured, statuses)


def judge(scene: Scene, measured: AlignedMeasurements) -> list[CaptureStatus]:
    """Let the capture detector judge measurements."""
    detector = NoisyDetector(scene)
    statuses = []
    for i, t in enumerate(measured.t.tolist()):
        stroke, torsion = measured.buffer[i].tolist()
        stroke_rate, torsion_rate = measured.buffer_rate[i].tolist()
        seen = Observation(
            t=t,
            chaser=_three(measured.chaser[i]),
            chaser_rate=_three(measured.chaser_rate[i]),
            target=_three(measured.target[i]),
            target_rate=_three(measured.target_rate[i]),
            stroke=stroke,
            stroke_rate=stroke_rate,
            torsion=torsion,
            torsion_rate=torsion_rate,
        )
        statuses.append(detector.update(seen))
    return [*statuses, *detector.finish()]


def _three(row: np.ndarray) -> tuple[float, float, float]:
    x, y, theta = row.tolist()
    return x, y, theta


def _needed(bag: Bag, topic: Topic) -> Columns:
    found = bag.columns(topic)
    if not found:
        raise RecordingError(f"{bag.name}: holds no {topic.absolute_name}, nothing to draw")
    return found


def _planar(odometry: Columns) -> tuple[np.ndarray, np.ndarray]:
    """Return poses (n, 3) and their rates in the world (n, 3), from nav_msgs/Odometry."""
    x, y = odometry["pose.pose.position.x"], odometry["pose.pose.position.y"]
    theta = np.unwrap(headings_of(odometry, "pose.pose"))
    c, s = np.cos(theta), np.sin(theta)
    # the twist is in the vehicle's own frame
    vx, vy = odometry["twist.twist.linear.x"], odometry["twist.twist.linear.y"]
    rates = (c * vx - s * vy, s * vx + c * vy, odometry["twist.twist.angular.z"])
    return np.stack([x, y, theta], axis=-1), np.stack(rates, axis=-1)


def _buffer(bag: Bag) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return stroke and torsion (n, 2), their rates (n, 2), and stamps (n,)."""
    state = bag.columns(BUFFER_STATE)
    if state:
        values = np.stack([state["axial_stroke"], state["torsion"]], axis=-1)
        rates = np.stack([state["axial_rate"], state["torsion_rate"]], axis=-1)
        return values, rates, stamps_of(state)
    joints = bag.columns(JOINT_STATES)
    if joints:
        names = list(joints["name"][0])
        if {HINGE_JOINT, SLIDE_JOINT} <= set(names):
            order = [names.index(SLIDE_JOINT), names.index(HINGE_JOINT)]
            return joints["position"][:, order], joints["velocity"][:, order], stamps_of(joints)
    raise RecordingError(
        f"{bag.name}: holds neither {BUFFER_STATE.absolute_name} nor {JOINT_STATES.absolute_name} "
        f"with {HINGE_JOINT} and {SLIDE_JOINT}: the tip's place is not known"
    )


def _optional(bag: Bag, at: Any, held: Any) -> dict[str, np.ndarray]:
    """Return what else was measured."""
    found: dict[str, np.ndarray] = {}
    wrench = bag.columns(CONTACT_WRENCH)
    if wrench:
        force = np.stack([wrench["wrench.force.x"], wrench["wrench.force.y"]], axis=-1)
        found["tip_force"] = at(stamps_of(wrench), force)
    contact = bag.columns(CONTACT_STATE)
    if contact:
        found["normal_force"] = at(stamps_of(contact), contact["normal_force"])
        found["peak_force"] = at(stamps_of(contact), contact["peak_force"][:, None])[:, 0]
        found["walls"] = held(stamps_of(contact), contact["walls"])
        found["begun"] = held(stamps_of(contact), contact["touches"])
    string = bag.columns(STRING_STATE)
    if string:
        values = np.stack([string[n] for n in ("tension", "mass_height", "mass_speed")], axis=-1)
        phase = held(stamps_of(string), string["phase"])
        found["string"] = np.column_stack([phase, at(stamps_of(string), values)])
    return found
