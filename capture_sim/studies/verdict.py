"""A run to its verdict and no further: the unit of work of design, envelope and scans.

The verdict is that of :func:`capture_sim.simulate`: same engine, same detector, same
measurements; only what comes after the verdict is left out.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from capture_sim.bench import Bench
from capture_sim.detection.exact import CaptureDetector, CaptureState, Observation
from capture_sim.errors import SimulationError
from capture_sim.samples import EventKind
from capture_sim.scene.parts import Scene

#: Measurements of the detector per call into the engine: a tenth of a second at 100 Hz.
_BLOCK = 10


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
    bench, detector = Bench(scene), CaptureDetector(scene)
    force = stroke = torsion = 0.0
    nearest = math.inf
    rate, first, failure, status = scene.run.rate, 0, "", None
    while status is None or not (status.final or bench.done or failure):
        grid = np.arange(first * finer, (first + _BLOCK) * finer) / (rate * finer)
        try:
            block = bench.advance(grid[grid <= scene.run.t_end])
        except SimulationError as error:
            block, failure = error.partial, str(error)
        seen = block
        for place, measured in enumerate(_observations(block[::finer])):
            status = detector.update(measured)
            if status.final:
                seen = block[: place * finer + 1]
                break
        force = max(force, float(seen["normal_force"].max(initial=0.0)))
        stroke = max(stroke, float(np.abs(seen["axial_stroke"]).max(initial=0.0)))
        torsion = max(torsion, float(np.abs(seen["torsion"]).max(initial=0.0)))
        nearest = min(nearest, float(seen["tip_distance"].min(initial=math.inf)))
        first += _BLOCK
    if not status.final:
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


def _observations(samples: np.ndarray) -> Iterator[Observation]:
    """Yield what :func:`capture_sim.simulation.observation` makes of each sample, faster."""
    columns = (samples[name].tolist() for name in ("t", "q", "v", "axial_stroke", "torsion"))
    for t, q, v, stroke, torsion in zip(*columns, strict=True):
        yield Observation(
            t=t,
            chaser=(q[0], q[1], q[2]),
            target=(q[5], q[6], q[7]),
            stroke=stroke,
            torsion=torsion,
            chaser_rate=(v[0], v[1], v[2]),
            target_rate=(v[5], v[6], v[7]),
            stroke_rate=v[4],
            torsion_rate=v[3] - v[2],
        )
