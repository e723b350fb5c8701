"""The output launcher/hold: its period, its readers, its one publisher, and its silence.

A driver holds its chaser if the last message is older than :data:`HOLD_TIMEOUT`.  The thread that
makes the decisions also publishes, so a stalled launcher falls silent and its driver holds.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Collection, Mapping, Sequence

#: Sent at least this often, s (wall).
HOLD_PERIOD = 0.1
#: A driver holds after this long without a message, s.
HOLD_TIMEOUT = 0.5
#: A publisher is discovered before its node's name is; it gets this long to be named, s.
NAMING_TIME = 0.3
#: A launcher that has just started may not have discovered another one yet: it lets nothing go
#: for this long, s.
MEETING_TIME = 1.0
#: Starts of the names of nodes that read topics and are no driver: `ros2 topic` and `ros2 bag`.
ONLOOKERS = ("_ros2cli", "rosbag2_recorder")


class HoldOutput:
    """Sends whether the chaser is held, with ``publish``, at each change and every period."""

    def __init__(self, publish: Callable[[bool], None]) -> None:
        self._publish = publish
        self._is_held: bool | None = None  # as last sent
        self._sent = -math.inf  # s, when

    def silence(self, now: float) -> float:
        """Return the time since the last message, s; 0 before the first one."""
        return 0.0 if self._is_held is None else now - self._sent

    def update(self, is_held: bool, now: float) -> None:
        """Send a message if the state has changed or the period is over; ``now`` in s."""
        if is_held is not self._is_held or now >= self._sent + HOLD_PERIOD:
            self._is_held, self._sent = is_held, now
            self._publish(is_held)


class HoldReaders:
    """Follows which nodes read launcher/hold: without a driver nothing may be let go.

    ``driver``: its name or full name; empty for any node but :data:`ONLOOKERS`.
    """

    def __init__(self, driver: str = "") -> None:
        self._driver = driver
        self._since: dict[str, float] = {}  # s, when each driver was found, by its full name
        self._mismatches: tuple[str, ...] = ()

    def note(self, nodes: Collection[str], mismatches: Mapping[str, str], now: float) -> None:
        """Note the full names of the nodes that read it at ``now``, s.

        ``mismatches``: nodes that would, and why no message can reach them.
        """
        self._since = {n: self._since.get(n, now) for n in nodes if self._is_driver(n)}
        self._mismatches = tuple(
            f"{node} {problem}" for node, problem in mismatches.items() if self._is_driver(node)
        )

    def absence(self) -> str:
        """Return the reason why no driver reads launcher/hold; empty if a driver does."""
        if self._since:
            return ""
        text = "launcher/hold: " + (f"not read by {self._driver}" if self._driver else "no reader")
        return f"{text} ({'; '.join(self._mismatches)})" if self._mismatches else text

    def refusal(self, now: float) -> str:
        """Return why nothing may be let go; empty once each driver has received a true.

        It is sent every :data:`HOLD_PERIOD`, and a driver lets go only after it has received one.
        """
        new = sorted(node for node, since in self._since.items() if now < since + HOLD_TIMEOUT)
        if new:
            return f"launcher/hold: {', '.join(new)} found less than {HOLD_TIMEOUT:g} s ago"
        return self.absence()

    def _is_driver(self, node: str) -> bool:
        name = node.rpartition("/")[2]
        if self._driver:
            return self._driver in (name, node)
        return not name.startswith(ONLOOKERS)


class HoldPublishers:
    """Follows which nodes publish launcher/hold: a second one could release a held chaser.

    ``own`` is the full name of the launcher that asks, which publishes the topic once.  ``began``
    (s) is when it started.  ``is_disputed`` is True if another publisher was found or heard since
    :meth:`begin`.
    """

    def __init__(self, own: str, began: float) -> None:
        self._own, self._began = own, began
        self._others: tuple[str, ...] = ()  # full names, a second node of the launcher's name too
        self._nameless_since = self._heard_since = math.inf  # s
        self._lets_go = self._has_heard_own = False
        self.is_disputed = False

    def begin(self) -> None:
        """Start a release, at which there is one publisher: discard earlier messages."""
        self._heard_since = math.inf
        self._lets_go = self._has_heard_own = self.is_disputed = False

    def hear(self, is_held: bool, lets_go: bool, now: float) -> None:
        """Note a message of launcher/hold, the launcher's own or another node's.

        ``lets_go``: the launcher has sent false last.  Once that has come back, a true is not its
        own.
        """
        if lets_go and self._lets_go and is_held and self._has_heard_own:
            self._heard_since = min(self._heard_since, now)
            self.is_disputed = True
        self._has_heard_own = lets_go and (not is_held or (self._lets_go and self._has_heard_own))
        self._lets_go = lets_go

    @property
    def has_nameless(self) -> bool:
        """True while a publisher is there whose node is not known yet."""
        return min(self._nameless_since, self._heard_since) < math.inf and not self._others

    def note(self, nodes: Sequence[str], n_nameless: int, now: float) -> None:
        """Note the full name of the node of each publisher at ``now``, s.

        ``n_nameless``: publishers whose node is not known.
        """
        if now > self._heard_since + MEETING_TIME:  # it has left, and was named if it could be
            self._heard_since = math.inf
        self._others = tuple(sorted((Counter(nodes) - Counter([self._own])).elements()))
        self._nameless_since = min(self._nameless_since, now) if n_nameless else math.inf
        self.is_disputed = self.is_disputed or bool(self._others) or n_nameless > 0

    def conflict(self, now: float) -> str:
        """Return the complaint that other nodes publish launcher/hold; empty if none does."""
        others = " and ".join(self._others)
        if not others and now > min(self._nameless_since, self._heard_since) + NAMING_TIME:
            others = "a node without a name"
        if not others:
            return ""
        return (
            f"launcher/hold: published by {self._own} and by {others}: must be one node: end the "
            "other one (a killed one is forgotten after 12 s)"
        )

    def refusal(self, now: float) -> str:
        """Return why nothing may be let go; empty if no other node can publish it."""
        if conflict := self.conflict(now):
            return conflict
        if self.has_nameless:
            return "launcher/hold: published by a node that is not known yet"
        if now < self._began + MEETING_TIME:
            return f"{self._own}: started less than {MEETING_TIME:g} s ago"
        return ""
