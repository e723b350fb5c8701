"""The rules of the verdict, evaluated at successive positions of the tip.

:func:`decide` contains the rules that apply during a run, :func:`decide_at_end` the rules at its
end.  Exact samples are evaluated in compiled code (:mod:`capture_sim.detection.exact`).
Measurements are evaluated in Python, at positions that a filter has estimated
(:mod:`capture_sim.detection.detector`).
"""

from __future__ import annotations

import math
from enum import IntEnum
from typing import NamedTuple

import numpy as np

from capture_sim.base.compiled.kernels import kernel
from capture_sim.dynamics.samples import Named
from capture_sim.scene.geometry import nearest_on_wall
from capture_sim.scene.parts import Scene

#: Standard deviations by which a value must satisfy a criterion.
GUARD = 3.0
#: GUARD for the border of the capture zone, where false entries and false exits cost the same.
ZONE_GUARD = 1.0
# s; tolerance for round-off: a difference of two decimal time stamps may be just below 0.2 s
_TICK = 1e-9


class CaptureState(Named):
    """State of the capture, as in msg/CaptureStatus.msg.

    Examples
    --------
    When the detector saw a bench change its state:

    >>> from capture_sim import CaptureState, simulate
    >>> run, seen = simulate("tilt_0"), {}
    >>> for status in run.statuses:
    ...     _ = seen.setdefault(status.label, round(status.t, 2))
    >>> seen
    {'approach': 0.0, 'contact': 2.8, 'captured': 3.12}
    >>> run.statuses[-1].state is CaptureState.CAPTURED
    True
    """

    APPROACH = 0
    CONTACT = 1
    CAPTURED = 2
    REBOUND = 3
    MISSED = 4
    STUCK = 5
    UNDECIDED = 6

    @property
    def is_verdict(self) -> bool:
        """True for captured, rebound, missed and stuck."""
        return CaptureState.CONTACT < self < CaptureState.UNDECIDED


class Cause(IntEnum):
    """Rule that gave the state; :func:`reason` returns its description."""

    NO_CONTACT = 0
    AT_CONE = 1
    PASSED_THROAT = 2
    DWELT = 3
    RETREATED = 4
    PASSED_BESIDE = 5
    AT_REST = 6
    MOVED_AWAY = 7
    LEFT_ZONE = 8
    CAME_OUT = 9
    END_NOT_APPROACHING = 10
    END_MOVING_OUT = 11
    END_AT_REST = 12
    END_BEFORE_CONTACT = 13
    END_AFTER_CONTACT = 14
    NOT_APPROACHED = 15
    NOT_MEASURED = 16
    CLOCKS_DIFFER = 17
    CONTACT_UNSEEN = 18
    JUMPED = 19
    STAYED = 20
    NO_END = 21


#: Text in the reason of a capture after which the tip has left the capture zone again.
_OUTSIDE_AGAIN = "but outside again"


class CaptureStatus(NamedTuple):
    """Status of the detector at one instant; fields and units as in msg/CaptureStatus.msg.

    ``nearest_deviation`` is the standard error of ``nearest_distance``, see
    :attr:`capture_sim.detection.nearest.ClosestApproach.estimate`.  ``may_precede`` (s) is the time
    by which the state may have begun before ``t - time_in_state``, because of noise and gaps;
    infinite: before the first measurement.  ``may_follow`` (s) is
    that by which it may have begun later; infinite: nothing so far is certain enough to tell.
    ``not_used`` is set at the end of a run.  It lists the numbers of unused measurements by source
    and reason, with the likely cause if they are many.
    """

    t: float
    state: CaptureState
    final: bool
    distance: float
    axial_offset: float
    lateral_offset: float
    relative_attitude: float
    relative_speed: float
    nearest_distance: float
    time_in_state: float
    reason: str
    not_used: str = ""
    nearest_deviation: float = 0.0
    may_precede: float = 0.0
    may_follow: float = 0.0

    @property
    def left_again(self) -> bool:
        """True if the tip was captured and is outside the capture zone again."""
        return self.state is CaptureState.CAPTURED and _OUTSIDE_AGAIN in self.reason

    @property
    def label(self) -> str:
        """State as text for tables, with ", left" if a captured tip has left the zone again."""
        return f"{self.state.label}, left" if self.left_again else self.state.label


