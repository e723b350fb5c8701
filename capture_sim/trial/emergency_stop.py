"""The emergency stop, as an input: while it is pressed or unknown, nothing is let go.

The input tells the launcher that the bench is stopped; it stops nothing itself.
"""

from __future__ import annotations

import math


class EmergencyStop:
    """State of the emergency stop.

    ``is_required``: a state must be known, and its messages must go on.  ``max_silence``: longest
    time between two messages then, s.
    """

    def __init__(self, *, is_required: bool = False, max_silence: float = 1.0) -> None:
        self._is_required, self._max_silence = is_required, max_silence
        self._is_pressed = False
        self._heard = -math.inf  # s

    def note(self, *, is_pressed: bool, now: float) -> None:
        """Note a message at ``now``, s."""
        self._is_pressed, self._heard = is_pressed, now

    def problem(self, now: float) -> str:
        """Return why the chaser must be held; empty if it may move."""
        if self._is_pressed:
            return "emergency_stop: pressed"
        if not self._is_required or now <= self._heard + self._max_silence:
            return ""
        if math.isinf(self._heard):
            return "emergency_stop: unknown, no message"
        silence = now - self._heard
        return f"emergency_stop: silent for {silence:.3g} s: must be at most {self._max_silence:g}"
