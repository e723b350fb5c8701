"""Evidence for the rules of plausibility before a release and after a verdict."""

from __future__ import annotations

from collections.abc import Collection

from capture_sim.messages.cdr import Numbers, frame_id_of
from capture_sim.messages.definitions import typestore
from capture_sim.messages.topics import LOAD_CELL, Topic
from capture_sim.plausibility.check import check
from capture_sim.plausibility.live import LiveMeasurements
from capture_sim.plausibility.rules import RULES, Doubt, Grade
from capture_sim.scene.parts import Scene

#: Seconds before a release, and of a trial, that are looked at.
BEFORE, TRIAL = 2.0, 60.0
_POSE = (*(f"position.{axis}" for axis in "xyz"), *(f"orientation.{axis}" for axis in "xyzw"))
_PREFIXES = {"geometry_msgs/msg/PoseStamped": "pose", "nav_msgs/msg/Odometry": "pose.pose"}


class Evidence:
    """Measurements for the rules: the last seconds, and the trial since its release.

    ``waived`` are the names of rules that are not checked.  Names of other rules are ignored.
    """

    def __init__(self, waived: Collection[str]) -> None:
        self._waived = [name for name in waived if name in RULES]
        self._before, self._trial = LiveMeasurements(BEFORE), LiveMeasurements(TRIAL)
        self._poses = {
            kind: Numbers(typestore(), kind, *(f"{prefix}.{name}" for name in _POSE))
            for kind, prefix in _PREFIXES.items()
        }

    def begin(self) -> None:
        """Note the release: the trial's measurements count from here on."""
        self._trial.clear()

    def add_pose(self, vehicle: str, topic: Topic, data: bytes, stamp: int, arrival: int) -> None:
        """Add a serialised pose of ``chaser`` or ``target``; stamp and arrival in ns."""
        numbers = self._poses[topic.type_name](data).item()
        frame = frame_id_of(topic, data)
        for live in (self._before, self._trial):
            live.add_pose(vehicle, topic.name, stamp, arrival, numbers[:3], numbers[3:], frame)

    def add_buffer(
        self, topic: Topic, stamp: int, arrival: int, stroke: float, torsion: float
    ) -> None:
        """Add a state of the buffer: stroke (m) and torsion (rad)."""
        for live in (self._before, self._trial):
            live.add_buffer(topic.name, stamp, arrival, stroke, torsion)

    def add_force(
        self, data: bytes, stamp: int, arrival: int, force: tuple[float, float, float]
    ) -> None:
        """Add a force of the load cell, N."""
        frame = frame_id_of(LOAD_CELL, data)
        for live in (self._before, self._trial):
            live.add_force(LOAD_CELL.name, stamp, arrival, force, frame)

    def before_release(self, scene: Scene | None) -> tuple[Doubt, ...]:
        """Return the doubts about the last seconds."""
        return check(self._before.measured(is_before_release=True), scene, self._waived)

    def of_trial(self, scene: Scene) -> tuple[Doubt, ...]:
        """Return the doubts about the trial since its release."""
        return check(self._trial.measured(), scene, self._waived)


def refusing(doubts: Collection[Doubt]) -> list[Doubt]:
    """Return the doubts by which nothing may be let go, and no verdict counts."""
    return [d for d in doubts if d.grade is Grade.REFUSED or d.leaves_out_topic]
