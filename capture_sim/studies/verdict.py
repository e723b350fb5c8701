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
        Largest normal force of a touch, N; of one that was still on, the largest sample.
    axial_stroke, torsion : float
        Largest magnitudes among the samples, m and rad.
    nearest : float
        Smallest distance of the tip's centre from the centre of BE among the samples, m.
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


def run_to_verdict(scene: Scene, rtol: float | None = None, finer: int = 1) -> Outcome:
    """Run a scene until the detector has come to its verdict.

    Parameters
    ----------
    scene
        What is on the bench; ``run.t_end`` bounds the run, ``run.rate`` is the detector's.
    rtol
        None takes ``scene.run.rtol``.
    finer
        Samples of strokes, force and distance per measurement of the detector.

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
    bench, detector = Bench(scene), ExactDetector(scene)
    rate = scene.run.rate * finer
    times = np.arange(math.floor(scene.run.t_end * rate) + 2) / rate
    force = stroke = torsion = 0.0
    nearest, failure = math.inf, ""
    for piece in drive(bench, times[times <= scene.run.t_end], block=_BLOCK * finer):
        used = detector.until_verdict(piece.samples[::finer])
        seen = piece.samples[: (used - 1) * finer + 1] if detector.final else piece.samples
        force = max(force, float(seen["normal_force"].max(initial=0.0)))
        stroke = max(stroke, float(np.abs(seen["axial_stroke"]).max(initial=0.0)))
        torsion = max(torsion, float(np.abs(seen["torsion"]).max(initial=0.0)))
        nearest = min(nearest, float(seen["tip_distance"].min(initial=math.inf)))
        failure = str(piece.failure or "")
        if detector.final:
            break
    status = detector.finish()
    began = [e.t for e in bench.events if e.kind is EventKind.TOUCH and e.t <= status.t]
    ended = [e.touch for e in bench.events if e.touch is not None]
    peaks = [float(touch["peak_force"]) for touch in ended if touch["start"] <= status.t]
    return Outcome(
        verdict=status.state,
        t=status.t,
        reason=failure or status.reason,
        first_touch=began[0] if began else math.nan,
        touches=len(began),
        peak_force=max([force, *peaks]),
        axial_stroke=stroke,
        torsion=torsion,
        nearest=nearest,
        failed=bool(failure),
    )
