"""Comparison of a recorded run, sample by sample, with a new simulation of its scene."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from capture_sim.dynamics.samples import SAMPLE, TRACE
from capture_sim.run.run import Run


class Difference(NamedTuple):
    """Difference of a field of the samples between two runs."""

    name: str
    largest: float  # largest absolute difference, unit as in msg/BenchState.msg
    first: float  # time of the first difference of even one bit, s


@dataclass(frozen=True)
class Agreement:
    """Result of the comparison of a recording with a new simulation of its scene."""

    compared: int  # number of samples at times that both runs have
    # number of samples of the recording at times that the simulation does not have, or at repeated
    # times: these samples belong to another run
    foreign: int
    missing: int  # number of samples of the simulation that the recording lacks, up to its end
    differences: tuple[Difference, ...]  # fields that differ
    same_events: bool  # True if the events are equal up to the end of the recording
    same_trace: bool  # True if the traces of the contact are equal up to the end of the recording

    @property
    def identical(self) -> bool:
        """True if all data of the recording are bit-identical in the simulation."""
        same = self.same_events and self.same_trace
        return same and self.compared > 0 and not (self.foreign or self.differences)

    def within(self, tolerance: float) -> bool:
        """Return True if no coordinate differs by more than the tolerance, m and rad.

        With a tolerance of 0, the events must be equal too.
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
