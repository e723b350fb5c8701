"""What perfect sensors measure."""

from __future__ import annotations

import numpy as np

from capture_sim.detection.align import Observation


def observation(sample: np.void) -> Observation:
    """Return what a perfect sensor measures in a sample."""
    q, v = sample["q"].tolist(), sample["v"].tolist()
    return Observation(
        t=float(sample["t"]),
        chaser=(q[0], q[1], q[2]),
        chaser_rate=(v[0], v[1], v[2]),
        target=(q[5], q[6], q[7]),
        target_rate=(v[5], v[6], v[7]),
        stroke=float(sample["axial_stroke"]),
        stroke_rate=v[4],
        torsion=float(sample["torsion"]),
        torsion_rate=v[3] - v[2],
    )
