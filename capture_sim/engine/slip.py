"""Sticking and sliding of the tip on a wall, for Coulomb's law with its events."""

from __future__ import annotations

from capture_sim.engine.notebook import SLIP, STICK
from capture_sim.engine.touches import log_event
from capture_sim.kernels import kernel
from capture_sim.model.equations import NORMAL, RUB, accelerate_sticking, slip_of

_SLIP_FLOOR = 1e-10  # of the scene's speed: slip below it is rounding's, without direction


@kernel
def slip_margin(y, par, mode, f, scratch, i):
    """Return how far the tip on wall ``i`` is from changing between sticking and sliding.

    Sliding: the slip in its direction, m/s.  Sticking: the force that is left, N.
    """
    if not mode.sticking[i]:
        return slip_of(y, par, i) * mode.direction[i] + _SLIP_FLOOR * par.speed_scale
    accelerate_sticking(y, par, mode, f, scratch)
    return par.mu_s * scratch[NORMAL + i] - abs(scratch[RUB + i])


@kernel
def change_slip(par, run, mode, events, t, y, f, scratch, i):
    """Let the tip on wall ``i`` stick if friction can hold it, else slide the way it must."""
    was = mode.sticking[i]
    mode.sticking[i] = 1
    accelerate_sticking(y, par, mode, f, scratch)
    needed = scratch[RUB + i]
    if not was and abs(needed) < par.mu_s * scratch[NORMAL + i]:
        log_event(events, run, STICK, t, y, 1 - 2 * i, needed)
        return
    mode.sticking[i] = 0
    # friction opposes the motion that it could not prevent
    mode.direction[i] = 1.0 if needed < 0.0 else -1.0
    log_event(events, run, SLIP, t, y, 1 - 2 * i, needed)
