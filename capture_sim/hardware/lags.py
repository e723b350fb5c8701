"""Measured lags of a loop: the latency of the wrenches, and the lag of the rig's servo."""

from __future__ import annotations

import statistics
from collections import deque

from capture_sim.hardware.law import TipState

#: Number of latest measurements whose median is the lag.
N_LATEST = 25
#: Speed up to which the tip is too slow to measure the servo lag, m/s.
MIN_SPEED = 1e-3


class Lags:
    """Latency and servo lag of a loop, as medians of the latest measurements.

    ``servo`` is the time (s) by which the rig's measured tip is behind the position that was sent.
    It is 0 before the first :meth:`update_servo`.
    """

    def __init__(self) -> None:
        self.servo = 0.0
        self._latencies: deque[float] = deque(maxlen=N_LATEST)
        self._servo_lags: deque[float] = deque(maxlen=N_LATEST)

    @property
    def latency(self) -> float:
        """Median time from a position to the use of its wrench, s; 0 without a measurement."""
        return statistics.median(self._latencies) if self._latencies else 0.0

    def add_latency(self, latency: float) -> None:
        """Add the latency (s) of the wrench that acts in the present step."""
        self._latencies.append(latency)

    def add_tip(self, sent: TipState, measured: TipState) -> None:
        """Add a measurement of the servo lag: the position sent, and the tip measured in answer.

        It is the distance behind, along the velocity, over the speed.  A slow tip is not used.
        """
        speed2 = sent.vx**2 + sent.vy**2
        if speed2 > MIN_SPEED**2:
            behind = (sent.x - measured.x) * sent.vx + (sent.y - measured.y) * sent.vy
            self._servo_lags.append(max(behind / speed2, 0.0))

    def update_servo(self) -> None:
        """Set ``servo`` to the median of the latest measurements of the servo lag."""
        if self._servo_lags:
            self.servo = statistics.median(self._servo_lags)
