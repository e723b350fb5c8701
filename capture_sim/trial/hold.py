"""The output launcher/hold: its period, its readers, and the meaning of its silence.

A driver holds its chaser when the last message is older than :data:`HOLD_TIMEOUT`.  The thread that
decides also sends: a stalled launcher sends nothing, so it cannot let go.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping

#: Sent at least this often, s (wall).
HOLD_PERIOD = 0.1
#: A driver holds after this long without a message, s.
HOLD_TIMEOUT = 0.5
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
        """Return why no driver is reached; empty if one is."""
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
