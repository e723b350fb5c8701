"""Description of an event in words, for :attr:`Event.detail`."""

from __future__ import annotations

import math

from capture_sim.dynamics.samples import (
    EventKind,
)

AT_WALL = (EventKind.TOUCH, EventKind.LIFT_OFF, EventKind.STICK, EventKind.SLIP)
_OF_VEHICLE = (*(EventKind.AT_REST, EventKind.MOVING, EventKind.THRUST_ON, EventKind.THRUST_OFF),)


def event_text(kind: EventKind, which: int, value: float) -> str:
    """Return the description of an event in words; empty for a kind without a description.

    ``which``: wall (+1 or -1; 0: the probe's slide), vehicle (1: chaser) or stop (negative:
    compressed) of the event.
    ``value``: the quantity in the text in SI units, e.g. a speed or a force.
    """
    wall = "+y wall" if which > 0 else "-y wall"
    stop = "compressed" if which < 0 else "extended"
    if kind is EventKind.LANDED:
        return f"hanging mass down, chaser at {value:.6g} m/s"
    if kind is EventKind.RAIL_END:
        return f"chaser free at {value:.6g} m/s"
    if kind is EventKind.TOUCH:
        return f"{wall} at {value:.6g} m/s"
    if kind is EventKind.LIFT_OFF:
        return f"{wall} after a peak of {value:.6g} N"
    if kind in _OF_VEHICLE:
        vehicle = "chaser" if which == 1 else "target"
        is_late = kind is EventKind.THRUST_OFF and value > 0.0
        return f"{vehicle}, no command for {value:g} s" if is_late else vehicle
    if kind in (EventKind.STOP_HIT, EventKind.STOP_LEFT):
        return f"{stop} at {value:.6g} m/s"
    if kind is EventKind.SEATED:
        return f"probe back on its seat at {value:.6g} m/s"
    if kind is EventKind.UNSEATED:
        return f"probe leaves its seat at {value:.6g} N"
    if kind is EventKind.SLIP and math.isinf(value):
        return f"{wall}, after the impact on the seat"
    if kind in (EventKind.STICK, EventKind.SLIP):
        place = wall if which else "probe in its slide"
        return f"{place}, friction {value:.6g} N to hold"
    if kind is EventKind.LATCHED:
        return f"tip caught {value * 1e3:.6g} mm from the centre of BE"
    return ""
