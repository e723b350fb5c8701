"""Estimates of the noise and the resolution of a smooth signal from its measurements alone."""

from __future__ import annotations

import math
from collections import deque
from itertools import islice, pairwise
from statistics import median

#: Smallest number of third differences for an estimate of the noise.
MIN_DIFFERENCES = 8
#: Median of |x| for a normally distributed x with standard deviation 1.
_MEDIAN = 0.6744897501960817
#: A signal with steps of one size is quantised if it pauses at least this often after a step.
_MIN_STOPS = 3
#: Largest round-off of a difference, and smallest step of a quantised signal, m or rad.
_ROUND_OFF, _MIN_STEP = 1e-10, 1e-6


def third_difference(t: list[float]) -> tuple[float, float, float, float]:
    """Return weights for four measurements at times ``t``, s, that cancel any parabola in time.

    The weighted sum of the measurements is their third difference.  The weights are scaled so that
    its standard deviation is that of a single measurement, if the errors are independent.
    """
    t_0, t_1, t_2, t_3 = t
    w_0 = 1.0 / ((t_0 - t_1) * (t_0 - t_2) * (t_0 - t_3))
    w_1 = 1.0 / ((t_1 - t_0) * (t_1 - t_2) * (t_1 - t_3))
    w_2 = 1.0 / ((t_2 - t_0) * (t_2 - t_1) * (t_2 - t_3))
    w_3 = 1.0 / ((t_3 - t_0) * (t_3 - t_1) * (t_3 - t_2))
    norm = math.sqrt(w_0 * w_0 + w_1 * w_1 + w_2 * w_2 + w_3 * w_3)
    return w_0 / norm, w_1 / norm, w_2 / norm, w_3 / norm


class NoiseEstimate:
    """Estimate of the standard deviation of a measurement from the last ``size`` third differences.

    It uses the median of their magnitudes, which the few large differences of an impact or an
    outlier hardly change.
    """

    def __init__(self, size: int = 200) -> None:
        #: Estimated standard deviation of a measurement; 0 while it is not known.
        self.deviation = 0.0
        self._differences: deque[float] = deque(maxlen=size)
        self._count = 0

    def add(self, difference: float) -> None:
        """Add a third difference, see :func:`third_difference`."""
        self._differences.append(abs(difference))
        self._count += 1
        # one more among many differences hardly changes the median
        is_due = self._count <= 4 * MIN_DIFFERENCES or self._count % MIN_DIFFERENCES == 0
        if self.known and is_due:
            self.deviation = median(self._differences) / _MEDIAN

    @property
    def known(self) -> bool:
        """True if there are enough differences for an estimate."""
        return self._count >= MIN_DIFFERENCES

    @property
    def latest(self) -> float:
        """Standard deviation estimated from the last few differences only; 0 without any."""
        if not self._differences:
            return 0.0
        return median(islice(reversed(self._differences), MIN_DIFFERENCES)) / _MEDIAN


class Resolution:
    """Estimate of the step of a quantised signal from its last ``size`` differences."""

    def __init__(self, size: int = 60) -> None:
        #: Common divisor of the steps of a quantised signal; 0 if the signal is not quantised.
        self.value = 0.0
        self._differences: deque[float] = deque(maxlen=size)
        self._count = 0

    def add(self, difference: float) -> None:
        """Add the difference between a measurement and the measurement before it."""
        self._differences.append(abs(difference))
        self._count += 1
        if self._count % MIN_DIFFERENCES == 0:
            self.value = self._find()

    @property
    def is_noisy(self) -> bool:
        """True if none of the last few measurements equals the measurement before it."""
        return all(islice(reversed(self._differences), MIN_DIFFERENCES))

    def _find(self) -> float:
        steps = [difference for difference in self._differences if difference > _ROUND_OFF]
        common = 0.0
        for step in steps:
            common = _common_divisor(common, step)
            if common < _MIN_STEP:
                return 0.0
        # a signal of constant speed has steps of one size, too, but no pauses
        stops = sum(b == 0.0 < a for a, b in pairwise(self._differences))
        multiples = {round(step / common) for step in steps}
        return common if stops >= _MIN_STOPS or len(multiples) > 1 else 0.0


def _common_divisor(a: float, b: float) -> float:
    """Return the greatest common divisor of two steps, within round-off (Euclid's algorithm)."""
    while a > _ROUND_OFF:
        rest = b % a
        a, b = (0.0 if a - rest < _ROUND_OFF else rest), a
    return b
