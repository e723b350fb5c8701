"""A recorded run compared, state by state, with its scene simulated again."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from capture_sim.samples import SAMPLE, TRACE, Event


class Difference(NamedTuple):
    """How a field of the samples differs between two runs.

    ``largest`` is the largest absolute difference, unit as in msg/BenchState.msg; ``first`` the
    time, s, when the field first differs by even one bit.
    """

    name: str
    largest: float
    first: float


@dataclass(frozen=True)
class Agreement:
    """What came of comparing a recording with its scene simulated again."""

    compared: int  # samples of the recording that the simulation has as well
    # samples of the recording at times that the simulation has none at, or has once more: they are
    # of another run
    foreign: int
    missing: int  # samples of the simulation that the recording lacks, up to where it ends
    differences: tuple[Difference, ...]  # fields that differ
    # up to where the recording ends
    same_events: bool
    same_trace: bool  # of the contact

    @property
    def identical(self) -> bool:
        """Everything in the recording is in the simulation, bit for bit."""
        same = self.same_events and self.same_trace
        return same and self.compared > 0 and not (self.foreign or self.differences)


def agreement(
    recorded: np.ndarray,
    again: np.ndarray,
    recorded_events: Sequence[Event],
    events: Sequence[Event],
    traces: tuple[np.ndarray, np.ndarray] | None = None,
) -> Agreement:
    """Compare what was recorded, (n,) of dtype SAMPLE, with what is simulated, (m,) by time.

    ``traces`` are the recorded and the simulated contact at the integrator's own steps, with the
    fields of TRACE.
    """
    index = np.searchsorted(again["t"], recorded["t"]).clip(max=max(len(again) - 1, 0))
    shared = again["t"][index] == recorded["t"] if len(again) else np.zeros(len(recorded), bool)
    mine, theirs = recorded[shared], again[index[shared]]
    found = []
    for name in SAMPLE.names or ():
        differs = mine[name] != theirs[name]
        differs = differs.any(axis=1) if differs.ndim > 1 else differs
        if differs.any():
            gap = np.abs(mine[name].astype(float) - theirs[name].astype(float))
            first = float(mine["t"][differs].min())
            found.append(Difference(name, float(gap.max()), first))
    # a recording that was cut is compared as far as it goes
    end = recorded["t"].max(initial=-np.inf)
    cut = end < again["t"].max(initial=-np.inf)
    until = end if cut else np.inf
    kept = [
        [(event.kind, event.t, event.wall) for event in log if event.t <= until]
        for log in (recorded_events, events)
    ]
    distinct = np.unique(index[shared]).size
    return Agreement(
        compared=distinct,
        foreign=len(recorded) - distinct,
        missing=int(np.count_nonzero(again["t"] <= until)) - distinct,
        differences=tuple(found),
        same_events=kept[0] == kept[1],
        same_trace=traces is None or _same_trace(*traces, until),
    )


def _same_trace(a: np.ndarray, b: np.ndarray, until: float) -> bool:
    # what was cut may lack the points behind its last sample
    a, b = a[a["t"] < until], b[b["t"] < until]
    return len(a) == len(b) and all(np.array_equal(a[n], b[n]) for n in TRACE.names or ())