class Criteria(NamedTuple):
    """The criteria and the geometry that they use, in m, s and rad.

    The values come from the scene's ``detector``, ``buffer``, ``probe`` and ``cone``.
    """

    radius: float
    dwell: float
    leave: float
    contact_gap: float
    still_speed: float
    still_time: float
    tip_radius: float
    rest_length: float
    a: float
    R_c: float
    L_c: float
    cos_b: float
    sin_b: float
    flies: float  # 1 if the scene has thrusters, see :func:`decide`; else 0

    @classmethod
    def of(cls, scene: Scene) -> Criteria:
        """Return the criteria of a scene."""
        part = scene.detector
        return cls(
            part.capture_radius,
            part.min_dwell,
            part.min_retreat,
            part.max_contact_gap,
            part.max_still_speed,
            part.min_still_time,
            scene.probe.tip_radius,
            scene.rest_length,
            scene.buffer.hinge_offset,
            *scene.cone.wall,
            float(scene.thrusters is not None),
        )

    def is_final(self, state: CaptureState) -> bool:
        """Return True if a state does not change any more: in a flight, only a capture."""
        return state is CaptureState.CAPTURED if self.flies else state.is_verdict


class Place(NamedTuple):
    """Position of the tip in the cone's frame at one instant, with its uncertainty.

    Attributes
    ----------
    t
        Time, s.
    axial, lateral
        Distance ahead of BE and offset from the axis, m.
    axial_rate, lateral_rate
        Rates of the position, m/s.
    axial_variance, lateral_variance
        Variances of the position, m^2; 0 if exact.
    size
        Number of measurements used to estimate the position.
    """

    t: float
    axial: float
    lateral: float
    axial_rate: float
    lateral_rate: float
    axial_variance: float = 0.0
    lateral_variance: float = 0.0
    size: int = 1


#: State of the evaluation of one run.  A time is NaN while its condition is not satisfied.
MEMORY = np.dtype(
    [
        ("state", "i8"),
        ("cause", "i8"),
        ("value", "f8"),  # m, the length named in the reason; 0 if it names none
        ("since", "f8"),  # s, start of the state
        ("has_approached", "i8"),  # the criteria are evaluated only if this is set, see decide
        ("farthest", "f8"),  # m, largest distance from BE before the approach
        ("first_t", "f8"),  # s, time of the first position
        ("has_stayed", "i8"),  # no position so far has been outside the capture zone
        ("has_been_outside", "i8"),  # the tip has been ahead of BE
        ("crossing_lateral", "f8"),  # m, lateral offset at the last crossing of BE's plane
        ("nearest", "f8"),  # m, smallest distance from BE
        ("nearest_now", "f8"),  # m, ... in the present approach
        ("t_verdict", "f8"),  # s, start of the verdict that a new approach may end
        ("nearest_gap", "f8"),  # m, smallest gap to a wall, less GUARD standard deviations
        ("fastest", "f8"),  # m/s, largest speed
        ("zone_since", "f8"),  # s, since when the tip has been in the capture zone
        ("outside_since", "f8"),  # s, since when a captured tip has surely been outside the zone
        ("still_since", "f8"),  # s, since when the tip has been at rest outside the zone
        ("still_axial", "f8"),  # m, position of that rest
        ("still_lateral", "f8"),
        ("t", "f8"),  # s, time of the last position
        ("axial", "f8"),  # m, last position
        ("lateral", "f8"),
        ("distance", "f8"),  # m, distance from BE at the last position
        ("speed", "f8"),  # m/s, speed in the cone's frame at the last position
        ("outwards", "f8"),  # m^2/s, that distance times its rate
    ]
)


def new_memory(*, has_approached: bool) -> np.ndarray:
    """Return the memory (1,) at the start of a run; see :func:`decide` for the parameter."""
    memory = _FIRST_MEMORY.copy()
    memory["has_approached"] = has_approached
    return memory


def _first_memory() -> np.ndarray:
    memory = np.zeros(1, MEMORY)
    memory["has_stayed"] = True
    memory["nearest"] = memory["nearest_now"] = memory["nearest_gap"] = math.inf
    for name in (
        "t_verdict",
        "first_t",
        "zone_since",
        "outside_since",
        "still_since",
        "axial",
        "lateral",
    ):
        memory[name] = math.nan
    return memory


_FIRST_MEMORY = _first_memory()


@kernel
def enter(memory, state, cause, t, value):
    """Set the state, its cause, its start time ``t`` (s) and the length in its reason (m)."""
    memory.state, memory.cause, memory.since, memory.value = state, cause, t, value


