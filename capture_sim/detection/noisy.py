"""The capture detector for measurements with noise, gaps and delays.

The noise is estimated from the measurements: a vehicle of 20 kg moves smoothly, so over four
successive measurements its position is a parabola in time, and their third difference is noise.
Without noise the path is the measured one.  With noise it is a parabola fitted (least squares) to
as many measurements before and after as the noise requires and ``detector.max_delay`` permits.
docs/detection.md has the reasoning in numbers.
"""

from __future__ import annotations

import math
from bisect import bisect_left, bisect_right
from collections import deque
from collections.abc import Iterable
from itertools import pairwise
from statistics import mean, median
from types import SimpleNamespace
from typing import NamedTuple

import numpy as np

from capture_sim.detection.align import Aligner, Observation, Source, Values
from capture_sim.detection.clocks import MAX_OFFSET, WARN_OFFSET, ClockOffsets
from capture_sim.detection.exact import (
    GUARD,
    CaptureState,
    CaptureStatus,
    Cause,
    Criteria,
    Place,
    decide,
    decide_at_end,
    enter,
    new_memory,
    note_push,
    reason,
    wall_gap,
)
from capture_sim.kernels import plain
from capture_sim.model.equations import tip_motion
from capture_sim.scene.parts import Scene

#: Largest and smallest number of third differences for an estimate of the noise.
MAX_DIFFERENCES, MIN_DIFFERENCES = 200, 8
#: Standard deviation of a fitted position that the window aims at, as a share of the radius.
ACCURACY = 0.06
#: A measurement further from the fit than this many standard deviations is left out.
OUTLIER = 5.0
#: Smallest interval between fitted positions, s: closer ones share nearly all measurements.
MIN_FIT_INTERVAL = 0.003
#: The median of |x| of a normal x with standard deviation 1.
_MEDIAN = 0.6744897501960817
#: Number of measurements of the buffer that are averaged if a single one is too noisy.
_N_AVERAGED = 12
#: Deflection of a pushed buffer in standard deviations: a single measurement of many decides.
BUFFER_GUARD = 6.0
#: Two poses of a noisy source never agree this closely, m and rad.
_EQUAL_POSE = 1e-12
#: If speeds are noisy, rest is also evaluated over this many ``still_time``.
_LONGEST_REST = 4.0
#: Period of the comparison of the sources' clocks, s (wall).
_CLOCK_PERIOD = 0.1

# a few hundred measurements a second: not worth compiled functions of their own
_tip_motion, _decide, _note_push = plain(tip_motion), plain(decide), plain(note_push)
_enter, _wall_gap = plain(enter), plain(wall_gap)


def third_difference(t: list[float]) -> tuple[float, float, float, float]:
    """Return weights of four measurements whose sum is 0 for any parabola in time.

    They are scaled so that the sum has the standard deviation of one independent measurement.
    """
    t_0, t_1, t_2, t_3 = t
    w_0 = 1.0 / ((t_0 - t_1) * (t_0 - t_2) * (t_0 - t_3))
    w_1 = 1.0 / ((t_1 - t_0) * (t_1 - t_2) * (t_1 - t_3))
    w_2 = 1.0 / ((t_2 - t_0) * (t_2 - t_1) * (t_2 - t_3))
    w_3 = 1.0 / ((t_3 - t_0) * (t_3 - t_1) * (t_3 - t_2))
    norm = math.sqrt(w_0 * w_0 + w_1 * w_1 + w_2 * w_2 + w_3 * w_3)
    return w_0 / norm, w_1 / norm, w_2 / norm, w_3 / norm


