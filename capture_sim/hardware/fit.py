"""Fit of a contact law to the rig's measurements in one contact.

The fit gives stiffness, damping, position of the wall, friction and the lag of the force.
"""

from __future__ import annotations

import math
from collections.abc import Generator, Iterator
from dataclasses import dataclass, replace

import numpy as np

from capture_sim.hardware.law import WallLaw

#: Standard deviations before the first touch: ln stiffness, loss at the approach speed, offset
#: (m), lag (s).
_PRIOR_DEVIATIONS = np.array([2.3, 3.0, 2e-4, 5e-3])
#: Smallest standard deviations of the parameters as a prior of the next contact: drift.
_DRIFT = np.array([0.05, 0.1, 2e-6, 2e-4])
#: Steps of the finite differences for the derivatives with respect to these parameters.
_DIFFERENCES = np.diag([1e-6, 1e-6, 1e-9, 1e-5])
#: Smallest standard deviation of a force in the fit, as a share of the peak force.
_MODEL_ERROR = 1e-3
_MAX_LOSS = 30.0  # damping times speed over stiffness; restitution 0.03
_MAX_ITERATIONS = 30
#: Cost per sample, in squared standard deviations, below which no further first guess is tried.
_FOUND = 2.0


@dataclass(frozen=True)
class LawEstimate:
    """A contact law with its uncertainty; ``deviations`` is None if the law was not fitted."""

    law: WallLaw  # of the walls; never generates energy
    lag: float = 0.0  # s, delay of the force relative to the tip's position of the same stamp
    lag_deviation: float = math.inf  # s, standard deviation
    # restitution, restitution_deviation: at the approach speed of the touch
    restitution: float = 1.0
    restitution_deviation: float = math.inf
    residual: float = 0.0  # N, rms of what the law does not describe
    peak_force: float = 0.0  # N, measured
    deviations: np.ndarray | None = None  # standard deviations of the four parameters of the fit


def fit_touch(
    samples: np.ndarray, prior: LawEstimate, speed: float, noise: float, threshold: float
) -> Generator[None, None, LawEstimate]:
    """Fit a contact law to the samples of one contact; the generator returns the estimate.

    It yields in each iteration, so that the loop can continue during the fit.  Levenberg and
    Marquardt's method minimises the squared misfit of the force, with ``prior`` as one more
    measurement.  The exponent is not fitted.  The fit can separate the force's lag from damping:
    with a lag only, the wall seems to be elsewhere on leaving than on entering.

    ``samples`` (n, 6): time (s), penetration (m, below 0 outside) and its rate (m/s), normal and
    tangential force (N), slip (m/s).  At least one normal force must reach ``threshold`` (N).
    ``speed`` (m/s) is the approach speed, ``noise`` (N) the standard deviation of a force.
    """
    t, depth, rate, force, tangential, slip = samples.T
    p = prior.law.exponent
    peak = float(force.max())
    sigma = max(noise, _MODEL_ERROR * peak)
    widths = _PRIOR_DEVIATIONS
    if prior.deviations is not None:
        widths = np.minimum(np.hypot(2.0 * prior.deviations, _DRIFT), widths)
    loss = min(prior.law.damping * speed / prior.law.stiffness, _MAX_LOSS)
    mean = np.array([math.log(prior.law.stiffness), loss, prior.law.offset, prior.lag])

    def law_of(theta: np.ndarray) -> WallLaw:
        stiffness = float(np.exp(theta[0]))  # inf where math.exp would raise
        damping, offset = float(theta[1]) * stiffness / speed, float(theta[2])
        return replace(prior.law, stiffness=stiffness, damping=damping, offset=offset)

    def predicted(theta: np.ndarray) -> np.ndarray:
        return law_of(theta).normal_forces(*_interpolated(t, depth, rate, t - theta[3]))

    def cost(theta: np.ndarray) -> float:
        misfit = (force - predicted(theta)) / sigma
        return float(misfit @ misfit + (((theta - mean) / widths) ** 2).sum())

    best, least, normal = mean, math.inf, np.diag(widths**-2.0)
    for theta in _first_guesses(t, depth, rate, force, threshold, p, mean):
        reached, damping = cost(theta), 1e-3
        for _ in range(_MAX_ITERATIONS):
            now = predicted(theta)
            J = np.stack([(predicted(theta + d) - now) / d.sum() for d in _DIFFERENCES], axis=1)
            here = J.T @ J / sigma**2 + np.diag(widths**-2.0)
            gradient = J.T @ (force - now) / sigma**2 - (theta - mean) / widths**2
            if reached < least:
                best, least, normal = theta, reached, here
            yield
            trial = theta + np.linalg.solve(here + damping * np.diag(np.diag(here)), gradient)
            trial[1] = min(max(trial[1], 0.0), _MAX_LOSS)
            new = cost(trial)
            if not new <= reached:
                damping *= 10.0
                if damping > 1e8:
                    break
                continue
            converged = reached - new < 1e-3 and damping <= 1e-3
            theta, reached, damping = trial, new, 0.1 * damping
            if converged:
                break
        if least < _FOUND * len(t):
            break
    theta = best
    residual = math.sqrt(float(np.mean((force - predicted(theta)) ** 2)))
    spread = max(1.0, residual / sigma)
    deviations = spread * np.sqrt(np.diag(np.linalg.inv(normal)))
    law = law_of(theta)
    law = replace(law, friction=_friction(force, tangential, slip, law, sigma))
    restitution = law.restitution(speed)
    lossier = replace(law, damping=law.damping + deviations[1] * law.stiffness / speed)
    return LawEstimate(
        law,
        float(theta[3]),
        float(deviations[3]),
        restitution,
        abs(restitution - lossier.restitution(speed)),
        residual,
        peak,
        deviations,
    )


