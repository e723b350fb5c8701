"""Decisions of the capture detector, and the detector for exact measurements.

The criteria (:func:`decide`) are asked one place of the tip after the other.  Where poses and
buffer are known exactly, as in a simulated run, :class:`ExactDetector` asks them in compiled
code, a block of samples at a time; :mod:`capture_sim.detection.noisy` asks the same criteria
about places that it has estimated.
"""

from __future__ import annotations

import math
from enum import IntEnum
from typing import Any, NamedTuple

import numpy as np

from capture_sim.kernels import entry_kernel, kernel, plain, records
from capture_sim.model.equations import tip_in_cone
from capture_sim.model.geometry import nearest_on_wall
from capture_sim.samples import Named
from capture_sim.scene.parts import Scene

#: A decision must hold for the place moved by so many standard deviations,
GUARD = 3.0
#: ... and for the border of the capture zone, where too far out and too far in weigh alike.
ZONE_GUARD = 1.0
# time stamps are decimal fractions: 0.2 s may come out a rounding short
_TICK = 1e-9


class CaptureState(Named):
    """State of the capture, as in msg/CaptureStatus.msg."""

    APPROACH = 0
    CONTACT = 1
    CAPTURED = 2
    REBOUND = 3
    MISSED = 4
    STUCK = 5


_STATES = tuple(CaptureState)


class Cause(IntEnum):
    """Why the state is what it is."""

    NO_CONTACT = 0
    AT_CONE = 1
    PASSED_BE = 2
    DWELT = 3
    RETREATED = 4
    PASSED_BY = 5
    STANDS = 6
    END_WITHOUT_CONTACT = 7
    END_MOVING_OUT = 8
    END_SHORT = 9
    NOT_MEASURED = 10


class CaptureStatus(NamedTuple):
    """The detector's view; fields and units as in msg/CaptureStatus.msg."""

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


class Criteria(NamedTuple):
    """What the decisions depend on, m, s and rad; see the scene's ``detector`` and ``cone``."""

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

    @classmethod
    def of(cls, scene: Scene) -> Criteria:
        """Return those of a scene."""
        limits = scene.detector
        return cls(
            limits.capture_radius,
            limits.min_dwell,
            limits.min_retreat,
            limits.max_contact_gap,
            limits.max_still_speed,
            limits.min_still_time,
            scene.probe.tip_radius,
            scene.rest_length,
            scene.buffer.hinge_offset,
            *scene.cone.wall,
        )


class Place(NamedTuple):
    """Where the tip is at one instant, and how well that is known.

    Attributes
    ----------
    t
        s.
    axial, lateral
        Ahead of BE and off the axis, m.
    axial_rate, lateral_rate
        In the cone's frame, m/s.
    axial_variance, lateral_variance
        m^2; 0 where they are exact.
    size
        Measurements that it was found from.
    """

    t: float
    axial: float
    lateral: float
    axial_rate: float
    lateral_rate: float
    axial_variance: float = 0.0
    lateral_variance: float = 0.0
    size: int = 1


#: What the criteria remember of a run; NaN: not so.
MEMORY = np.dtype(
    [
        ("state", "i8"),
        ("cause", "i8"),
        ("value", "f8"),  # m, named in the reason; 0 where there is none
        ("since", "f8"),  # s, in the state
        ("ahead", "i8"),  # the tip has been ahead of BE
        ("nearest", "f8"),  # m, to BE
        ("nearest_gap", "f8"),  # m, to a wall, less what the noise may hide
        ("fastest", "f8"),  # m/s
        ("zone_since", "f8"),  # s, in the capture zone
        ("still_since", "f8"),  # s, standing outside of it
        ("t", "f8"),  # s, of the last place,
        ("distance", "f8"),  # m, of the tip from BE then,
        ("speed", "f8"),  # m/s, in the cone's frame,
        ("outwards", "f8"),  # m^2/s, distance times its rate
    ]
)

_NUMBERS = (
    *("t", "distance", "axial_offset", "lateral_offset", "relative_attitude", "relative_speed"),
    *("nearest_distance", "time_in_state"),
)
#: One status in numbers.
_ROW = np.dtype(
    [("state", "i8"), ("cause", "i8"), ("value", "f8"), *((name, "f8") for name in _NUMBERS)]
)