@kernel
def wall_gap(criteria, axial, lateral):
    """Return the tip's gap to the nearer wall, m, and the two components of the wall's normal."""
    c = criteria
    plus = nearest_on_wall(axial, lateral, c.R_c, c.L_c, c.cos_b, c.sin_b)
    minus = nearest_on_wall(axial, -lateral, c.R_c, c.L_c, c.cos_b, c.sin_b)
    distance, n_u, n_Y = plus if plus[0] <= minus[0] else minus
    return distance - c.tip_radius, n_u, n_Y


@kernel
def note_push(criteria, memory, t, axial, lateral):
    """Enter the contact state if the buffer is pushed while the tip is near a wall.

    Far from the walls, the jerk of the launch may push the buffer.
    """
    near = wall_gap(criteria, axial, lateral)[0] < criteria.tip_radius
    if memory.state == CaptureState.APPROACH and memory.has_approached and near:
        enter(memory, CaptureState.CONTACT, Cause.AT_CONE, t, 0.0)


@kernel
def must_have_hit(criteria, memory, corner_time):
    """Return True if a tip that reversed its motion was so near a wall that it must have hit it.

    Coasting vehicles do not reverse by themselves.  ``corner_time`` (s, or m per m/s) is the length
    that smoothing cuts off the corner of a hit in the path, per unit of speed.
    """
    return memory.nearest_gap < criteria.contact_gap + memory.fastest * corner_time


@kernel
def is_approaching(criteria, memory, t, distance, unsure):
    """Return True once the tip has come nearer to BE by the capture radius.

    On a real bench, a trial may begin long before the release, with the chaser at rest, moved by
    hand or still being pulled back.  Such motion must not affect the verdict.
    """
    if not memory.has_approached:
        if math.isnan(memory.first_t):
            memory.first_t = t
        if distance - ZONE_GUARD * unsure > criteria.radius:
            memory.has_stayed = 0
        memory.farthest = max(memory.farthest, distance)
        memory.nearest = memory.nearest_now = distance
        if memory.farthest - distance - GUARD * unsure > criteria.radius:
            memory.has_approached = 1
    return memory.has_approached != 0


@kernel
def watch_capture(criteria, memory, t, distance, unsure, axial, margin, outside_time):
    """Update the cause of a capture: whether the tip has left the capture zone again."""
    inside = distance + ZONE_GUARD * unsure <= criteria.radius or axial + margin <= 0.0
    outside = distance - GUARD * unsure > criteria.radius and axial - margin > 0.0
    if memory.cause == Cause.DWELT or memory.cause == Cause.LEFT_ZONE:
        before, after = Cause.DWELT, Cause.LEFT_ZONE
    else:
        before, after = Cause.PASSED_THROAT, Cause.CAME_OUT
    if not outside:
        memory.outside_since = math.nan
    elif math.isnan(memory.outside_since):
        memory.outside_since = t
    if t - memory.outside_since >= outside_time - _TICK:
        memory.cause = after
    elif inside:
        memory.cause = before
    memory.value = distance if memory.cause == after else 0.0


@kernel
def approach_again(criteria, memory, t, distance, unsure):
    """Begin a new approach if the tip has come nearer to BE since a verdict, or into the zone.

    Nearer means by the capture radius.  The closest approach of the run is kept; the criteria of
    the new approach start again.
    """
    if memory.t_verdict != memory.since:
        memory.t_verdict, memory.farthest = memory.since, distance
    memory.farthest = max(memory.farthest, distance)
    is_nearer = memory.farthest - distance - GUARD * unsure > criteria.radius
    if is_nearer or distance + GUARD * unsure < criteria.radius:
        enter(memory, CaptureState.APPROACH, Cause.NO_CONTACT, t, 0.0)
        memory.nearest_now, memory.nearest_gap, memory.fastest = distance, math.inf, 0.0
        memory.zone_since = memory.still_since = math.nan
        memory.has_been_outside = 0


