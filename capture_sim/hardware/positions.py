"""Positions that are sent to the rig: the run-up from rest, and positions ahead of the lag."""

from __future__ import annotations

import math
from collections import deque

import numpy as np

from capture_sim.hardware.guard import LoopLimits
from capture_sim.hardware.law import TipState

#: Time constant by which a prediction follows the lag, s.
LAG_TIME = 0.03


class RunUp:
    """The path from rest to the vehicles' first position and speed, which ends at time 0.

    ``span`` is its duration, s, rounded to a whole number of steps.
    """

    def __init__(self, first: TipState, span: float, step: float) -> None:
        self.n_steps = round(span / step)
        self._first, self._span = first, self.n_steps * step

    def pose(self, t: float) -> TipState:
        """Return the position at a time from ``-span`` to 0, s."""
        first, span = self._first, self._span
        u = 1.0 + t / span if span else 1.0
        rates = np.array(first[4:]) * (u * u * (3.0 - 2.0 * u) if span else 0.0)
        back = span * (0.5 - u**3 + 0.5 * u**4)
        place = np.array(first[1:4]) - back * np.array(first[4:])
        return TipState(t, *place.tolist(), *rates.tolist())


class Predictor:
    """Predicts the tip's position at the time when the rig's answer is used, from its velocity."""

    def __init__(self, first: TipState, step: float, limits: LoopLimits) -> None:
        self._step, self._max_lag = step, limits.latency
        # the lag of the time limit, followed from rest, needs a quarter of the acceleration
        speed = math.hypot(first.vx, first.vy)
        self._tau = max(LAG_TIME, math.sqrt(4.0 * limits.latency * speed / limits.acceleration))
        self._lead = self._lead_rate = 0.0  # s
        self._past: deque[TipState] = deque(maxlen=2048)  # the newest first

    def add(self, tip: TipState) -> None:
        """Note the tip's position at the next step."""
        self._past.appendleft(tip)

    def follow(self, lag: float) -> None:
        """Let the lead follow the lag, s, for a step; for steps outside of contacts.

        Smoothly: its jumps would be jumps of the position.
        """
        lag = min(lag, self._max_lag)
        rate = ((lag - self._lead) / self._tau - 2.0 * self._lead_rate) / self._tau
        self._lead_rate += self._step * rate
        self._lead += self._step * self._lead_rate

    def predicted(self) -> TipState:
        """Return where the tip will be, by its difference over a span of the lead.

        Such a difference does not follow a buffer that rings faster than that.  The time stays that
        of the tip, by which the answer is known.
        """
        tip = self._past[0]
        n = min(round(self._lead / self._step), len(self._past) - 1)
        before = self._past[n]
        rates = np.array(tip[4:])
        if n > 0:
            rates = (np.array(tip[1:4]) - np.array(before[1:4])) / (n * self._step)
        place = np.array(tip[1:4]) + self._lead * rates
        return TipState(tip.t, *place.tolist(), *rates.tolist())