def new_memory() -> np.ndarray:
    """Return the memory (1,) at the start of a run."""
    memory = np.zeros(1, MEMORY)
    memory["nearest"] = memory["nearest_gap"] = math.inf
    memory["zone_since"] = memory["still_since"] = math.nan
    return memory


@kernel
def enter(memory, state, cause, t, value):
    """Change the state."""
    memory.state, memory.cause, memory.since, memory.value = state, cause, t, value


@kernel
def wall_gap(criteria, axial, lateral):
    """Return the tip's gap to the nearer wall, m, and that wall's normal."""
    c = criteria
    plus = nearest_on_wall(axial, lateral, c.R_c, c.L_c, c.cos_b, c.sin_b)
    minus = nearest_on_wall(axial, -lateral, c.R_c, c.L_c, c.cos_b, c.sin_b)
    distance, n_u, n_Y = plus if plus[0] <= minus[0] else minus
    return distance - c.tip_radius, n_u, n_Y


@kernel
def feel_push(criteria, memory, t, axial, lateral):
    """Note that the buffer is pushed: at the cone that is a contact, far off the launch's jerk."""
    near = wall_gap(criteria, axial, lateral)[0] < criteria.tip_radius
    if memory.state == CaptureState.APPROACH and near:
        enter(memory, CaptureState.CONTACT, Cause.AT_CONE, t, 0.0)


@kernel
def hit_unseen(criteria, memory, rounding):
    """Whether a tip that has turned round was so near a wall that it must have hit it.

    Vehicles that coast do not turn round by themselves.  ``rounding`` (s): what smoothing
    takes off the corner that a hit makes in the path, per m/s.
    """
    return memory.nearest_gap < criteria.contact_gap + memory.fastest * rounding


@kernel
def decide(criteria, memory, place, stood, rounding):
    """Ask the criteria about one place of the tip, later than the one before.

    ``stood``: whether the tip has stood for long enough, where its speed is no matter of one
    place (``place.size > 1``).  ``rounding``: see :func:`hit_unseen`.
    """
    t, axial, lateral = place.t, place.axial, place.lateral
    var_a, var_l = place.axial_variance, place.lateral_variance
    square = axial * axial + lateral * lateral
    distance, unsure = math.sqrt(square), 0.0
    if var_a > 0.0 or var_l > 0.0:
        # without what noise adds to a length on average
        distance = math.sqrt(max(square - var_a - var_l, 0.0))
        if square > 0.0:
            unsure = axial * axial * var_a + lateral * lateral * var_l
            unsure = math.sqrt(unsure / square)
        else:
            unsure = math.sqrt(max(var_a, var_l))
    speed = math.hypot(place.axial_rate, place.lateral_rate)
    memory.t, memory.distance, memory.speed = t, distance, speed
    memory.outwards = axial * place.axial_rate + lateral * place.lateral_rate
    memory.nearest = min(memory.nearest, distance)
    memory.fastest = max(memory.fastest, speed)
    if memory.state > CaptureState.CONTACT:
        return

    gap, n_u, n_Y = wall_gap(criteria, axial, lateral)
    gap_unsure = GUARD * math.sqrt(n_u * n_u * var_a + n_Y * n_Y * var_l)
    memory.nearest_gap = min(memory.nearest_gap, gap - gap_unsure)
    if memory.state == CaptureState.APPROACH and gap + gap_unsure < criteria.contact_gap:
        enter(memory, CaptureState.CONTACT, Cause.AT_CONE, t, 0.0)

    margin = GUARD * math.sqrt(var_a)
    passed = memory.ahead != 0 and axial + margin <= 0.0
    if axial - margin > 0.0:
        memory.ahead = 1
    if passed and abs(lateral) < criteria.R_c:
        enter(memory, CaptureState.CAPTURED, Cause.PASSED_BE, t, 0.0)
        return

    # who is in is out only when that is sure, and the other way round
    guard = ZONE_GUARD if math.isnan(memory.zone_since) else -ZONE_GUARD
    if distance + guard * unsure > criteria.radius:
        memory.zone_since = math.nan
    elif math.isnan(memory.zone_since):
        memory.zone_since = t
    if t - memory.zone_since >= criteria.dwell - _TICK:
        enter(memory, CaptureState.CAPTURED, Cause.DWELT, t, 0.0)
        return

    retreat = distance - memory.nearest - GUARD * unsure
    if passed or retreat > criteria.leave:
        met = memory.state == CaptureState.CONTACT or hit_unseen(criteria, memory, rounding)
        if met and not passed:
            enter(memory, CaptureState.REBOUND, Cause.RETREATED, t, memory.nearest)
        else:
            enter(memory, CaptureState.MISSED, Cause.PASSED_BY, t, 0.0)
        return

    outside = distance - ZONE_GUARD * unsure > criteria.radius
    if not (outside and place.size == 1 and speed < criteria.still_speed):
        memory.still_since = math.nan
    elif math.isnan(memory.still_since):
        memory.still_since = t
    stood = stood and outside
    if stood or t - memory.still_since >= criteria.still_time - _TICK:
        enter(memory, CaptureState.STUCK, Cause.STANDS, t, distance)


