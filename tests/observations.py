"""What perfect sensors measure."""

from __future__ import annotations

import numpy as np

from capture_sim.detection.align import Observation


def observation(sample: np.void) -> Observation:
    """Return what a perfect sensor measures in a sample."""
    q, v = sample["q"].tolist(), sample["v"].tolist()
    buffer = float(sample["axial_stroke"]), float(sample["torsion"]), v[4], v[3] - v[2]
    return Observation(float(sample["t"]), (*q[:3], *v[:3]), (*q[5:], *v[5:]), buffer)