def _first_guesses(
    t: np.ndarray,
    depth: np.ndarray,
    rate: np.ndarray,
    force: np.ndarray,
    threshold: float,
    exponent: float,
    mean: np.ndarray,
) -> Iterator[np.ndarray]:
    """Yield initial parameters (4,) of the fit: ln stiffness, loss, offset (m) and lag (s).

    The loss is damping times approach speed over stiffness.  The first and the last sample at or
    above the threshold give offset and lag.
    """
    loaded = np.flatnonzero(force >= threshold)
    first, last = loaded[0], loaded[-1]
    speeds = rate[first] - rate[last]
    shift = mean[3]
    if speeds > 0.0:
        shift = float(np.clip((depth[first] - depth[last]) / speeds, 0.0, t[last] - t[first]))
    peak = int(np.argmax(force))
    for loss in (mean[1], 1.0, 3.0, 0.0):
        for lag in (shift, mean[3]):
            offset = -(depth[first] - rate[first] * lag)
            inside = max(float(depth[peak]) + offset, 1e-6)
            stiffness = float(force[peak]) / inside**exponent / (1.0 + loss)
            yield np.array([math.log(max(stiffness, 1e-9)), loss, offset, lag])


def _interpolated(
    t: np.ndarray, x: np.ndarray, v: np.ndarray, times: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return values and slopes, at given times, of the Hermite cubics through x with slopes v.

    Outside the range of t, the continuation is linear.
    """
    inside = np.clip(times, t[0], t[-1])
    i = np.clip(np.searchsorted(t, inside, side="right") - 1, 0, len(t) - 2)
    h = t[i + 1] - t[i]
    u = (inside - t[i]) / h
    a = x[i + 1] - x[i]
    b, c = h * v[i] - a, a - h * v[i + 1]
    value = x[i] + u * a + u * (1.0 - u) * ((1.0 - u) * b + u * c)
    slope = (a + (1.0 - 2.0 * u) * ((1.0 - u) * b + u * c) + u * (1.0 - u) * (c - b)) / h
    return value + slope * (times - inside), slope


def _friction(
    force: np.ndarray, tangential: np.ndarray, slip: np.ndarray, prior: WallLaw, sigma: float
) -> float:
    """Return the coefficient of friction that fits the tangential forces by least squares.

    The friction of ``prior`` counts as one more measurement, with a standard deviation of 1.
    """
    drive = -force * prior.friction_shares(slip) / sigma
    return max(float((drive @ tangential / sigma + prior.friction) / (drive @ drive + 1.0)), 0.0)
