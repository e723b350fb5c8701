"""A recorded run compared, sample by sample, with its scene simulated again."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from capture_sim.dynamics.samples import SAMPLE, TRACE
from capture_sim.run.run import Run


class Difference(NamedTuple):
    """How a field of the samples differs between two runs."""

    name: str
    largest: float  # largest absolute difference, unit as in msg/BenchState.msg
    first: float  # s, when the field first differs by even one bit


@dataclass(frozen=True)
class Agreement:
    """Outcome of comparing a recording with its scene simulated again."""

    compared: int  # samples of the recording that the simulation has as well
    # samples of the recording at times that the simulation has none at, or has once more: they are
    # of another run
    foreign: int
    missing: int  # samples of the simulation that the recording lacks, up to its end
    differences: tuple[Difference, ...]  # fields that differ
    # up to the end of the recording
    same_events: bool
    same_trace: bool  # of the contact

    @property
    def identical(self) -> bool:
        """True if everything in the recording is in the simulation, bit by bit."""
        same = self.same_events and self.same_trace
        return same and self.compared > 0 and not (self.foreign or self.differences)

    def within(self, tolerance: float) -> bool:
        """Return True if no coordinate differs by more than the tolerance, m and rad.

        With tolerance 0 the events must be the same too.
        """
        largest = max((d.largest for d in self.differences if d.name == "q"), default=0.0)
        is_near = largest <= tolerance and (self.same_events or tolerance > 0.0)
        return is_near and self.compared > 0 and not self.foreign


def agreement(recording: Run, simulation: Run) -> Agreement:
    """Compare the exact samples, events and contact of a recording with a simulation.

    A recording that ends early is compared up to its end.
    """
    recorded, simulated = recording.given.samples, simulation.given.samples
    index = np.searchsorted(simulated["t"], recorded["t"]).clip(max=max(len(simulated) - 1, 0))
    shared = np.zeros(len(recorded), bool)
    if len(simulated):
        shared = simulated["t"][index] == recorded["t"]
    shared_recorded, shared_simulated = recorded[shared], simulated[index[shared]]
    differences = []
    for name in SAMPLE.names or ():
        differs = shared_recorded[name] != shared_simulated[name]
        differs = differs.any(axis=1) if differs.ndim > 1 else differs
        if differs.any():
            gap = np.abs(shared_recorded[name].astype(float) - shared_simulated[name].astype(float))
            first = float(shared_recorded["t"][differs].min())
            differences.append(Difference(name, float(gap.max()), first))
    end = recorded["t"].max(initial=-np.inf)
    until = end if end < simulated["t"].max(initial=-np.inf) else np.inf
    recorded_events, events = (
        [(event.kind, event.t, event.wall) for event in run.given.events if event.t <= until]
        for run in (recording, simulation)
    )
    distinct = np.unique(index[shared]).size
    return Agreement(
        compared=distinct,
        foreign=len(recorded) - distinct,
        missing=int(np.count_nonzero(simulated["t"] <= until)) - distinct,
        differences=tuple(differences),
        same_events=recorded_events == events,
        same_trace=_same_trace(recording.trace, simulation.trace, until),
    )


def _same_trace(a: np.ndarray, b: np.ndarray, until: float) -> bool:
    # a truncated recording may lack the points after its last sample
    a, b = a[a["t"] < until], b[b["t"] < until]
    return len(a) == len(b) and all(np.array_equal(a[n], b[n]) for n in TRACE.names or ())
