"""The lag of a loop: from a position that is sent to the effect of its wrench on the vehicles."""

from __future__ import annotations

import statistics
from collections import deque

from capture_sim.hardware.law import TipState

#: A lag is the median of so many measurements.
N_LATEST = 25
#: A tip that is slower than this shows no lag, m/s.
MIN_SPEED = 1e-3


class Lags:
    """Latency and servo lag of a loop.

    ``servo``: by how much the rig's measured tip is behind the position that it answers, s; it is
    updated outside of contacts.
    """

    def __init__(self) -> None:
        self.servo = 0.0
        self._latencies: deque[float] = deque(maxlen=N_LATEST)
        self._servo_lags: deque[float] = deque(maxlen=N_LATEST)

    @property
    def latency(self) -> float:
        """From a position to the use of its wrench, s, by the stamps."""
        return statistics.median(self._latencies) if self._latencies else 0.0

    def add_latency(self, latency: float) -> None:
        """Note the latency of the wrench in use, s."""
        self._latencies.append(latency)

    def add_tip(self, sent: TipState, measured: TipState) -> None:
        """Note the rig's measured tip, outside of contacts, and the position that it answers."""
        speed2 = sent.vx**2 + sent.vy**2
        if speed2 > MIN_SPEED**2:
            behind = (sent.x - measured.x) * sent.vx + (sent.y - measured.y) * sent.vy
            self._servo_lags.append(max(behind / speed2, 0.0))

    def update_servo(self) -> None:
        """Update the servo lag by the measured tips."""
        if self._servo_lags:
            self.servo = statistics.median(self._servo_lags)
