"""The capture detector on what a real bench measures: noise, holes and late comers.

How far the measurements scatter is found from themselves: a vehicle of 20 kg moves
smoothly, so that over four measurements in a row its place is a parabola in time, and
what is left of the third difference is noise.  Where there is none, the path is the
measured one.  Where there is, it is a parabola fitted (least squares) to the measurements
before and after, as many as the noise asks for and the allowed delay permits.
docs/detection.md has the reasoning in numbers.
"""

from __future__ import annotations

import math
from bisect import bisect_left, bisect_right
from collections import deque
from itertools import pairwise
from statistics import mean, median
from types import SimpleNamespace
from typing import NamedTuple

import numpy as np

from capture_sim.detection.align import Aligner, Observation, Source, Values
from capture_sim.detection.exact import (
    GUARD,
    CaptureState,
    CaptureStatus,
    Cause,
    Criteria,
    Place,
    decide,
    decide_at_end,
    feel_push,
    new_memory,
    reason,
)
from capture_sim.kernels import plain
from capture_sim.model.equations import tip_motion
from capture_sim.scene.parts import Scene

#: Third differences that the noise is estimated from, at most and at least.
MEMORY, ENOUGH = 200, 8
#: The fit shall know the tip this well where the delay allows it, of the capture radius.
ACCURACY = 0.06
#: A fitted point further off than this many standard deviations is left out.
OUTLIER = 5.0
#: Fitted places are this far apart at least, s: closer ones share nearly all measurements.
SPACING = 0.003
#: The median of |x| of a normal x with standard deviation 1.
_MEDIAN = 0.6744897501960817
#: Measurements of the buffer that are averaged where a single one scatters too much.
_SMOOTHED = 12
#: The buffer is asked at every measurement and answered by a single one: it is pushed by so
#: many standard deviations.
BUFFER_GUARD = 6.0
#: Poses that scatter never agree this closely, m and rad.
_SAME = 1e-12
#: A stand is looked for over this many ``still_time`` as well, where speeds scatter.
_LONGEST_STAND = 4.0

# a few hundred measurements a second: not worth compiled functions of their own
_tip_motion, _decide, _feel_push = plain(tip_motion), plain(decide), plain(feel_push)


def third_difference(t: list[float]) -> tuple[float, float, float, float]:
    """Return weights of four measurements whose sum is 0 for any parabola in time.

    Scaled so that the sum over independent measurements scatters as one of them does.
    """
    t_0, t_1, t_2, t_3 = t
    w_0 = 1.0 / ((t_0 - t_1) * (t_0 - t_2) * (t_0 - t_3))
    w_1 = 1.0 / ((t_1 - t_0) * (t_1 - t_2) * (t_1 - t_3))
    w_2 = 1.0 / ((t_2 - t_0) * (t_2 - t_1) * (t_2 - t_3))
    w_3 = 1.0 / ((t_3 - t_0) * (t_3 - t_1) * (t_3 - t_2))
    norm = math.sqrt(w_0 * w_0 + w_1 * w_1 + w_2 * w_2 + w_3 * w_3)
    return w_0 / norm, w_1 / norm, w_2 / norm, w_3 / norm


class NoiseEstimate:
    """The scatter of a smooth signal's measurements, from its third differences.

    The median makes it blind to the few that a hit makes large.

    Attributes
    ----------
    deviation : float
        Standard deviation of one measurement; 0 while it is not known.
    """

    def __init__(self) -> None:
        self.deviation = 0.0
        self._left: deque[float] = deque(maxlen=MEMORY)
        self._count = 0

    def add(self, left: float) -> None:
        """Add a third difference, see :func:`third_difference`."""
        self._left.append(abs(left))
        self._count += 1
        # of many, one more does not change the median
        if self.known and (self._count <= 4 * ENOUGH or self._count % ENOUGH == 0):
            self.deviation = median(self._left) / _MEDIAN

    @property
    def known(self) -> bool:
        """Whether there are enough measurements."""
        return self._count >= ENOUGH


