"""Positions to send to the rig: the run-up from rest, and positions predicted ahead of the lag."""

from __future__ import annotations

import math
from collections import deque

import numpy as np

from capture_sim.hardware.guard import LoopLimits
from capture_sim.hardware.law import TipState

#: Smallest time constant with which the lead of a prediction follows the lag, s.
LAG_TIME = 0.03


class RunUp:
    """Straight path of the tip from rest to its first position and velocity, reached at time 0.

    ``first`` is the tip's state at time 0.  ``span`` (s) is the duration of the path, rounded to a
    whole number of steps of length ``step`` (s).
    """

    def __init__(self, first: TipState, span: float, step: float) -> None:
        self.n_steps = round(span / step)
        self._first, self._span = first, self.n_steps * step

    def pose(self, t: float) -> TipState:
        """Return the tip's state on the path at a time (s) from ``-span`` to 0."""
        first, span = self._first, self._span
        u = 1.0 + t / span if span else 1.0
        rates = np.array(first[4:]) * (u * u * (3.0 - 2.0 * u))  # without a path: the first speed
        back = span * (0.5 - u**3 + 0.5 * u**4)
        place = np.array(first[1:4]) - back * np.array(first[4:])
        return TipState(t, *place.tolist(), *rates.tolist())


class Predictor:
    """Predicts the position that the tip will have when the rig's answer acts on the vehicles.

    The prediction is linear in time.  It is ahead of the tip by the lead (s), which follows the
    measured lag.
    """

    def __init__(self, first: TipState, step: float, limits: LoopLimits) -> None:
        self._step, self._max_lag = step, limits.latency
        # a jump of the lag from 0 to its limit then takes a quarter of the acceleration limit
        speed = math.hypot(first.vx, first.vy)
        self._tau = max(LAG_TIME, math.sqrt(4.0 * limits.latency * speed / limits.acceleration))
        self._lead = self._lead_rate = 0.0  # s
        self._past: deque[TipState] = deque(maxlen=2048)  # the newest first

    def add(self, tip: TipState) -> None:
        """Add the tip's state at the next step, from which :meth:`predicted` starts."""
        self._past.appendleft(tip)

    def follow(self, lag: float) -> None:
        """Move the lead towards the lag (s) for one step; to be called only outside contacts.

        The lead changes smoothly, because a jump of the lead would be a jump of the sent position.
        The lag is limited to the latency limit.
        """
        lag = min(lag, self._max_lag)
        rate = ((lag - self._lead) / self._tau - 2.0 * self._lead_rate) / self._tau
        self._lead_rate += self._step * rate
        self._lead += self._step * self._lead_rate

    def predicted(self) -> TipState:
        """Return the tip's state extrapolated by the lead.

        The velocity is the mean over an equally long time before, which smooths oscillations of the
        buffer with shorter periods.  ``t`` remains the time of the latest state, because the rig
        stamps its answer with it.
        """
        tip = self._past[0]
        n = min(round(self._lead / self._step), len(self._past) - 1)
        before = self._past[n]
        rates = np.array(tip[4:])
        if n > 0:
            rates = (np.array(tip[1:4]) - np.array(before[1:4])) / (n * self._step)
        place = np.array(tip[1:4]) + self._lead * rates
        return TipState(tip.t, *place.tolist(), *rates.tolist())
