"""Rest: the one check of whether a body, or the buffer, is at rest by its measurements.

It is asked before a release (chaser, target, buffer), after a hold (has the chaser stopped?) and
for a chaser that was put back at its start.  A body is at rest if, over the last :data:`WINDOW`,

- the medians of blocks of 0.1 s, and that of the newest values, differ by at most the excursion,
- straight lines through the whole window and through its newest half are at most as steep as the
  speed,

and if this was true at every evaluation of the last :data:`SETTLE`.  Two medians at two instants
are not enough: an oscillation passes them at each turning point.

The limits follow from what a release may do.  A chaser that is let go at a speed v along the rail
gains the same energy from the string, so that the speed of impact is sqrt(v_0^2 + v^2), i.e. about
v^2 / (2 v_0) above v_0.  At v_0 = 0.1 m/s, 4 mm/s are 0.08 % of it, and the fastest oscillation
below 2 Hz that stays within an excursion of 2.5 mm, 16 mm/s, is 1.2 %.
"""

from __future__ import annotations

import itertools
import math
from collections import deque
from collections.abc import Collection, Sequence
from statistics import median
from typing import NamedTuple

import numpy as np

Pose = tuple[float, float, float]  # x, y (m), heading (rad), in the world

#: Window of the measurements that are compared, s, and the part of it that they must cover.
WINDOW, MIN_SPAN = 1.0, 0.8
#: Minimum number of measurements in the window.
MIN_COUNT = 8
#: Time for which each evaluation must have found rest, s: a sway passes at its turning points.
SETTLE = 0.5
#: Length of a block, s, and number of newest measurements that are a block of their own: a push
#: shows at its second measurement or, from 30 Hz on, at the second of three.
BLOCK, N_NEWEST = 0.1, 3
#: Time between two evaluations while measurements arrive, s.
EVALUATION_PERIOD = 0.05
#: Age up to which the newest measurement shows the present, s.
MAX_AGE = 0.1
#: Measurements before a longer gap do not count, s: the body may have moved in it.
MAX_GAP = 0.3
#: Standard deviations of a block's median by which noise enlarges the permitted excursion: ten
#: medians of noise have a range of 3.1 of them on average.
NOISE_FACTOR = 3.0
#: Standard deviation of third differences of noise, in units of that of the noise.
_THIRD_DIFFERENCES = math.sqrt(20.0)
#: Median of the absolute values of normal noise, in units of its standard deviation.
_MEDIAN_OF_NORMAL = 0.6745
#: Standard deviation of a median, times the root of the number of values.
_MEDIAN_DEVIATION = 1.25
#: A chaser within this distance of its start is back at its start, m.
MAX_START_ERROR = 0.05


class RestLimit(NamedTuple):
    """Limits of one coordinate of a body at rest; SI units."""

    excursion: float  # largest difference of the blocks' medians
    speed: float  # of a straight line
    max_noise: float  # standard deviation; more noise than this counts as motion
    is_angle: bool = False


_LENGTH = RestLimit(0.0025, 0.004, 0.0008)
_ANGLE = RestLimit(0.015, 0.01, 0.005, is_angle=True)
#: Limits of a vehicle: x, y and heading.
POSE_LIMITS = (_LENGTH, _LENGTH, _ANGLE)
#: Limits of the buffer: stroke and torsion.
BUFFER_LIMITS = (_LENGTH, _ANGLE)


class Motion(NamedTuple):
    """Motion of one coordinate over the window, and the excursion that its noise permits."""

    excursion: float
    speed: float  # the larger one of the window and of its newest half
    permitted: float
    limit: RestLimit

    @property
    def is_rest(self) -> bool:
        """True if excursion and speed are within their limits."""
        return self.excursion <= self.permitted and self.speed <= self.limit.speed

    @property
    def text(self) -> str:
        """The motion in words."""
        unit, scale = ("degrees", math.degrees(1.0)) if self.limit.is_angle else ("mm", 1e3)
        return (
            f"moves by {scale * self.excursion:.3g} {unit} within {WINDOW:g} s, at "
            f"{scale * self.speed:.3g} {unit}/s"
        )


