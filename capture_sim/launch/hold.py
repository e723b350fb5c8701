"""The output launcher/hold: when it is sent, and the meaning of its silence.

A driver holds its chaser when the last message is older than :data:`HOLD_TIMEOUT`.  The thread that
decides also sends: a stalled launcher sends nothing, so it cannot let go.
"""

from __future__ import annotations

import math
from collections.abc import Callable

#: Sent at least this often, s (wall).
HOLD_PERIOD = 0.1
#: A driver holds after this long without a message, s.
HOLD_TIMEOUT = 0.5


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
