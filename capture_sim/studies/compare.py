"""Two runs held against each other in time, aligned at their first contacts."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from capture_sim.studies.measured_touches import RESOLVED, quiet_before_contact, stretches_above
from capture_sim.studies.measurements import Measurements, Series

#: Samples that two series must have in common to be compared.
LEAST = 4
#: Sample times are decimal fractions: a window may end a rounding short of one, s.
_TICK = 1e-9


@dataclass(frozen=True)
class Gap:
    """How far a measured thing of two runs is apart.

    Attributes
    ----------
    name
        Field of :class:`~.measurements.Measurements`, a pose's part behind a dot.
    rms, largest
        SI units.
    at
        When it is largest, s after the first contact.
    begin, end
        First and last sample that was compared, s after the first contact.
    """

    name: str
    rms: float
    largest: float
    at: float
    begin: float
    end: float


class TouchTable(NamedTuple):
    """Touches of a run one by one, in order; what is not known of one is NaN (wall: 0).

    Attributes
    ----------
    start, peak_time : ndarray (n,)
        s.
    lasted : ndarray (n,)
        s.
    peak : ndarray (n,)
        N.
    impulse : ndarray (n,)
        N s.
    wall : ndarray (n,)
        +1 or -1.
    """

    start: np.ndarray
    lasted: np.ndarray
    peak_time: np.ndarray
    peak: np.ndarray
    impulse: np.ndarray
    wall: np.ndarray

    def within(self, contact: float, window: float) -> TouchTable:
        """Return those that begin in the window after a first contact, which becomes t = 0."""
        later = self.start - contact
        inside = (later >= -_TICK) & (later <= window)
        shifted = self._replace(start=later, peak_time=self.peak_time - contact)
        return TouchTable(*(column[inside] for column in shifted))


def table_of_touches(touches: np.ndarray) -> TouchTable:
    """Return located touches, (n,) of dtype TOUCH, in the order of their starts."""
    ordered = touches[np.argsort(touches["start"], kind="stable")]
    return TouchTable(
        start=ordered["start"],
        lasted=ordered["end"] - ordered["start"],
        peak_time=ordered["peak_time"],
        peak=ordered["peak_force"],
        impulse=ordered["impulse"],
        wall=ordered["wall"],
    )


def table_of_force(t: np.ndarray, force: np.ndarray) -> TouchTable | None:
    """Return the touches that a sampled force shows; None where it is too slow to show any.

    The first touch with fewer than RESOLVED samples ends the table: behind it others may have
    been missed.  Peak and impulse are those of the magnitude, friction included.

    Parameters
    ----------
    t : ndarray (n,)
        s, ascending.
    force : ndarray (n, 2)
        N; nothing touches at its beginning.
    """
    quiet = quiet_before_contact(force)
    if quiet is None:
        return None
    size = np.hypot(*(force - quiet.bias).T)
    rows = []
    for first, end in stretches_above(size, quiet.threshold):
        if end - first < RESOLVED:
            break
        top = first + int(np.argmax(size[first:end]))
        held, dt = size[first:end], np.diff(t[first:end])
        impulse = float(0.5 * (held[1:] + held[:-1]) @ dt)
        rows.append((t[first], t[end - 1] - t[first], t[top], size[top], impulse, 0.0))
    return TouchTable(*np.array(rows).T) if rows else None


_PARTS = {"chaser": ("x", "y", "theta"), "target": ("x", "y", "theta")}


def overlap(
    a: Series, b: Series, contact_a: float, contact_b: float, window: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return when both series were sampled, (n,), s after the first contacts, and how often.

    The times are those of the series with fewer samples there: the other one is finer, and
    interpolated.

    Returns
    -------
    times : ndarray (n,)
    counts : ndarray (2,)
        Samples of each in the stretch that both hold.
    """
    mine, theirs = a.t - contact_a, b.t - contact_b
    begin = max(0.0, mine[0], theirs[0]) - _TICK
    end = min(window, mine[-1], theirs[-1]) + _TICK
    inside = [t[(t >= begin) & (t <= end)] for t in (mine, theirs)]
    counts = np.array([len(t) for t in inside])
    return inside[int(np.argmin(counts))], counts


def gaps(
    a: Measurements, b: Measurements, contact_a: float, contact_b: float, window: float
) -> list[Gap]:
    """Return how far two runs are apart round their first contacts.

    Poses count from where they were at the first contact: two benches need not share an
    origin, and the approach is a matter of the launch.  What has fewer than LEAST samples in
    common is left out.

    Parameters
    ----------
    a, b
        What was measured.
    contact_a, contact_b
        Their first contacts, s.
    window
        s after the first contact that are compared.
    """
    found = []
    there = dict(b.items())
    for name, mine in a.items():
        theirs = there.get(name)
        if theirs is None:
            continue
        t, _ = overlap(mine, theirs, contact_a, contact_b, window)
        if t.size < LEAST:
            continue
        for part, label in enumerate(_PARTS.get(name, ("",))):
            x, y = (s.values if s.values.ndim == 1 else s.values[:, part] for s in (mine, theirs))
            if label == "theta":  # a quaternion does not tell whole turns
                x, y = np.unwrap(x), np.unwrap(y)
            t_x, t_y = mine.t - contact_a, theirs.t - contact_b
            difference = np.interp(t, t_x, x) - np.interp(t, t_y, y)
            if name in _PARTS:
                difference -= np.interp(0.0, t_x, x) - np.interp(0.0, t_y, y)
            worst = int(np.argmax(np.abs(difference)))
            found.append(
                Gap(
                    f"{name}.{label}" if label else name,
                    float(np.sqrt(np.mean(difference**2))),
                    float(difference[worst]),
                    float(t[worst]),
                    float(t[0]),
                    float(t[-1]),
                )
            )
    return found
