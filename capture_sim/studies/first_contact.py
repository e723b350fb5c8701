"""The first contact alone: how far the buffer gives, how long it lasts, how hard it is."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from capture_sim.bench import Bench
from capture_sim.errors import SimulationError
from capture_sim.kernels import plain
from capture_sim.results import first_cluster, first_contact_end
from capture_sim.samples import EventKind
from capture_sim.scene.parts import Scene
from capture_sim.solver.roots import cubic_minimum

_RATE = 2000.0  # Hz, of the samples; between them strokes are cubic
_BLOCK = 0.1  # s per call into the engine

_minimum = plain(cubic_minimum)


@dataclass(frozen=True)
class FirstContact:
    """The first cluster of touches (:func:`capture_sim.results.first_cluster`); SI units.

    Attributes
    ----------
    axial_stroke, torsion : float
        Largest magnitudes while it lasted, m and rad: |Delta x| and |Delta theta| of the
        paper's design flow.
    duration : float
        From the first touch to the end of the last, s; NaN without a touch.
    peak_force : float
        Largest normal force, N.
    buffer_force : float
        Largest axial force of the buffer among the samples, N: what the vehicles feel.
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

    It is over as :func:`capture_sim.results.first_cluster` has it, or with the run.

    Raises
    ------
    SceneError
        If a value is out of its range.
    """
    bench = Bench(scene)
    pieces: list[np.ndarray] = []
    failure, t, end = "", 0.0, None
    while end is None and not failure and t < scene.run.t_end:
        first = round(t * _RATE)
        t = min(t + _BLOCK, scene.run.t_end)
        try:
            pieces.append(bench.advance(np.arange(first, round(t * _RATE)) / _RATE))
        except SimulationError as error:
            pieces.append(error.partial)
            failure = str(error)
        end = first_contact_end(bench.events, t)
    samples = np.concatenate(pieces)
    began = next((e.t for e in bench.events if e.kind is EventKind.TOUCH), None)
    if began is None or samples.size == 0:
        return FirstContact(0.0, 0.0, math.nan, 0.0, 0.0, 0, failure)
    if end is None:
        end = float(samples["t"][-1])
    touches = first_cluster(bench.touches)
    inside = (samples["t"] > began - 1.0 / _RATE) & (samples["t"] < end + 1.0 / _RATE)
    window = samples[inside]
    twist_rate = window["v"][:, 3] - window["v"][:, 2]
    return FirstContact(
        axial_stroke=largest(window["t"], window["axial_stroke"], window["v"][:, 4]),
        torsion=largest(window["t"], window["torsion"], twist_rate),
        duration=end - began,
        peak_force=float(touches["peak_force"].max(initial=0.0)),
        buffer_force=float(np.abs(window["axial_force"]).max(initial=0.0)),
        touches=int(touches.size),
        failure=failure,
    )


def largest(t: np.ndarray, values: np.ndarray, rates: np.ndarray) -> float:
    """Return the largest magnitude of a smooth curve, found between its samples as well.

    Parameters
    ----------
    t, values, rates
        (n,) times, values and their rates there.
    """
    if t.size == 0:
        return 0.0
    best = float(np.abs(values).max())
    for sign in (1.0, -1.0):
        f, d = -sign * values, -sign * rates
        for k in np.flatnonzero((d[:-1] < 0.0) & (d[1:] > 0.0)):
            width = t[k + 1] - t[k]
            place, low = _minimum(f[k], d[k] * width, f[k + 1], d[k + 1] * width)
            if place >= 0.0:
                best = max(best, float(-low))
    return best
