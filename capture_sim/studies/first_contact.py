"""The first contact alone: how far the buffer gives, how long it lasts, how hard it is."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from capture_sim.bench import Bench, drive
from capture_sim.errors import SimulationError
from capture_sim.results import first_cluster, first_contact_end
from capture_sim.samples import EventKind
from capture_sim.scene.parts import Scene

_RATE = 2000.0  # Hz, of the samples of the buffer's force
_BLOCK = 200  # samples per call into the engine


@dataclass(frozen=True)
class FirstContact:
    """The first contact of a run (:func:`capture_sim.results.first_cluster`); SI units.

    Attributes
    ----------
    axial_stroke, torsion : float
        Largest magnitudes until it ended, m and rad: |Delta x| and |Delta theta| of the
        paper's design flow.
    duration : float
        From the start of the first touch to the end of the last, s; NaN without a touch.
    peak_force : float
        Largest normal force, N.
    buffer_force : float
        Largest axial force of the buffer among samples at 2 kHz, N: what the vehicles feel.
    touches : int
    failure : str
        Why the run had to stop, if it did; the rest is then of what was run.
    """

    axial_stroke: float
    torsion: float
    duration: float
    peak_force: float
    buffer_force: float
    touches: int
    failure: str = ""


def run_first_contact(scene: Scene) -> FirstContact:
    """Run a scene until its first contact is over.

    Raises
    ------
    SceneError
        If a value is out of its range.
    """
    grid = np.arange(0.0, scene.run.t_end, 1.0 / _RATE)
    bench, now, end, failure = Bench(scene), 0.0, None, ""
    for block in drive(bench, grid, block=_BLOCK):
        now = float(block.samples["t"].max(initial=now))
        failure = "" if block.failure is None else str(block.failure)
        end = first_contact_end(bench.events, now)
        if end is not None:
            break
    began = next((e.t for e in bench.events if e.kind is EventKind.TOUCH), None)
    if began is None:
        return FirstContact(0.0, 0.0, math.nan, 0.0, 0.0, 0, failure)
    end, touches = now if end is None else end, first_cluster(bench.touches)
    bench = Bench(scene)  # once more, to the contact's end and no further: its extremes
    try:
        samples = bench.advance(np.append(grid[grid < end], end))
    except SimulationError as error:
        samples = error.partial
    inside = samples[samples["t"] >= began]
    found = bench.extremes.before_latch

    def largest(field: str, *extremes: str) -> float:
        # what the launch left behind is no matter of the contact
        sampled = float(np.abs(inside[field]).max(initial=0.0))
        exact = (float(found[name]) for name in extremes if found[f"{name}_time"] >= began)
        return max([sampled, *exact])

    return FirstContact(
        axial_stroke=largest("axial_stroke", "compression", "extension"),
        torsion=largest("torsion", "torsion"),
        duration=end - began,
        peak_force=float(touches["peak_force"].max(initial=0.0)),
        buffer_force=float(np.abs(inside["axial_force"]).max(initial=0.0)),
        touches=int(touches.size),
        failure=failure,
    )