@entry_kernel
def follow(criteria, memories, samples, y, rows, to_verdict):
    """Ask the criteria about samples, one after the other.

    Fills ``rows`` of dtype _ROW with the statuses, the last one with those that find no room.
    ``y`` (16,) is room for a state.  Returns how many samples were used: all, or those up to
    the one that brings the verdict.
    """
    memory, c = memories[0], criteria
    for k in range(samples.size):
        sample = samples[k]
        t, axial, lateral = sample.t, sample.tip_axial, sample.tip_lateral
        for i in range(8):
            y[i] = sample.q[i]
            y[8 + i] = sample.v[i]
        _, _, wx, wy = tip_in_cone(y, c)
        if max(abs(sample.axial_stroke), abs(sample.torsion) * c.rest_length) > c.contact_gap:
            feel_push(c, memory, t, axial, lateral)
        place = Place(t, axial, lateral, -wx, wy, 0.0, 0.0, 1)
        decide(c, memory, place, False, 0.0)
        row = rows[min(k, rows.size - 1)]
        row.state, row.cause, row.value = memory.state, memory.cause, memory.value
        row.t = t
        row.distance = sample.tip_distance
        row.axial_offset = axial
        row.lateral_offset = lateral
        row.relative_attitude = y[2] - y[7]
        row.relative_speed = memory.speed
        row.nearest_distance = memory.nearest
        row.time_in_state = t - memory.since
        if to_verdict and memory.state > CaptureState.CONTACT:
            return k + 1
    return samples.size


_hit_unseen, _enter = plain(hit_unseen), plain(enter)


def decide_at_end(criteria: Criteria, memory: Any, rounding: float) -> None:
    """Give the verdict of a run that ended with its last place, see :func:`decide`."""
    still, outwards = memory.speed < criteria.still_speed, memory.outwards > 0.0
    at_wall = memory.nearest_gap < criteria.contact_gap
    unseen = _hit_unseen(criteria, memory, rounding)
    met = memory.state == CaptureState.CONTACT or (still and at_wall) or (outwards and unseen)
    if not met:
        state, cause = CaptureState.MISSED, Cause.END_WITHOUT_CONTACT
    elif outwards and not still:
        state, cause = CaptureState.REBOUND, Cause.END_MOVING_OUT
    else:
        state, cause = CaptureState.STUCK, Cause.END_SHORT
    _enter(memory, state, cause, memory.t, memory.distance)


_REASONS = {
    Cause.NO_CONTACT: "no contact yet",
    Cause.AT_CONE: "tip at the cone",
    Cause.PASSED_BE: "tip passed BE",
    Cause.DWELT: "within {radius:g} mm of BE for {dwell:g} s",
    Cause.RETREATED: "retreated {leave:g} mm from {value:.2f} mm",
    Cause.PASSED_BY: "tip passed the cone by",
    Cause.STANDS: "stands {value:.2f} mm short of BE",
    Cause.END_WITHOUT_CONTACT: "no contact before the run ended",
    Cause.END_MOVING_OUT: "run ended with the tip {value:.2f} mm from BE and moving out",
    Cause.END_SHORT: "run ended with the tip {value:.2f} mm short of BE",
    Cause.NOT_MEASURED: "nothing was measured",
}


