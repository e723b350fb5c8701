"""What must hold between the groups of the engine's record, checked between its segments.

Only where the kernels run as plain Python (``NUMBA_DISABLE_JIT=1``): ``install`` puts the checks
round the functions that plan and close a segment.  It also fills scratch with NaN whenever its
owner returns, and checks that a function described by 'Return ...' writes nothing but scratch.
"""

import functools
import inspect
import math

import numpy as np

from capture_sim.base.compiled.kernels import Kernel
from capture_sim.dynamics.engine import consequences, events, extremes, loop, rail, segment, steps
from capture_sim.dynamics.engine.state import NO_EVENT, SCRATCH, STEP, Segment, StepStatus
from capture_sim.dynamics.engine.steps import distance_to_edge
from capture_sim.dynamics.model.equations import (
    N_TOTAL,
    NO_TOUCH,
    Hold,
    gap_and_rate,
    rate_of_change,
    tip_in_cone,
)
from capture_sim.dynamics.samples import EventKind
from capture_sim.scene.laws import FrictionLaw


def check_touches(w):
    mode, t0 = w.system.mode, w.step.t0
    for touch in mode.touch:
        if not touch.on:
            assert touch == NO_TOUCH[0], f"of a touch that is over remains {touch}"
            continue
        assert not mode.latched
        assert touch.start <= t0
        assert abs(touch.direction) == 1.0
        assert touch.sticking == 0 or w.system.par.friction_law == FrictionLaw.COULOMB
        assert touch.largest_rate >= touch.approach_speed >= 0.0
        assert touch.start <= touch.peak_time <= t0
        assert touch.peak_force >= 0.0
        assert touch.chi >= 0.0


def check_between_segments(w):
    """After a segment has been closed: the state at t0 and all that is said to belong to it."""
    step, stepper, rail, totals = w.step, w.stepper, w.rail, w.totals
    mode, par = w.system.mode, w.system.par
    check_touches(w)
    assert np.all(totals.extreme_time <= step.t0)
    assert not (rail.taut and not rail.on)
    assert not (mode.held == Hold.SEAT and (par.preload == 0.0 or stepper.y[4] != par.h_0))
    assert not (mode.held == Hold.FRICTION and par.slide_friction == 0.0)
    assert not (mode.held and (stepper.y[12] != 0.0 or mode.slide_direction != 0.0))
    assert mode.held or abs(mode.slide_direction) == (par.slide_friction > 0.0)
    assert not (mode.rest_S and np.any(stepper.y[8:11]))
    assert not (mode.rest_T and np.any(stepper.y[13:16]))
    if rail.on:
        return
    if step.start_measured:
        px, py, wx, wy = tip_in_cone(stepper.y, par)
        for i, side in enumerate((1.0, -1.0)):
            gap = gap_and_rate(px, py, wx, wy, side, par)[:2]
            known = (math.inf, 0.0) if mode.latched else gap
            assert (step.start.gap[i], step.start.gap_rate[i]) == known
        distance, rate = distance_to_edge(px, py, wx, wy, par)
        assert step.start.gap[2] == distance - par.latch_radius
        assert step.start.gap_rate[2] == rate
        assert step.start.tip_speed == math.sqrt(wx * wx + wy * wy)
    if not step.equations_changed and not any(touch.sticking for touch in mode.touch):
        # a force that has been found by events is known to their rounding only
        f = np.zeros(N_TOTAL)
        rate_of_change(step.t0, stepper.y, f, w.system)
        assert np.array_equal(stepper.K[stepper.stages], f)
        if step.loads_kept:
            loads = np.zeros(4)
            extremes.write_loads(loads, stepper.y, f[12], f[11] - f[10], w.system)
            assert np.array_equal(step.loads, loads)
        if par.has_supports and step.x_end == 1.0:
            assert np.array_equal(step.hold, w.system.out.hold)


