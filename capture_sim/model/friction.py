"""Coulomb friction of the tip on the wall.

Three laws regularise it at zero slip, one switches there:

``tanh``
    mu F_n tanh(v / v_eps): smooth and cheap; creeps by about v_eps where a real tip
    would stick.
``clamp``
    mu F_n v / v_eps up to v_eps, mu F_n beyond: what other engines have, for comparison with
    them; its corners cost accuracy.
``brown_mcphee``
    F_n (mu tanh 4x + (mu_s - mu) x / (x^2 / 4 + 3/4)^2), x = v / v_eps: the continuous law
    of Brown and McPhee (2016) without its viscous part; its peak, mu_s, lies at v_eps.
``coulomb``
    Coulomb's own law by events: sliding in a fixed direction, or sticking with whatever
    force keeps the slip at zero, as long as mu_s F_n can.  No creep and no v_eps; costs
    an event at each change and a second elimination while sticking.
"""

from __future__ import annotations

from capture_sim.kernels import inline_kernel
from capture_sim.model.trig import hyperbolic_tangent

NONE, TANH, BROWN_MCPHEE, COULOMB, CLAMP = range(5)
NUMBER = {
    "none": NONE,
    "tanh": TANH,
    "clamp": CLAMP,
    "brown_mcphee": BROWN_MCPHEE,
    "coulomb": COULOMB,
}


@inline_kernel
def friction_coefficient(x, mu, mu_s, law):
    """Return friction force per normal force, with the sign of the slip.

    For the regularised laws; ``x`` is the slip over v_eps.
    """
    if law == BROWN_MCPHEE:
        shape = 0.25 * x * x + 0.75
        return mu * hyperbolic_tangent(4.0 * x) + (mu_s - mu) * x / (shape * shape)
    if law == CLAMP:
        return mu * min(1.0, max(-1.0, x))
    return mu * hyperbolic_tangent(x)
