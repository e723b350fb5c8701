"""Where the energy of a run went, by the curves of force: step 6 of the paper's design flow."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from capture_sim.bench import Bench
from capture_sim.scene.parts import Scene

_RATE = 2000.0  # Hz
_PER_TOUCH = 60  # samples over each touch, denser towards its ends


@dataclass(frozen=True)
class Energy:
    """Energies up to a time, J.

    Attributes
    ----------
    approach : float
        Kinetic energy of the relative motion at the start: of the reduced mass.
    damper : float
        Absorbed by the axial damper: area of the load-stroke curve, less what its spring
        still holds.
    contact : float
        Lost in the touches: area of normal force over penetration, both walls.
    damper_ledger, contact_ledger : float
        The same two as integrated with the motion.
    """

    approach: float
    damper: float
    contact: float
    damper_ledger: float
    contact_ledger: float


def energy_of(scene: Scene, t_end: float) -> Energy:
    """Return the energies of a run up to ``t_end`` (s), from a run sampled for the purpose.

    Raises
    ------
    SimulationError
        The integration had to stop.
    """
    scene = replace(scene, run=replace(scene.run, t_end=max(t_end, 1e-6)))
    first = Bench(scene)
    first.advance(np.zeros(0))
    times = [np.arange(0.0, t_end, 1.0 / _RATE), np.array([t_end])]
    # denser where the force starts and ends, as delta^1.5 does
    within = 0.5 - 0.5 * np.cos(np.linspace(0.0, np.pi, _PER_TOUCH))
    for touch in first.touches:
        times.append(touch["start"] + within * (touch["end"] - touch["start"]))
    samples = Bench(scene).advance(np.unique(np.concatenate(times)))
    stroke, load = samples["axial_stroke"], samples["axial_force"]
    last, start = samples[-1], samples[0]
    spring = float(last["elastic_axial"] - start["elastic_axial"])
    # the force on the probe pushes it out: it takes energy while the stroke goes inwards
    absorbed = -_area(stroke, load)
    lost = sum(
        _area(samples["penetration"][:, wall], samples["normal_force"][:, wall])
        for wall in range(2)
    )
    relative = start["v"][:2] - start["v"][5:7]
    chaser, target = scene.chaser_total_mass, scene.target.mass
    return Energy(
        approach=0.5 * chaser * target / (chaser + target) * float(relative @ relative),
        damper=absorbed - spring,
        contact=lost - float(last["elastic_contact"]),
        damper_ledger=float(last["dissipated_axial"]),
        contact_ledger=float(last["dissipated_contact"]),
    )


def _area(x: np.ndarray, y: np.ndarray) -> float:
    """Return the integral of y over x, by trapezoids."""
    return float(np.sum(0.5 * (y[1:] + y[:-1]) * np.diff(x)))
