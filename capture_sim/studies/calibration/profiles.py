"""Profiles of chi2: how far a parameter may be from its value, without the Gaussian error.

At some fixed values of a parameter all others are fitted again (Venzon and Moolgavkar, 1988).  If
the model is linear within the errors, chi2 rises there by the squares of the distances in standard
errors.  Otherwise the interval is where it rises by 4 (95 %).  Kinks of chi2, where a touch comes
or goes, make it rough by about one unit, so that a rise by 1 says little.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from concurrent.futures import Executor
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from capture_sim.errors import SceneError
from capture_sim.studies.calibration.calibrate import Calibration
from capture_sim.studies.calibration.descent import descend
from capture_sim.studies.calibration.joint import Linear, Problem
from capture_sim.studies.executors import InProcess

#: Distances of the fixed values, in standard errors.
DISTANCES = (-2.0, -1.0, 1.0, 2.0)
#: The error is wrong if a rise is off by more than this share, and the roughness of chi2.
_GAUSSIAN, _ROUGH = 0.3, 1.0
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
    def roots(self) -> np.ndarray:
        """Signed roots of the rises (n,): DISTANCES, if the standard error is right."""
        return np.asarray(np.copysign(np.sqrt(np.maximum(self.rises, 0.0)), DISTANCES))

    @property
    def is_gaussian(self) -> bool:
        """True if the standard error gives the intervals."""
        right = np.square(DISTANCES)
        return bool(np.all(np.abs(self.rises - right) <= _GAUSSIAN * right + _ROUGH))

    @property
    def is_better_elsewhere(self) -> bool:
        """True if another value gives a lower chi2 than the fit."""
        return bool(self.rises.min() < _BETTER)

    def interval(self, root: float) -> tuple[float, float]:
        """Return where chi2 rises by the square of ``root``, interpolated; infinite if beyond."""
        is_known = np.isfinite(self.rises)
        roots = np.r_[self.roots[is_known], 0.0]
        values = np.r_[self.values[is_known], self.value]
        order = np.argsort(values)
        roots, values = roots[order], values[order]
        low, high = np.interp([-root, root], roots, values, left=-math.inf, right=math.inf)
        return float(low), float(high)

    @property
    def text(self) -> str:
        """The profile in words."""
        rises = ", ".join(f"{rise:.3g}" for rise in self.rises)
        words = f"{self.name}: chi2 rises by {rises} at -2, -1, 1 and 2 standard errors"
        if self.is_better_elsewhere:
            return f"{words}: a better fit is there, so this one has not converged"
        if self.is_gaussian:
            return f"{words}, as it should: the error is right"
        unit = "" if self.unit == "1" else f" {self.unit}"
        low, high = self.interval(2.0)
        return f"{words}: the error is wrong; 95 % interval {low:.6g} to {high:.6g}{unit}"


def profiles(
    found: Calibration, names: Sequence[str], *, executor: Executor | None = None
) -> tuple[Profile, ...]:
    """Return the profiles of some parameters of a fit.

    ``executor`` as in :func:`capture_sim.calibrate`.

    Raises
    ------
    SceneError
        A name is not one of the fitted parameters, or the fit does not determine it.

    Examples
    --------
    >>> import capture_sim
    >>> found = capture_sim.calibrate([capture_sim.simulate("tilt_0")], ["c_rr"], restarts=1)
    >>> [profile] = profiles(found, ["c_rr"])
    >>> profile.is_gaussian
    True
    """
    check_profiled(names, found.names)
    assert found.problem is not None
    problem = replace(found.problem, executor=executor or InProcess())
    return tuple(_profile(found, problem, name) for name in names)


def check_profiled(names: Sequence[str], fitted: Sequence[str]) -> None:
    """Raise SceneError if one of ``names`` is not fitted, or given twice."""
    for k, name in enumerate(names):
        if name not in fitted or name in names[:k]:
            raise SceneError(
                f"profile {name}: must be one of the fitted parameters, once: {', '.join(fitted)}"
            )


def _profile(found: Calibration, problem: Problem, name: str) -> Profile:
    at = found.linear
    assert at is not None
    j = found.names.index(name)
    value, error = float(found.values[j]), float(found.errors[j])
    if not 0.0 < error < math.inf:
        raise SceneError(f"profile {name}: the trials do not determine it")
    values = np.array([value + distance * error for distance in DISTANCES])
    rises = [_least(problem, at, j, fixed) - at.chi2 for fixed in values.tolist()]
    return Profile(name, found.units[j], value, error, values, np.array(rises))


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
    moved = fixed.coordinate(value) - at.place[j]
    place = at.place + covariance[:, j] / covariance[j, j] * moved
    place[j] = fixed.coordinate(value)
    low, high = other.limits
    place = np.clip(place, low, high)
    search = descend(other, place, other.weighed(), covariance, most=_STEPS)
    return math.inf if search is None else search.linear.chi2