def check_planned(w):
    """After a segment has been planned: it lies ahead, and its event can happen."""
    step, event, mode = w.step, w.event, w.system.mode
    assert step.segment == (Segment.RAIL if w.rail.on else Segment.STEP)
    assert step.t1 >= step.t0
    if event.kind == NO_EVENT:
        return
    assert math.isfinite(step.t1)
    kind, which = EventKind(event.kind), event.which
    resting = (mode.rest_S, mode.rest_T)
    possible = {
        EventKind.TOUCH: lambda: not mode.touch[which].on and not mode.latched,
        EventKind.LIFT_OFF: lambda: mode.touch[which].on,
        EventKind.STICK: lambda: mode.touch[which].on if which < 2 else not mode.held,
        EventKind.SLIP: lambda: mode.held == Hold.FRICTION,
        EventKind.MOVING: lambda: resting[which],
        EventKind.AT_REST: lambda: w.rail.on or not resting[which],
        EventKind.LATCHED: lambda: not mode.latched,
        EventKind.STOP_HIT: lambda: mode.stop == 0,
        EventKind.STOP_LEFT: lambda: mode.stop == which,
        EventKind.SEATED: lambda: not mode.held and w.system.par.preload > 0.0,
        EventKind.UNSEATED: lambda: mode.held == Hold.SEAT,
        EventKind.LANDED: lambda: w.rail.taut,
        EventKind.RAIL_END: lambda: w.rail.on and not w.rail.taut,
        EventKind.END: lambda: step.t1 == w.progress.t_stop,
    }
    assert possible[kind]()


def check_ended(w):
    assert w.progress.done
    assert w.step.segment == Segment.NONE
    assert not any(touch.on for touch in w.system.mode.touch)


#: Scratch of each function, which no other may read after it returns.
OWNED = {
    "value_inside": ("sought",),
    "seat_left_by": ("sought",),
    "locate_zero": ("sought",),
    "slip_changed_by": ("sought",),
    "measure_seat": ("moved",),
    "value_at": ("watched",),
    "watch_loads": ("near_start", "near_end"),
    "may_rest": ("halted",),
    "close_rail": ("on_rail",),
    "sample_at": ("sampled",),
}
assert {name for names in OWNED.values() for name in names} == set(SCRATCH.names)
ENGINE = (consequences, events, extremes, loop, rail, segment, steps)


def poison(w, names):
    for name in names:
        w.scratch[name][...] = np.nan
    w.stepper.y_stage[...] = np.nan
    w.system.spare[...] = np.nan


def kept(w):
    """What only functions that are not described by 'Return ...' may change."""
    parts = [w.system.mode, w.stepper.y, w.stepper.y_new, w.y_end]
    parts += [w.progress, w.rail, w.totals, w.event]
    # the dense output is computed where it is first needed
    parts += [w.step[name] for name in STEP.names if name != "dense_ready"]
    return [part.tobytes() for part in parts]


def guarded(kernel):
    """Return a kernel that poisons its scratch, and is checked against what it says.

    Its numbers must not come from poisoned scratch; one that returns something writes nothing.
    """
    name = kernel.py_func.__name__
    returns = (kernel.py_func.__doc__ or "").startswith("Return")

    @functools.wraps(kernel.py_func)
    def checked(w, *rest):
        assert not any(isinstance(x, float) and math.isnan(x) for x in rest), f"NaN into {name}"
        before = kept(w) if returns else None
        result = kernel(w, *rest)
        assert before is None or kept(w) == before, f"{name} writes"
        poison(w, OWNED.get(name, ()))
        return result

    return checked


def guard_scratch():
    """Guard every kernel of the engine that has the whole record, in all modules that call it."""
    wrapped = {}
    for module in ENGINE:
        for name, kernel in list(vars(module).items()):
            if not isinstance(kernel, Kernel) or name in ("dense", "advance"):
                continue
            if next(iter(inspect.signature(kernel.py_func).parameters)) != "w":
                continue
            setattr(module, name, wrapped.setdefault(kernel, guarded(kernel)))


def install():
    """Put the checks into the loop, for the whole process."""
    guard_scratch()

    def followed_by(check, name):
        function = getattr(loop, name)

        @functools.wraps(function)
        def checked(w, *rest):
            result = function(w, *rest)
            if result is None or result == StepStatus.SERVED:
                check(w)
            return result

        setattr(loop, name, checked)

    for name in ("close_step", "close_rail"):
        followed_by(check_between_segments, name)
    for name in ("plan_step", "plan_rail"):
        followed_by(check_planned, name)
    followed_by(check_ended, "end_run")