class MeasuredTip(NamedTuple):
    """The tip in the cone's frame, as measured: axial and lateral.

    Attributes
    ----------
    place
        m.
    rigid
        Where it would be with the buffer at rest, which moves smoothly, m.
    rate
        Of ``place``, m/s; None where it is not measured.
    """

    place: tuple[float, float]
    rigid: tuple[float, float]
    rate: tuple[float, float] | None


class TipPath:
    """Follows the tip; hands out its places in order of time, each once.

    Parameters
    ----------
    radius
        Of the capture zone, m: the scale that the accuracy is measured by.
    delay
        s, how long after an instant measurements may be waited for to know the tip then.
    clean
        m, scatter below which the measurements are taken as they are.
    gap
        s; over a longer hole nothing is fitted.  Never less than three intervals.
    keep
        s, how far back :meth:`fit` may be asked.
    """

    def __init__(
        self, *, radius: float, delay: float, clean: float, gap: float, keep: float
    ) -> None:
        self._radius, self._delay, self._clean, self._gap = radius, delay, clean, gap
        self._keep = keep + 2.0 * delay
        self._t: list[float] = []
        self._tips: list[MeasuredTip] = []
        self._noise = (NoiseEstimate(), NoiseEstimate())
        self._buffer_noise = (0.0, 0.0)
        self._deviation = (0.0, 0.0)
        self._half_window = 0.0
        self._interval = 0.0
        self._count = 0
        self._handed_out = -math.inf  # up to here places have been handed out

    @property
    def deviation(self) -> tuple[float, float]:
        """Scatter of one measurement of axial and lateral, m; 0 where it does not matter."""
        return self._deviation

    @property
    def half_window(self) -> float:
        """How long after an instant its place is handed out, s."""
        return self._half_window

    @property
    def gap(self) -> float:
        """The longest time without a measurement that counts as none, s."""
        return max(self._gap, 3.0 * self._interval)

    def add(
        self, t: float, tip: MeasuredTip, buffer_noise: tuple[float, float] = (0.0, 0.0)
    ) -> list[Place]:
        """Add a measurement at ``t`` (s); return the places that it completes.

        ``buffer_noise``: what the buffer's measurements add to the scatter of ``tip``, m.
        """
        self._buffer_noise = buffer_noise
        if not self._t or t > self._t[-1]:
            self._t.append(t)
            self._tips.append(tip)
            self._learn()
            self._forget()
            if self._half_window == 0.0 and len(self._t) > 1 and self._handed_out == self._t[-2]:
                self._handed_out = t  # as nearly always: no need to search
                return [self._at(len(self._t) - 1)]
        else:
            place = bisect_left(self._t, t)
            if self._t[place] == t:
                return []
            self._t.insert(place, t)
            self._tips.insert(place, tip)
        return self._hand_out(self._t[-1], self._half_window)

    def finish(self) -> list[Place]:
        """Return the places that were still waiting for later measurements."""
        return self._hand_out(math.inf, self._half_window)

    def fit(self, t: float, begin: float, end: float, degree: int) -> Place:
        """Return the place at ``t`` from a polynomial through [begin, end]."""
        i, k = bisect_left(self._t, begin), bisect_right(self._t, end)
        times = np.array(self._t[i:k]) - t
        tips = np.array([tip.place for tip in self._tips[i:k]])
        spread = max(float(np.abs(times).max()), 1e-9)
        kept = np.ones(times.size, dtype=bool)
        sigma = np.maximum(self._deviation, 1e-12)
        while True:
            n = int(kept.sum())
            basis = np.vander(times / spread, min(degree, n - 1) + 1, increasing=True)
            inverse = np.linalg.inv(basis[kept].T @ basis[kept])
            coefficients = inverse @ (basis[kept].T @ tips[kept])
            off = (np.abs(tips - basis @ coefficients) / sigma).max(axis=1) * kept
            worst = int(off.argmax())
            # one at a time: it has bent the parabola towards itself and away from the others
            if off[worst] <= OUTLIER or n <= max(degree + 2, 0.8 * times.size):
                break
            kept[worst] = False
        variance = max(float(inverse[0, 0]), 0.0) * np.square(self._deviation)
        rates = coefficients[1] / spread if len(coefficients) > 1 else np.zeros(2)
        numbers = *coefficients[0].tolist(), *rates.tolist(), *variance.tolist()
        return Place._make((t, *numbers, n))

    def rate_over(self, begin: float, end: float) -> tuple[float, float]:
        """Return the mean speed over a while and its standard deviation, m/s."""
        i, k = bisect_left(self._t, begin), bisect_right(self._t, end)
        times = np.array(self._t[i:k])
        if times.size < 3:
            return math.inf, math.inf
        times -= times.mean()
        square = float(times @ times)
        rates = times @ np.array([tip.place for tip in self._tips[i:k]]) / square
        return math.hypot(*rates), math.hypot(*self._deviation) / math.sqrt(2.0 * square)

    def _learn(self) -> None:
        """Estimate the noise anew, and from it the window."""
        t = self._t[-4:]
        if len(t) == 4 and t[3] - t[0] <= 3.0 * self.gap:
            w_0, w_1, w_2, w_3 = third_difference(t)
            p_0, p_1, p_2, p_3 = (tip.rigid for tip in self._tips[-4:])
            for i in (0, 1):
                self._noise[i].add(w_0 * p_0[i] + w_1 * p_1[i] + w_2 * p_2[i] + w_3 * p_3[i])
        self._count += 1
        if self._count <= ENOUGH or self._count % ENOUGH == 0:
            recent = self._t[-51:]
            if len(recent) > 1:
                self._interval = median(b - a for a, b in pairwise(recent))
        axial, lateral = (
            math.hypot(of_pose.deviation, of_buffer)
            for of_pose, of_buffer in zip(self._noise, self._buffer_noise, strict=True)
        )
        if math.hypot(axial, lateral) < self._clean:
            self._deviation, self._half_window = (0.0, 0.0), 0.0
            return
        self._deviation = (axial, lateral)
        # a parabola's middle has 9/4 of the variance of a mean
        count = (1.5 * max(axial, lateral) / (ACCURACY * self._radius)) ** 2
        self._half_window = min(max(0.5 * count, 2.0) * self._interval, self._delay)

    def _forget(self) -> None:
        while self._t[0] < self._t[-1] - self._keep:
            del self._t[0], self._tips[0]

    def _hand_out(self, newest: float, wait: float) -> list[Place]:
        first = bisect_right(self._t, self._handed_out)
        # a rounding of the stamps must not put off a place
        last = bisect_right(self._t, newest - wait + 1e-9)
        spacing = SPACING - 1e-9 if self._half_window > 0.0 else 0.0
        places = []
        for i in range(first, last):
            if self._t[i] - self._handed_out >= spacing:
                places.append(self._at(i))
                self._handed_out = self._t[i]
        return places

    def _at(self, i: int) -> Place:
        t = self._t[i]
        if self._half_window == 0.0:
            tip = self._tips[i]
            return Place(t, *tip.place, *(tip.rate or self._difference(i)))
        return self.fit(t, t - self._half_window, t + self._half_window, 2)

    def _difference(self, i: int) -> tuple[float, float]:
        """Return the mean rate since the measurement before, m/s."""
        if i == 0:
            return 0.0, 0.0
        dt = self._t[i] - self._t[i - 1]
        (a0, l0), (a1, l1) = self._tips[i - 1].place, self._tips[i].place
        return (a1 - a0) / dt, (l1 - l0) / dt


