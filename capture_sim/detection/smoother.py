"""The smoother, which estimates the path of the tip from measurements with noise.

The noise is estimated from the measurements themselves.  A vehicle of 20 kg moves smoothly, so over
four successive measurements its position is a parabola in time, and the third difference of the
measurements is noise.  Without noise the path consists of the measured positions.  With noise each
position comes from a parabola fitted (least squares) to the measurements before and after it, as
many as the noise requires and ``detector.max_delay`` permits.  docs/detection.md gives the
reasons with numbers.
"""

from __future__ import annotations

import math
from bisect import bisect_left, bisect_right
from itertools import pairwise
from statistics import median
from typing import NamedTuple

import numpy as np

from capture_sim.detection.criteria import Place
from capture_sim.detection.nearest import Half
from capture_sim.detection.noise import MIN_DIFFERENCES, NoiseEstimate, third_difference

#: Desired standard deviation of a fitted position, as a share of the capture radius.
ACCURACY = 0.06
#: Measurements further from the fit than this number of standard deviations are left out.
OUTLIER = 5.0
#: Smallest number of measurements in a window to fit a parabola to each half of them.
_MIN_SIZE = 8
#: Largest difference, in standard deviations, of the positions fitted with a window and half of it.
_AGREEMENT = 1.5
#: Smallest number of measurements between two gaps from which a position is fitted.
_MIN_BETWEEN_GAPS = 3
#: Smallest interval between fitted positions, s; closer positions share nearly all measurements.
MIN_FIT_INTERVAL = 0.003


class MeasuredTip(NamedTuple):
    """Measured position of the tip in the cone's frame, axial and lateral."""

    place: tuple[float, float]  # m
    rigid: tuple[float, float]  # m, position computed with the buffer at rest, so it moves smoothly
    rate: tuple[float, float] | None  # of ``place``, m/s; None if not measured


