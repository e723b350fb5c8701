"""The touches of a run: located by events, or found in a measured force.

A touch of the tip lasts about a third of a millisecond.  So a sampled force shows it only if its
rate is ten times higher than that, or if each message carries the peak since the last one.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from capture_sim.plausibility.signals import baseline
from capture_sim.scene.parts import Cone

#: Samples that a touch must have above the threshold for its peak to be known to 1 %.
MIN_SAMPLES = 4
#: Samples before the contact that the noise is known from at least.
_QUIET = 50
#: Chance that noise alone passes the threshold anywhere in the recording.
_FALSE_ALARM = 1e-3
#: Where a sensor has no noise at all, this part of the largest force is none.
_NOTHING = 1e-3
#: Part of a touch's force that must be across the tip's axis to tell the wall.
_ACROSS = 0.1
#: A curve through n samples leaves this many standard deviations, sqrt(2 n), less than the n that
#: their noise has in the sum of its squares: few samples are met, many are smoothed.
_BELOW_NOISE = 2.0
#: Points of that curve per sample, of which the largest is the peak: of a half sine through four
#: samples it is low by 2e-4 at most.
_POINTS = 20
#: A zero that moves by this many standard deviations of its means, and this part of the noise,
#: drifts.
_DRIFT_DEVIATIONS, _LEAST_DRIFT = 6.0, 0.5
#: A touch began anywhere between two samples: an interval is this many standard deviations.
_UNIFORM = math.sqrt(12.0)
#: The trapezoidal rule over a touch by Hertz's law of n samples is wrong by so much times n^-2.5
#: of the impulse: standard deviation over where the samples fall.
_SAMPLING = 0.28
#: An impact speed is measured if poses come this close to the contact, m: over this distance
#: rolling resistance changes 0.1 m/s by 2 %.
MAX_UNSEEN_TRAVEL = 0.02
#: Sample times are decimal fractions: a window may end a rounding short of one, s.
TICK = 1e-9
_COLUMNS = ("start", "peak", "lasted", "peak_time", "impulse", "wall")


@dataclass(frozen=True)
class Touches:
    """Touches of a run, (n,) each, in order; unknown values are NaN (wall: 0)."""

    start: np.ndarray  # s
    peak: np.ndarray  # N, of the normal force, or of the magnitude where that was measured
    lasted: np.ndarray  # s
    peak_time: np.ndarray  # s
    impulse: np.ndarray  # N s
    wall: np.ndarray  # +1 or -1
    start_noise: float = 0.0  # standard deviation, s
    peak_noise: float = 0.0  # standard deviation, N
    threshold: float = 0.0  # N; touches whose peak is below it were not seen
    spacing: float = 0.0  # s between the samples they were found in; 0 where none can be missed
    all_found: bool = True  # False if the force shows further ones, too short for its samples
    is_delay_known: bool = True  # False if a filter or another clock may delay all of them alike

    def of(self, kept: np.ndarray | slice) -> Touches:
        """Return some of the touches."""
        return replace(self, **{name: getattr(self, name)[kept] for name in _COLUMNS})

    def later(self, by: float) -> Touches:
        """Return these touches with all times shifted by ``by``, s."""
        return replace(self, start=self.start + by, peak_time=self.peak_time + by)

    def within(self, contact: float, window: float) -> Touches:
        """Return the touches within the window after a first contact, which becomes t = 0."""
        shifted = self.later(-contact)
        return shifted.of((shifted.start >= -TICK) & (shifted.start <= window))

    def with_noise(self, start: float, peak: float) -> Touches:
        """Return the touches with a sensor's noise, s and N, added to the sampling's."""
        start_noise = math.hypot(self.start_noise, start)
        return replace(self, start_noise=start_noise, peak_noise=max(self.peak_noise, peak))

    def with_default_noise(self, start: float, peak: float) -> Touches:
        """Return the touches with this noise, s and N, each where theirs is not known.

        Events have neither, counted touches only that of their times.
        """
        return replace(
            self, start_noise=self.start_noise or start, peak_noise=self.peak_noise or peak
        )

    @property
    def strength(self) -> str:
        """The field that a fit compares: ``"impulse"`` of a sampled force, else ``"peak"``.

        Sampling and low-pass filters lower a peak, by 10 % with a filter of 4 kHz and a touch of
        0.35 ms.  They leave the impulse as it is.
        """
        return "impulse" if self.spacing > 0.0 and np.isfinite(self.impulse).all() else "peak"

    @property
    def strength_noise(self) -> np.ndarray:
        """Standard deviations of the strengths, (n,): an impulse is a sum of samples."""
        if self.strength == "peak":
            return np.full(self.start.size, self.peak_noise)
        samples = self.lasted / self.spacing
        of_force = self.peak_noise * self.spacing * np.sqrt(samples + 2.0)  # with both flanks
        return np.hypot(of_force, _SAMPLING * samples**-2.5 * self.impulse)

    def may_miss(self, lasted: np.ndarray | float) -> bool:
        """True if touches that last so long, s, could have too few samples to be found."""
        shortest = float(np.min(lasted, initial=math.inf))
        return MIN_SAMPLES * self.spacing > shortest


def located(touches: np.ndarray) -> Touches:
    """Return the touches of events, (n,) of dtype TOUCH, in the order of their starts."""
    t = touches[np.argsort(touches["start"], kind="stable")]
    lasted = t["end"] - t["start"]
    return Touches(t["start"], t["peak_force"], lasted, t["peak_time"], t["impulse"], t["wall"])


def unseen_impact(travel: float) -> str:
    """Return why an impact speed is not measured; empty if it is.

    ``travel``: how far the tip went before the contact without poses, m.
    """
    if travel <= MAX_UNSEEN_TRAVEL:
        return ""
    return f"impact speed not measured: no poses in the last {1e3 * travel:.3g} mm before it"


class Quiet(NamedTuple):
    """Reading of a force sensor before the first contact."""

    bias: np.ndarray  # (2,), N; (n, 2) if it drifts
    sigma: float  # standard deviation of a component, N
    threshold: float  # magnitude that noise passes in one of 1000 recordings, N


def quiet_before_contact(t: np.ndarray, force: np.ndarray) -> Quiet | None:
    """Return bias, noise and threshold of a force (n, 2), N; None when there is too little of it.

    Nothing touches at its beginning, and its zero may drift: slowly, unlike a touch.  The magnitude
    of white noise of two components has Rayleigh's distribution: it passes k sigma with the chance
    exp(-k^2 / 2).
    """
    zero = _drifting_zero(t, force)
    if zero is None:
        return _quiet(force)
    quiet = _quiet(force - zero)
    return None if quiet is None else quiet._replace(bias=zero + quiet.bias)


def _drifting_zero(t: np.ndarray, force: np.ndarray) -> np.ndarray | None:
    """Return the zero of a force that drifts, (n, 2), N, at times (n,), s; None if it does not.

    Before the contact the zero is a running median.  After it the zero is extrapolated along a
    line.
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
    # both means have noise; a drift that is less than a part of the noise changes nothing
    limit = max(_DRIFT_DEVIATIONS * math.sqrt(2.0 / quarter), _LEAST_DRIFT) * quiet.sigma
    if float(np.abs(moved).max()) <= max(limit, 1e-9):
        return None
    zero = zero.copy()
    if first < len(t):
        rate = moved / (t[first - quarter // 2 - 1] - t[quarter // 2])
        zero[first:] = zero[first] + np.outer(t[first:] - t[first], rate)
    return zero


def _quiet(force: np.ndarray) -> Quiet | None:
    """Return bias, noise and threshold of a force (n, 2), N, whose zero does not drift."""
    n = len(force)
    until = max(_QUIET, n // 20)
    if n < until:
        return None
    k = math.sqrt(2.0 * math.log(n / _FALSE_ALARM))
    for _ in range(2):  # from the beginning, then from all before the contact found so
        before = force[:until]
        bias = np.median(before, axis=0)
        sigma = float(np.median(np.abs(before - bias)) / 0.6745)
        size = np.hypot(*(force - bias).T)
        threshold = max(k * sigma, _NOTHING * float(size.max()))
        above = np.flatnonzero(size > threshold)
        until = max(until, int(above[0]) - MIN_SAMPLES if above.size else n)
    return Quiet(bias, sigma, threshold)


def above(size: np.ndarray, threshold: float) -> list[slice]:
    """Return where a magnitude (n,) passes the threshold; each slice ends below half of it."""
    inside = np.concatenate([[False], size > 0.5 * threshold, [False]])
    starts, ends = np.flatnonzero(inside[1:] != inside[:-1]).reshape(-1, 2).T.tolist()
    parts = [slice(start, end) for start, end in zip(starts, ends, strict=True)]
    return [part for part in parts if size[part].max() > threshold]


def first_above(t: np.ndarray, force: np.ndarray) -> float | None:
    """Return when a force (n, 2) first passes its noise, s; None if it never does."""
    quiet = quiet_before_contact(t, force)
    if quiet is None:
        return None
    found = above(np.hypot(*(force - quiet.bias).T), quiet.threshold)
    return float(t[found[0].start]) if found else None


def normal_force(
    force: np.ndarray, attitude: np.ndarray, cone: Cone, wall: float = 0.0
) -> np.ndarray:
    """Return the part of a force on the tip that is normal to the wall it comes from, (n,), N.

    The force (n, 2), N, is in the tip's frame, whose attitude (n,), rad, is that in the cone.
    Friction acts along the wall and leaves the normal part as it is.  Without a ``wall``, +1 or -1,
    each sample counts for the wall that pushes its way, which turns noise into a force.
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
    """Find the touches in a sampled force; None where it shows none, or is too slow for it.

    The first touch with fewer than :data:`MIN_SAMPLES` samples ends the search: behind it others
    may have been missed.  A touch starts and ends between two samples; its peak is that of a curve
    through them (see :func:`_peak`).

    Times (n,), s, ascend; the force (n, 2), N, is in the tip's frame, with bias and noise, and
    nothing touches at its beginning.  With the tip's attitude (n,), rad, in the cone, peak and
    impulse are those of the normal force, else those of the magnitude, friction included.
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
        # from the sample before the touch to the one after it: the flanks belong to the impulse
        with_flanks = slice(first - 1, min(end + 1, len(t)))
        values = size[with_flanks]
        if attitude is not None and cone is not None:
            values = normal_force(net[with_flanks], attitude[with_flanks], cone, wall)
        times = t[with_flanks]
        impulse = float(0.5 * (values[1:] + values[:-1]) @ np.diff(times))
        if impulse <= 0.0:
            continue  # a wall never pulls: a filter overshoots after a touch
        peak_time, peak = _peak(times, values, quiet.sigma)
        start, stop = 0.5 * (t[first - 1] + t[first]), 0.5 * (t[end - 1] + times[-1])
        spacing.append(t[first] - t[first - 1])
        rows.append((start, peak, stop - start, peak_time, impulse, wall))
    if not rows:
        return None
    # noise alone makes it an interval early where it passes the level that a touch begins at
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
    """Find the touches in messages that count them since the last one; None if none.

    The first message that counts two touches ends the search: it has one peak for both.  Of each
    message, (n,): time (s, ascending), touches begun and largest force (N) since the one before,
    and whether it touches now.
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

    It is the top of a cubic spline, which meets a few samples and smooths many (Reinsch, 1967).
    The largest of many samples would read high by some sigma, and a parabola through the largest
    of a few reads low, by 2 % where they are 50 us apart and the touch lasts 0.35 ms.
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
