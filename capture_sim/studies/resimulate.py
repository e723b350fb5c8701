"""A run simulated again and held against what was recorded, state by state."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from capture_sim.samples import SAMPLE, TRACE, Event


@dataclass(frozen=True)
class Difference:
    """How a field of the samples differs between two runs.

    Attributes
    ----------
    name
        Of the field, unit as in msg/BenchState.msg.
    largest
        Largest absolute difference.
    first
        When it first differs by even one bit, s.
    """

    name: str
    largest: float
    first: float


@dataclass(frozen=True)
class Agreement:
    """What came of comparing two runs of one scene.

    Attributes
    ----------
    compared
        Samples that both have.
    only
        Samples that one of them has alone.
    differences
        Fields that differ; empty when the runs are bit for bit the same.
    same_events
        Both have the same events at the same times, as far as both go.
    same_trace
        Both have the same trace of the contact, bit for bit, as far as both go.
    """

    compared: int
    only: int
    differences: tuple[Difference, ...]
    same_events: bool
    same_trace: bool

    @property
    def identical(self) -> bool:
        """Bit for bit the same, as far as both go."""
        return not self.differences and self.same_events and self.same_trace


def agreement(
    a: np.ndarray,
    b: np.ndarray,
    events_a: Sequence[Event],
    events_b: Sequence[Event],
    traces: tuple[np.ndarray, np.ndarray] | None = None,
) -> Agreement:
    """Compare samples at the times that both runs have.

    Parameters
    ----------
    a, b
        (n,) and (m,) of dtype SAMPLE.
    events_a, events_b
        In order.
    traces
        Both runs' contact at the integrator's own steps, with the fields of TRACE, where they
        have one.
    """
    times, in_a, in_b = np.intersect1d(a["t"], b["t"], return_indices=True)
    a_there, b_there = a[in_a], b[in_b]
    found = []
    for name in SAMPLE.names or ():
        mine, theirs = a_there[name], b_there[name]
        differs = (mine != theirs).reshape(len(times), -1).any(axis=1)
        if differs.any():
            gap = np.abs(mine.astype(float) - theirs.astype(float))
            found.append(Difference(name, float(gap.max()), float(times[differs.argmax()])))
    # one that was cut off is compared as far as it goes
    until = np.inf if len(a) == len(b) else min(a["t"][-1:].sum(), b["t"][-1:].sum())
    told_a, told_b = (
        [(event.kind, event.t, event.wall) for event in events if event.t <= until]
        for events in (events_a, events_b)
    )
    only = len(a) + len(b) - 2 * len(times)
    same_trace = traces is None or _same_points(*traces, until)
    return Agreement(len(times), only, tuple(found), told_a == told_b, same_trace)


def _same_points(a: np.ndarray, b: np.ndarray, until: float) -> bool:
    # what was cut off may lack the points behind its last sample
    a, b = a[a["t"] < until], b[b["t"] < until]
    return len(a) == len(b) and all(np.array_equal(a[n], b[n]) for n in TRACE.names or ())