class _Window(NamedTuple):
    """Measurements near an instant, and the parabola fitted to them."""

    first: int  # number of the first measurement
    tips: np.ndarray  # (n, 2), m
    degree: int
    basis: np.ndarray  # (n, degree + 1)
    fitted: np.ndarray  # (n, 2), m
    centre: np.ndarray  # (2,), m, fitted position at the instant
    gain: float  # variance of the centre divided by that of a measurement

    @classmethod
    def of(cls, first: int, times: np.ndarray, tips: np.ndarray) -> _Window:
        """Fit a parabola to ``tips``, (n, 2), m, at ``times``, (n,), s, after the instant.

        With few measurements the fit is a line or a constant.  ``first`` is the number of the first
        measurement.
        """
        n = len(times)
        degree = 2 if n >= _MIN_SIZE else max(min(n // 2 - 1, 1), 0)
        basis = np.vander(times / max(float(np.abs(times).max()), 1e-9), degree + 1, True)
        inverse = _inverse(basis)
        coefficients = inverse @ tips
        gain = float(inverse[0] @ inverse[0])
        return cls(first, tips, degree, basis, basis @ coefficients, coefficients[0], gain)

    def is_noise(self, sigma: np.ndarray) -> bool:
        """Return True if noise of deviation ``sigma``, (2,), m, explains the fit's residuals."""
        square = np.minimum(np.square((self.tips - self.fitted) / sigma), OUTLIER**2)
        dof = 2 * max(len(self.tips) - self.degree - 1, 1)
        return bool(square.sum() / dof - 1.0 <= 3.0 * math.sqrt(2.0 / dof))


def _inverse(basis: np.ndarray) -> np.ndarray:
    """Return the pseudo-inverse, (k, n), of a basis of full rank, (n, k), for least squares.

    It solves the normal equations, which are well conditioned because the times in the basis are
    scaled to at most 1.  A decomposition (QR or SVD) would take several times as long.
    """
    transposed = basis.T
    return np.asarray(np.linalg.solve(transposed @ basis, transposed))


class TipPath:
    """Estimator of the tip's path, which turns measurements into places in the order of time.

    ``radius`` (m) is the radius of the capture zone, from which the required accuracy follows.
    ``delay`` (s) is the longest wait after an instant for later measurements.  If the noise is
    below ``clean`` (m), the measurements are used directly.  An interval without measurements that
    is longer than ``gap`` (s) and than three usual intervals counts as a gap, see :attr:`gap`.
    No fit includes measurements from both sides of a gap, because a hit there would bend the path.
    Measurements stay in memory for at least ``keep`` (s), for :meth:`fit` and :meth:`rate_over`.
    """

    def __init__(
        self, *, radius: float, delay: float, clean: float, gap: float, keep: float
    ) -> None:
        self._radius, self._delay, self._clean, self._gap = radius, delay, clean, gap
        self._keep = keep + 2.0 * delay
        self._t: list[float] = []
        self._tips: list[MeasuredTip] = []
        self._noise = (NoiseEstimate(), NoiseEstimate())
        self._buffer_noise, self._least_noise = (0.0, 0.0), 0.0
        self._deviation = (0.0, 0.0)
        self._half_window = 0.0
        self._interval = 0.0
        self._count = 0
        self._gap_ends: list[float] = []  # s, times of the first measurements after a gap
        self._t_returned = -math.inf  # s, time of the last place that was returned
        self._n_forgotten = 0  # number of measurements removed from the memory

    @property
    def deviation(self) -> tuple[float, float]:
        """Standard deviations of a measurement, axial and lateral, m; 0 if the noise is small."""
        return self._deviation

    @property
    def half_window(self) -> float:
        """Half of the length of the fit's window, s; a place is returned with this delay."""
        return self._half_window

    @property
    def knows_noise(self) -> bool:
        """True if the noise is known, i.e. if there were enough measurements to estimate it."""
        return all(noise.known for noise in self._noise)

    @property
    def gap(self) -> float:
        """Longest interval without measurements that does not count as a gap, s."""
        return max(self._gap, 3.0 * self._interval)

    def add(
        self,
        t: float,
        tip: MeasuredTip,
        buffer_noise: tuple[float, float] = (0.0, 0.0),
        least_noise: float = 0.0,
    ) -> list[Place]:
        """Add a measurement at ``t`` (s), later than the last; return the places that it completes.

        ``buffer_noise`` (m, axial and lateral) are the standard deviations of the tip's position
        due to the buffer's measurements.  ``least_noise`` (m) is that due to quantised poses, the
        smallest that is assumed for poses.
        """
        self._buffer_noise, self._least_noise = buffer_noise, least_noise
        self._t.append(t)
        self._tips.append(tip)
        self._learn()
        if len(self._t) > 1 and t - self._t[-2] > self.gap:
            self._gap_ends.append(t)
        self._forget()
        if self._half_window == 0.0 and len(self._t) > 1 and self._t_returned == self._t[-2]:
            self._t_returned = t  # this is the usual case, which needs no search
            return [self._at(len(self._t) - 1)]
        return self._completed(t, self._half_window)

    def finish(self) -> list[Place]:
        """Return the remaining places, which no later measurements will complete."""
        return self._completed(math.inf, self._half_window)

    def fit(self, t: float, begin: float, end: float, degree: int) -> Place:
        """Return the place at ``t``, s, from a polynomial fitted to [``begin``, ``end``], s.

        ``t`` is the time of a measurement.  The interval is cut off at gaps.  Outliers are left out
        of the fit, one by one, up to about a fifth of the measurements.
        """
        i, k = self._between_gaps(t, begin, end)
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
            # one at a time, because an outlier bends the curve away from the other measurements
            if deviations[worst] <= OUTLIER or n <= max(degree + 2, 0.8 * times.size):
                break
            is_used[worst] = False
        variance = max(float(inverse[0, 0]), 0.0) * np.square(self._deviation)
        rates = coefficients[1] / spread if len(coefficients) > 1 else np.zeros(2)
        numbers = *coefficients[0].tolist(), *rates.tolist(), *variance.tolist()
        return Place._make((t, *numbers, n))

    def halves(self, t: float) -> tuple[Half, Half]:
        """Return two positions of the tip at ``t``, s, with independent noise.

        The first is fitted to every other measurement of a window around ``t``, the second to the
        remaining measurements.  Beforehand the window is halved until one parabola explains all its
        measurements, so that it contains no touch, or until it has too few measurements.
        """
        sigma = np.maximum(self._deviation, 1e-12)
        half_window, narrower = self._half_window, self._window(t, 0.5 * self._half_window)
        window = self._window(t, half_window)
        while len(narrower.tips) >= _MIN_SIZE:
            # both windows share measurements, so their noises are not independent
            spread = math.sqrt(max(narrower.gain - window.gain, 0.0)) * sigma
            bias = np.abs(narrower.centre - window.centre)
            if not window.is_noise(sigma) or (bias > _AGREEMENT * spread).any():
                half_window *= 0.5
                window, narrower = narrower, self._window(t, 0.5 * half_window)
            else:
                break
        i, n, basis, degree = window.first, len(window.tips), window.basis, window.degree
        tips, square = window.tips, np.square((window.tips - window.fitted) / sigma)
        is_used = (square <= OUTLIER**2).all(axis=1)
        is_even = (np.arange(i, i + n) + self._n_forgotten) % 2 == 0
        found = []
        for part in (is_even, ~is_even):
            chosen = part & is_used if (part & is_used).sum() > degree else part
            if not chosen.any():
                chosen = np.ones(n, dtype=bool)
            inverse = _inverse(basis[chosen])[0]
            axial, lateral = inverse @ tips[chosen]
            variances = float(inverse @ inverse) * np.square(sigma)
            found.append(Half(float(axial), float(lateral), *variances.tolist()))
        return found[0], found[1]

    def _between_gaps(self, t: float, begin: float, end: float) -> tuple[int, int]:
        """Return the numbers of the measurements in an interval that no gap separates from ``t``.

        The first number is included, the second is not; ``begin`` and ``end`` in s.
        """
        i, k = bisect_left(self._t, begin), bisect_right(self._t, end)
        for gap_end in self._gap_ends:
            if begin < gap_end <= t:
                i = bisect_left(self._t, gap_end)
            elif t < gap_end <= end:
                return i, min(k, bisect_left(self._t, gap_end))
        return i, k

    def _window(self, t: float, half_window: float) -> _Window:
        i, k = self._between_gaps(t, t - half_window, t + half_window)
        tips = np.array([tip.place for tip in self._tips[i:k]])
        return _Window.of(i, np.array(self._t[i:k]) - t, tips)

    def rate_over(self, begin: float, end: float) -> tuple[float, float]:
        """Return the tip's mean speed over an interval, s, and its standard deviation, m/s.

        Both are infinite if there are fewer than three measurements.
        """
        i, k = bisect_left(self._t, begin), bisect_right(self._t, end)
        times = np.array(self._t[i:k])
        if times.size < 3:
            return math.inf, math.inf
        times -= times.mean()
        square = float(times @ times)
        rates = times @ np.array([tip.place for tip in self._tips[i:k]]) / square
        return math.hypot(*rates), math.hypot(*self._deviation) / math.sqrt(2.0 * square)

    def _learn(self) -> None:
        """Update the estimates of noise and interval, and from them the length of the window."""
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
            math.hypot(max(of_pose.deviation, self._least_noise), of_buffer)
            for of_pose, of_buffer in zip(self._noise, self._buffer_noise, strict=True)
        )
        if math.hypot(axial, lateral) < self._clean:
            self._deviation, self._half_window = (0.0, 0.0), 0.0
            return
        self._deviation = (axial, lateral)
        # the middle of a fitted parabola has 9/4 of the variance of a mean
        count = (1.5 * max(axial, lateral) / (ACCURACY * self._radius)) ** 2
        self._half_window = min(max(0.5 * count, 2.0) * self._interval, self._delay)

    def _forget(self) -> None:
        while self._t[0] < self._t[-1] - self._keep:
            del self._t[0], self._tips[0]
            self._n_forgotten += 1
        while self._gap_ends and self._gap_ends[0] < self._t[0]:
            del self._gap_ends[0]

    def _completed(self, newest: float, wait: float) -> list[Place]:
        """Return the new places up to ``wait``, s, before ``newest``, s, the latest measurement."""
        first = bisect_right(self._t, self._t_returned)
        # a round-off error of the stamps must not delay a place
        last = bisect_right(self._t, newest - wait + 1e-9)
        interval = MIN_FIT_INTERVAL - 1e-9 if self._half_window > 0.0 else 0.0
        places = []
        for i in range(first, last):
            if self._t[i] - self._t_returned >= interval and not self._is_isolated(i):
                places.append(self._at(i))
                self._t_returned = self._t[i]
        return places

    def _is_isolated(self, i: int) -> bool:
        """Return True if number ``i`` has too few neighbours between two gaps for a fit."""
        if self._half_window == 0.0 or not self._gap_ends:
            return False
        t = self._t[i]
        first, last = self._between_gaps(t, -math.inf, math.inf)
        is_after_gap = first > 0
        return is_after_gap and last < len(self._t) and last - first < _MIN_BETWEEN_GAPS

    def _at(self, i: int) -> Place:
        t = self._t[i]
        if self._half_window == 0.0:
            tip = self._tips[i]
            return Place(t, *tip.place, *(tip.rate or self._difference(i)))
        return self.fit(t, t - self._half_window, t + self._half_window, 2)

    def _difference(self, i: int) -> tuple[float, float]:
        """Return the mean rates since the measurement before number ``i``, m/s; 0 for the first."""
        if i == 0:
            return 0.0, 0.0
        dt = self._t[i] - self._t[i - 1]
        (a0, l0), (a1, l1) = self._tips[i - 1].place, self._tips[i].place
        return (a1 - a0) / dt, (l1 - l0) / dt
