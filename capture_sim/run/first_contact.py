"""The first contact of a run: its touches, its end, and the impact speed."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence

import numpy as np

from capture_sim.dynamics.samples import Event, EventKind


def first_cluster(touches: np.ndarray) -> np.ndarray:
    """Return the touches of the first contact, (m,) of dtype TOUCH, from a run's touches (n,).

    A light tip chatters on the wall before it slides.  The first contact is with the wall that the
    tip touches first.  It ends when the tip touches the other wall, or at a pause that is longer
    than the chatter before it.  The length of the chatter is the time from the start of its first
    touch to the start of its last touch.  The pause after the very first touch has no chatter
    before it, so it is compared with the chatter that follows, from the start of the second touch
    to the end of the last one.
    """
    ordered = touches[np.argsort(touches["start"], kind="stable")]
    # as lists, because access to single elements of an array is slow
    start, end, wall = (ordered[name].tolist() for name in ("start", "end", "wall"))
    count = _count_chatter(start, end, wall)
    return ordered[: _count_first_contact(start, end, count)]


def first_contact_end(events: Iterable[Event], now: float) -> float | None:
    """Return the time at which the first contact ended, s since the release.

    The result is None if the first contact has not begun, or if it may still go on at time ``now``,
    s.  ``events`` are the events of the run up to ``now``.
    """
    starts = [event for event in events if event.kind is EventKind.TOUCH]
    start = [event.t for event in starts]
    end = [math.inf] * len(start)
    for touch in (event.touch for event in events if event.touch is not None):
        end = [touch["end"] if t == touch["start"] else e for t, e in zip(start, end, strict=True)]
    count = _count_chatter(start, end, [event.wall for event in starts])
    if count == 0:
        return None
    may_continue = count < 2 or now - end[count - 1] <= start[count - 1] - start[0]
    if may_continue and count == len(start):
        return None
    contact_end = float(end[_count_first_contact(start, end, count) - 1])
    return contact_end if math.isfinite(contact_end) else None


def _count_chatter(start: Sequence[float], end: Sequence[float], wall: Sequence[int]) -> int:
    """Return the number of touches up to the first long pause, or to a touch of the other wall.

    A pause is long if it exceeds the time from the first start to the last start before it.
    """
    size = next((k for k, side in enumerate(wall) if side != wall[0]), len(start))
    for count in range(2, size):
        if start[count] - end[count - 1] > start[count - 1] - start[0]:
            return count
    return size


def _count_first_contact(start: Sequence[float], end: Sequence[float], count: int) -> int:
    """Return the number of touches of the first contact: 1 or ``count``.

    It is 1 if the pause after the first touch is longer than the time from the start of the second
    touch to the end of touch number ``count``.
    """
    is_single = count > 1 and start[1] - end[0] > end[count - 1] - start[1]
    return 1 if is_single else count


def impact_speed(events: Iterable[Event]) -> float | None:
    """Return the speed of the chaser relative to the target at the first touch, m/s.

    The result is None if there is no touch, and NaN if the speed was not measured.
    """
    touch = first_touch(events)
    if touch is None:
        return None
    return math.hypot(touch.v[0] - touch.v[5], touch.v[1] - touch.v[6])


def first_touch(events: Iterable[Event]) -> Event | None:
    """Return the first TOUCH event; None if there is no touch."""
    return next((event for event in events if event.kind is EventKind.TOUCH), None)
