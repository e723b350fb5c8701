"""The closest approach of a path that is measured with noise.

The smallest of many noisy distances is too small, and noise adds to each.  So the measurements are
divided into two halves, whose noise is independent.  Where the path through one half comes closest,
the other half gives the distance, and the other way round.
"""

from __future__ import annotations

import math
from typing import NamedTuple

#: A squared distance below so many of its standard errors is not known to be above 0.
_LEAST = 2.0
#: Standard errors below which it is.
_BOUND = 3.0
#: Standard errors that count against a position which is known less well.
_PENALTY = 3.0


class Half(NamedTuple):
    """Position of the tip in the cone's frame from one half of the measurements."""

    axial: float  # m
    lateral: float
    axial_variance: float  # m^2
    lateral_variance: float

    @property
    def square(self) -> float:
        """Squared distance without the mean contribution of noise, m^2; it may be negative."""
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
    """Follows a path for its closest approach to the origin."""

    def __init__(self) -> None:
        self._exact = math.inf
        # by the half that chooses: its smallest square, and the other half's there with variance
        self._chosen = [math.inf, math.inf]
        self._squares = [math.nan, math.nan]
        self._variances = [math.nan, math.nan]

    def add_exact(self, distance: float) -> None:
        """Add a position that is known without noise, m from the origin."""
        self._exact = min(self._exact, distance)

    def add(self, halves: tuple[Half, Half]) -> None:
        """Add a position by both halves of the measurements."""
        for k, (choosing, other) in enumerate((halves, halves[::-1])):
            # of two distances the one that is known better
            upper = choosing.square + _PENALTY * math.sqrt(choosing.variance)
            if upper < self._chosen[k]:
                self._chosen[k] = upper
                self._squares[k], self._variances[k] = other.square, other.variance

    @property
    def estimate(self) -> tuple[float, float]:
        """The closest approach and its standard error, m; the error is 0 for an exact path.

        If noise hides whether the closest approach is 0, the error is infinite and the first number
        is an upper limit.  Without a position the first number is infinite.
        """
        if math.isnan(self._squares[0]):
            return self._exact, 0.0
        square = 0.5 * sum(self._squares)
        deviation = 0.5 * math.sqrt(sum(self._variances))
        if square <= _LEAST * deviation:
            return math.sqrt(max(square, 0.0) + _BOUND * deviation), math.inf
        distance = math.sqrt(square)
        return distance, 0.5 * deviation / distance


def in_words(distance: float, deviation: float) -> str:
    """Return an estimate of the closest approach, m, as a text."""
    if not math.isfinite(distance):
        return "no position of the tip"
    if math.isinf(deviation):
        return f"closest approach hidden by noise, below {distance * 1e3:.1f} mm"
    if deviation > 0.0:
        return f"closest approach {distance * 1e3:.2f} mm +- {deviation * 1e3:.2f} mm"
    return f"closest approach in the samples {distance * 1e3:.3f} mm"
