"""Measurements of the last seconds, kept by a running node for the rules of plausibility."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence

import numpy as np

from capture_sim.plausibility.check import check_names
from capture_sim.plausibility.measured import Deflections, Forces, Measured, Poses
from capture_sim.plausibility.motion import MeasuredMotion
from capture_sim.plausibility.rules import Grade, examine


def check(measured, scene=None, waived=()):
    """Return every doubt about measurements, the gravest grade first."""
    check_names(waived)
    doubts = examine(MeasuredMotion(measured, scene), waived).doubts
    return tuple(sorted(doubts, key=lambda doubt: list(Grade).index(doubt.grade)))


#: Largest number of measurements that are kept of a source.
MAX_KEPT = 4000


class _Kept:
    """The latest messages of one topic, and every frame_id that it has ever had."""

    def __init__(self, topic: str) -> None:
        self.topic = topic
        # stamp, arrival, values, frame_id
        self.rows: deque[tuple[int, int, tuple[float, ...], str]] = deque(maxlen=MAX_KEPT)

    @property
    def frame_ids(self) -> tuple[str, ...]:
        """The frame ids of the messages that are kept, each once, the oldest first."""
        return tuple(dict.fromkeys(row[3] for row in self.rows))


class LiveMeasurements:
    """Store of the messages of the last ``span`` seconds, for the rules of plausibility.

    Add each message when it arrives.  Before a decision, e.g. about the release, call
    :func:`check` with :meth:`measured`.  Adding a message costs
    about a microsecond, a check of 2 s some milliseconds.

    There are four sources: chaser, target, buffer and force.  Of each, the messages of the last
    ``span`` seconds before its latest message are kept, by arrival, and at most ``MAX_KEPT``.  A
    source that has stopped thus keeps its last messages.  A message on another topic than before
    replaces all that were kept of its source.

    Stamps and arrivals are integers in ns.  All arrivals must be by one clock, that of the node.
    Stamps may be by any clock: the rules compare them with the arrivals.

    Examples
    --------
    >>> live = LiveMeasurements()
    >>> live.add_pose("chaser", "motion_capture/chaser", 0, 0, (0, 0, 0), (0, 0, 0, 1), "world")
    >>> live.measured().chaser.count
    1
    """

    def __init__(self, span: float = 2.0) -> None:
        self._span = round(span * 1e9)
        self._kept: dict[str, _Kept] = {}

    def clear(self) -> None:
        """Discard all measurements, e.g. at the start of a trial."""
        self._kept.clear()

    def add_pose(
        self,
        vehicle: str,
        topic: str,
        stamp: int,
        arrival: int,
        position: Sequence[float],
        quaternion: Sequence[float],
        frame_id: str = "",
    ) -> None:
        """Add a pose; ``vehicle`` is "chaser" or "target".

        ``stamp`` and ``arrival`` are in ns, ``position`` is x, y, z in m, and ``quaternion`` is
        x, y, z, w.
        """
        self._add(vehicle, topic, stamp, arrival, (*position, *quaternion), frame_id)

    def add_buffer(
        self, topic: str, stamp: int, arrival: int, stroke: float, torsion: float
    ) -> None:
        """Add a state of the buffer: stroke (m) and torsion (rad); stamp and arrival in ns."""
        self._add("buffer", topic, stamp, arrival, (stroke, torsion), "")

    def add_force(
        self, topic: str, stamp: int, arrival: int, force: Sequence[float], frame_id: str = ""
    ) -> None:
        """Add a force of the load cell: x, y, z in N; stamp and arrival in ns."""
        self._add("force", topic, stamp, arrival, tuple(force), frame_id)

    def _add(
        self,
        source: str,
        topic: str,
        stamp: int,
        arrival: int,
        values: tuple[float, ...],
        frame_id: str,
    ) -> None:
        kept = self._kept.get(source)
        if kept is None or kept.topic != topic:
            kept = self._kept[source] = _Kept(topic)
        kept.rows.append((stamp, arrival, values, frame_id))
        while kept.rows[0][1] < arrival - self._span:
            kept.rows.popleft()

    def measured(self, *, is_before_release: bool = False) -> Measured:
        """Return the measurements that are kept; their times count from the earliest arrival.

        ``is_before_release`` is passed on, see :class:`Measured`.
        """
        arrivals = [kept.rows[0][1] for kept in self._kept.values() if kept.rows]
        origin = min(arrivals, default=0)

        def channel(name: str) -> tuple[_Kept, np.ndarray, np.ndarray, np.ndarray] | None:
            kept = self._kept.get(name)
            if kept is None or not kept.rows:
                return None
            stamps, arrived, values, _ = zip(*kept.rows, strict=True)
            t, arrival = ((np.array(x, dtype=np.int64) - origin) / 1e9 for x in (stamps, arrived))
            return kept, t, arrival, np.array(values, dtype=float)

        def poses(name: str) -> Poses | None:
            if (found := channel(name)) is None:
                return None
            kept, t, arrival, values = found
            return Poses(kept.topic, t, arrival, kept.frame_ids, values[:, :3], values[:, 3:])

        buffer = force = None
        if (found := channel("buffer")) is not None:
            kept, t, arrival, values = found
            buffer = Deflections(kept.topic, t, arrival, (), "", *values.T)
        if (found := channel("force")) is not None:
            kept, t, arrival, values = found
            force = Forces(kept.topic, t, arrival, kept.frame_ids, values)
        return Measured(poses("chaser"), poses("target"), buffer, force, origin, is_before_release)
