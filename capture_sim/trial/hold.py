"""The output launcher/hold: its period, its readers, its single publisher, and its silence.

A driver holds its chaser when the last message is older than :data:`HOLD_TIMEOUT`.  The same thread
decides and sends.  So a stalled launcher sends nothing, and its driver holds the chaser.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Collection, Mapping, Sequence

#: Maximum time between two messages, s (wall).
HOLD_PERIOD = 0.1
#: A driver holds its chaser after this time without a message, s.
HOLD_TIMEOUT = 0.5
#: A publisher is discovered before its node's name: a conflict is reported after this time, s.
NAMING_TIME = 0.3
#: A launcher releases nothing for this time after its start, s, because it may not have discovered
#: another launcher yet.
MEETING_TIME = 1.0
#: First characters of the names of readers that are no driver: `ros2 topic` and `ros2 bag`.
ONLOOKERS = ("_ros2cli", "rosbag2_recorder")


class HoldOutput:
    """Publishes whether the chaser is held, at each change and at least every period.

    ``publish`` is called with True to hold the chaser and with False to let it go.
    """

    def __init__(self, publish: Callable[[bool], None]) -> None:
        self._publish = publish
        self._is_held: bool | None = None  # value last sent
        self._sent = -math.inf  # s, time of the last message

    def silence(self, now: float) -> float:
        """Return the time since the last message, s; 0 before the first one."""
        return 0.0 if self._is_held is None else now - self._sent

    def update(self, is_held: bool, now: float) -> None:
        """Send a message if the state has changed or the period has elapsed; ``now`` in s."""
        if is_held is not self._is_held or now >= self._sent + HOLD_PERIOD:
            self._is_held, self._sent = is_held, now
            self._publish(is_held)


class HoldReaders:
    """Monitors the nodes that read launcher/hold: without a driver, no release is permitted.

    ``driver``: name or full name of the driver; empty accepts any node except :data:`ONLOOKERS`.
    """

    def __init__(self, driver: str = "") -> None:
        self._driver = driver
        self._since: dict[str, float] = {}  # s, time of discovery of each driver, by full name
        self._mismatches: tuple[str, ...] = ()

    def note(self, nodes: Collection[str], mismatches: Mapping[str, str], now: float) -> None:
        """Note the full names of the nodes that read launcher/hold at ``now``, s.

        ``mismatches``: by full name, why no message can reach a node that has subscribed.
        """
        self._since = {n: self._since.get(n, now) for n in nodes if self._is_driver(n)}
        self._mismatches = tuple(
            f"{node} {problem}" for node, problem in mismatches.items() if self._is_driver(node)
        )

    def absence(self) -> str:
        """Return why launcher/hold reaches no driver; empty if it reaches a driver."""
        if self._since:
            return ""
        text = "launcher/hold: " + (f"not read by {self._driver}" if self._driver else "no reader")
        return f"{text} ({'; '.join(self._mismatches)})" if self._mismatches else text

    def refusal(self, now: float) -> str:
        """Return why a release is refused; empty once each driver has received a true message.

        True messages are sent every :data:`HOLD_PERIOD`.  A driver lets the chaser go only after it
        has received one.
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


class HoldListener:
    """launcher/hold as another node receives it: is the chaser held again after a release?

    What a held chaser does decides nothing: the detector evaluates no measurement from then on.  A
    driver holds its chaser too when the messages stop, see :data:`HOLD_TIMEOUT`; if they go on, the
    launcher only stood still, and so did this node's knowledge.
    """

    def __init__(self) -> None:
        self._let_go = math.nan  # s, latest message that lets go
        self.is_held = False  # it was let go, and a later message holds it

    def note(self, *, is_held: bool, now: float) -> None:
        """Note a message at ``now``, s."""
        if not is_held:
            self._let_go = now
        elif not math.isnan(self._let_go):
            self.is_held = True

    def may_be_held(self, now: float) -> bool:
        """Return True if the chaser is held again, or if the messages have stopped, at ``now``."""
        return self.is_held or now > self._let_go + HOLD_TIMEOUT


class HoldPublishers:
    """Monitors the nodes that publish launcher/hold: there must be only one publisher.

    With two publishers, one could release the chaser while the other commands a hold.  ``own``:
    full name of this launcher, which has one publisher; ``began``: start time of the launcher, s.
    ``is_disputed``: another publisher was found or heard since :meth:`begin`.
    """

    def __init__(self, own: str, began: float) -> None:
        self._own, self._began = own, began
        self._others: tuple[str, ...] = ()  # full names; includes a second node of the own name
        self._nameless_since = self._heard_since = math.inf  # s
        self._lets_go = self._has_heard_own = False
        self.is_disputed = False

    def begin(self) -> None:
        """Forget the messages heard before a release: there is only one publisher now."""
        self._heard_since = math.inf
        self._lets_go = self._has_heard_own = self.is_disputed = False

    def hear(self, is_held: bool, lets_go: bool, now: float) -> None:
        """Note a received message of launcher/hold, of this launcher or of another node.

        ``lets_go``: this launcher has sent false last.  Once it has received its own false, a true
        message comes from another node.
        """
        if lets_go and self._lets_go and is_held and self._has_heard_own:
            self._heard_since = min(self._heard_since, now)
            self.is_disputed = True
        self._has_heard_own = lets_go and (not is_held or (self._lets_go and self._has_heard_own))
        self._lets_go = lets_go

    @property
    def has_nameless(self) -> bool:
        """True while there is a publisher whose node name is still unknown."""
        return min(self._nameless_since, self._heard_since) < math.inf and not self._others

    def note(self, nodes: Sequence[str], n_nameless: int, now: float) -> None:
        """Note the full name of the node of each publisher at ``now``, s.

        ``n_nameless``: number of publishers whose node name is unknown.
        """
        if now > self._heard_since + MEETING_TIME:  # the other publisher has left, or has a name
            self._heard_since = math.inf
        self._others = tuple(sorted((Counter(nodes) - Counter([self._own])).elements()))
        self._nameless_since = min(self._nameless_since, now) if n_nameless else math.inf
        self.is_disputed = self.is_disputed or bool(self._others) or n_nameless > 0

    def conflict(self, now: float) -> str:
        """Return an error text that names other publishers of launcher/hold; empty without any."""
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
        """Return why a release is refused; empty if no other node can publish launcher/hold."""
        if conflict := self.conflict(now):
            return conflict
        if self.has_nameless:
            return "launcher/hold: published by a node that is not known yet"
        if now < self._began + MEETING_TIME:
            return f"{self._own}: started less than {MEETING_TIME:g} s ago"
        return ""