class NoiseEstimate:
    """The noise of a smooth signal's measurements, from its third differences.

    The median makes it insensitive to the few differences that a hit makes large.
    """

    def __init__(self) -> None:
        #: Standard deviation of a measurement; 0 while it is not known.
        self.deviation = 0.0
        self._differences: deque[float] = deque(maxlen=MAX_DIFFERENCES)
        self._count = 0

    def add(self, difference: float) -> None:
        """Add a third difference, see :func:`third_difference`."""
        self._differences.append(abs(difference))
        self._count += 1
        # of many, one more does not change the median
        is_due = self._count <= 4 * MIN_DIFFERENCES or self._count % MIN_DIFFERENCES == 0
        if self.known and is_due:
            self.deviation = median(self._differences) / _MEDIAN

    @property
    def known(self) -> bool:
        """True if there are enough measurements."""
        return self._count >= MIN_DIFFERENCES


class MeasuredTip(NamedTuple):
    """The tip in the cone's frame, as measured: axial and lateral."""

    place: tuple[float, float]  # m
    rigid: tuple[float, float]  # with the buffer at rest, which moves smoothly, m
    rate: tuple[float, float] | None  # of ``place``, m/s; None if not measured


class TipPath:
    """Follows the tip; returns its places in the order of time, each once.

    ``radius`` is that of the capture zone, m, which the accuracy refers to; ``delay``, s, the
    longest wait after an instant for the measurements of its fit.  With noise below ``clean``, m,
    the measurements are used directly.  Nothing is fitted over a gap longer than ``gap``, s, but
    never less than three intervals.  :meth:`fit` may reach back by ``keep``, s.
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
        self._t_returned = -math.inf  # stamp of the last place that was returned

    @property
    def deviation(self) -> tuple[float, float]:
        """Standard deviation of an axial and lateral measurement, m; 0 below ``clean``."""
        return self._deviation

    @property
    def half_window(self) -> float:
        """Delay after an instant until its place is returned, s."""
        return self._half_window

    @property
    def knows_noise(self) -> bool:
        """True if there were enough measurements to estimate the noise."""
        return all(noise.known for noise in self._noise)

    @property
    def gap(self) -> float:
        """The longest interval without a measurement that is no gap, s."""
        return max(self._gap, 3.0 * self._interval)

    def add(
        self, t: float, tip: MeasuredTip, buffer_noise: tuple[float, float] = (0.0, 0.0)
    ) -> list[Place]:
        """Add a measurement at ``t`` (s); return the places that it completes.

        ``buffer_noise`` is the standard deviation that the buffer's measurements add to it, m.
        """
        self._buffer_noise = buffer_noise
        if not self._t or t > self._t[-1]:
            self._t.append(t)
            self._tips.append(tip)
            self._learn()
            self._forget()
            if self._half_window == 0.0 and len(self._t) > 1 and self._t_returned == self._t[-2]:
                self._t_returned = t  # as nearly always: no need to search
                return [self._at(len(self._t) - 1)]
        else:
            index = bisect_left(self._t, t)
            if self._t[index] == t:
                return []
            self._t.insert(index, t)
            self._tips.insert(index, tip)
        return self._completed(self._t[-1], self._half_window)

    def finish(self) -> list[Place]:
        """Return the places that still wait for later measurements."""
        return self._completed(math.inf, self._half_window)

    def fit(self, t: float, begin: float, end: float, degree: int) -> Place:
        """Return the place at ``t`` from a polynomial through [begin, end]."""
        i, k = bisect_left(self._t, begin), bisect_right(self._t, end)
        times = np.array(self._t[i:k]) - t
        tips = np.array([tip.place for tip in self._tips[i:k]])
        spread = max(float(np.abs(times).max()), 1e-9)
        is_used = np.ones(times.size, dtype=bool)
        sigma = np.maximum(self._deviation, 1e-12)
        while True:
            n = int(is_used.sum())
            basis = np.vander(times / spread, min(degree, n - 1) + 1, increasing=True)
            inverse = np.linalg.inv(basis[is_used].T @ basis[is_used])
            coefficients = inverse @ (basis[is_used].T @ tips[is_used])
            deviations = (np.abs(tips - basis @ coefficients) / sigma).max(axis=1) * is_used
            worst = int(deviations.argmax())
            # one at a time: it has bent the parabola towards itself and away from the others
            if deviations[worst] <= OUTLIER or n <= max(degree + 2, 0.8 * times.size):
                break
            is_used[worst] = False
        variance = max(float(inverse[0, 0]), 0.0) * np.square(self._deviation)
        rates = coefficients[1] / spread if len(coefficients) > 1 else np.zeros(2)
        numbers = *coefficients[0].tolist(), *rates.tolist(), *variance.tolist()
        return Place._make((t, *numbers, n))

    def rate_over(self, begin: float, end: float) -> tuple[float, float]:
        """Return the mean speed over an interval and its standard deviation, m/s."""
        i, k = bisect_left(self._t, begin), bisect_right(self._t, end)
        times = np.array(self._t[i:k])
        if times.size < 3:
            return math.inf, math.inf
        times -= times.mean()
        square = float(times @ times)
        rates = times @ np.array([tip.place for tip in self._tips[i:k]]) / square
        return math.hypot(*rates), math.hypot(*self._deviation) / math.sqrt(2.0 * square)

    def _learn(self) -> None:
        """Update the estimate of the noise, and from it the window."""
        t = self._t[-4:]
        if len(t) == 4 and t[3] - t[0] <= 3.0 * self.gap:
            w_0, w_1, w_2, w_3 = third_difference(t)
            p_0, p_1, p_2, p_3 = (tip.rigid for tip in self._tips[-4:])
            for i in (0, 1):
                self._noise[i].add(w_0 * p_0[i] + w_1 * p_1[i] + w_2 * p_2[i] + w_3 * p_3[i])
        self._count += 1
        if self._count <= MIN_DIFFERENCES or self._count % MIN_DIFFERENCES == 0:
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

    def _completed(self, newest: float, wait: float) -> list[Place]:
        """Return the places that need no measurement later than ``newest``, s."""
        first = bisect_right(self._t, self._t_returned)
        # a round-off error of the stamps must not delay a place
        last = bisect_right(self._t, newest - wait + 1e-9)
        interval = MIN_FIT_INTERVAL - 1e-9 if self._half_window > 0.0 else 0.0
        places = []
        for i in range(first, last):
            if self._t[i] - self._t_returned >= interval:
                places.append(self._at(i))
                self._t_returned = self._t[i]
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
    """Follows one run, as it is measured, to a verdict; :class:`ExactDetector` has the verdicts.

    Measurements may be noisy, missing, late and in any order.  With noise the path is smoothed
    (:class:`TipPath`): then a status is about an instant up to ``detector.max_delay`` before, and
    decisions allow for the remaining noise.

    The scene gives the geometry of buffer and cone, and the criteria.  ``is_released``: the run
    begins with the chaser's release, as simulated ones do.  Otherwise nothing is evaluated before
    the tip has approached BE by ``detector.capture_radius``.  ``last``: no later instant is
    evaluated, s.
    """

    def __init__(self, scene: Scene, *, is_released: bool = True, last: float = math.inf) -> None:
        part = scene.detector
        self._last_instant = last
        self.aligner = Aligner(part.max_data_gap)
        #: The source whose clock differs from the others' by more than :data:`WARN_OFFSET`, and
        #: by how much, s; None if none does.
        self.clock_offset: tuple[Source, float] | None = None
        self._clocks = ClockOffsets()
        self._clocks_compared = -math.inf  # s, arrival
        self._scene = scene
        self._criteria = Criteria.of(scene)
        memory = new_memory(has_approached=is_released)
        fields = zip(memory.dtype.names or (), *memory.tolist(), strict=True)
        self._memory = SimpleNamespace(**dict(fields))
        self._path = TipPath(
            radius=part.capture_radius,
            delay=part.max_delay,
            clean=part.max_contact_gap / 4.0,
            gap=part.max_data_gap,
            keep=_LONGEST_REST * part.min_still_time,
        )
        self._earliest = math.inf  # s, smallest stamp
        self._place: Place | None = None  # the last that was evaluated
        self._t_rest_end = -math.inf  # s, the last instant before the approach
        self._t_gap_end = -math.inf  # s, the first instant after the last gap
        self._is_contact_unseen = False  # the tip may have met the cone in a gap
        self._last: tuple[Observation, MeasuredTip] | None = None
        self._buffer_noise = (NoiseEstimate(), NoiseEstimate())
        self._buffer: deque[tuple[float, float, float]] = deque(maxlen=_N_AVERAGED)

    @property
    def delay(self) -> float:
        """Present delay between an instant and its evaluation, s; 0 without noise."""
        return self._path.half_window

    @property
    def scatter(self) -> tuple[float, float]:
        """Standard deviation of the tip's measured axial and lateral position, m."""
        return self._path.deviation

    @property
    def _state(self) -> CaptureState:
        return CaptureState(int(self._memory.state))

    def measure(
        self, source: Source, t: float, values: Values, arrival: float | None = None
    ) -> list[CaptureStatus]:
        """Add a measurement of one source, see :class:`Aligner`; return the statuses it completes.

        ``arrival`` is the message's time of arrival, s by any clock; None if it shows nothing
        about the source's clock, as in a simulation.
        """
        self._earliest = min(self._earliest, t)
        if arrival is not None:
            self._compare_clocks(source, t, arrival)
        if self.clocks_differ:
            return []
        return self._update_all(self.aligner.add(source, t, values))

    @property
    def clocks_differ(self) -> bool:
        """True while a source's clock is so far from the others' that nothing is evaluated."""
        return self.clock_offset is not None and abs(self.clock_offset[1]) > MAX_OFFSET

    def _compare_clocks(self, source: Source, t: float, arrival: float) -> None:
        self._clocks.add(source, t, arrival)
        if arrival - self._clocks_compared >= _CLOCK_PERIOD:
            self._clocks_compared = arrival
            worst = self._clocks.worst()
            self.clock_offset = worst if worst and abs(worst[1]) > WARN_OFFSET else None

    def _update_all(self, observations: Iterable[Observation]) -> list[CaptureStatus]:
        return [self.update(each) for each in observations if each.t <= self._last_instant]

    def update(self, observation: Observation) -> CaptureStatus:
        """Add measurements of all sources at one instant; return the status."""
        tip = self._tip(observation)
        if self._is_frozen(observation):
            return self._status(observation, tip)
        if self._last is None:
            self._memory.since = observation.t  # a bench's clock may count from 1970
        if self._last is None or observation.t > self._last[0].t:
            self._last = (observation, tip)
            self._buffer.append((observation.t, observation.buffer[0], observation.buffer[1]))
            if self._state is CaptureState.APPROACH and self._pushed():
                _note_push(self._criteria, self._memory, observation.t, *tip.place)
        for place in self._path.add(observation.t, tip, self._buffer_scatter()):
            self._decide(place)
        return self._status(observation, tip)

    def finish(self, *, cut: bool = False) -> list[CaptureStatus]:
        """Close the run; return the remaining statuses, that of the end last.

        The last status is that of the last measurement: a verdict, or undecided.  It is final,
        unless a cut run has no verdict.  If nothing was measured, its numbers are NaN and its
        time is the earliest stamp.  ``cut``: the run was ended before its time.
        """
        remaining = self._update_all(self.aligner.flush())
        memory = self._memory
        if self._last is None:
            memory.state, memory.cause = CaptureState.UNDECIDED, Cause.NOT_MEASURED
            if self.clocks_differ:
                self._blame_clocks()
            unknown = (math.nan,) * 3
            memory.since = self._earliest if math.isfinite(self._earliest) else 0.0
            observation = Observation(memory.since, unknown, unknown, unknown[:2])
            return [self._status(observation, self._tip(observation), is_over=not cut)]
        for place in self._path.finish():
            self._decide(place)
        last = self._place
        if self._state.is_verdict:
            pass
        elif self.clocks_differ:
            self._blame_clocks()
        elif last is None:  # too few measurements to know the noise, and so an approach
            memory.state, memory.cause = CaptureState.UNDECIDED, Cause.NOT_APPROACHED
            memory.since = self._last[0].t
        elif self._state <= CaptureState.CONTACT:
            if last.size > 1:
                # the end of a fit is its least certain position: fit the last second once more
                end = self._path.fit(last.t, last.t - self._criteria.still_time, last.t, 1)
                memory.outwards = end.axial * end.axial_rate + end.lateral * end.lateral_rate
                memory.speed = math.hypot(end.axial_rate, end.lateral_rate)
                memory.distance = math.hypot(end.axial, end.lateral)
            # a source that stopped before the end: the rest of the run is unknown
            is_blind = self.aligner.newest - last.t > self._path.gap
            decide_at_end(self._criteria, memory, self._corner_time, cut=cut or is_blind)
            self._doubt_miss()
        return [*remaining, self._status(*self._last, is_over=not cut)]

    def _blame_clocks(self) -> None:
        assert self.clock_offset is not None
        memory = self._memory
        memory.state, memory.cause = CaptureState.UNDECIDED, Cause.CLOCKS_DIFFER
        memory.value = abs(self.clock_offset[1])

    def _is_frozen(self, observation: Observation) -> bool:
        """Return True if a noisy source repeats its last pose exactly, i.e. has lost tracking."""
        if self._path.half_window == 0.0 or self._last is None:
            return False
        last = self._last[0]
        return any(
            max(abs(a - b) for a, b in zip(new[:3], old[:3], strict=True)) < _EQUAL_POSE
            for new, old in (
                (observation.chaser, last.chaser),
                (observation.target, last.target),
            )
        )

    @property
    def _corner_time(self) -> float:
        """Length by which a parabola shortens the corner of a hit in the path, m per m/s.

        That is 3/16 of the change of velocity times the window.
        """
        return 3.0 / 16.0 * 2.0 * self._path.half_window

    def _decide(self, place: Place) -> None:
        if not (self._memory.has_approached or self._path.knows_noise):
            return  # noise would be taken for an approach
        if not self._memory.has_approached:
            self._t_rest_end = place.t
        if self._place is not None and place.t - self._place.t > self._path.gap:
            self._note_gap(self._place, place)
        criteria, is_still = self._criteria, False
        if place.size > 1 and self._state <= CaptureState.CONTACT:
            # the mean speed over a longer time is known better
            for times in (1.0, _LONGEST_REST):
                begin = place.t - times * criteria.still_time
                if begin < max(self._t_rest_end, self._t_gap_end):
                    break  # it includes the rest before the release, or a gap
                speed, deviation = self._path.rate_over(begin, place.t)
                is_still = is_still or speed + GUARD * deviation < criteria.still_speed
        _decide(criteria, self._memory, place, is_still, self._corner_time)
        self._doubt_miss()
        self._place = place

    def _note_gap(self, before: Place, after: Place) -> None:
        """Note that it is unknown what the tip did between two places."""
        memory, criteria = self._memory, self._criteria
        memory.zone_since = memory.still_since = math.nan
        self._t_gap_end = after.t
        wall_distance = _wall_gap(criteria, before.axial, before.lateral)[0]
        if wall_distance > memory.fastest * (after.t - before.t):
            return  # too far away to have met the cone
        if self._state is not CaptureState.APPROACH or not memory.has_approached:
            return
        unseen = self.aligner.values_between(Source.BUFFER, before.t, after.t)
        strokes = [(stroke, torsion) for stroke, torsion, *_ in unseen]
        if any(self._is_pushed(strokes[: k + 1]) for k in range(len(strokes))):
            _enter(memory, CaptureState.CONTACT, Cause.AT_CONE, after.t, 0.0)
        else:
            self._is_contact_unseen = True

    def _doubt_miss(self) -> None:
        """Turn a miss into undecided if the tip may have met the cone in a gap."""
        memory = self._memory
        is_doubtful = memory.cause in (Cause.MOVED_AWAY, Cause.END_NOT_APPROACHING)
        if self._is_contact_unseen and self._state is CaptureState.MISSED and is_doubtful:
            _enter(
                memory, CaptureState.UNDECIDED, Cause.CONTACT_UNSEEN, memory.since, memory.nearest
            )

    def _pushed(self) -> bool:
        """Update the buffer's noise while it is at rest; return True if it has been pushed."""
        if len(self._buffer) >= 4:
            four = list(self._buffer)[-4:]
            weights = third_difference([t for t, _, _ in four])
            for i, noise in enumerate(self._buffer_noise):
                noise.add(sum(w * item[1 + i] for w, item in zip(weights, four, strict=True)))
        return self._is_pushed([(stroke, torsion) for _, stroke, torsion in self._buffer])

    def _is_pushed(self, values: list[tuple[float, float]]) -> bool:
        """Return True if the last of these strokes (m) and torsions (rad) show a push."""
        if not self._buffer_noise[0].known:
            return False
        limit, arm = self._criteria.contact_gap, self._criteria.rest_length
        stroke, torsion = values[-1]
        scatter = max(self._buffer_scatter())
        if BUFFER_GUARD * scatter >= limit:
            # a single measurement is too noisy: take the mean of several
            if len(values) < _N_AVERAGED:
                return False
            stroke, torsion = (mean(column) for column in zip(*values[-_N_AVERAGED:], strict=True))
            scatter /= math.sqrt(_N_AVERAGED)
        return max(abs(stroke), abs(torsion) * arm) > limit + BUFFER_GUARD * scatter

    def _buffer_scatter(self) -> tuple[float, float]:
        """Return the contribution of the buffer's noise to the tip's noise, m."""
        stroke, torsion = (noise.deviation for noise in self._buffer_noise)
        return stroke, torsion * self._criteria.rest_length

    def _tip(self, observation: Observation) -> MeasuredTip:
        """Return the tip in the cone's frame from the measured poses and buffer."""
        a, h_0, front = self._criteria.a, self._criteria.rest_length, self._scene.cone.L_T
        chaser, target, (stroke, torsion) = (
            observation.chaser[:3],
            observation.target[:3],
            observation.buffer[:2],
        )
        theta, phi, theta_T = chaser[2], chaser[2] + torsion, target[2]
        rates: Values = (0.0,) * 8
        if observation.has_rates:
            stroke_rate, torsion_rate = observation.buffer[2:]
            rates = (
                *observation.chaser[3:],
                observation.chaser[5] + torsion_rate,
                stroke_rate,
                *observation.target[3:],
            )
        sS, cS, sT, cT = math.sin(theta), math.cos(theta), math.sin(theta_T), math.cos(theta_T)
        sines = (sS, cS, math.sin(phi), math.cos(phi), sT, cT)
        px, py, wx, wy = _tip_motion((*chaser, phi, h_0 + stroke, *target, *rates), a, *sines)
        at_rest = (*chaser, theta, h_0, *target, *rates)
        bx, by, _, _ = _tip_motion(at_rest, a, sS, cS, sS, cS, sT, cT)
        rate = (-wx, wy) if observation.has_rates else None
        return MeasuredTip((-(px + front), py), (-(bx + front), by), rate)

    def _status(
        self, observation: Observation, tip: MeasuredTip, *, is_over: bool = False
    ) -> CaptureStatus:
        rate, place, memory = tip.rate, self._place, self._memory
        if place is not None and (rate is None or place.size > 1):
            rate = (place.axial_rate, place.lateral_rate)
        return CaptureStatus(
            t=observation.t,
            state=self._state,
            final=is_over or self._state.is_verdict,
            distance=math.hypot(*tip.place),
            axial_offset=tip.place[0],
            lateral_offset=tip.place[1],
            relative_attitude=observation.chaser[2] - observation.target[2],
            relative_speed=math.nan if rate is None else math.hypot(*rate),
            nearest_distance=float(memory.nearest),
            time_in_state=observation.t - float(memory.since),
            reason=reason(self._criteria, int(memory.cause), float(memory.value)),
        )
