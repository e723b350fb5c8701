"""Bounds of what measurements say: between which values a figure of a run lies.

A sample says what was before it only if nothing can have happened since the sample before.  The
first contact therefore lies between the last time up to which a source excludes a contact without
a pause, and the first time at which a source shows one.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from typing import NamedTuple

import numpy as np

from capture_sim.plausibility.motion import MIN_MESSAGES, MeasuredMotion
from capture_sim.plausibility.signals import noise

#: Base frames may be off by this, m, so poses exclude a contact only at a larger gap.
_FRAMES = 5e-3
#: Standard deviations of a single measurement by which it may be wrong.
DEVIATIONS = 3.0
#: Samples that are further apart than this, s, and than three of their intervals, have a hole.
HOLE = 0.05
#: A tip that is away from the walls before and after a hole has not met them in it if it had to be
#: this many times as fast as it ever was.
_FASTER = 2.0
#: Time before the tip is near the walls from which the buffer's own motion is taken, s, and the
#: share by which a deflection must exceed it.
_FREE, _SHARE = 0.5, 1.2
#: Least deflection that may be a contact, m.
_LEAST = 2e-5
#: Between two samples a signal may rise above both by this share of its second difference; it is
#: an eighth in a parabola.
_UNSEEN = 0.5
#: Share of a peak that may be unseen, from which on nothing is known of it.
_UNRESOLVED = 0.5


class Bounds(NamedTuple):
    """Values between which a figure lies, and what makes them wide."""

    low: float  # -inf: before the recording
    high: float  # inf: not known
    why: str = ""  # e.g. "no data"; empty if they are as close as the samples

    def later(self, by: float) -> Bounds:
        """Return the bounds of a time with ``by``, s, added."""
        return self._replace(low=self.low + by, high=self.high + by)

    def around(self, value: float) -> float:
        """Return the value, or the bound that it exceeds."""
        return min(max(value, self.low), self.high)

    @property
    def is_wide(self) -> bool:
        """True if they are further apart than samples are."""
        return bool(self.why) or self.high - self.low > HOLE

    def text(self, value: float | None = None) -> str:
        """Return a time and its bounds, s, in words, e.g. ``2.595 s (2.590 to 2.600)``."""
        why = f" ({self.why})" if self.why else ""
        if math.isinf(self.low) and math.isinf(self.high):
            return f"not known{why}"
        if math.isinf(self.low):
            return f"before {self.high:.3f} s{why}"
        if math.isinf(self.high):
            return f"none seen, but possible after {self.low:.3f} s{why}"
        if self.is_wide or value is None:
            return f"between {self.low:.3f} and {self.high:.3f} s{why}"
        return f"{value:.3f} s ({self.low:.3f} to {self.high:.3f})"


UNKNOWN = Bounds(-math.inf, math.inf)


def peak_bounds(
    t: np.ndarray, values: np.ndarray, begin: float, end: float, error: float
) -> Bounds:
    """Return the bounds of the peak of a signal that is sampled at times ``t`` (n,), s, ascending.

    The signal ``values`` (n,) is not negative at its peak.  A larger peak may be hidden where there
    is no sample for longer than :data:`HOLE` between ``begin`` and ``end``, s, and where the signal
    rises and falls within a few samples.  ``error`` is that of the signal's zero.
    """
    if len(t) < MIN_MESSAGES:
        return UNKNOWN._replace(why="no data")
    if math.isinf(error):
        return UNKNOWN._replace(why="the sensor's zero is not known")
    peak, deviation = float(values.max()), DEVIATIONS * noise(values) + error
    low = max(peak - deviation, 0.0)
    is_open = ~_steps(t) & (t[1:] > begin) & (t[:-1] < end)
    if is_open.any() or t[0] > begin + HOLE or t[-1] < end - HOLE:
        return Bounds(low, math.inf, "no data")
    bend = np.pad(np.abs(np.diff(values, n=2)), 1)
    tops = np.maximum(values[:-1], values[1:]) + _UNSEEN * np.maximum(bend[:-1], bend[1:])
    high = float(tops.max()) + deviation
    if high - peak > _UNRESOLVED * peak + deviation:
        return Bounds(low, math.inf, "samples too far apart")
    return Bounds(low, high)


def contact_text(first: tuple[float, str] | None, bounds: Bounds | None) -> str:
    """Return the time of a first contact, its source and its bounds in words."""
    if bounds is None:
        return "none" if first is None else f"{first[0]:.3f} s, by {first[1]}"
    text = bounds.text(None if first is None else first[0])
    return text if first is None or bounds.is_wide else f"{text}, by {first[1]}"


def contact_bounds(motion: MeasuredMotion, shown: Iterable[float] = ()) -> Bounds | None:
    """Return the bounds of the first contact, s after the origin of ``motion``.

    None if there is none and none can be hidden, or if scene or poses are missing.  ``shown`` are
    times at which further sources show a contact, s.
    """
    if motion.scene is None or motion.pair is None or len(motion.smooth_times) < MIN_MESSAGES:
        return None
    t = motion.smooth_times
    margin = _FRAMES + DEVIATIONS * motion.pose_noise
    low = least = float(t[0])
    end = float(t[-1])
    if motion.stiff_gap[0] <= margin:
        low = least = -math.inf
    else:
        by_poses = list(_by_poses(motion, margin))
        least = _reached(low, by_poses)
        low = _reached(low, [*by_poses, *_by_buffer(motion, margin)])
    seen = sorted(
        [
            *shown,
            *_inside(motion, margin),
            *(at for name, at in motion.contacts.items() if name != "poses"),
        ]
    )
    later = [x for x in seen if x >= low]
    earlier = [x for x in seen if least <= x < low]
    if later:
        high = later[0]
        if math.isinf(low):  # no rest before it shows where a source leaves its zero
            high += _sample_interval(motion)
        if earlier:  # poses allow it: stamps of one source are late
            low = max(least, earlier[0] - _sample_interval(motion))
    elif seen:  # a source shows a contact where another one excludes it
        return Bounds(seen[0], low, "the sources differ")
    elif low >= end - HOLE:
        return None
    else:
        high = math.inf
    return Bounds(low, high, _why(motion, low, high))


def _reached(begin: float, excluded: Iterable[tuple[float, float]]) -> float:
    """Return the time up to which intervals cover all from ``begin`` on, s."""
    for low, high in sorted(excluded):
        if low <= begin + 1e-9:
            begin = max(begin, high)
    return begin


def _sample_interval(motion: MeasuredMotion) -> float:
    """Return the largest median interval of buffer and force, s."""
    channels = [x for x in (motion.buffer, motion.force) if x is not None]
    return max((float(np.median(np.diff(np.sort(x.t)))) for x in channels), default=0.0)


def _steps(t: np.ndarray) -> np.ndarray:
    """Return True for each interval of times (n,) that is no hole, (n - 1,)."""
    step = np.diff(t)
    return np.asarray(step <= max(HOLE, 3.0 * float(np.median(step)) if step.size else 0.0))


def _by_poses(motion: MeasuredMotion, margin: float) -> Iterator[tuple[float, float]]:
    """Yield the intervals in which poses exclude a contact."""
    t, gap = motion.smooth_times, motion.stiff_gap
    span = max(int(np.searchsorted(t, t[0] + 0.2)), 1)
    closing = (gap[:-span] - gap[span:]) / (t[span:] - t[:-span])
    fastest = max(float(closing.max(initial=0.0)), 0.01)
    away = gap > margin
    room = (gap[:-1] + gap[1:] - 2.0 * margin) / np.maximum(np.diff(t), 1e-9)
    whole = away[:-1] & away[1:] & (_steps(t) | (room > _FASTER * fastest))
    for k in np.flatnonzero(whole).tolist():
        yield float(t[k]), float(t[k + 1])


def _by_buffer(motion: MeasuredMotion, margin: float) -> list[tuple[float, float]]:
    """Return the intervals in which the buffer excludes a contact; empty if they are not known.

    It does while it is deflected no more than it was before the tip came near the walls.
    """
    buffer, scene = motion.buffer, motion.scene
    if buffer is None or scene is None:
        return []
    kept = buffer.is_measured
    t, first = np.unique(buffer.t[kept], return_index=True)
    values = np.column_stack([buffer.stroke, scene.rest_length * buffer.torsion])[kept][first]
    near = np.flatnonzero(motion.stiff_gap <= margin)
    until = motion.smooth_times[near[0]] if near.size else motion.smooth_times[-1]
    free = (t < until) & (t > until - _FREE)
    if free.sum() < MIN_MESSAGES:
        return []
    size = np.hypot(*(values - np.median(values[free], axis=0)).T)
    limit = _SHARE * float(size[free].max()) + _LEAST
    begin = int(np.flatnonzero(free)[0])
    out = np.flatnonzero(size[begin:] > limit)
    last = begin + int(out[0]) - 1 if out.size else len(t) - 1
    excluded = [
        (float(t[k]), float(t[k + 1])) for k in np.flatnonzero(_steps(t)) if begin <= k < last
    ]
    if out.size and excluded and last + 1 < len(t):
        after = slice(last, min(last + 4, len(t)))
        growth = float((np.diff(size[after]) / np.diff(t[after])).max(initial=0.0))
        ahead = limit / growth if growth > 0.0 else math.inf
        excluded = [(a, min(b, float(t[last]) - ahead)) for a, b in excluded]
    return [(a, b) for a, b in excluded if b > a]


def _inside(motion: MeasuredMotion, margin: float) -> list[float]:
    """Return the time at which poses have an undeflected tip inside of a wall, if they do, s."""
    found = np.flatnonzero(motion.stiff_depth > margin)
    return [float(motion.smooth_times[found[0]])] if found.size else []


def _why(motion: MeasuredMotion, low: float, high: float) -> str:
    """Return what makes the bounds of a time wide; empty if it is the samples' interval."""
    if math.isinf(low):
        return "the recording begins with the tip at the walls"
    if high - low <= HOLE:
        return ""
    lacking = []
    for channel in motion.measured.channels:
        t = np.unique(channel.t[channel.is_measured])
        holes = np.flatnonzero(~_steps(t))
        is_open = any(t[k] < high and t[k + 1] > low for k in holes)
        lacking.append(is_open or t[-1] < min(high, motion.smooth_times[-1]) - HOLE)
    if lacking and all(lacking):
        return "no data"
    return "a source has no data" if any(lacking) else "noise and base frames"


def speed_error(motion: MeasuredMotion, window: float) -> float:
    """Return the standard error of the vehicles' relative speed, m/s, by lines through poses.

    The lines are fitted over ``window``, s; the noise of the poses is white.  NaN without poses.
    """
    pair = motion.pair
    if pair is None:
        return math.nan
    interval = max(float(np.median(np.diff(pair.t))), 1e-6)
    count = max(window / interval, 2.0)
    noises = [noise(x) for pose in (pair.chaser, pair.target) for x in pose.T[:2]]
    of_one = math.sqrt(sum(x * x for x in noises) / 2.0)
    return of_one * math.sqrt(12.0 / count**3) / interval
