"""The touches of a run: located by the integrator's events, or found in a measured force.

A touch of the tip lasts about a third of a millisecond.  Sampled forces therefore show touches only
at rates of about 12 kHz or more, with ``MIN_SAMPLES`` samples in a touch.  Slower messages show
touches only if each message has the number of touches and the peak force since the message before.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from capture_sim.plausibility.signals import baseline
from capture_sim.scene.parts import Cone

#: Smallest number of samples in a touch for its peak to be known to 1 %.
MIN_SAMPLES = 4
#: Smallest number of samples before the contact from which the noise is estimated.
_QUIET = 50
#: Probability that noise alone exceeds the threshold anywhere in the recording.
_FALSE_ALARM = 1e-3
#: Smallest threshold as a share of the largest force, for sensors without noise.
_NOTHING = 1e-3
#: Share of a touch's force that must act across the tip's axis to identify the wall.
_ACROSS = 0.1
#: The sum of squares of n samples' noise, in units of the variance, is n with a standard deviation
#: of sqrt(2 n).  The fitted curve may leave n less this number of standard deviations.  It thus
#: passes through a few samples, and smooths many.
_BELOW_NOISE = 2.0
#: Number of points per sample at which the fitted curve is evaluated to find its peak.  For a half
#: sine with four samples, the peak is low by a share of at most 2e-4.
_POINTS = 20
#: A sensor's zero drifts if two means of it differ by more than this number of the difference's
#: standard deviations, and by more than this share of the noise.
_DRIFT_DEVIATIONS, _MIN_DRIFT = 6.0, 0.5
#: Interval of the samples by the standard deviation of a time that is uniformly distributed in it.
_UNIFORM = math.sqrt(12.0)
#: Error of the trapezoidal rule for the impulse of a Hertzian touch with n samples: its standard
#: deviation over all positions of the samples is this number times n^-2.5 times the impulse.
_SAMPLING = 0.28
#: An impact speed counts as measured if the last pose is at most this far from the contact, m.
#: Over this distance rolling resistance changes a speed of 0.1 m/s by 2 %.
MAX_UNSEEN_TRAVEL = 0.02
#: Tolerance for the round-off of times at the ends of a window, s.
TICK = 1e-9
_COLUMNS = ("start", "peak", "lasted", "peak_time", "impulse", "wall")


@dataclass(frozen=True)
class Touches:
    """Touches of a run, (n,) each, in order; unknown values are NaN (wall: 0)."""

    start: np.ndarray  # s
    peak: np.ndarray  # N, of the normal force, or of the force's magnitude
    lasted: np.ndarray  # s
    peak_time: np.ndarray  # s
    impulse: np.ndarray  # N s
    wall: np.ndarray  # +1 or -1
    start_noise: float = 0.0  # standard deviation, s
    peak_noise: float = 0.0  # standard deviation, N
    threshold: float = 0.0  # N; touches with a smaller peak were not found
    spacing: float = 0.0  # s, interval of the force's samples; 0 if no sampled force was used
    all_found: bool = True  # False if the force shows further touches, with too few samples
    is_delay_known: bool = True  # False if a filter or another clock may delay all touches equally

    def of(self, kept: np.ndarray | slice) -> Touches:
        """Return the touches that a mask, (n,) bool, or a slice selects."""
        return replace(self, **{name: getattr(self, name)[kept] for name in _COLUMNS})

    def later(self, by: float) -> Touches:
        """Return the touches with all times increased by ``by``, s."""
        return replace(self, start=self.start + by, peak_time=self.peak_time + by)

    def within(self, contact: float, window: float) -> Touches:
        """Return the touches that start within ``window``, s, after the time ``contact``, s.

        The times of the returned touches count from ``contact``.
        """
        shifted = self.later(-contact)
        return shifted.of((shifted.start >= -TICK) & (shifted.start <= window))

    def with_noise(self, start: float, peak: float) -> Touches:
        """Return the touches with a sensor's noise included, standard deviations in s and N.

        The noise of the start is combined with that of the sampling, as independent errors.  The
        noise of the peak becomes the larger of the two values.
        """
        start_noise = math.hypot(self.start_noise, start)
        return replace(self, start_noise=start_noise, peak_noise=max(self.peak_noise, peak))

    def with_default_noise(self, start: float, peak: float) -> Touches:
        """Return the touches with these noises, s and N, in place of noises that are 0 (unknown).

        Both are unknown for touches from events.  For touches counted in messages, only that of the
        peak is unknown.
        """
        return replace(
            self, start_noise=self.start_noise or start, peak_noise=self.peak_noise or peak
        )

    @property
    def strength(self) -> str:
        """Field that a fit compares: ``"impulse"`` for a sampled force, else ``"peak"``.

        Sampling and low-pass filters lower a peak, e.g. by 10 % for a filter of 4 kHz and a touch
        of 0.35 ms.  They do not change the impulse.
        """
        return "impulse" if self.spacing > 0.0 and np.isfinite(self.impulse).all() else "peak"

    @property
    def strength_noise(self) -> np.ndarray:
        """Standard deviation of each touch's :attr:`strength`, (n,), N (peak) or N s (impulse).

        That of an impulse includes the noise of its samples and the error of the trapezoidal rule.
        """
        if self.strength == "peak":
            return np.full(self.start.size, self.peak_noise)
        samples = self.lasted / self.spacing
        of_force = self.peak_noise * self.spacing * np.sqrt(samples + 2.0)  # with both flanks
        return np.hypot(of_force, _SAMPLING * samples**-2.5 * self.impulse)

    def may_miss(self, lasted: np.ndarray | float) -> bool:
        """Return True if the samples could be too few to find touches of some durations.

        ``lasted`` has one or more durations, s; the shortest counts.
        """
        shortest = float(np.min(lasted, initial=math.inf))
        return MIN_SAMPLES * self.spacing > shortest


def located(touches: np.ndarray) -> Touches:
    """Return located touches, (n,) of dtype TOUCH, as Touches in the order of their starts."""
    t = touches[np.argsort(touches["start"], kind="stable")]
    lasted = t["end"] - t["start"]
    return Touches(t["start"], t["peak_force"], lasted, t["peak_time"], t["impulse"], t["wall"])


def unseen_impact(travel: float) -> str:
    """Return the reason why an impact speed counts as not measured; '' if it is measured.

    ``travel`` is the distance that the tip travelled without poses just before the contact, m.
    """
    if travel <= MAX_UNSEEN_TRAVEL:
        return ""
    return f"impact speed not measured: no poses in the last {1e3 * travel:.3g} mm before it"


class Quiet(NamedTuple):
    """Bias and noise of a force sensor, from its readings before the first contact."""

    bias: np.ndarray  # (2,), N; (n, 2) if it drifts
    sigma: float  # standard deviation of a component, N
    threshold: float  # N; the magnitude of noise exceeds it in one of 1000 recordings


def quiet_before_contact(t: np.ndarray, force: np.ndarray) -> Quiet | None:
    """Return bias, noise and threshold of a measured force (n, 2), N, at times (n,), s.

    The result is None if there are too few samples.  The recording must begin without contact.  The
    sensor's zero may drift slowly.  The threshold assumes white noise in two components, whose
    magnitude has a Rayleigh distribution: it exceeds k sigma with the probability exp(-k^2 / 2).
    """
    zero = _drifting_zero(t, force)
    if zero is None:
        return _quiet(force)
    quiet = _quiet(force - zero)
    return None if quiet is None else quiet._replace(bias=zero + quiet.bias)


def _drifting_zero(t: np.ndarray, force: np.ndarray) -> np.ndarray | None:
    """Return the zero of a force sensor that drifts, (n, 2), N, at times (n,), s.

    Before the contact the zero is a running median, and from the contact on it is extrapolated
    linearly.  The result is None if no drift is found, or if there are too few samples to find it.
    """
    zero = baseline(t, force)
    quiet = _quiet(force - zero)
    if quiet is None:
        return None
    size = np.hypot(*(force - zero - quiet.bias).T)
    found = above(size, quiet.threshold)
    first = found[0].start if found else len(t)
    quarter = first // 4
    if quarter < _QUIET:
        return None
    moved = force[first - quarter : first].mean(axis=0) - force[:quarter].mean(axis=0)
    # both means have noise; a drift much smaller than the noise has no effect
    limit = max(_DRIFT_DEVIATIONS * math.sqrt(2.0 / quarter), _MIN_DRIFT) * quiet.sigma
    if float(np.abs(moved).max()) <= max(limit, 1e-9):
        return None
    zero = zero.copy()
    if first < len(t):
        rate = moved / (t[first - quarter // 2 - 1] - t[quarter // 2])
        zero[first:] = zero[first] + np.outer(t[first:] - t[first], rate)
    return zero


def _quiet(force: np.ndarray) -> Quiet | None:
    """Return bias, noise and threshold of a force (n, 2), N, whose zero does not drift.

    The result is None if there are too few samples.
    """
    n = len(force)
    until = max(_QUIET, n // 20)
    if n < until:
        return None
    k = math.sqrt(2.0 * math.log(n / _FALSE_ALARM))
    for _ in range(2):  # first from the beginning, then from all samples before the contact
        before = force[:until]
        bias = np.median(before, axis=0)
        sigma = float(np.median(np.abs(before - bias)) / 0.6745)
        size = np.hypot(*(force - bias).T)
        threshold = max(k * sigma, _NOTHING * float(size.max()))
        above = np.flatnonzero(size > threshold)
        until = max(until, int(above[0]) - MIN_SAMPLES if above.size else n)
    return Quiet(bias, sigma, threshold)


def above(size: np.ndarray, threshold: float) -> list[slice]:
    """Return a slice for each part of a magnitude (n,) that exceeds the threshold.

    A part begins and ends where the magnitude crosses half of the threshold.
    """
    inside = np.concatenate([[False], size > 0.5 * threshold, [False]])
    starts, ends = np.flatnonzero(inside[1:] != inside[:-1]).reshape(-1, 2).T.tolist()
    parts = [slice(start, end) for start, end in zip(starts, ends, strict=True)]
    return [part for part in parts if size[part].max() > threshold]


def first_above(t: np.ndarray, force: np.ndarray) -> float | None:
    """Return the time at which a force (n, 2), N, first exceeds its noise, s.

    The result is None if it never does, or if there are too few samples to estimate the noise.
    """
    quiet = quiet_before_contact(t, force)
    if quiet is None:
        return None
    found = above(np.hypot(*(force - quiet.bias).T), quiet.threshold)
    return float(t[found[0].start]) if found else None


def normal_force(
    force: np.ndarray, attitude: np.ndarray, cone: Cone, wall: float = 0.0
) -> np.ndarray:
    """Return the component of a force on the tip that is normal to the touched wall, (n,), N.

    The force (n, 2), N, is in the sensor's axes, and ``attitude`` (n,), rad, is the attitude of
    these axes in the cone.  Friction acts along the wall and has no normal component.  ``wall`` is
    +1 or -1.  If it is 0, each sample counts for the wall that could cause the lateral force, which
    makes noise appear as a force.
    """
    c, s = np.cos(attitude), np.sin(attitude)
    along = c * force[:, 0] - s * force[:, 1]
    across = s * force[:, 0] + c * force[:, 1]
    outward = -wall * across if wall else np.abs(across)
    return np.asarray(-math.sin(cone.half_angle) * along + math.cos(cone.half_angle) * outward)


def in_force(
    t: np.ndarray,
    force: np.ndarray,
    attitude: np.ndarray | None = None,
    cone: Cone | None = None,
) -> Touches | None:
    """Find the touches in a sampled force; None if no touch is found.

    The search ends at the first touch with fewer than :data:`MIN_SAMPLES` samples, because touches
    after it may have been missed.  If the sampling is too slow, no touch is found at all.  A touch
    starts and ends midway between two samples; its peak is that of a curve fitted to the samples
    (see :func:`_peak`).

    Times (n,), s, ascend.  The force (n, 2), N, is in the sensor's axes, with bias and noise, and
    must begin without contact.  If ``cone`` and the ``attitude`` of these axes in the cone, (n,),
    rad, are given, peak and impulse are those of the normal force.  Otherwise they are those of the
    magnitude, which includes friction.
    """
    quiet = quiet_before_contact(t, force)
    if quiet is None:
        return None
    net = force - quiet.bias
    size = np.hypot(*net.T)
    rows, spacing, all_found = [], [0.0], True
    for part in above(size, quiet.threshold):
        first, end = part.start, part.stop
        if end - first < MIN_SAMPLES or first == 0:
            all_found = False
            break
        across = float(net[part, 1].sum())
        # a force along the tip's axis may come from either wall, or from both
        wall = -float(np.sign(across)) if abs(across) > _ACROSS * size[part].sum() else 0.0
        # with the samples before and after the touch, which belong to the impulse
        with_flanks = slice(first - 1, min(end + 1, len(t)))
        values = size[with_flanks]
        if attitude is not None and cone is not None:
            values = normal_force(net[with_flanks], attitude[with_flanks], cone, wall)
        times = t[with_flanks]
        impulse = float(0.5 * (values[1:] + values[:-1]) @ np.diff(times))
        if impulse <= 0.0:
            continue  # a wall never pulls, so this is the overshoot of a filter after a touch
        peak_time, peak = _peak(times, values, quiet.sigma)
        start, stop = 0.5 * (t[first - 1] + t[first]), 0.5 * (t[end - 1] + times[-1])
        spacing.append(t[first] - t[first - 1])
        rows.append((start, peak, stop - start, peak_time, impulse, wall))
    if not rows:
        return None
    # the start is an interval early if noise alone exceeds half of the threshold there
    early = math.exp(-0.125 * (quiet.threshold / quiet.sigma) ** 2) if quiet.sigma else 0.0
    return _touches(
        rows,
        start_noise=max(spacing) * math.sqrt(_UNIFORM**-2.0 + early),
        is_delay_known=False,
        peak_noise=quiet.sigma,
        threshold=quiet.threshold,
        spacing=max(spacing),
        all_found=all_found,
    )


def in_messages(
    t: np.ndarray, begun: np.ndarray, peak: np.ndarray, in_touch: np.ndarray
) -> Touches | None:
    """Find the touches in messages that count touches; None if no touch is found.

    The search ends at the first touch that cannot be separated from another touch, e.g. at a
    message that counts two touches, as it has only one peak for both.  Durations and impulses are
    NaN, and walls are 0.

    The arguments are (n,) each: the times of the messages, s, ascending; the number of touches
    ``begun`` and the ``peak`` force, N, since the message before; and whether the tip is
    ``in_touch`` at the message.
    """
    rows, spacing = [], [0.0]
    for i in np.flatnonzero(begun):
        if i == 0 or begun[i] > 1 or in_touch[i - 1]:
            break
        last = i
        while in_touch[last] and last + 1 < len(t) and not begun[last + 1]:
            last += 1
        start = 0.5 * (t[i - 1] + t[i])
        spacing.append(t[i] - t[i - 1])
        rows.append((start, peak[i : last + 1].max(), math.nan, start, math.nan, 0.0))
    if not rows:
        return None
    return _touches(rows, start_noise=max(spacing) / _UNIFORM)


def _touches(rows: Sequence[tuple[float, ...]], **noise: Any) -> Touches:
    return Touches(**dict(zip(_COLUMNS, np.array(rows).T, strict=True)), **noise)


def _peak(t: np.ndarray, values: np.ndarray, sigma: float) -> tuple[float, float]:
    """Return time and value of the peak of a touch, s and N, from samples with noise, N.

    It is the maximum of a cubic smoothing spline (Reinsch, 1967), which passes through a few
    samples and smooths many.  The largest of many samples would be too high by some sigma.  A
    parabola through the largest of a few samples would be too low, by 2 % for a touch of 0.35 ms
    and samples 50 us apart.
    """
    # imported here: the import takes a quarter of a second, and only sampled forces need it
    from scipy.interpolate import UnivariateSpline

    count = len(t)
    residual = max(count - _BELOW_NOISE * math.sqrt(2.0 * count), 0.0) * sigma**2
    curve = UnivariateSpline(t, values, k=3, s=residual)
    times = np.linspace(t[0], t[-1], _POINTS * count)
    forces = curve(times)
    top = int(np.argmax(forces))
    return float(times[top]), float(forces[top])
