"""What the loop keeps of a run, as one record that all its kernels read and write.

One record, not an array or a tuple each: a kernel takes one pointer, and all lengths are known
when it is compiled.
"""

from __future__ import annotations

from enum import IntEnum

import numpy as np

from capture_sim.model.equations import N_TOTAL, STOP, SYSTEM
from capture_sim.samples import EXTREME_NAMES, SAMPLE, TOUCH
from capture_sim.solver.runge_kutta import stepper_type


class Status(IntEnum):
    """How a call of the loop ended; from NOT_FINITE on the run cannot go on."""

    SERVED = 0
    INTERRUPTED = 1  # to be called again: the room for events is used up, or enough was done
    NOT_FINITE = 2
    STEP_TOO_SMALL = 3
    TOO_MANY_STEPS = 4
    PILE_UP = 5
    TIP_THROUGH_WALL = 6
    PROBE_IN_HINGE = 7
    STEP_TOO_LONG = 8


class Segment(IntEnum):
    """Kind of the present segment."""

    NONE = 0
    RAIL = 1
    STEP = 2


NO_EVENT = -1  # beside the EventKinds in ``pending``
#: Wall of an event that has none; typed, as each literal would be compiled as a case of its own.
NO_WALL = np.int64(0)
SMALLEST_STEP = 1e-15  # s; below it t + h stands still for runs of minutes
EVENT_ROOM = 256
#: The states and the energies count in the error, the impulses do not.
N_WATCHED = STOP + 1

#: Where a run stands.
RUN = np.dtype(
    [
        ("t0", "f8"),  # start of the present segment
        ("t1", "f8"),  # its end
        ("h", "f8"),  # full length of the integrator's step it was cut from
        ("x_end", "f8"),  # its end as a fraction of that step
        ("cut", "f8"),  # place (0..1) of the first event in the step; 2: none
        ("segment", "i8"),  # of Segment
        ("pending", "i8"),  # event at its end, of EventKind, or NO_EVENT
        ("pending_wall", "i8"),  # its wall, vehicle or stop
        ("begun", "i8"),
        ("status", "i8"),  # of Status
        ("dense_ready", "i8"),
        ("fresh", "i8"),  # equations have changed: K[0] is stale
        ("h_next", "f8"),
        ("h_free", "f8"),  # next step before the last touch began
        ("error", "f8"),  # of the last accepted step
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
        ("touch_rate", "f8", (2,)),  # largest rate of penetration
        ("touch_peak", "f8", (2,)),
        ("touch_peak_time", "f8", (2,)),
        ("touch_impulse", "f8", (2,)),  # the integrals when it began
        ("touch_hysteresis", "f8", (2,)),
        ("force", "f8", (2,)),  # normal force at t0, and its rate
        ("force_rate", "f8", (2,)),
        ("gap", "f8", (3,)),  # at t0: of both walls and to the latch, m
        ("gap_rate", "f8", (3,)),
        ("tip_speed", "f8"),  # at t0: of the tip against the target, m/s
        ("next_gap", "f8", (3,)),  # likewise at the end of the step
        ("next_gap_rate", "f8", (3,)),
        ("next_tip_speed", "f8"),
        ("measured", "i8"),  # the gaps belong to t0
        ("slow", "i8", (2,)),  # chaser, target: too slow to become slow again
        ("substeps", "i8"),  # events located within one fixed step
        ("extreme", "f8", (2, len(EXTREME_NAMES))),  # before and after the latch
        ("extreme_time", "f8", (2, len(EXTREME_NAMES))),
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

#: All of a run.
WORKSPACE = np.dtype(
    [
        ("system", SYSTEM),
        ("step", stepper_type(N_TOTAL, N_WATCHED)),
        ("run", RUN),
        ("y_end", "f8", (N_TOTAL,)),  # state at the end of the present segment
        ("y_x", "f8", (N_TOTAL,)),  # at a place inside it
        ("events", EVENT, (EVENT_ROOM,)),
        ("sample", SAMPLE),  # of t0, at the release and where the run had to stop
    ],
    align=True,
)
