"""Profiles of chi2: how far a parameter may be from its value, without the Gaussian error.

At some fixed values of a parameter all others are fitted again (Venzon and Moolgavkar, 1988).  If
the model is linear within the errors, chi2 is a parabola there: its curvature gives the standard
error, and its vertex shows how far the search has ended from the minimum.  Otherwise the interval
is where chi2 rises by 4 (95 %).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from capture_sim.errors import SceneError
from capture_sim.studies.fit.descent import descend
from capture_sim.studies.fit.joint import Linear, Problem

#: Distances of the fixed values, in standard errors.
DISTANCES = (-2.0, -1.0, 1.0, 2.0)
#: A standard error is right if chi2 differs from a parabola by at most this, if the parabola's own
#: error is it within this factor, and if the vertex is within this distance, in standard errors.
_MISFIT, _FACTOR, _SHIFT = 0.6, 1.25, 0.5
#: A rise below this shows a better fit than the one that was found.
_BETTER = -1.0
#: Largest number of steps of each search.
_STEPS = 8


class Profile(NamedTuple):
    """Rise of chi2 at some fixed values of a parameter; SI units."""

    name: str
    unit: str
    value: float  # of the fit
    error: float  # its standard error
    values: np.ndarray  # (n,), at DISTANCES
    rises: np.ndarray  # (n,), infinite where the bench cannot be simulated

    @property
    def is_gaussian(self) -> bool:
        """True if the standard error gives the intervals."""
        if not np.isfinite(self.rises).all():
            return False
        at, rises = np.array([0.0, *DISTANCES]), np.array([0.0, *self.rises])
        curve = np.polyfit(at, rises, 2)
        misfit = np.abs(np.polyval(curve, at) - rises).max()
        curvature, slope = float(curve[0]), float(curve[1])
        return bool(
            misfit <= _MISFIT
            and _FACTOR**-2 <= curvature <= _FACTOR**2
            and abs(slope) <= 2.0 * curvature * _SHIFT
        )

    @property
    def is_better_elsewhere(self) -> bool:
        """True if another value gives a lower chi2 than the fit."""
        return bool(self.rises.min() < _BETTER)

    def interval(self, root: float) -> tuple[float, float]:
        """Return where chi2 rises by the square of ``root``, interpolated; infinite if beyond."""
        is_known = np.isfinite(self.rises)
        rises = np.maximum(self.rises[is_known], 0.0)
        roots = np.r_[np.copysign(np.sqrt(rises), np.array(DISTANCES)[is_known]), 0.0]
        values = np.r_[self.values[is_known], self.value]
        order = np.argsort(values)
        ends = np.interp([-root, root], roots[order], values[order], left=-math.inf, right=math.inf)
        return float(ends[0]), float(ends[1])

    @property
    def text(self) -> str:
        """The profile in words."""
        rises = ", ".join(f"{rise:.3g}" for rise in self.rises)
        words = f"{self.name}: chi2 rises by {rises} at -2, -1, 1 and 2 standard errors"
        if self.is_better_elsewhere:
            return f"{words}: a better fit is there, so this one has not converged"
        if self.is_gaussian:
            return f"{words}: the error is right within a quarter"
        unit = "" if self.unit == "1" else f" {self.unit}"
        low, high = self.interval(2.0)
        return f"{words}: the error is wrong; 95 % interval {low:.6g} to {high:.6g}{unit}"


def check_profiled(names: Sequence[str], fitted: Sequence[str]) -> None:
    """Raise SceneError if one of ``names`` is not fitted, or given twice."""
    for k, name in enumerate(names):
        if name not in fitted or name in names[:k]:
            raise SceneError(
                f"profile {name}: must be one of the fitted parameters, once: {', '.join(fitted)}"
            )


def profile_of(problem: Problem, at: Linear, j: int, value: float, error: float) -> Profile:
    """Return the profile of the parameter with index j of a fit; ``value`` and ``error`` in SI.

    Raise SceneError if the fit does not determine it.
    """
    parameter = problem.parameters[j]
    if not 0.0 < error < math.inf:
        raise SceneError(f"profile {parameter.name}: the trials do not determine it")
    values = np.array([value + distance * error for distance in DISTANCES])
    rises = [_least(problem, at, j, fixed) - at.chi2 for fixed in values.tolist()]
    return Profile(parameter.name, parameter.unit, value, error, values, np.array(rises))


def _least(problem: Problem, at: Linear, j: int, value: float) -> float:
    """Return the least chi2 with a parameter fixed at a value (SI); infinite if out of range."""
    parameter = problem.parameters[j]
    if not parameter.low <= value <= parameter.high:
        return math.inf
    fixed = replace(parameter, low=value, high=value)
    parameters = [*problem.parameters[:j], fixed, *problem.parameters[j + 1 :]]
    other = problem.replaced(problem.trials, parameters)
    # the others go along as the linear model says
    covariance = at.covariance
    moved = fixed.position(value) - at.place[j]
    place = at.place + covariance[:, j] / covariance[j, j] * moved
    place[j] = fixed.position(value)
    low, high = other.limits
    place = np.clip(place, low, high)
    search = descend(other, place, other.weighed(), covariance, most=_STEPS)
    return math.inf if search is None else search.linear.chi2
