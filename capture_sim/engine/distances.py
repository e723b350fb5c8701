"""How far the tip is from walls, latch and stops, and how fast that changes."""

from __future__ import annotations

import math

from capture_sim.kernels import kernel
from capture_sim.model.equations import tip_in_cone, wall_gap


@kernel
def distances(y, par):
    """Return gaps and their rates: +y wall, -y wall, latch; and the tip's speed; m and m/s."""
    px, py, wx, wy = tip_in_cone(y, par)
    g0, d0, _, _ = wall_gap(px, py, wx, wy, 1.0, par)
    g1, d1, _, _ = wall_gap(px, py, wx, wy, -1.0, par)
    g2 = 1.0
    d2 = 0.0
    if par.has_latch:
        ux = px + par.L_T
        distance = math.sqrt(ux * ux + py * py)
        g2 = distance - par.latch_radius
        if distance > 0.0:
            d2 = (ux * wx + py * wy) / distance
    return g0, d0, g1, d1, g2, d2, math.sqrt(wx * wx + wy * wy)


@kernel
def remember_distances(run, near):
    """Keep the distances at the start of the next stretch."""
    run.gap[0] = near[0]
    run.gap_rate[0] = near[1]
    run.gap[1] = near[2]
    run.gap_rate[1] = near[3]
    run.gap[2] = near[4]
    run.gap_rate[2] = near[5]
    run.tip_speed = near[6]
    run.measured = 1


@kernel
def stop_distance(y, par, side):
    """Return the probe's way to a stroke stop and its rate; ``side`` -1 compressed, +1."""
    end = par.stop_compressed if side < 0 else par.stop_extended
    return side * (end - (y[4] - par.h_0)), -side * y[12]


@kernel
def way_to_events(par, run, mode):
    """Return how far the tip may move in the present step without leaping over an event, m.

    A distance changes no faster than the tip moves: away from the walls (and the latch) the
    step ends short of them, near them it is so short that gap and rate show every dip.
    """
    way = math.inf
    if mode.latched:
        return way
    near = 0.25 * par.R_t
    for i in range(2):
        way = min(way, max(run.gap[i] - near, near))
    if par.has_latch:
        near = 0.25 * par.latch_radius
        way = min(way, max(run.gap[2] - near, near))
    return way
