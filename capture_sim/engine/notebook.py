"""What the loop keeps of a run, the events it logs, and how it may end."""

from __future__ import annotations

import numpy as np

from capture_sim.samples import TOUCH

#: Where a run stands; the loop's own notebook.
RUN = np.dtype(
    [
        ("t0", "f8"),  # start of the present stretch
        ("t1", "f8"),  # its end
        ("h", "f8"),  # full length of the integrator's step it was cut from
        ("stretch", "i8"),  # NONE, RAIL or STEP
        ("pending", "i8"),  # event at its end, -1 for none
        ("pending_wall", "i8"),
        ("dense_ready", "i8"),
        ("fresh", "i8"),  # equations have changed: K[0] is stale
        ("h_next", "f8"),
        ("h_free", "f8"),  # next step before the last touch began
        ("error", "f8"),
        ("stiff", "i8"),  # the implicit method is at work
        ("held_back", "i8"),  # explicit steps in a row that only the contact kept short
        ("h_stiff", "f8"),  # next implicit step; the last one; the one that is factorised
        ("h_last", "f8"),
        ("h_factored", "f8"),
        ("derived", "i8"),  # the derivatives belong to this touch
        ("on_rail", "i8"),
        ("taut", "i8"),
        ("travel", "f8"),  # along the rail at t0
        ("speed", "f8"),  # along the rail at t0
        ("acceleration", "f8"),
        ("t_stop", "f8"),
        ("done", "i8"),
        ("steps", "i8"),
        ("rejected", "i8"),
        ("evaluations", "i8"),
        ("pile", "i8"),  # events in a row without progress
        ("energy_0", "f8"),
        ("lost_landing", "f8"),
        ("lost_latch", "f8"),
        ("touches", "i8"),
        ("touch_start", "f8", (2,)),
        ("touch_speed", "f8", (2,)),
        ("touch_peak", "f8", (2,)),
        ("touch_peak_time", "f8", (2,)),
        ("touch_impulse", "f8", (2,)),  # the integrals when it began
        ("touch_hysteresis", "f8", (2,)),
        ("force", "f8", (2,)),  # normal force at t0, and its rate
        ("force_rate", "f8", (2,)),
        ("gap", "f8", (3,)),  # at t0: of both walls and to the latch, m
        ("gap_rate", "f8", (3,)),
        ("tip_speed", "f8"),  # at t0: of the tip against the target, m/s
        ("measured", "i8"),  # the gaps belong to t0
        ("slow", "i8", (2,)),  # chaser, target: too slow to become slow again
        ("substeps", "i8"),  # events located within one fixed step
        ("n_events", "i8"),
        ("n_trace", "i8"),
    ],
    align=True,
)

EVENT = np.dtype(
    [
        ("kind", "i8"),
        ("t", "f8"),
        ("wall", "i8"),
        ("value", "f8"),
        ("q", "f8", (8,)),
        ("v", "f8", (8,)),
        ("touch", TOUCH),
    ],
    align=True,
)

NONE, RAIL, STEP = 0, 1, 2
RELEASE, LANDED, RAIL_END, TOUCH_BEGINS, LIFT_OFF, AT_REST, MOVING, LATCHED, END = range(9)
STOP_HIT, STOP_LEFT, STICK, SLIP = range(9, 13)
SLOW = 13  # a vehicle is slow enough to be held by its supports: rest, if they can
NO_EVENT = -1

# how the loop ended
SERVED, EVENTS_FULL, NOT_FINITE, STEP_TOO_SMALL, TOO_MANY_STEPS, PILE_UP = range(6)
TIP_THROUGH_WALL, PROBE_IN_HINGE, STEP_TOO_LONG = 6, 7, 8

SMALLEST_STEP = 1e-15  # s; below it t + h stands still for runs of minutes
