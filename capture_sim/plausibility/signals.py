"""Noise, baseline, onset and slope of measured signals, given as arrays."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

#: The median of |x| of a normal x with standard deviation 1.
_MEDIAN = 0.6744897501960817
#: Least number of samples in a block of :func:`baseline`, and number of blocks in its line.
_MIN_BLOCK, _N_BLOCKS = 5, 5
#: Duration of a block of :func:`baseline`, s, unless that is too short for its samples.
_BLOCK_TIME = 0.1


def noise(values: np.ndarray) -> float:
    """Return the standard deviation of the noise on a smooth signal (n,); 0 if n < 8.

    It is estimated from third differences of the samples, which must be evenly spaced.  The third
    difference of white noise has 20 times the variance of the noise; that of a smooth motion is
    small.  The median of their sizes is used, so that single jumps have no influence.
    """
    if len(values) < 8:
        return 0.0
    return float(np.median(np.abs(np.diff(values, n=3))) / _MEDIAN / math.sqrt(20.0))


def span(values: np.ndarray) -> float:
    """Return the range of a signal (n,) between its 1st and 99th percentiles; 0 if n = 0.

    The samples beyond these percentiles are left out, because they may be outliers.
    """
    if not len(values):
        return 0.0
    low, high = np.percentile(values, [1.0, 99.0])
    return float(high - low)


def smooth(values: np.ndarray, count: int) -> np.ndarray:
    """Return running medians over ``count`` successive values, (n - count + 1,).

    If n < ``count``, the values are returned unchanged, (n,).  Outliers have little influence while
    they are fewer than half of the values of a window.
    """
    if len(values) < count:
        return values
    windows = np.lib.stride_tricks.sliding_window_view(values, count)
    return np.asarray(np.median(windows, axis=1))


def baseline(t: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Return what a sensor would read at each time ``t`` (n,), s, without contact, (n, m).

    ``values`` (n, m) are its readings of m components, with evenly spaced times.  They are divided
    into blocks of 0.1 s, or of five samples if those last longer.  The medians of the five blocks
    before a sample's block are extrapolated to the sample along a straight line.  The baseline thus
    follows a slow drift, but not a touch.

    Samples near the begin have fewer blocks before them.  In the second to fifth block the baseline
    is the mean of the earlier medians; in the first block it is that block's own median.  If there
    are fewer than two full blocks, it is the median of all values; if n < 2, it is the values.
    """
    n = len(t)
    if n < 2:
        return values.copy()
    interval = max(float(np.median(np.diff(t))), 1e-6)
    size = max(_MIN_BLOCK, round(_BLOCK_TIME / interval))
    n_blocks = n // size
    if n_blocks < 2:
        return np.broadcast_to(np.median(values, axis=0), values.shape)
    medians = np.median(values[: n_blocks * size].reshape(n_blocks, size, -1), axis=1)
    level, rate = np.empty((2, n_blocks + 1, values.shape[1]))
    level[0], rate[0] = medians[0], 0.0
    for k in range(1, min(_N_BLOCKS, n_blocks + 1)):
        level[k], rate[k] = medians[:k].mean(axis=0), 0.0
    if n_blocks >= _N_BLOCKS:
        windows = np.lib.stride_tricks.sliding_window_view(medians, _N_BLOCKS, axis=0)
        steps = np.arange(_N_BLOCKS) - 0.5 * (_N_BLOCKS - 1)
        level[_N_BLOCKS:] = windows.mean(axis=-1)
        rate[_N_BLOCKS:] = windows @ (steps / (steps @ steps))
    index = np.arange(n)
    block = np.minimum(index // size, n_blocks)
    # blocks from the middle of those before
    ahead = (index + 0.5) / size - (block - 0.5 * _N_BLOCKS)
    return np.asarray(level[block] + rate[block] * ahead[:, None])


#: A tip that is further than this from the walls does not touch them, m.  Before its first contact
#: the buffer is at rest while the tip, as if the buffer were rigid, is this far ahead of the mouth.
AWAY = 1e-2
#: The zero of an encoder is the median of this many states at rest; it is not known from fewer
#: than the second number.
N_REST, MIN_REST = 200, 20
#: A zero up to this, m at the tip, is left as it is: a quarter of the gap that is a contact.
MIN_ZERO = 5e-5


def zero_of(
    deflections: Sequence[tuple[float, float]] | np.ndarray, length: float
) -> tuple[float, float]:
    """Return what the buffer's encoders show at rest: stroke, m, and torsion, rad.

    ``deflections`` are strokes (m) and torsions (rad) at rest, the newest last; ``length`` is the
    distance from hinge to tip, m.  A zero that is not above both ``MIN_ZERO`` at the tip and five
    standard errors counts as 0.
    """
    if len(deflections) < MIN_REST:
        return 0.0, 0.0
    middle, errors = rest_of(deflections)
    limit = np.maximum(5.0 * errors, [MIN_ZERO, MIN_ZERO / length])
    stroke, torsion = np.where(np.abs(middle) > limit, middle, 0.0).tolist()
    return stroke, torsion


def rest_of(
    deflections: Sequence[tuple[float, float]] | np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Return the medians of the newest deflections at rest, (2,), and their standard errors, (2,).

    There must be one deflection at least; see :func:`zero_of`.
    """
    values = np.array(deflections[-N_REST:])
    middle = np.median(values, axis=0)
    # of a median of normal noise; the deviation is robust too
    deviation = 1.4826 * np.median(np.abs(values - middle), axis=0)
    return middle, 1.2533 * deviation / math.sqrt(len(values))


def zero_text(zero: tuple[float, float]) -> str:
    """Return a zero of the buffer, from :func:`zero_of`, in words; '' if it is 0."""
    parts = (("stroke", zero[0], "mm"), ("torsion", zero[1], "mrad"))
    shown = [f"{name} {1e3 * value:+.3g} {unit}" for name, value, unit in parts if value]
    return f"{' and '.join(shown)} at rest before the contact: taken out" if shown else ""


def onset(t: np.ndarray, values: np.ndarray, least: float) -> tuple[float, float] | None:
    """Return the time at which a signal first leaves its baseline, s, and its noise.

    ``values`` (n, m) are the signal at the times ``t`` (n,), s; ``least`` is in the signal's unit.
    A sample is off the baseline if its distance from :func:`baseline` exceeds both ``least`` and
    six standard deviations of the noise.  The time is that of the first such sample that has
    another one among the next two.  None if there is none, or if n < 10.

    The noise is the standard deviation of one component, from the first 5 % of the samples, at
    least 20.  It is exact for m = 2 only.
    """
    if len(t) < 10:
        return None
    rest = values - baseline(t, values)
    size = np.sqrt(np.einsum("ij,ij->i", rest, rest))
    quiet = size[: max(len(size) // 20, 20)]
    sigma = float(np.median(quiet) / 1.1774)  # of one component of two (Rayleigh)
    limit = max(6.0 * sigma, least)
    out = size > limit
    pairs = out[:-2] & (out[1:-1] | out[2:])
    found = np.flatnonzero(pairs)
    return (float(t[found[0]]), sigma) if found.size else None


def slope(t: np.ndarray, values: np.ndarray) -> tuple[float, float]:
    """Return the slope of a fitted line, and its standard error, in units of the values per s.

    The line is fitted to ``values`` (n,) at the ascending times ``t`` (n,), s.  (0, inf) if n < 3
    or if all times are equal.
    """
    if len(t) < 3 or t[-1] <= t[0]:
        return 0.0, math.inf
    middle = t - t.mean()
    square = float(middle @ middle)
    rate = float(middle @ values) / square
    rest = values - values.mean() - rate * middle
    return rate, math.sqrt(float(rest @ rest) / (len(t) - 2) / square)
