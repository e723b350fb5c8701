"""Coulomb friction of the tip, regularised at zero slip."""

from __future__ import annotations

import math

from capture_sim.kernels import kernel


@kernel
def friction_force(normal: float, slip: float, mu: float, v_eps: float) -> float:
    """Return the friction force along the tangent, N, against the slip (m/s).

    mu F_n tanh(slip / v_eps): smooth, so the integrator keeps its order; the price is a
    creep of the order of v_eps where a real tip would stick.
    """
    if mu == 0.0 or normal == 0.0:
        return 0.0
    return -mu * normal * math.tanh(slip / v_eps)