@kernel
def decide(criteria, memory, place, has_rested, corner_time, outside_time):
    """Evaluate the criteria at one position of the tip; positions must be in the order of time.

    No criterion is evaluated before ``memory.has_approached`` is set.  For a simulated run it is
    set from the start, because such a run starts with the release.

    ``has_rested`` is true if the tip has been at rest for long enough; it is needed for smoothed
    positions (``place.size > 1``), which are not tested for rest here.  ``corner_time``: see
    :func:`must_have_hit`.  ``outside_time`` (s): a captured tip counts as outside the capture zone
    again once it has been outside for this long.

    A vehicle that flies may hold, back off or try again: its states *missed*, *rebound* and *stuck*
    are left when the tip comes nearer to BE again by the capture radius, from the approach side.
    """
    t, axial, lateral = place.t, place.axial, place.lateral
    var_a, var_l = place.axial_variance, place.lateral_variance
    square = axial * axial + lateral * lateral
    distance, unsure = math.sqrt(square), 0.0
    if var_a > 0.0 or var_l > 0.0:
        # subtract the mean contribution of noise to a squared length
        distance = math.sqrt(max(square - var_a - var_l, 0.0))
        if square > 0.0:
            unsure = axial * axial * var_a + lateral * lateral * var_l
            unsure = math.sqrt(unsure / square)
        else:
            unsure = math.sqrt(max(var_a, var_l))
    speed = math.hypot(place.axial_rate, place.lateral_rate)
    if memory.axial > 0.0 and axial <= 0.0:
        share = memory.axial / (memory.axial - axial)
        memory.crossing_lateral = memory.lateral + share * (lateral - memory.lateral)
    memory.t, memory.axial, memory.lateral = t, axial, lateral
    memory.distance, memory.speed = distance, speed
    memory.outwards = axial * place.axial_rate + lateral * place.lateral_rate
    if not is_approaching(criteria, memory, t, distance, unsure):
        return
    memory.nearest = min(memory.nearest, distance)
    memory.nearest_now = min(memory.nearest_now, distance)
    memory.fastest = max(memory.fastest, speed)
    margin = GUARD * math.sqrt(var_a)
    if memory.state == CaptureState.CAPTURED:
        watch_capture(criteria, memory, t, distance, unsure, axial, margin, outside_time)
    if memory.state > CaptureState.CAPTURED and criteria.flies > 0.0 and axial > 0.0:
        approach_again(criteria, memory, t, distance, unsure)
    if memory.state > CaptureState.CONTACT:
        return

    gap, n_u, n_Y = wall_gap(criteria, axial, lateral)
    gap_unsure = GUARD * math.sqrt(n_u * n_u * var_a + n_Y * n_Y * var_l)
    memory.nearest_gap = min(memory.nearest_gap, gap - gap_unsure)
    if memory.state == CaptureState.APPROACH and gap + gap_unsure < criteria.contact_gap:
        enter(memory, CaptureState.CONTACT, Cause.AT_CONE, t, 0.0)

    passed = memory.has_been_outside != 0 and axial + margin <= 0.0
    if axial - margin > 0.0:
        memory.has_been_outside = 1
    if passed:
        # use the offset at the crossing of BE's plane: the tip may now be far behind the plane
        beside = abs(memory.crossing_lateral)
        if beside < criteria.R_c:
            enter(memory, CaptureState.CAPTURED, Cause.PASSED_THROAT, t, 0.0)
        else:
            enter(memory, CaptureState.MISSED, Cause.PASSED_BESIDE, t, beside)
        return

    # hysteresis: the tip enters or leaves the zone only if the change exceeds the noise
    guard = ZONE_GUARD if math.isnan(memory.zone_since) else -ZONE_GUARD
    if distance + guard * unsure > criteria.radius:
        memory.zone_since = math.nan
    elif math.isnan(memory.zone_since):
        memory.zone_since = t
    if t - memory.zone_since >= criteria.dwell - _TICK:
        enter(memory, CaptureState.CAPTURED, Cause.DWELT, t, 0.0)
        return

    if distance - memory.nearest_now - GUARD * unsure > criteria.leave:
        if memory.state == CaptureState.CONTACT or must_have_hit(criteria, memory, corner_time):
            enter(memory, CaptureState.REBOUND, Cause.RETREATED, t, memory.nearest_now)
        else:
            enter(memory, CaptureState.MISSED, Cause.MOVED_AWAY, t, memory.nearest_now)
        return

    is_outside = distance - ZONE_GUARD * unsure > criteria.radius
    if not is_outside or place.size > 1:
        memory.still_since = math.nan
    else:
        moved = math.hypot(axial - memory.still_axial, lateral - memory.still_lateral)
        if math.isnan(memory.still_since) or moved > criteria.still_speed * criteria.still_time:
            memory.still_since, memory.still_axial, memory.still_lateral = t, axial, lateral
    has_rested = has_rested and is_outside
    if has_rested or t - memory.still_since >= criteria.still_time - _TICK:
        enter(memory, CaptureState.STUCK, Cause.AT_REST, t, distance)


