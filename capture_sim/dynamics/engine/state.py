"""State of a run: one record, in groups by the module that writes them.

A single record passes to a kernel as one pointer, with all lengths known at compile time.
``tests/invariants.py`` checks the invariants between the groups.
"""

from __future__ import annotations

from enum import IntEnum

import numpy as np

from capture_sim.dynamics.model.equations import N_TOTAL, STOP, SYSTEM
from capture_sim.dynamics.samples import EXTREME_NAMES, SAMPLE, TOUCH
from capture_sim.dynamics.solver.runge_kutta import stepper_type


class StepStatus(IntEnum):
    """How a call of the loop ended; from NOT_FINITE on the run cannot continue."""

    SERVED = 0
    INTERRUPTED = 1  # call again: the log is full, or the call has taken its share of time
    NOT_FINITE = 2
    STEP_TOO_SMALL = 3
    TOO_MANY_STEPS = 4
    PILE_UP = 5
    TIP_THROUGH_WALL = 6
    PROBE_IN_HINGE = 7
    STEP_TOO_LONG = 8
    ENERGY_LOST = 9


class Segment(IntEnum):
    """Kind of the present segment."""

    NONE = 0
    RAIL = 1
    STEP = 2


NO_EVENT = -1  # next to the EventKinds in ``event.kind``
#: Wall of an event that has none; typed, as each literal would be compiled as a case of its own.
NO_WALL = np.int64(0)
SMALLEST_STEP = 1e-15  # s; below it t + h equals t in runs of minutes
LOG_ROOM = 256
#: Entries of y under error control: the states and the energies, not the impulses.
N_WATCHED = STOP + 1

#: Position of the tip at one end of the present step, and its distances.
DISTANCES = np.dtype(
    [
        ("gap", "f8", (3,)),  # of both walls and to the latch, m
        ("gap_rate", "f8", (3,)),
        ("tip", "f8", (4,)),  # position and velocity in the target's frame, m and m/s
        ("tip_speed", "f8"),  # m/s
    ],
    align=True,
)

#: The present segment and the integrator's step that it was cut from; written by ``steps`` and
#: ``segment``.
STEP = np.dtype(
    [
        ("segment", "i8"),  # of Segment
        ("t0", "f8"),  # start of the segment
        ("t1", "f8"),  # its end
        ("h", "f8"),  # full length of the step
        ("x_end", "f8"),  # end of the segment as a fraction of the step
        ("dense_ready", "i8"),
        ("equations_changed", "i8"),  # K[0] is stale
        ("h_next", "f8"),
        ("h_before_touch", "f8"),  # next step before the last touch began
        ("error", "f8"),  # of the last accepted step
        ("substeps", "i8"),  # events located within one fixed step
        ("start", DISTANCES),
        ("start_measured", "i8"),  # ``start`` belongs to t0
        ("loads", "f8", (4,)),  # of the buffer at the end of the segment before, see extremes
        ("loads_kept", "i8"),  # ... which are those at t0
        ("hold", "f8", (6,)),  # load on supports at rest at the end of the step, see OUT
        ("hold_load", "f8", (2,)),  # axial force of a held probe at both ends of the step, N
        ("hold_load_rate", "f8", (2,)),  # N/s
        ("end", DISTANCES),
    ],
    align=True,
)

#: The first event in the present segment; written by ``events``.
NEXT_EVENT = np.dtype(
    [
        ("kind", "i8"),  # of EventKind, or NO_EVENT
        ("which", "i8"),  # its wall, vehicle or stop
        ("x", "f8"),  # its fraction of the step, 0..1; 2: no event
    ],
    align=True,
)

#: The chaser on its rail; written by ``rail``.
RAIL = np.dtype(
    [
        ("on", "i8"),
        ("taut", "i8"),
        ("travel", "f8"),  # at t0, m
        ("speed", "f8"),  # at t0, m/s
        ("acceleration", "f8"),  # without drag
        ("damping", "f8"),  # drag over the moving mass, 1/s
    ],
    align=True,
)

#: Counts, energies lost at events, and extremes of the run so far; any kernel may add to them.
TOTALS = np.dtype(
    [
        ("steps", "i8"),
        ("rejected", "i8"),
        ("touches", "i8"),
        ("energy_0", "f8"),  # J, at the release
        ("floor_0", "f8"),  # result of floor_work() there, J
        ("lost_landing", "f8"),  # J, at the instant of an event
        ("lost_latch", "f8"),
        ("work_thrust", "f8"),  # of wrenches from outside, up to the start of the step, J
        ("lost_slide", "f8"),  # by friction in the slide, but for the present slide
        ("slide_from", "f8"),  # h where the present slide began, m
        ("extreme", "f8", (2, len(EXTREME_NAMES))),  # before and after the latch
        ("extreme_time", "f8", (2, len(EXTREME_NAMES))),
    ],
    align=True,
)

#: Progress of the run; written by ``loop`` and ``consequences``.
PROGRESS = np.dtype(
    [
        ("begun", "i8"),
        ("done", "i8"),
        ("status", "i8"),  # of StepStatus
        ("t_stop", "f8"),  # of this call: a pause, or the end of the run
        ("t_end", "f8"),  # of the run
        ("events_at_t0", "i8"),  # in a row, without progress
        ("released_at_t0", "i8"),  # the probe was held until the present time
        ("slow", "i8", (2,)),  # chaser, target: below the rest speed; AT_REST is not sought again
        ("n_log", "i8"),
        ("n_trace", "i8"),
    ],
    align=True,
)

#: An entry of the event log.
EVENT = np.dtype(
    [
        ("kind", "i8"),
        ("t", "f8"),
        ("which", "i8"),  # its wall, vehicle or stop
        ("value", "f8"),
        ("q", "f8", (8,)),
        ("v", "f8", (8,)),
        ("touch", TOUCH),
    ],
    align=True,
)

#: Temporary states.  Each belongs to one function, which writes it before it reads it.  The tests
#: put NaN into all of them between the calls of these functions.  All are as long as y, because for
#: another length the compiler would compile the equations a second time.
SCRATCH = np.dtype(
    [
        ("sought", "f8", (N_TOTAL,)),  # events: where an event is sought
        ("moved", "f8", (N_TOTAL,)),  # events.measure_hold: shortly after or before an end
        ("watched", "f8", (N_TOTAL,)),  # extremes.value_at: where a maximum is sought
        ("near_start", "f8", (N_TOTAL,)),  # extremes.watch_latch: shortly after the start
        ("near_end", "f8", (N_TOTAL,)),  # extremes.watch_loads: shortly before the end
        ("halted", "f8", (N_TOTAL,)),  # consequences.may_rest: with a vehicle at rest
        ("on_rail", "f8", (N_TOTAL,)),  # rail.close_rail: at the end of the segment
        ("sampled", "f8", (N_TOTAL,)),  # loop.sample_at: at a sample
    ],
    align=True,
)

#: The whole record.  The touches of both walls are in ``system.mode.touch``.
WORKSPACE = np.dtype(
    [
        ("system", SYSTEM),
        ("stepper", stepper_type(N_TOTAL, N_WATCHED)),
        ("step", STEP),
        ("event", NEXT_EVENT),
        ("rail", RAIL),
        ("totals", TOTALS),
        ("progress", PROGRESS),
        ("y_end", "f8", (N_TOTAL,)),  # state at the end of the present segment
        ("scratch", SCRATCH),
        ("log", EVENT, (LOG_ROOM,)),
        ("sample", SAMPLE),  # at the release, and where the run stopped early
    ],
    align=True,
)
