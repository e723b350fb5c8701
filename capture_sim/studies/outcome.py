"""What comes of a run to its verdict, or to the end of its first contact, and no further.

These are the units of work of design, envelope and scans.  Contact and verdict are those of
:func:`capture_sim.simulate`: same engine, same detector, same measurements.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from capture_sim.bench import Bench, drive
from capture_sim.detection.exact import CaptureState, ExactDetector
from capture_sim.errors import SimulationError
from capture_sim.results import first_cluster, first_contact_end
from capture_sim.samples import EventKind
from capture_sim.scene.parts import Scene

#: Measurements of the detector per call into the engine: more would run on too far after a
#: verdict, fewer cost calls.
_BLOCK = 20

_RATE = 2000.0  # Hz, of the samples of a first contact: the buffer's force
_CONTACT_BLOCK = 200  # samples per call into the engine


@dataclass(frozen=True)
class Outcome:
    """What came of a run up to its verdict; SI units.

    Extremes are those of the motion, not of samples of it, up to the end of the last piece
    that was run: at most 0.2 s of the detector's 100 Hz later than the verdict.

    Attributes
    ----------
    verdict : CaptureState
        As the detector gives it.
    t : float
        Of the verdict, s since the release.
    reason : str
        The detector's, or why the run had to stop.
    first_touch : float
        s since the release; NaN without a touch.
    touches : int
        That had begun by then.
    peak_force : float
        Largest normal force on a wall, N.
    axial_stroke, torsion : float
        Largest magnitudes until the latch closes, if it does, m and rad.
    nearest : float
        Smallest distance of the tip's centre from the centre of BE, m.
    failed : bool
        The integration had to stop; the verdict is that of the run up to there.
    """

    verdict: CaptureState
    t: float
    reason: str
    first_touch: float
    touches: int
    peak_force: float
    axial_stroke: float
    torsion: float
    nearest: float
    failed: bool = False

    @property
    def captured(self) -> bool:
        """Whether the tip was captured."""
        return self.verdict is CaptureState.CAPTURED


def run_to_verdict(scene: Scene) -> Outcome:
    """Run a scene until the detector has come to its verdict.

    ``run.t_end`` bounds the run, ``run.rate`` is the detector's.  A run that had to stop has an
    outcome as well: see ``failed``.

    Raises
    ------
    SceneError
        If a value is out of its range.
    """
    bench, detector, failure = Bench(scene), ExactDetector(scene), ""
    times = np.arange(math.floor(scene.run.t_end * scene.run.rate) + 2) / scene.run.rate
    for piece in drive(bench, times[times <= scene.run.t_end], block=_BLOCK):
        detector.until_verdict(piece.samples)
        failure = str(piece.failure or "")
        if detector.final:
            break
    status = detector.finish()
    began = bench.times_of(EventKind.TOUCH)
    began = began[began <= status.t]
    before, after = bench.extremes
    return Outcome(
        verdict=status.state,
        t=status.t,
        reason=failure or status.reason,
        first_touch=float(began[0]) if began.size else math.nan,
        touches=began.size,
        peak_force=float(before["normal_force"]),
        axial_stroke=float(max(before["compression"], before["extension"])),
        torsion=float(before["torsion"]),
        nearest=float(min(each["tip_distance"] for each in (before, after) if each is not None)),
        failed=bool(failure),
    )


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
    for block in drive(bench, grid, block=_CONTACT_BLOCK):
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
