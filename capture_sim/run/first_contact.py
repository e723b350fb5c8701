"""The first contact of a run: the touches of its chatter, its end, and its speed."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence

import numpy as np

from capture_sim.dynamics.samples import Event, EventKind


def first_cluster(touches: np.ndarray) -> np.ndarray:
    """Return the touches of the first contact, (m,) of dtype TOUCH, of a run's touches (n,).

    A light tip chatters on the wall before it slides.  The first contact is with the wall touched
    first.  It ends when the tip touches the other wall, or when a pause is longer than the chatter
    before it (from the start of the first touch to the start of the last).  After a single touch
    there is no chatter yet: the pause belongs to the contact if it is shorter than the contact
    that follows.
    """
    ordered = touches[np.argsort(touches["start"], kind="stable")]
    # as plain numbers: NumPy is slow with single ones
    start, end, wall = (ordered[name].tolist() for name in ("start", "end", "wall"))
    count = _count_chatter(start, end, wall)
    return ordered[: _count_first_contact(start, end, count)]


def first_contact_end(events: Iterable[Event], now: float) -> float | None:
    """Return the end of the first contact, s; None if it has not ended at time ``now``, s."""
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
    """Return the number of touches from the first to the end of its chatter, by their starts."""
    size = next((k for k, side in enumerate(wall) if side != wall[0]), len(start))
    for count in range(2, size):
        if start[count] - end[count - 1] > start[count - 1] - start[0]:
            return count
    return size


def _count_first_contact(start: Sequence[float], end: Sequence[float], count: int) -> int:
    """Return how many of the first ``count`` touches are the first contact: one, or all."""
    is_single = count > 1 and start[1] - end[0] > end[count - 1] - start[1]
    return 1 if is_single else count


def impact_speed(events: Iterable[Event]) -> float | None:
    """Return the speed of the chaser relative to the target at the first touch, m/s.

    None without a touch, NaN if it was not measured.
    """
    touch = first_touch(events)
    if touch is None:
        return None
    return math.hypot(touch.v[0] - touch.v[5], touch.v[1] - touch.v[6])


def first_touch(events: Iterable[Event]) -> Event | None:
    """Return the event of the first touch; None without one."""
    return next((event for event in events if event.kind is EventKind.TOUCH), None)
