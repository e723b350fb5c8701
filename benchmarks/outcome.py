"""What any engine hands back, and how far that is from a reference."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from capture_sim.results import first_cluster

#: A touch as any engine can give it; ``end`` is NaN for one that was still on.
TOUCHED = np.dtype(
    [
        ("start", "f8"),  # s
        ("end", "f8"),  # s
        ("wall", "i8"),  # +1 or -1
        ("peak_force", "f8"),  # N; NaN where an engine does not tell
    ]
)


@dataclass(frozen=True)
class Outcome:
    """A run's result.

    Attributes
    ----------
    q : ndarray (8,)
        Coordinates at the end, m and rad; NaN if it did not get there.
    evaluations : int
        Of the equations of motion.
    touches : ndarray (n,) of dtype TOUCHED, or None
        In order of their starts; None where an engine does not tell.
    impulse : float
        Normal impulse of both walls, N s; NaN where an engine does not tell.
    peak_force : float
        Largest normal force, N; NaN where an engine does not tell.
    failure : str
        Why there is no result; empty if there is one.
    """

    q: np.ndarray
    evaluations: int
    touches: np.ndarray | None = None
    impulse: float = math.nan
    peak_force: float = math.nan
    failure: str = ""


@dataclass(frozen=True)
class Errors:
    """How far an outcome is from a reference; NaN where it cannot be told.

    Attributes
    ----------
    position : float
        Largest difference in any coordinate, m or rad.
    peak_force : float
        Largest difference in the peak force of a touch of the first contact, per largest
        force there; NaN if the touches are not the reference's.
    event_time : float
        Largest difference in the time of a touch or lift-off, s; NaN likewise.
    impulse : float
        Difference in the normal impulse of both walls, per impulse.
    touches : int
        Number of touches begun; -1 where an engine does not tell.
    """

    position: float = math.nan
    peak_force: float = math.nan
    event_time: float = math.nan
    impulse: float = math.nan
    touches: int = -1


def errors(outcome: Outcome, truth: Outcome) -> Errors:
    """Compare an outcome with the reference's at the same time."""
    if outcome.failure:
        return Errors()
    position = float(np.abs(outcome.q - truth.q).max())
    impulse = abs(outcome.impulse - truth.impulse) / truth.impulse
    if outcome.touches is None or truth.touches is None:
        peak = abs(outcome.peak_force - truth.peak_force) / truth.peak_force
        return Errors(position=position, impulse=impulse, peak_force=peak)
    ours, theirs = outcome.touches, truth.touches
    if not np.array_equal(ours["wall"], theirs["wall"]):
        return Errors(position=position, impulse=impulse, touches=ours.size)
    times = [np.abs(ours["start"] - theirs["start"]), _both(ours["end"], theirs["end"])]
    ended = theirs[np.isfinite(theirs["end"])]
    first = np.isin(theirs["start"], first_cluster(ended)["start"])
    largest = theirs["peak_force"][first].max(initial=0.0)
    off = np.abs(ours["peak_force"] - theirs["peak_force"])[first].max(initial=0.0)
    return Errors(
        position=position,
        peak_force=float(off / largest) if largest > 0.0 else math.nan,
        event_time=float(max(difference.max(initial=0.0) for difference in times)),
        impulse=impulse,
        touches=ours.size,
    )


def _both(ours: np.ndarray, theirs: np.ndarray) -> np.ndarray:
    """Return differences, 0 where both touches are still on, inf where only one is."""
    difference: np.ndarray = np.abs(ours - theirs)
    on, also_on = np.isnan(ours), np.isnan(theirs)
    difference[on & also_on] = 0.0
    difference[on != also_on] = np.inf
    return difference
