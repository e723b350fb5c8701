"""Coulomb friction of the tip on the wall.

Two laws regularise it at zero slip, one switches there:

``tanh``
    mu F_n tanh(v / v_eps): smooth and cheap; creeps by about v_eps where a real tip
    would stick.
``brown_mcphee``
    F_n (mu tanh 4x + (mu_s - mu) x / (x^2 / 4 + 3/4)^2), x = v / v_eps: the continuous law
    of Brown and McPhee (2016) without its viscous part; its peak, mu_s, lies at v_eps.
``coulomb``
    Coulomb's own law by events: sliding in a fixed direction, or sticking with whatever
    force keeps the slip at zero, as long as mu_s F_n can.  No creep and no v_eps; costs
    an event at each change and a second elimination while sticking.
"""

from __future__ import annotations

import math

from capture_sim.kernels import inline_kernel

NONE, TANH, BROWN_MCPHEE, COULOMB = 0, 1, 2, 3
NUMBER = {"none": NONE, "tanh": TANH, "brown_mcphee": BROWN_MCPHEE, "coulomb": COULOMB}


@inline_kernel
def friction_coefficient(slip, mu, mu_s, v_eps, law):
    """Return friction force per normal force, with the sign of the slip (m/s).

    For the regularised laws.
    """
    x = slip / v_eps
    if law == BROWN_MCPHEE:
        shape = 0.25 * x * x + 0.75
        return mu * math.tanh(4.0 * x) + (mu_s - mu) * x / (shape * shape)
    # beyond 20 the hyperbolic tangent is 1 to the last bit
    if x > 20.0:
        return mu
    if x < -20.0:
        return -mu
    return mu * math.tanh(x)
