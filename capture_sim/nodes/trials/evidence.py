"""Measurements for the check of plausibility before a release and after a verdict."""

from __future__ import annotations

from collections.abc import Collection

from capture_sim.messages.cdr import Numbers, frame_id_of
from capture_sim.messages.definitions import typestore
from capture_sim.messages.topics import LOAD_CELL, Topic
from capture_sim.plausibility.check import check
from capture_sim.plausibility.live import LiveMeasurements
from capture_sim.plausibility.rules import RULES, Doubt, Grade
from capture_sim.scene.parts import Scene

#: Length of the latest measurements, s, that are checked before a release, and of a trial.
BEFORE, TRIAL = 2.0, 60.0
_POSE = (*(f"position.{axis}" for axis in "xyz"), *(f"orientation.{axis}" for axis in "xyzw"))
_PREFIXES = {"geometry_msgs/msg/PoseStamped": "pose", "nav_msgs/msg/Odometry": "pose.pose"}


class Evidence:
    """Keeps measurements, and checks them against the rules of :mod:`capture_sim.plausibility`.

    It keeps two sets: the last :data:`BEFORE` s, for the check before a release, and the
    measurements since the release, for the check after the verdict.  ``waived`` are the names of
    rules that are not checked; names that are not rules of plausibility are ignored.
    """

    def __init__(self, waived: Collection[str]) -> None:
        self._waived = [name for name in waived if name in RULES]
        self._before, self._trial = LiveMeasurements(BEFORE), LiveMeasurements(TRIAL)
        self._poses = {
            kind: Numbers(typestore(), kind, *(f"{prefix}.{name}" for name in _POSE))
            for kind, prefix in _PREFIXES.items()
        }

    def begin(self) -> None:
        """Note the release: :meth:`of_trial` checks only measurements added from now on."""
        self._trial.clear()

    def add_pose(self, vehicle: str, topic: Topic, data: bytes, stamp: int, arrival: int) -> None:
        """Add a serialised pose message ``data`` of a vehicle, ``chaser`` or ``target``.

        ``stamp``: its stamp, ns, by the source's clock.  ``arrival``: its time of arrival, ns, by
        the steady clock of this machine.
        """
        numbers = self._poses[topic.type_name](data).item()
        frame = frame_id_of(topic, data)
        for live in (self._before, self._trial):
            live.add_pose(vehicle, topic.name, stamp, arrival, numbers[:3], numbers[3:], frame)

    def add_buffer(
        self, topic: Topic, stamp: int, arrival: int, stroke: float, torsion: float
    ) -> None:
        """Add a state of the buffer: stroke (m) and torsion (rad); times as in :meth:`add_pose`."""
        for live in (self._before, self._trial):
            live.add_buffer(topic.name, stamp, arrival, stroke, torsion)

    def add_force(
        self, data: bytes, stamp: int, arrival: int, force: tuple[float, float, float]
    ) -> None:
        """Add a force of the load cell, N, with its serialised message ``data``.

        The message gives the frame; times as in :meth:`add_pose`.
        """
        frame = frame_id_of(LOAD_CELL, data)
        for live in (self._before, self._trial):
            live.add_force(LOAD_CELL.name, stamp, arrival, force, frame)

    def before_release(self, scene: Scene | None) -> tuple[Doubt, ...]:
        """Return the broken rules of the last :data:`BEFORE` s, each with its finding.

        Without a scene, the rules that need one are not checked.
        """
        return check(self._before.measured(is_before_release=True), scene, self._waived)

    def of_trial(self, scene: Scene) -> tuple[Doubt, ...]:
        """Return the broken rules of the trial since its release, each with its finding.

        Of a long trial, only the last :data:`TRIAL` s count, and of each source at most the latest
        :data:`capture_sim.plausibility.live.MAX_KEPT` messages.
        """
        return check(self._trial.measured(), scene, self._waived)


def refusing(doubts: Collection[Doubt]) -> list[Doubt]:
    """Return the doubts that refuse a release, and that make a verdict undecided.

    These are doubts of grade *refused*, and those by which no message of a topic can be used.
    """
    return [d for d in doubts if d.grade is Grade.REFUSED or d.leaves_out_topic]
