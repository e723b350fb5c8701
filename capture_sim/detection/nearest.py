"""The closest approach of a path that is measured with noise.

The minimum of many noisy distances is biased low, while noise increases each distance on average.
The measurements are therefore divided into two halves with independent noise.  One half gives the
position of the closest approach, and the other half the distance there.  The two halves then swap
their roles.
"""

from __future__ import annotations

import math
from typing import NamedTuple

#: A squared distance is not significantly above 0 below this number of its standard errors.
_MIN_SIGNIFICANCE = 2.0
#: Number of standard errors in the upper limit of such a squared distance.
_BOUND = 3.0
#: Number of standard errors added to a squared distance before comparison, so that an uncertain
#: position is less likely to be chosen.
_PENALTY = 3.0


class Half(NamedTuple):
    """Position of the tip in the cone's frame from one half of the measurements."""

    axial: float  # m
    lateral: float
    axial_variance: float  # m^2
    lateral_variance: float

    @property
    def square(self) -> float:
        """Squared distance, m^2, less the mean contribution of noise; may be negative."""
        square = self.axial**2 + self.lateral**2
        return square - self.axial_variance - self.lateral_variance

    @property
    def variance(self) -> float:
        """Variance of :attr:`square`, m^4."""
        return sum(
            max(4.0 * value**2 * variance - 2.0 * variance**2, 2.0 * variance**2)
            for value, variance in (
                (self.axial, self.axial_variance),
                (self.lateral, self.lateral_variance),
            )
        )


class ClosestApproach:
    """Estimator of the closest approach of a path to the origin."""

    def __init__(self) -> None:
        self._exact = math.inf
        # for each choosing half: its smallest upper limit of the squared distance, and the squared
        # distance of the other half at that position, with its variance
        self._chosen = [math.inf, math.inf]
        self._squares = [math.nan, math.nan]
        self._variances = [math.nan, math.nan]

    def add_exact(self, distance: float) -> None:
        """Add a noise-free position of the tip by its distance from the centre of BE, m."""
        self._exact = min(self._exact, distance)

    def add(self, halves: tuple[Half, Half]) -> None:
        """Add a position as estimated from each half of the measurements."""
        for k, (choosing, other) in enumerate((halves, halves[::-1])):
            # of two similar distances, prefer the more certain distance
            upper = choosing.square + _PENALTY * math.sqrt(choosing.variance)
            if upper < self._chosen[k]:
                self._chosen[k] = upper
                self._squares[k], self._variances[k] = other.square, other.variance

    @property
    def estimate(self) -> tuple[float, float]:
        """The closest approach and its standard error, m; the error is 0 if the value is exact.

        If the closest approach is not significantly above 0, the error is infinite and the first
        number is an upper limit.  If no position was added, the first number is infinite.
        """
        if math.isnan(self._squares[0]):
            return self._exact, 0.0
        square = 0.5 * sum(self._squares)
        deviation = 0.5 * math.sqrt(sum(self._variances))
        if square <= _MIN_SIGNIFICANCE * deviation:
            return math.sqrt(max(square, 0.0) + _BOUND * deviation), math.inf
        distance = math.sqrt(square)
        return distance, 0.5 * deviation / distance


def in_words(distance: float, deviation: float) -> str:
    """Return an estimate of the closest approach, m, as a text."""
    if not math.isfinite(distance):
        return "no position of the tip"
    if math.isinf(deviation):
        return f"closest approach hidden by noise or a gap, below {distance * 1e3:.1f} mm"
    if deviation > 0.0:
        return f"closest approach {distance * 1e3:.2f} mm +- {deviation * 1e3:.2f} mm"
    return f"closest approach in the samples {distance * 1e3:.3f} mm"
