"""Reading of the buffer's joints from sensor_msgs/JointState, in one message or in one each."""

from __future__ import annotations

import math
import struct
from bisect import bisect_left
from collections import deque
from collections.abc import Sequence

from rosbags.typesys.store import Typestore

from capture_sim.detection.measurements import Values
from capture_sim.errors import MessageError, one_line
from capture_sim.messages.cdr import Layout
from capture_sim.messages.convert import HINGE_JOINT, SLIDE_JOINT
from capture_sim.messages.definitions import decoded
from capture_sim.messages.topics import JOINT_STATES

#: Names of the joints of stroke and torsion, in the order of the values.
NEEDED = (SLIDE_JOINT, HINGE_JOINT)
#: Maximum interval between two messages for a joint to be interpolated between them, ns.
MAX_INTERVAL = 100_000_000
#: A stamp that is earlier than the previous stamp by more than this starts a new run, ns.
_NEW_RUN = 1_000_000_000
#: Maximum number of messages of one joint that are kept until the other joint's message arrives.
_MAX_MESSAGES = 50
#: Characters that may separate a prefix from a joint's name.
_SEPARATORS = "/_.-:"
#: Length of a serialised message's encapsulation header, bytes, and formats of stamp and number.
_ENCAPSULATION = 4
_STAMP, _DOUBLE = struct.Struct("<iI"), struct.Struct("<d")
_AFTER_STAMP = _ENCAPSULATION + _STAMP.size

#: Position and velocity of a joint; the velocity is NaN where it is missing.
_Row = tuple[float, float]


class NoJointsError(MessageError):
    """A JointState contains no measurement of the buffer."""


class JointWaitsError(NoJointsError):
    """A JointState contains one joint, and no message of the other joint fits it."""


class JointReader:
    """Reader of the stamp and the buffer's joints in sensor_msgs/JointState.

    A driver names the same joints in every message.  The offsets of their numbers are therefore
    computed again only for a message whose texts differ from those of the previous message.

    If each joint has its own messages, they are combined: a measurement has the stamp of one
    joint, and the other joint is interpolated.  A joint's name may have a prefix, e.g.
    ``rig/buffer_slide``, which must be equal in all messages.
    """

    def __init__(self, store: Typestore) -> None:
        self._store = store
        # previous message: its length, and the parts that a message of equal layout must share
        self._size, self._parts = 0, list[tuple[slice, bytes]]()
        self._places: list[int] = []
        self._joined = _Joined()
        self._prefix: str | None = None

    def __call__(self, data: bytes) -> tuple[int, Values]:
        """Return the stamp, ns, and the values of the buffer.

        NoJointsError is raised if the message gives no measurement of the buffer, MessageError if
        it is no JointState.
        """
        if len(data) != self._size or any(data[part] != same for part, same in self._parts):
            return self._find(data)
        sec, nanosec = _STAMP.unpack_from(data, _ENCAPSULATION)
        values = tuple([_DOUBLE.unpack_from(data, place)[0] for place in self._places])
        return sec * 1_000_000_000 + nanosec, values

    def _find(self, data: bytes) -> tuple[int, Values]:
        message = decoded(JOINT_STATES, data, self._store)
        stamp = message.header.stamp.sec * 1_000_000_000 + message.header.stamp.nanosec
        places = self._places_in(list(message.name))
        n_positions, n_velocities = len(message.position), len(message.velocity)
        there = [place for place in places if place is not None]
        if max(there) >= n_positions:
            raise NoJointsError(
                f"{n_positions} positions of {len(message.name)} joints: must be one of each"
            )
        has_rates = n_velocities > max(there)
        rows = {
            joint: (
                float(message.position[place]),
                float(message.velocity[place]) if has_rates else math.nan,
            )
            for joint, place in enumerate(places)
            if place is not None
        }
        if len(there) == 1:
            [(joint, row)] = rows.items()
            if found := self._joined.add(joint, stamp, row):
                return found
            raise JointWaitsError(f"only {NEEDED[joint]}: must be {' and '.join(NEEDED)}")
        self._remember(data, there, n_positions, has_rates=has_rates)
        return stamp, _values(rows[0], rows[1], has_rates=has_rates)

    def _remember(
        self, data: bytes, joints: Sequence[int], n_positions: int, *, has_rates: bool
    ) -> None:
        """Store the offsets of the numbers, for further messages of equal layout."""
        fields = Layout(self._store, JOINT_STATES.type_name, data).records.fields or {}
        starts = [fields[name][1] for name in ("position", "velocity")[: 1 + has_rates]]
        self._places = [start + 8 * joint for start in starts for joint in joints]
        first = fields["position"][1]
        behind = first + 8 * n_positions  # offset of the number of velocities
        shared = slice(_ENCAPSULATION), slice(_AFTER_STAMP, first), slice(behind, behind + 4)
        self._size, self._parts = len(data), [(part, data[part]) for part in shared]

    def _places_in(self, names: Sequence[str]) -> list[int | None]:
        """Return the indices of the buffer's joints in the names, None for a missing joint.

        NoJointsError is raised if both joints are missing.
        """
        needed = " and ".join(NEEDED)
        if not names:
            raise NoJointsError(f"no joint names: must be {needed}")
        for prefix in ("", *_prefixes(names)) if self._prefix is None else (self._prefix,):
            places = [names.index(prefix + j) if prefix + j in names else None for j in NEEDED]
            if any(place is not None for place in places):
                self._prefix = prefix
                return places
        listed = one_line(", ".join(names[:5])) + (", ..." if len(names) > 5 else "")
        raise NoJointsError(f"joints {listed}: must be {needed}")


