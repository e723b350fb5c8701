"""Noise, steps and slopes of measured signals, as arrays."""

from __future__ import annotations

import math

import numpy as np

#: The median of |x| of a normal x with standard deviation 1.
_MEDIAN = 0.6744897501960817
#: Samples of a baseline's block, at least, and blocks of a baseline.
_MIN_BLOCK, _N_BLOCKS = 5, 5
#: Duration of such a block, s.
_BLOCK_TIME = 0.1


def noise(values: np.ndarray) -> float:
    """Return the standard deviation of the noise of a smooth signal (n,), from third differences.

    The third difference of white noise has 20 times its variance, that of a smooth motion is small;
    the median keeps jumps from counting.
    """
    if len(values) < 8:
        return 0.0
    return float(np.median(np.abs(np.diff(values, n=3))) / _MEDIAN / math.sqrt(20.0))


def span(values: np.ndarray) -> float:
    """Return the range of a signal (n,) without its outermost hundredths, which may be outliers."""
    if not len(values):
        return 0.0
    low, high = np.percentile(values, [1.0, 99.0])
    return float(high - low)


def smooth(values: np.ndarray, count: int) -> np.ndarray:
    """Return running medians of ``count`` values, (n - count + 1,); as they are if there are fewer.

    Two bad frames of nine do not count.
    """
    if len(values) < count:
        return values
    windows = np.lib.stride_tricks.sliding_window_view(values, count)
    return np.asarray(np.median(windows, axis=1))


def baseline(t: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Return what a sensor (n, m) reads without an event, as known just before each time, (n, m).

    It goes on along a line through the medians of the five tenths of a second before: slow drift is
    in it, a touch is not.  The first tenth counts for itself.
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


def onset(t: np.ndarray, values: np.ndarray, least: float) -> tuple[float, float] | None:
    """Return when a signal (n, m) first leaves its baseline, s, and the noise; None if never.

    It leaves it with two of three successive samples: by six standard deviations and ``least``.
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
    """Return the slope of a line through values (n,), 1/s, and its standard error."""
    if len(t) < 3 or t[-1] <= t[0]:
        return 0.0, math.inf
    middle = t - t.mean()
    square = float(middle @ middle)
    rate = float(middle @ values) / square
    rest = values - values.mean() - rate * middle
    return rate, math.sqrt(float(rest @ rest) / (len(t) - 2) / square)
