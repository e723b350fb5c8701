"""A run to its verdict and no further: the unit of work of design, envelope and scans.

The verdict is that of :func:`capture_sim.simulate`: same engine, same detector, same
measurements; only what comes after the verdict is left out.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from capture_sim.bench import Bench, drive
from capture_sim.detection.exact import CaptureState, ExactDetector
from capture_sim.samples import EventKind
from capture_sim.scene.parts import Scene

#: Measurements of the detector per call into the engine: more would run on too far after a
#: verdict, fewer cost calls.
_BLOCK = 20


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


def run_to_verdict(scene: Scene, rtol: float | None = None) -> Outcome:
    """Run a scene until the detector has come to its verdict.

    Parameters
    ----------
    scene
        What is on the bench; ``run.t_end`` bounds the run, ``run.rate`` is the detector's.
    rtol
        None takes ``scene.run.rtol``.

    Returns
    -------
    Outcome
        Also of a run that had to stop: see ``failed``.

    Raises
    ------
    SceneError
        If a value is out of its range.
    """
    if rtol is not None:
        scene = replace(scene, run=replace(scene.run, rtol=rtol))
    bench, detector, failure = Bench(scene), ExactDetector(scene), ""
    times = np.arange(math.floor(scene.run.t_end * scene.run.rate) + 2) / scene.run.rate
    for piece in drive(bench, times[times <= scene.run.t_end], block=_BLOCK):
        detector.until_verdict(piece.samples)
        failure = str(piece.failure or "")
        if detector.final:
            break
    status = detector.finish()
    began = [e.t for e in bench.events if e.kind is EventKind.TOUCH and e.t <= status.t]
    before, after = bench.extremes
    return Outcome(
        verdict=status.state,
        t=status.t,
        reason=failure or status.reason,
        first_touch=began[0] if began else math.nan,
        touches=len(began),
        peak_force=float(before["normal_force"]),
        axial_stroke=float(max(before["compression"], before["extension"])),
        torsion=float(before["torsion"]),
        nearest=float(min(each["tip_distance"] for each in (before, after) if each is not None)),
        failed=bool(failure),
    )