def reason(criteria: Criteria, cause: int, value: float) -> str:
    """Return the cause in words; ``value`` is the length that it names, m."""
    return _REASONS[Cause(cause)].format(
        radius=criteria.radius * 1e3,
        dwell=criteria.dwell,
        leave=criteria.leave * 1e3,
        value=value * 1e3,
    )


class ExactDetector:
    """Follows one run, known exactly, from the approach to a verdict.

    The tip is *captured* when its centre stays within ``detector.capture_radius`` of the centre of
    BE for ``detector.min_dwell``, or passes BE inside the throat; it has *rebounded* when it
    has been in contact and then retreats by ``detector.min_retreat`` from its nearest approach;
    *missed* when it does so without contact or passes BE outside the throat; it is *stuck*
    when it stands still for ``detector.min_still_time`` outside the radius.

    Parameters
    ----------
    scene
        Geometry of buffer and cone, and the ``detector`` part.

    Examples
    --------
    >>> from capture_sim import Bench, load_scene
    >>> bench = Bench(load_scene("paper_designed"))
    >>> detector = ExactDetector(bench.scene)
    >>> statuses = detector.update(bench.advance(bench.times(0, 100))[::10])
    >>> statuses[0].state.label
    'contact'
    """

    def __init__(self, scene: Scene) -> None:
        self._criteria = Criteria.of(scene)
        self._memory = new_memory()
        self._y = np.zeros(16)
        self._row = np.zeros(1, _ROW)  # the last status
        for name in _NUMBERS[1:6]:
            self._row[name] = math.nan
        self._row["nearest_distance"] = math.inf
        self._text = ((-1, 0.0), "")  # the last reason

    @property
    def state(self) -> CaptureState:
        """After the samples so far."""
        return CaptureState(int(self._memory["state"][0]))

    @property
    def final(self) -> bool:
        """Whether there is a verdict."""
        return self.state > CaptureState.CONTACT

    def update(self, samples: np.ndarray) -> list[CaptureStatus]:
        """Return the status at each of the next samples, (n,) of dtype SAMPLE."""
        rows = np.zeros(samples.size, _ROW)
        self._follow(samples, rows, to_verdict=False)
        return [self._status(row) for row in rows.tolist()]

    def until_verdict(self, samples: np.ndarray) -> int:
        """Take the next samples, (n,) of dtype SAMPLE, up to the one that brings the verdict.

        Returns
        -------
        int
            How many were taken: all of them unless :attr:`final`.
        """
        return self._follow(samples, self._row, to_verdict=True)

    def _follow(self, samples: np.ndarray, rows: np.ndarray, *, to_verdict: bool) -> int:
        if not samples.size:
            return 0
        memory, read = records(self._memory), records(np.ascontiguousarray(samples))
        used: int = follow(self._criteria, memory, read, self._y, records(rows), to_verdict)
        self._row = rows[-1:]
        return used

    def finish(self, *, cut: bool = False) -> CaptureStatus:
        """Close the run: a verdict is given even if none was reached.

        The status is that of the last sample.

        Parameters
        ----------
        cut
            The run was ended before its end: what was not decided by then stays so.
        """
        memory, row = self._memory.view(np.recarray)[0], self._row[0]
        if math.isnan(row["distance"]):
            if not cut:
                memory.state, memory.cause = CaptureState.MISSED, Cause.NOT_MEASURED
        elif not (self.final or cut):
            decide_at_end(self._criteria, memory, 0.0)
        for name in ("state", "cause", "value"):
            row[name] = memory[name]
        row["time_in_state"] = row["t"] - memory.since
        return self._status(row.tolist())

    def _status(self, row: Any) -> CaptureStatus:
        state, cause, value, t, *numbers = row
        if self._text[0] != (cause, value):
            self._text = (cause, value), reason(self._criteria, cause, value)
        final = state > CaptureState.CONTACT
        return CaptureStatus._make((t, _STATES[state], final, *numbers, self._text[1]))
