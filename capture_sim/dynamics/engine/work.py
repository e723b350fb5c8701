"""Work of external wrenches: of thrust on the vehicles, and of a rig's wrench on the tip.

A wrench is constant in axes that turn with its vehicle.  The work of its moment, and of its force
in the axes at the start of a step, is force times path.  Only the contribution of the axes' turn
during the step is integrated numerically, over the dense output.
"""

from __future__ import annotations

import math

from capture_sim.base.compiled.kernels import kernel
from capture_sim.dynamics.engine.steps import entry_inside
from capture_sim.dynamics.model.equations import tip_in_cone, turned
from capture_sim.dynamics.model.trig import sine_cosine

# places and weights on 0..1 of Gauss's quadrature with four points
_OUTER = 0.5 * math.sqrt(3.0 / 7.0 + 2.0 / 7.0 * math.sqrt(6.0 / 5.0))
_INNER = 0.5 * math.sqrt(3.0 / 7.0 - 2.0 / 7.0 * math.sqrt(6.0 / 5.0))
_PLACES = (0.5 - _OUTER, 0.5 - _INNER, 0.5 + _INNER, 0.5 + _OUTER)
_SMALL = (18.0 - math.sqrt(30.0)) / 72.0
_LARGE = (18.0 + math.sqrt(30.0)) / 72.0
_WEIGHTS = (_SMALL, _LARGE, _LARGE, _SMALL)


@kernel
def work_inside(w, x, y):
    """Return the work of external wrenches from the start of the step to its fraction ``x``, J.

    The wrenches are the thrust, and the wrench on the tip with its reaction on the target.  ``y``
    is the state at ``x``.
    """
    par, mode, a = w.system.par, w.system.mode, w.stepper.y
    work = 0.0
    if mode.driven and not mode.latched:
        px_a, py_a, _, _ = tip_in_cone(a, par)
        px, py, _, _ = tip_in_cone(y, par)
        # exact: the force is constant in the target's axes, in which the path is measured
        work += mode.wrench[0] * (px - px_a) + mode.wrench[1] * (py - py_a)
        work += mode.wrench[2] * (y[3] - y[7] - a[3] + a[7])
    if mode.thrusting:
        for vehicle in range(2):
            work += work_on(w, x, y, vehicle)
    return work


@kernel
def work_on(w, x, y, vehicle):
    """Return the work of thrust on a vehicle (0 chaser, 1 target), J; see :func:`work_inside`."""
    a, thrust = w.stepper.y, w.system.mode.thrust
    first, heading = (0, 2) if vehicle == 0 else (5, 7)
    fx, fy = thrust[3 * vehicle], thrust[3 * vehicle + 1]
    work = thrust[3 * vehicle + 2] * (y[heading] - a[heading])
    if fx == 0.0 and fy == 0.0:
        return work
    s, c = sine_cosine(a[heading])
    gx, gy = turned(fx, fy, s, c)
    work += gx * (y[first] - a[first]) + gy * (y[first + 1] - a[first + 1])
    if a[8 + heading] == 0.0 and y[8 + heading] == 0.0 and y[heading] == a[heading]:
        return work
    extra = 0.0
    for k in range(4):
        place = x * _PLACES[k]
        s, c = sine_cosine(entry_inside(w, place, heading))
        hx, hy = turned(fx, fy, s, c)
        vx, vy = entry_inside(w, place, 8 + first), entry_inside(w, place, 9 + first)
        extra += _WEIGHTS[k] * ((hx - gx) * vx + (hy - gy) * vy)
    return work + extra * x * w.step.h