@kernel
def decide_at_end(criteria, memory, corner_time, cut):
    """Evaluate a run that ended without a verdict; for its parameters see :func:`decide`.

    The rules are in docs/detection.md.  ``cut`` is true if the run was ended early; a tip at rest
    or moving out then gives no verdict.
    """
    is_still = memory.speed < criteria.still_speed
    moves_out = memory.outwards > 0.0 and not is_still
    is_outside = memory.distance > criteria.radius
    hit = must_have_hit(criteria, memory, corner_time)
    has_met = memory.state == CaptureState.CONTACT or (
        hit if moves_out else is_still and memory.nearest_gap < criteria.contact_gap
    )
    state = CaptureState.UNDECIDED
    has_dwelt = memory.t - memory.first_t >= criteria.dwell - _TICK
    approached = memory.has_approached != 0
    if not cut and not approached and memory.has_stayed != 0 and has_dwelt:
        state, cause = CaptureState.CAPTURED, Cause.STAYED
    elif not approached:
        cause = Cause.NOT_APPROACHED
    elif not cut and has_met and is_outside and is_still:
        state, cause = CaptureState.STUCK, Cause.END_AT_REST
    elif (
        not cut and has_met and moves_out and memory.distance - memory.nearest_now > criteria.radius
    ):
        state, cause = CaptureState.REBOUND, Cause.END_MOVING_OUT
    elif not cut and not has_met and is_outside and (is_still or moves_out):
        state, cause = CaptureState.MISSED, Cause.END_NOT_APPROACHING
    else:
        cause = Cause.END_AFTER_CONTACT if has_met else Cause.END_BEFORE_CONTACT
    enter(memory, state, cause, memory.t, memory.distance)


_REASONS = {
    Cause.NO_CONTACT: "no contact yet",
    Cause.AT_CONE: "tip at the cone",
    Cause.PASSED_THROAT: "tip passed BE",
    Cause.DWELT: "within {radius:g} mm of BE for {dwell:g} s",
    Cause.RETREATED: "retreated {leave:g} mm from {value:.2f} mm",
    Cause.PASSED_BESIDE: "tip passed BE {value:.2f} mm off the axis",
    Cause.AT_REST: "at rest {value:.2f} mm from BE",
    Cause.MOVED_AWAY: "moved away without contact; closest approach to BE {value:.2f} mm",
    Cause.LEFT_ZONE: "within {radius:g} mm of BE for {dwell:g} s, {outside}: {value:.2f} mm",
    Cause.CAME_OUT: "tip passed BE, {outside}: {value:.2f} mm",
    Cause.END_NOT_APPROACHING: "run ended without contact, tip {value:.2f} mm from BE",
    Cause.END_MOVING_OUT: "run ended with the tip {value:.2f} mm from BE and moving out",
    Cause.END_AT_REST: "run ended with the tip at rest {value:.2f} mm from BE",
    Cause.END_BEFORE_CONTACT: "run ended before any contact, tip {value:.2f} mm from BE",
    Cause.END_AFTER_CONTACT: "run ended after a contact, tip {value:.2f} mm from BE",
    Cause.NOT_APPROACHED: "tip never came {radius:g} mm nearer to BE",
    Cause.NOT_MEASURED: "nothing was measured",
    Cause.CLOCKS_DIFFER: "clocks of the sources differ by {value:.0f} ms",  # value: s
    Cause.CONTACT_UNSEEN: (
        "moved away; closest approach to BE {value:.2f} mm, after a gap in the measurements "
        "in which it may have met the cone"
    ),
    Cause.JUMPED: "the poses of a vehicle jumped by {value:.2f} mm and stayed there",
    Cause.NO_END: "the recording was cut, with the tip {value:.2f} mm from BE",
    Cause.STAYED: "within {radius:g} mm of BE from the first pose to the end",
}


def reason(criteria: Criteria, cause: int, value: float) -> str:
    """Return the description of a cause; ``value`` is the length that it contains, m.

    For :attr:`Cause.CLOCKS_DIFFER`, ``value`` is a time, s.
    """
    return _REASONS[Cause(cause)].format(
        radius=criteria.radius * 1e3,
        dwell=criteria.dwell,
        leave=criteria.leave * 1e3,
        outside=_OUTSIDE_AGAIN,
        value=value * 1e3,
    )