class Rest:
    """Evaluates the latest measurements of one source; the caller adds only finite, new ones.

    ``limits``: one for each coordinate, e.g. :data:`POSE_LIMITS`.  Times are s by a steady clock.
    """

    def __init__(self, limits: Sequence[RestLimit] = POSE_LIMITS) -> None:
        self._limits = limits
        self._rows: deque[tuple[float, tuple[float, ...]]] = deque()  # s, arrival
        self._since = math.inf  # s, time since which each evaluation has found rest
        self._evaluated = -math.inf  # s, arrival of the newest row of the last evaluation
        self._motions: tuple[Motion, ...] = ()  # of that evaluation; empty: too few rows

    def add(self, values: Sequence[float], now: float) -> None:
        """Add a measurement that arrived at ``now``."""
        rows = self._rows
        if rows and now > rows[-1][0] + MAX_GAP:
            rows.clear()
        rows.append((now, tuple(values[: len(self._limits)])))
        while rows[0][0] < now - WINDOW:
            rows.popleft()
        if now >= self._evaluated + EVALUATION_PERIOD:
            self._evaluate()

    def median(self, now: float) -> tuple[float, ...] | None:
        """Return the median of each coordinate in the window before ``now``; None without any."""
        rows = [values for t, values in self._rows if t >= now - WINDOW]
        return median_of(rows, self._limits) if rows else None

    def newest(self) -> tuple[float, ...] | None:
        """Return the median of the newest block; None before there are :data:`N_NEWEST`."""
        rows = [values for t, values in self._rows if t >= self._rows[-1][0] - BLOCK]
        rows = rows if len(rows) >= N_NEWEST else [values for _, values in self._rows][-N_NEWEST:]
        return median_of(rows, self._limits) if len(rows) >= N_NEWEST else None

    def is_at_rest(self, now: float) -> bool:
        """Return True if the measurements show that the body is at rest at ``now``."""
        return not self.problem(now)

    def motion(self, now: float) -> str:
        """Return the body's motion in words; empty if it is at rest or if that is unknown."""
        self._evaluate()
        if not self._rows or now > self._rows[-1][0] + MAX_GAP:
            return ""
        moving = [each for each in self._motions if not each.is_rest]
        by_excess = [max(m.excursion / m.permitted, m.speed / m.limit.speed) for m in moving]
        return moving[by_excess.index(max(by_excess))].text if moving else ""

    def problem(self, now: float) -> str:
        """Return why the body is not at rest at ``now``, or why that is unknown; empty at rest."""
        self._evaluate()
        if not self._rows:
            return "has no measurement that tells whether it is at rest"
        latest = self._rows[-1][0]
        if motion := self.motion(now):
            return motion
        if not self._motions:
            return (
                "has too few measurements to tell whether it is at rest: must be "
                f"{MIN_COUNT} in {WINDOW:g} s without a gap of {MAX_GAP:g} s"
            )
        if now > latest + MAX_AGE:
            return f"was last measured {now - latest:.2g} s ago: must be at most {MAX_AGE:g}"
        if latest < self._since + SETTLE:
            return f"is at rest for {latest - self._since:.1g} s: must be {SETTLE:g}"
        return ""

    def _evaluate(self) -> None:
        """Evaluate the rows, if there are new ones since the last evaluation."""
        rows = self._rows
        if not rows or rows[-1][0] <= self._evaluated:
            return
        self._evaluated = rows[-1][0]
        self._motions = self._motions_of_rows()
        if not self._motions or not all(each.is_rest for each in self._motions):
            self._since = math.inf
        else:
            self._since = min(self._since, self._evaluated)

    def _motions_of_rows(self) -> tuple[Motion, ...]:
        rows = self._rows
        if len(rows) < MIN_COUNT or rows[-1][0] - rows[0][0] < MIN_SPAN:
            return ()
        times = np.array([t for t, _ in rows])
        table = np.array([values for _, values in rows])
        for i, limit in enumerate(self._limits):
            if limit.is_angle:
                table[:, i] = np.unwrap(table[:, i])
        blocks = _blocks(times)
        size = median(block.stop - block.start for block in blocks)
        if blocks[-1].stop - blocks[-1].start > N_NEWEST:
            blocks.append(slice(len(times) - N_NEWEST, len(times)))
        ordered = [np.sort(table[block], axis=0) for block in blocks]
        medians = np.array([0.5 * (x[(len(x) - 1) // 2] + x[len(x) // 2]) for x in ordered])
        excursions = np.ptp(medians, axis=0)
        noise = np.minimum(_noise(table), [limit.max_noise for limit in self._limits])
        of_block = noise if size < N_NEWEST else _MEDIAN_DEVIATION * noise / math.sqrt(size)
        whole, _ = _slopes(times, table, noise)
        is_newest = times >= times[-1] - 0.5 * WINDOW
        newest, deviation = _slopes(times[is_newest], table[is_newest], noise)
        # half of the window is less exact: one standard deviation is no motion
        speeds = np.maximum(whole, newest - deviation)
        return tuple(
            Motion(excursion, speed, limit.excursion + NOISE_FACTOR * deviation, limit)
            for excursion, speed, deviation, limit in zip(
                *(each.tolist() for each in (excursions, speeds, of_block)),
                self._limits,
                strict=True,
            )
        )


class HeldWatch:
    """Checks that a chaser stops once it is held again after a release.

    ``timeout``: time in which the chaser must stop, s.  Otherwise :attr:`alarm` reports the motion
    until the chaser is at rest at its start.  If too few poses arrive to tell at that time, the
    check is made as soon as there are enough.
    """

    def __init__(self, timeout: float) -> None:
        self._timeout = timeout
        self._start: tuple[float, ...] | None = None  # pose at the release
        self._held: float = math.nan  # s, time of the hold; NaN while nothing is checked
        self.alarm = ""

    def let_go(self, pose: tuple[float, ...] | None) -> None:
        """Note that the chaser is released at this pose."""
        self._start, self._held = pose, math.nan

    def hold(self, now: float) -> None:
        """Note that the chaser is held from ``now`` on, s."""
        self._held = now

    def update(self, rest: Rest, now: float) -> None:
        """Check the motion at ``now``, s, and set or clear :attr:`alarm`."""
        if not self.alarm and math.isnan(self._held):
            return
        is_at_rest = rest.is_at_rest(now)
        if self.alarm:
            pose = rest.median(now)
            if is_at_rest and pose and (self._start is None or _is_near(pose, self._start)):
                self.alarm = ""
        elif is_at_rest and now > self._held + SETTLE:
            self._held = math.nan
        elif now > self._held + self._timeout and (motion := rest.motion(now)):
            # with too few poses to tell, as in a dropout, the check goes on
            self._held = math.nan
            self.alarm = (
                f"the chaser {motion}, {self._timeout:g} s after launcher/hold was set: its "
                "driver does not hold it; nothing is let go before it is at rest at its start"
            )


def median_of(
    rows: Collection[Sequence[float]], limits: Sequence[RestLimit] = POSE_LIMITS
) -> tuple[float, ...]:
    """Return the median of each coordinate of a body at rest; angles may differ by turns."""
    columns = zip(*rows, strict=True)
    return tuple(
        x[0] + median(math.remainder(each - x[0], math.tau) for each in x)
        if limit.is_angle
        else median(x)
        for x, limit in zip(columns, limits, strict=True)
    )


def _blocks(times: np.ndarray) -> list[slice]:
    """Return the rows of each block of :data:`BLOCK`, counted from the newest, the oldest first."""
    number = (times[-1] - times) // BLOCK
    ends = [0, *(np.flatnonzero(np.diff(number)) + 1).tolist(), len(times)]
    return [slice(begin, end) for begin, end in itertools.pairwise(ends)]


def _noise(table: np.ndarray) -> np.ndarray:
    """Return the standard deviation of the noise of each column, by its third differences."""
    spread = np.sort(np.abs(np.diff(table, 3, axis=0)), axis=0)[(len(table) - 3) // 2]
    return np.asarray(spread) / _MEDIAN_OF_NORMAL / _THIRD_DIFFERENCES


def _slopes(
    times: np.ndarray, table: np.ndarray, noise: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the speeds of straight lines (least squares) and their standard deviations."""
    centred = times - times.mean()
    square = float(centred @ centred)
    if square == 0.0:
        return np.zeros(len(noise)), np.full(len(noise), math.inf)
    return np.abs(centred @ table) / square, noise / math.sqrt(square)


def _is_near(pose: Sequence[float], start: Sequence[float]) -> bool:
    return math.dist(pose[:2], start[:2]) <= MAX_START_ERROR
