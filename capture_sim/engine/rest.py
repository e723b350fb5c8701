"""Vehicles that their supports hold: when one may come to rest, when it is torn loose."""

from __future__ import annotations

from capture_sim.engine.notebook import AT_REST
from capture_sim.engine.touches import log_event
from capture_sim.kernels import kernel
from capture_sim.model.equations import N_STATE, ROLLING, accelerate, accelerate_sticking
from capture_sim.model.observe import kinetic_energy
from capture_sim.model.supports import fastest_ball, load_factor
from capture_sim.model.trig import sine_cosine

_REST_SPEED = 5.0  # of v_eps: see docs/model.md, supports
# share of the supports' limit below which a slow vehicle is put at rest: at it, the smoothed
# resistance would let it creep at _REST_SPEED v_eps, r / sqrt(1 - r^2) = 5
_REST_SHARE = 0.98


@kernel
def is_slow(y, par, which, times):
    """Tell whether a vehicle is below ``times`` the speed at which it may be put at rest."""
    if which == 0:
        s, c = sine_cosine(y[2])
        speed = fastest_ball(y[8], y[9], y[10], c, s, par.balls_S)
    else:
        s, c = sine_cosine(y[7])
        speed = fastest_ball(y[13], y[14], y[15], c, s, par.balls_T)
    return speed < times * _REST_SPEED * par.v_eps_ball


@kernel
def ratio_of_limit(y, par, mode, f, scratch, which):
    """Return which share of its supports' limit a vehicle needs to stand still."""
    if mode.sticking[0] or mode.sticking[1]:
        sx, sy, sm, tx, ty, tm = accelerate_sticking(y, par, mode, f, scratch)
    else:
        sx, sy, sm, tx, ty, tm = accelerate(y, par, mode, f, scratch)
    if which == 0:
        s, c = sine_cosine(y[2])
        return load_factor(sx, sy, sm, c, s, par.balls_S)
    s, c = sine_cosine(y[7])
    return load_factor(tx, ty, tm, c, s, par.balls_T)


@kernel
def may_rest(y, y_x, f, par, mode, scratch, which):
    """Tell whether the supports could hold a vehicle if it stood still here."""
    for i in range(N_STATE):
        y_x[i] = y[i]
    first = 8 if which == 0 else 13
    for i in range(first, first + 3):
        y_x[i] = 0.0
    return ratio_of_limit(y_x, par, mode, f, scratch, which) < _REST_SHARE


@kernel
def stop_vehicle(par, run, mode, events, t, y, which):
    """Put a vehicle at rest on its supports; what speed it had left goes to them."""
    before = kinetic_energy(y, par)
    first = 8 if which == 0 else 13
    for i in range(first, first + 3):
        y[i] = 0.0
    y[ROLLING] += before - kinetic_energy(y, par)
    if which == 0:
        mode.rest_S = 1
    else:
        mode.rest_T = 1
    run.fresh = 1
    log_event(events, run, AT_REST, t, y, which + 1, 0.0)
