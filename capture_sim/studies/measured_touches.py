"""The first touches of a run: as events tell them, or found in the contact force that was measured.

A touch of the tip lasts some third of a millisecond, so a force tells of it only when it is
sampled ten times faster than that, or when each message carries the peak since the last one.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from capture_sim.scene.parts import Cone

#: Samples that a touch must have above the threshold for its peak to be known to 1 %.
RESOLVED = 4
#: Samples before the contact that the noise is known from at least.
_QUIET = 50
#: Chance that noise alone passes the threshold anywhere in the recording.
_FALSE_ALARM = 1e-3
#: Where a sensor has no noise at all, this part of the largest force is none.
_NOTHING = 1e-3


@dataclass(frozen=True)
class Touches:
    """The first touches of a run, in order.

    Attributes
    ----------
    start : ndarray (n,)
        s.
    peak : ndarray (n,)
        Of the normal force, N.
    start_noise, peak_noise
        Standard deviations, s and N.
    least
        N; touches whose peak is below it were not seen.
    spacing
        s between the samples of the force they were found in; 0 where none can be missed.
    """

    start: np.ndarray
    peak: np.ndarray
    start_noise: float
    peak_noise: float
    least: float = 0.0
    spacing: float = 0.0

    def could_be_missed(self, lasted: np.ndarray) -> bool:
        """Whether touches that last so long, s, would have too few samples to be found."""
        return bool(lasted.size) and RESOLVED * self.spacing > float(lasted.min())


class Quiet(NamedTuple):
    """What a force sensor tells before anything touches.

    Attributes
    ----------
    bias : ndarray (2,)
        N.
    sigma
        Standard deviation of a component, N.
    threshold
        Magnitude, N, that noise passes in one of 1000 recordings.
    """

    bias: np.ndarray
    sigma: float
    threshold: float


class Found(NamedTuple):
    """A stretch of samples in which the force is above the noise.

    Attributes
    ----------
    first, end
        Its samples.
    """

    first: int
    end: int


def quiet_before_contact(force: np.ndarray) -> Quiet | None:
    """Return bias, noise and threshold of a planar force; None when there is too little of it.

    The magnitude of white noise of two components has Rayleigh's distribution: it passes
    k sigma with the chance exp(-k^2 / 2).

    Parameters
    ----------
    force : ndarray (n, 2)
        N; nothing touches at its beginning.
    """
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
        until = max(until, int(above[0]) - RESOLVED if above.size else n)
    return Quiet(bias, sigma, threshold)


def stretches_above(size: np.ndarray, threshold: float) -> list[Found]:
    """Return where a magnitude (n,) passes the threshold; each ends below half of it."""
    low = np.concatenate([[0], (size > 0.5 * threshold).astype(np.int8), [0]])
    edges = np.flatnonzero(np.diff(low))
    return [
        Found(int(first), int(end))
        for first, end in zip(edges[::2], edges[1::2], strict=True)
        if size[first:end].max() > threshold
    ]


def normal_force(force: np.ndarray, attitude: np.ndarray, cone: Cone) -> np.ndarray:
    """Return the part of a force on the tip that is normal to the wall it comes from, (n,), N.

    Friction acts along the wall and leaves it as it is.

    Parameters
    ----------
    force : ndarray (n, 2)
        N, in the tip's frame.
    attitude : ndarray (n,)
        Of the tip in the cone, rad.
    cone
        Its walls.
    """
    c, s = np.cos(attitude), np.sin(attitude)
    along = c * force[:, 0] - s * force[:, 1]
    across = s * force[:, 0] + c * force[:, 1]
    return np.asarray(-math.sin(cone.beta) * along + math.cos(cone.beta) * np.abs(across))


def touches_in_force(
    t: np.ndarray,
    force: np.ndarray,
    attitude: np.ndarray,
    cone: Cone,
    count: int,
    start_noise: float,
    peak_noise: float,
) -> Touches | None:
    """Find the first touches in a sampled force; None where it shows none, or is too slow for it.

    The first touch with fewer than :data:`RESOLVED` samples ends the search: behind it others
    may have been missed.

    Parameters
    ----------
    t : ndarray (n,)
        s, ascending.
    force, attitude, cone
        See :func:`normal_force`.
    count
        Touches at most.
    start_noise, peak_noise
        Standard deviations of the sensor, s and N; what sampling and noise add is added.
    """
    quiet = quiet_before_contact(force)
    if quiet is None:
        return None
    free = force - quiet.bias
    normal = normal_force(free, attitude, cone)
    start, peak, spacing = [], [], []
    for first, end in stretches_above(np.hypot(*free.T), quiet.threshold)[:count]:
        if first == 0 or end - first < RESOLVED:
            break
        spacing.append(t[first] - t[first - 1])
        start.append(0.5 * (t[first - 1] + t[first]))
        peak.append(_vertex(normal, first + int(np.argmax(normal[first:end]))))
    if not start:
        return None
    # the touch began anywhere between two samples
    late = max(spacing) / math.sqrt(12.0)
    return Touches(
        np.array(start),
        np.array(peak),
        math.hypot(start_noise, late),
        max(peak_noise, quiet.sigma),
        quiet.threshold,
        max(spacing),
    )


def touches_told(
    t: np.ndarray,
    begun: np.ndarray,
    peak: np.ndarray,
    in_touch: np.ndarray,
    count: int,
    start_noise: float,
    peak_noise: float,
) -> Touches | None:
    """Find the first touches in messages that tell of what was since the last one; None if none.

    The first message that tells of two touches ends the search: one peak is told of both.

    Parameters
    ----------
    t : ndarray (n,)
        s, ascending.
    begun, peak : ndarray (n,)
        Touches begun and largest force (N) since the message before.
    in_touch : ndarray (n,)
        Whether it touches now.
    count, start_noise, peak_noise
        See :func:`touches_in_force`.
    """
    start: list[float] = []
    peaks: list[float] = []
    spacing: list[float] = []
    for i in np.flatnonzero(begun)[:count]:
        if i == 0 or begun[i] > 1 or in_touch[i - 1]:
            break
        last = i
        while in_touch[last] and last + 1 < len(t) and not begun[last + 1]:
            last += 1
        start.append(0.5 * (t[i - 1] + t[i]))
        spacing.append(t[i] - t[i - 1])
        peaks.append(peak[i : last + 1].max())
    if not start:
        return None
    late = max(spacing) / math.sqrt(12.0)
    return Touches(np.array(start), np.array(peaks), math.hypot(start_noise, late), peak_noise)


def _vertex(values: np.ndarray, i: int) -> float:
    """Return the top of the parabola through a largest value and its neighbours."""
    if not 0 < i < len(values) - 1:
        return float(values[i])
    before, here, after = values[i - 1 : i + 2]
    bend = before - 2.0 * here + after
    return float(here - 0.125 * (after - before) ** 2 / bend if bend < 0.0 else here)
