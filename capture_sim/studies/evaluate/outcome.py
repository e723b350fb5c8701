"""Outcomes of runs up to the verdict, the end of the run, or the end of the first contact.

Studies consist of these runs.  Contact and verdict are identical to :func:`capture_sim.simulate`,
because engine, detector and measurements are identical.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from capture_sim.detection.criteria import CaptureState
from capture_sim.dynamics.bench import Bench
from capture_sim.dynamics.drive import drive
from capture_sim.dynamics.samples import EventKind
from capture_sim.errors import SimulationError
from capture_sim.run.first_contact import first_cluster, first_contact_end
from capture_sim.run.integration import Integration
from capture_sim.run.loads import loads_of
from capture_sim.scene.parts import Scene

_RATE = 2000.0  # sample rate of the buffer's force in a first contact, Hz
_CONTACT_BLOCK = 200  # samples per call into the engine

#: Label of the verdict of a capture.
CAPTURED = CaptureState.CAPTURED.label


@dataclass(frozen=True)
class Outcome:
    """Verdict and loads of a run, in SI units.

    If the integration failed, all values refer to the run up to the failure.
    """

    verdict: str  # captured, rebound, missed, stuck or undecided
    t: float  # time of the verdict, s since the release
    reason: str  # reason of the detector, or of the failure
    left_again: bool  # the tip was captured and is outside the capture zone again
    first_touch: float  # s since the release; NaN without a touch
    loads: dict[str, Any]  # by name, see capture_sim.run.loads.loads_of
    energy_residual: float  # largest residual of the energy balance, J
    failure: str = ""  # why the integration failed; empty if it did not
    # distance of the tip's centre behind BE at the end, m; 0 within the capture radius
    behind: float = 0.0

    @property
    def captured(self) -> bool:
        """True if the tip was captured."""
        return self.verdict == CAPTURED


def run_to_verdict(scene: Scene) -> Outcome:
    """Run a scene until the detector's verdict, or until ``run.t_end`` if there is none before.

    The detector has the rate ``run.rate``.  The run stops at most 20 measurements of the detector
    after the verdict, and the loads include this time.
    """
    run = Integration(scene)
    run.integrate_to_verdict()
    return outcome_of(run)


def run_to_end(scene: Scene) -> Outcome:
    """Run a scene to its end; the verdict is the same as in :func:`run_to_verdict`."""
    run = Integration(scene)
    run.integrate()
    return outcome_of(run)


def outcome_of(run: Integration) -> Outcome:
    """Return the verdict and the loads of an integrated run, up to its last step."""
    bench = run.bench
    status = run.finish()
    first_touches = bench.times_of(EventKind.TOUCH)[:1]
    return Outcome(
        verdict=status.state.label,
        t=run.since,
        reason=run.failure or status.reason,
        left_again=status.left_again,
        first_touch=float(first_touches[0]) if first_touches.size else math.nan,
        loads=loads_of(bench.extremes, bench.touches),
        energy_residual=run.energy_residual,
        failure=run.failure,
        behind=run.behind,
    )


@dataclass(frozen=True)
class FirstContactLoads:
    """Peak loads of a run's first contact, in SI units.

    :func:`capture_sim.run.first_contact.first_cluster` defines the end of the first contact.  Axial
    stroke and torsion are |Delta x| and |Delta theta| of the paper's design flow.
    """

    axial_stroke: float
    torsion: float
    duration: float  # from start of the first touch to end of the last, s; NaN without touch
    peak_force: float  # peak normal force of a touch
    buffer_force: float  # axial force on the vehicles
    touches: int  # number of touches
    failure: str = ""  # why the run failed; the other values then refer to the run up to there


def run_first_contact(scene: Scene) -> FirstContactLoads:
    """Run a scene until its first contact is over."""
    grid = np.arange(0.0, scene.run.t_end, 1.0 / _RATE)
    bench, now, end, failure = Bench(scene), 0.0, None, ""
    for block in drive(bench, grid, block=_CONTACT_BLOCK):
        now = float(block.samples["t"].max(initial=now))
        failure = "" if block.failure is None else str(block.failure)
        end = first_contact_end(bench.events, now)
        if end is not None:
            break
    began = next((e.t for e in bench.events if e.kind is EventKind.TOUCH), None)
    if began is None:
        return FirstContactLoads(0.0, 0.0, math.nan, 0.0, 0.0, 0, failure)
    end, touches = now if end is None else end, first_cluster(bench.touches)
    bench = Bench(scene)  # run again, only to the end of the contact, for its extremes
    try:
        samples = bench.advance(np.append(grid[grid < end], end))
    except SimulationError as error:
        samples = error.partial
    inside = samples[samples["t"] >= began]
    found = bench.extremes.before_latch

    def largest(field: str, *extremes: str) -> float:
        # oscillations from the launch do not count as loads of the contact
        sampled = float(np.abs(inside[field]).max(initial=0.0))
        exact = (float(found[name]) for name in extremes if found[f"{name}_time"] >= began)
        return max([sampled, *exact])

    return FirstContactLoads(
        axial_stroke=largest("axial_stroke", "axial_stroke_in", "axial_stroke_out"),
        torsion=largest("torsion", "torsion"),
        duration=end - began,
        peak_force=float(touches["peak_force"].max(initial=0.0)),
        buffer_force=largest("axial_force", "buffer_force"),
        touches=int(touches.size),
        failure=failure,
    )