class NoisyDetector:
    """Follows one run, as it is measured, to a verdict; see :class:`ExactDetector` for those.

    Measurements may scatter, be missing and come late or in any order.  Where they scatter
    the path is smoothed (:class:`TipPath`): then a status is about an instant up to
    ``detector.max_delay`` before, and decisions allow for what is left of the noise.

    Parameters
    ----------
    scene
        Geometry of buffer and cone, and the ``detector`` part.

    Attributes
    ----------
    aligner : Aligner
        Of the measurements of :meth:`measure`.
    """

    def __init__(self, scene: Scene) -> None:
        limits = scene.detector
        self.aligner = Aligner(limits.max_data_gap)
        self._scene = scene
        self._criteria = Criteria.of(scene)
        memory = new_memory()
        named = zip(memory.dtype.names or (), *memory.tolist(), strict=True)
        self._memory = SimpleNamespace(**dict(named))
        self._path = TipPath(
            radius=limits.capture_radius,
            delay=limits.max_delay,
            clean=limits.max_contact_gap / 4.0,
            gap=limits.max_data_gap,
            keep=_LONGEST_STAND * limits.min_still_time,
        )
        self._place: Place | None = None  # the last that was decided on
        self._last: tuple[Observation, MeasuredTip] | None = None
        self._buffer_noise = (NoiseEstimate(), NoiseEstimate())
        self._buffer: deque[tuple[float, float, float]] = deque(maxlen=_SMOOTHED)

    @property
    def delay(self) -> float:
        """How long after an instant it is decided on at present, s; 0 without noise."""
        return self._path.half_window

    @property
    def scatter(self) -> tuple[float, float]:
        """Standard deviation of the tip's measured axial and lateral place, m."""
        return self._path.deviation

    @property
    def _state(self) -> CaptureState:
        return CaptureState(int(self._memory.state))

    def measure(self, source: Source, t: float, values: Values) -> list[CaptureStatus]:
        """Take a measurement of one source; return the statuses that it completes.

        Parameters
        ----------
        source, t, values
            See :class:`Aligner`.
        """
        return [self.update(seen) for seen in self.aligner.add(source, t, values)]

    def update(self, seen: Observation) -> CaptureStatus:
        """Take a measurement of all sources; return the status."""
        tip = self._tip(seen)
        if self._frozen(seen):
            return self._status(seen, tip)
        if self._last is None:
            self._memory.since = seen.t  # a bench's clock may count from 1970
        if self._last is None or seen.t > self._last[0].t:
            self._last = (seen, tip)
            self._buffer.append((seen.t, seen.buffer[0], seen.buffer[1]))
            if self._state is CaptureState.APPROACH and self._pushed():
                _feel_push(self._criteria, self._memory, seen.t, *tip.place)
        for place in self._path.add(seen.t, tip, self._buffer_scatter()):
            self._decide(place)
        return self._status(seen, tip)

    def finish(self, *, cut: bool = False) -> list[CaptureStatus]:
        """Close the run; return what was still waiting, the status of the end last.

        A verdict is given even if none was reached.  The last status is that of the last
        measurement; without any, all of it is NaN.

        Parameters
        ----------
        cut
            The run was ended before its end: what was not decided by then stays so.
        """
        rest = [self.update(seen) for seen in self.aligner.flush()]
        memory = self._memory
        if self._last is None:
            if not cut:
                memory.state, memory.cause = CaptureState.MISSED, Cause.NOT_MEASURED
            nowhere = (math.nan,) * 3
            seen = Observation(0.0, nowhere, nowhere, nowhere[:2])
            return [self._status(seen, self._tip(seen))]
        for place in self._path.finish():
            self._decide(place)
        last = self._place
        if last is not None and not cut and self._state <= CaptureState.CONTACT:
            if last.size > 1:
                # the end of a fit is its weakest place: one more of the last second
                end = self._path.fit(last.t, last.t - self._criteria.still_time, last.t, 1)
                memory.outwards = end.axial * end.axial_rate + end.lateral * end.lateral_rate
                memory.speed = math.hypot(end.axial_rate, end.lateral_rate)
            decide_at_end(self._criteria, memory, self._rounding)
        return [*rest, self._status(*self._last)]

    def _frozen(self, seen: Observation) -> bool:
        """Whether a pose that scatters is repeated: its source has lost sight and says the last."""
        if self._path.half_window == 0.0 or self._last is None:
            return False
        last = self._last[0]
        return any(
            max(abs(a - b) for a, b in zip(new[:3], old[:3], strict=True)) < _SAME
            for new, old in ((seen.chaser, last.chaser), (seen.target, last.target))
        )

    @property
    def _rounding(self) -> float:
        """What a parabola takes off the corner that a hit makes in the path, s per m/s.

        That is 3/16 of the change of velocity in half a window.
        """
        return 3.0 / 16.0 * 2.0 * self._path.half_window

    def _decide(self, place: Place) -> None:
        if self._place is not None and place.t - self._place.t > self._path.gap:
            # nobody knows what happened meanwhile
            self._memory.zone_since = self._memory.still_since = math.nan
        limits, stood = self._criteria, False
        if place.size > 1 and self._state <= CaptureState.CONTACT:
            # a speed is known only after a while: the same question for longer times
            for times in (1.0, _LONGEST_STAND):
                begin = place.t - times * limits.still_time
                speed, unsure = self._path.rate_over(begin, place.t)
                stood = stood or speed + GUARD * unsure < limits.still_speed
        _decide(limits, self._memory, place, stood, self._rounding)
        self._place = place

    def _pushed(self) -> bool:
        """Learn the buffer's noise while it is at rest; see whether it has been pushed."""
        if len(self._buffer) >= 4:
            four = list(self._buffer)[-4:]
            weights = third_difference([seen[0] for seen in four])
            for i, noise in enumerate(self._buffer_noise):
                noise.add(sum(w * seen[1 + i] for w, seen in zip(weights, four, strict=True)))
        if not self._buffer_noise[0].known:
            return False
        limit, arm = self._criteria.contact_gap, self._criteria.rest_length
        _, stroke, torsion = self._buffer[-1]
        scatter = max(self._buffer_scatter())
        if BUFFER_GUARD * scatter >= limit:
            # one measurement says nothing: the mean of some
            if len(self._buffer) < _SMOOTHED:
                return False
            stroke = mean(seen[1] for seen in self._buffer)
            torsion = mean(seen[2] for seen in self._buffer)
            scatter /= math.sqrt(_SMOOTHED)
        return max(abs(stroke), abs(torsion) * arm) > limit + BUFFER_GUARD * scatter

    def _buffer_scatter(self) -> tuple[float, float]:
        """Return what the buffer's measurements add to the tip's scatter, m."""
        stroke, torsion = (noise.deviation for noise in self._buffer_noise)
        return stroke, torsion * self._criteria.rest_length

    def _tip(self, seen: Observation) -> MeasuredTip:
        """Return the tip in the cone's frame from the measured poses and buffer."""
        a, h_0, front = self._criteria.a, self._criteria.rest_length, self._scene.cone.L_T
        chaser, target, (stroke, torsion) = seen.chaser[:3], seen.target[:3], seen.buffer[:2]
        theta, phi, theta_T = chaser[2], chaser[2] + torsion, target[2]
        rates: Values = (0.0,) * 8
        if seen.has_rates:
            stroke_rate, torsion_rate = seen.buffer[2:]
            rates = (*seen.chaser[3:], seen.chaser[5] + torsion_rate, stroke_rate, *seen.target[3:])
        sS, cS, sT, cT = math.sin(theta), math.cos(theta), math.sin(theta_T), math.cos(theta_T)
        turned = (sS, cS, math.sin(phi), math.cos(phi), sT, cT)
        px, py, wx, wy = _tip_motion((*chaser, phi, h_0 + stroke, *target, *rates), a, *turned)
        at_rest = (*chaser, theta, h_0, *target, *rates)
        bx, by, _, _ = _tip_motion(at_rest, a, sS, cS, sS, cS, sT, cT)
        rate = (-wx, wy) if seen.has_rates else None
        return MeasuredTip((-(px + front), py), (-(bx + front), by), rate)

    def _status(self, seen: Observation, tip: MeasuredTip) -> CaptureStatus:
        rate, place, memory = tip.rate, self._place, self._memory
        if place is not None and (rate is None or place.size > 1):
            rate = (place.axial_rate, place.lateral_rate)
        return CaptureStatus(
            t=seen.t,
            state=self._state,
            final=self._state > CaptureState.CONTACT,
            distance=math.hypot(*tip.place),
            axial_offset=tip.place[0],
            lateral_offset=tip.place[1],
            relative_attitude=seen.chaser[2] - seen.target[2],
            relative_speed=math.nan if rate is None else math.hypot(*rate),
            nearest_distance=float(memory.nearest),
            time_in_state=seen.t - float(memory.since),
            reason=reason(self._criteria, int(memory.cause), float(memory.value)),
        )