def _prefixes(names: Sequence[str]) -> list[str]:
    """Return the prefix of the buffer's joints in the names, if any; NoJointsError for several."""
    found = dict.fromkeys(
        name.removesuffix(joint) for joint in NEEDED for name in names if name.endswith(joint)
    )
    prefixes = [prefix for prefix in found if prefix and prefix[-1] in _SEPARATORS]
    if len(prefixes) > 1:
        listed = one_line(", ".join(prefixes[:5]))
        raise NoJointsError(f"buffers with the prefixes {listed}: must be one buffer")
    return prefixes


class _Joined:
    """Combination of messages of one joint each into measurements, by their stamps."""

    def __init__(self) -> None:
        self._rows: list[deque[tuple[int, _Row]]] = [
            deque(maxlen=_MAX_MESSAGES),
            deque(maxlen=_MAX_MESSAGES),
        ]
        self._last = -math.inf  # ns, the stamp of the last measurement

    def add(self, joint: int, stamp: int, row: _Row) -> tuple[int, Values] | None:
        """Add a joint's message; return the measurement that it completes, or None.

        The stamp of the measurement is the older of both joints' newest stamps.
        """
        own, other = self._rows[joint], self._rows[1 - joint]
        if own and stamp < own[-1][0] - _NEW_RUN:
            own.clear()
            other.clear()
            self._last = -math.inf
        if own and stamp <= own[-1][0]:
            return None
        own.append((stamp, row))
        if other:
            t = min(stamp, other[-1][0])
            rows = [_at(t, rows) for rows in self._rows] if t > self._last else [None]
            if rows[0] is not None and rows[-1] is not None:
                self._last = t
                has_rates = math.isfinite(rows[0][1] + rows[-1][1])
                return t, _values(rows[0], rows[-1], has_rates=has_rates)
        return None


def _at(t: int, rows: deque[tuple[int, _Row]]) -> _Row | None:
    """Return position and velocity of a joint, interpolated at a stamp, ns.

    None is returned unless there are messages before and after the stamp, at most
    :data:`MAX_INTERVAL` apart, or one at the stamp.
    """
    i = bisect_left(rows, t, key=lambda item: item[0])
    if i == len(rows):
        return None
    after, behind = rows[i]
    if after == t:
        return behind
    if i == 0 or after - rows[i - 1][0] > MAX_INTERVAL:
        return None
    before, ahead = rows[i - 1]
    share = (t - before) / (after - before)
    position, rate = (a + share * (b - a) for a, b in zip(ahead, behind, strict=True))
    return position, rate


def _values(slide: _Row, hinge: _Row, *, has_rates: bool) -> Values:
    values = (slide[0], hinge[0])
    return (*values, slide[1], hinge[1]) if has_rates else values
