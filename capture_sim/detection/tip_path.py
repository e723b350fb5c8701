"""The tip's path in the cone's frame, from measurements with noise, holes and late comers.

How far the measurements scatter is found from themselves: a vehicle of 20 kg moves
smoothly, so that over four measurements in a row its place is a parabola in time, and
what is left of the third difference is noise.  Where there is none, the path is the
measured one, to the last bit.  Where there is, it is a parabola fitted (least squares) to
the measurements before and after, as many as the noise asks for and the allowed delay
permits.  docs/detection.md has the reasoning in numbers.
"""

from __future__ import annotations

import math
from bisect import bisect_left, bisect_right
from collections import deque
from dataclasses import dataclass
from itertools import pairwise
from statistics import median

import numpy as np

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


@dataclass(frozen=True)
class Place:
    """Where the tip is at one instant, and how well that is known.

    Attributes
    ----------
    t
        s.
    axial, lateral
        Ahead of BE and off the axis, m.
    variance
        Of axial and lateral, m^2.
    axial_rate, lateral_rate
        m/s.
    count
        Measurements that it was found from.
    """

    t: float
    axial: float
    lateral: float
    variance: tuple[float, float] = (0.0, 0.0)
    axial_rate: float = math.nan
    lateral_rate: float = math.nan
    count: int = 1

    @property
    def distance(self) -> float:
        """To the centre of BE, m; without what noise adds to a length on average."""
        square = self.axial**2 + self.lateral**2
        if self.variance == (0.0, 0.0):
            return math.hypot(self.axial, self.lateral)
        return math.sqrt(max(square - sum(self.variance), 0.0))

    @property
    def speed(self) -> float:
        """In the cone's frame, m/s."""
        return math.hypot(self.axial_rate, self.lateral_rate)

    @property
    def uncertainty(self) -> float:
        """Standard deviation of the distance, m."""
        square = self.axial**2 + self.lateral**2
        if square == 0.0:
            return math.sqrt(max(self.variance))
        weighted = self.axial**2 * self.variance[0] + self.lateral**2 * self.variance[1]
        return math.sqrt(weighted / square)


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
        """Take in a third difference, see :func:`third_difference`."""
        self._left.append(abs(left))
        self._count += 1
        # of many, one more does not change the median
        if self.known and (self._count <= 4 * ENOUGH or self._count % ENOUGH == 0):
            self.deviation = median(self._left) / _MEDIAN

    @property
    def known(self) -> bool:
        """Whether there are enough measurements."""
        return self._count >= ENOUGH


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
        self._tip: list[tuple[float, float]] = []
        self._rigid: list[tuple[float, float]] = []
        self._rate: list[tuple[float, float] | None] = []
        self._noise = (NoiseEstimate(), NoiseEstimate())
        self._buffer_noise = (0.0, 0.0)
        self._deviation = (0.0, 0.0)
        self._half_window = 0.0
        self._interval = 0.0
        self._count = 0
        self._judged = -math.inf  # up to here places have been handed out

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
        self,
        t: float,
        tip: tuple[float, float],
        rigid: tuple[float, float],
        rate: tuple[float, float] | None,
        buffer_noise: tuple[float, float] = (0.0, 0.0),
    ) -> list[Place]:
        """Take in a measurement; return the places that it completes.

        Parameters
        ----------
        t
            s.
        tip
            Axial and lateral place of the tip, m.
        rigid
            ... and where it would be with the buffer at rest: that moves smoothly.
        rate
            Rates of ``tip`` where they are measured, m/s.
        buffer_noise
            What the buffer's own measurements add to the scatter of ``tip``, m.
        """
        self._buffer_noise = buffer_noise
        if not self._t or t > self._t[-1]:
            self._t.append(t)
            self._tip.append(tip)
            self._rigid.append(rigid)
            self._rate.append(rate)
            self._learn()
            self._forget()
            if self._half_window == 0.0 and len(self._t) > 1 and self._judged == self._t[-2]:
                self._judged = t  # as nearly always: no need to search
                return [self._at(len(self._t) - 1)]
        else:
            place = bisect_left(self._t, t)
            if self._t[place] == t:
                return []
            self._t.insert(place, t)
            self._tip.insert(place, tip)
            self._rigid.insert(place, rigid)
            self._rate.insert(place, rate)
        return self._hand_out(self._t[-1], self._half_window)

    def finish(self) -> list[Place]:
        """Return the places that were still waiting for later measurements."""
        return self._hand_out(math.inf, self._half_window)

    def fit(self, t: float, begin: float, end: float, degree: int) -> Place:
        """Return the place at ``t`` from a polynomial through [begin, end]."""
        i, k = bisect_left(self._t, begin), bisect_right(self._t, end)
        times = np.array(self._t[i:k]) - t
        tips = np.array(self._tip[i:k])
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
        variance = float(inverse[0, 0]) * np.square(self._deviation)
        rates = coefficients[1] / spread if len(coefficients) > 1 else np.zeros(2)
        return Place(
            t,
            float(coefficients[0, 0]),
            float(coefficients[0, 1]),
            (float(variance[0]), float(variance[1])),
            float(rates[0]),
            float(rates[1]),
            n,
        )

    def rate_over(self, begin: float, end: float) -> tuple[float, float]:
        """Return the mean speed over a stretch and its standard deviation, m/s."""
        i, k = bisect_left(self._t, begin), bisect_right(self._t, end)
        times = np.array(self._t[i:k])
        if times.size < 3:
            return math.inf, math.inf
        times -= times.mean()
        square = float(times @ times)
        rates = times @ np.array(self._tip[i:k]) / square
        return math.hypot(*rates), math.hypot(*self._deviation) / math.sqrt(2.0 * square)

    def _learn(self) -> None:
        """Estimate the noise anew, and from it the window."""
        t = self._t[-4:]
        if len(t) == 4 and t[3] - t[0] <= 3.0 * self.gap:
            w_0, w_1, w_2, w_3 = third_difference(t)
            p_0, p_1, p_2, p_3 = self._rigid[-4:]
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
            del self._t[0], self._tip[0], self._rigid[0], self._rate[0]

    def _hand_out(self, newest: float, wait: float) -> list[Place]:
        first = bisect_right(self._t, self._judged)
        # a rounding of the stamps must not put off a place
        last = bisect_right(self._t, newest - wait + 1e-9)
        apart = SPACING - 1e-9 if self._half_window > 0.0 else 0.0
        places = []
        for i in range(first, last):
            if self._t[i] - self._judged >= apart:
                places.append(self._at(i))
                self._judged = self._t[i]
        return places

    def _at(self, i: int) -> Place:
        t = self._t[i]
        if self._half_window == 0.0:
            rate = self._rate[i]
            if rate is None:
                rate = self._difference(i)
            return Place(t, *self._tip[i], (0.0, 0.0), *rate)
        begin, end = t - self._half_window, t + self._half_window
        return self.fit(t, begin, end, 2)

    def _difference(self, i: int) -> tuple[float, float]:
        """Return the mean rate since the measurement before, m/s."""
        if i == 0:
            return 0.0, 0.0
        dt = self._t[i] - self._t[i - 1]
        (a0, l0), (a1, l1) = self._tip[i - 1], self._tip[i]
        return (a1 - a0) / dt, (l1 - l0) / dt
