"""Peak loads of a run, before and after the latch closes."""

from __future__ import annotations

import copy
import functools
import json
import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from capture_sim.base.compiled.kernels import plain
from capture_sim.detection.criteria import Criteria
from capture_sim.dynamics.model.equations import stop_force, tip_in_cone
from capture_sim.dynamics.model.parameters import pack
from capture_sim.dynamics.samples import EXTREMES, Event, EventKind, Extremes
from capture_sim.run.bounds import UNKNOWN, Bounds
from capture_sim.run.first_contact import first_cluster
from capture_sim.run.series import Series
from capture_sim.scene.parts import Scene


class Load(NamedTuple):
    """Definition of a reported load: its key in results, its units, and its fields of EXTREMES."""

    key: str
    meaning: str
    unit: str  # SI
    shown_in: str  # unit in tables
    factor: float  # from unit to shown_in
    extremes: tuple[str, ...]  # fields of EXTREMES; the load is the peak over all of them
    least: bool = False  # True: the load is the minimum, not the maximum
    is_measured: bool = False  # True: a rig has a sensor of it, so that its bounds are known


#: Reported loads of a run; :func:`loads_of` returns up to four keys for each.
LOADS = (
    Load(
        "max_axial_stroke_in",
        "stroke inwards",
        *("m", "mm", 1e3),
        ("axial_stroke_in",),
        is_measured=True,
    ),
    Load(
        "max_axial_stroke_out",
        "stroke outwards",
        *("m", "mm", 1e3),
        ("axial_stroke_out",),
        is_measured=True,
    ),
    Load("max_torsion", "torsion", "rad", "mrad", 1e3, ("torsion",), is_measured=True),
    Load("max_buffer_force", "force of the buffer", "N", "N", 1.0, ("buffer_force",)),
    Load("max_buffer_torque", "torque of the buffer", "N m", "N m", 1.0, ("buffer_torque",)),
    Load(
        "max_normal_force",
        "peak normal force",
        *("N", "N", 1.0),
        ("normal_force_plus_y", "normal_force_minus_y"),
        is_measured=True,
    ),
    Load(
        "max_normal_force_plus_y",
        "peak normal force, +y wall",
        "N",
        "N",
        1.0,
        ("normal_force_plus_y",),
    ),
    Load(
        "max_normal_force_minus_y",
        "peak normal force, -y wall",
        "N",
        "N",
        1.0,
        ("normal_force_minus_y",),
    ),
    Load("max_latch_force", "force of the latch", "N", "N", 1.0, ("latch_force",)),
    Load("max_penetration", "penetration", "m", "um", 1e6, ("penetration",)),
    Load(
        "nearest_distance", "closest approach to BE", "m", "mm", 1e3, ("tip_distance",), least=True
    ),
)


#: A load in m or rad below this value is round-off and counts as 0.
_ROUND_OFF = 1e-15


def loads_of(extremes: Extremes, touches: np.ndarray) -> dict[str, Any]:
    """Return the loads of a run by key, SI units.

    Every load of :data:`LOADS` except the force of the latch has four keys.  For example,
    ``max_torsion`` is the peak over the whole run, and ``max_torsion_before_latch`` the peak until
    the latch closes (over the whole run if it never does).  Their times are ``max_torsion_time``
    and ``max_torsion_before_latch_time``, s since the release.  The force of the latch has only the
    two keys for the whole run.  A load that never occurs is 0, with time None.  A load that was not
    measured is None.

    Two further keys are ``touches``, the number of touches, and ``first_contact_impulse``, N s,
    None if it was not measured.  The argument ``touches`` is (n,) of dtype TOUCH.
    """
    # as tuples, because access to the fields of a record is slow
    rows: list[Any] = [row.item() for row in extremes if row is not None]
    loads: dict[str, Any] = {}
    for load, keys, columns in _columns_of_loads():
        before = _peak(load, columns, rows[:1])
        whole = before if len(rows) == 1 else _peak(load, columns, rows)
        loads[keys[0]], loads[keys[1]] = whole
        loads[keys[2]], loads[keys[3]] = before
    del loads["max_latch_force_before_latch"], loads["max_latch_force_before_latch_time"]
    loads["touches"] = int(touches.size)
    loads["first_contact_impulse"] = if_measured(first_cluster(touches)["impulse"].sum())
    return loads


def bounds_of_loads(
    loads: Mapping[str, Any], bounds: Mapping[str, Bounds] | None
) -> dict[str, float | None]:
    """Return the keys of a summary for the bounds of loads; None where a bound is not known.

    ``bounds`` are those of a measured run by the key of the load, see :func:`peak_bounds`; None for
    loads that are exact, which are their own bounds.
    """
    found: dict[str, float | None] = {}
    for key in (load.key for load in LOADS if load.is_measured):
        if bounds is None:
            low = high = loads[key]
        else:
            low, high = map(if_measured, bounds.get(key, UNKNOWN)[:2])
        found[f"{key}_low"], found[f"{key}_high"] = low, high
    return found


#: Key of the standard error of the closest approach in results.
NEAREST_ERROR = "nearest_distance_error"


def with_closest(loads: dict[str, Any], distance: float, deviation: float) -> dict[str, Any]:
    """Return a copy of ``loads`` in which an estimate replaces the closest approach.

    ``distance`` is the estimate, m, and ``deviation`` its standard error, m, which is added under
    the key :data:`NEAREST_ERROR`.  Both are stored as None if one of them is not finite, because
    noise then hides the closest approach.  Its times are None, as an estimate has no time.
    """
    known = math.isfinite(distance) and math.isfinite(deviation)
    found = {**loads, NEAREST_ERROR: deviation if known else None}
    for key in ("nearest_distance", "nearest_distance_before_latch"):
        found[key], found[f"{key}_time"] = distance if known else None, None
    return found


@functools.cache
def _columns_of_loads() -> list[tuple[Load, list[str], list[tuple[int, int]]]]:
    """Return each load with its four keys and the column numbers of its fields in EXTREMES.

    There is a pair of numbers for each field: the column of the value and the column of its time.
    """
    names = EXTREMES.names or ()
    ends = ("", "_time", "_before_latch", "_before_latch_time")
    return [
        (
            load,
            [f"{load.key}{end}" for end in ends],
            [(names.index(name), names.index(f"{name}_time")) for name in load.extremes],
        )
        for load in LOADS
    ]


def _peak(
    load: Load, columns: Sequence[tuple[int, int]], rows: Sequence[tuple[float, ...]]
) -> tuple[float | None, float | None]:
    """Return the peak of a load over rows of EXTREMES and the peak's time, s.

    The minimum counts if ``load.least`` is set.  The peak is None if all values are NaN.  The time
    is None without a peak, and for a maximum of 0.
    """
    value = t = None
    for row in rows:
        for column, time_column in columns:
            number = row[column]
            is_peak = value is None or (number < value if load.least else number > value)
            if is_peak and math.isfinite(number):
                value, t = number, row[time_column]
    if value is not None and value < _ROUND_OFF and load.unit in ("m", "rad"):
        value = 0.0
    return value, t if value or load.least else None


#: Share of the cylinder's free length behind the probe beyond which a stroke inwards is
#: implausible, because a real spring or damper needs the rest of the length.
_USABLE_SHARE = 0.5


def plausible_stroke(scene: Scene) -> float:
    """Return the largest plausible stroke inwards, m.

    It is half of the cylinder's free length behind the probe at rest.  With stops, which limit the
    stroke themselves, it is infinite.
    """
    if scene.stops is not None:
        return math.inf
    behind_hinge = scene.probe.length + scene.probe.tip_radius - scene.rest_length
    return _USABLE_SHARE * max(scene.cylinder.length - behind_hinge, 0.0)


def implausible_stroke(scene: Scene, stroke: float | None) -> str:
    """Return a warning if a stroke inwards (m) exceeds :func:`plausible_stroke`, else ''."""
    if not stroke or stroke <= plausible_stroke(scene):
        return ""
    return (
        f"stroke inwards {stroke * 1e3:.4g} mm is more than half of the cylinder's room, and "
        "nothing ends it: set stops.compression, or a stiffer buffer"
    )


def sampled_extremes(
    scene: Scene,
    samples: np.ndarray,
    touches: np.ndarray,
    events: Iterable[Event],
    buffer: Mapping[str, Series] | None = None,
) -> Extremes:
    """Return the extremes of a run from its samples, touches and events.

    This is for runs without extremes from the integrator.  Peak forces of touches come from
    ``touches``.  The latch's force at its closing is computed from the state of the LATCHED event.
    Peaks of the quantities in ``buffer`` (``stroke``, ``torsion``) come from these series, all
    others from the samples, so peaks between two samples are missed.  A quantity that was not
    measured is NaN.
    """
    latched = next((event for event in events if event.kind is EventKind.LATCHED), None)
    latch_time = math.inf if latched is None else latched.t
    parts = [samples[samples["t"] < latch_time], samples[samples["t"] >= latch_time]]
    is_before = touches["start"] < latch_time
    touches_of_part = touches[is_before], touches[~is_before]
    extremes = np.zeros(2, EXTREMES)
    begin, end = samples["t"][[0, -1]] if samples.size else (0.0, 0.0)

    def signal(name: str, field: str, part: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        if buffer is None:
            return part["t"], part[field]
        t, values, _ = buffer[name]
        in_part = (t < latch_time) == (part is parts[0])
        kept = (t >= begin) & (t <= end) & in_part
        return t[kept], values[kept]

    for row, part, part_touches in zip(extremes, parts, touches_of_part, strict=True):
        stroke = signal("stroke", "axial_stroke", part)
        torsion = signal("torsion", "torsion", part)
        # a latched tip does not press on the walls
        penetration = np.where(part["normal_force"] > 0.0, part["penetration"], 0.0)
        series = [
            ("axial_stroke_in", stroke[0], np.maximum(-stroke[1], 0.0)),
            ("axial_stroke_out", stroke[0], np.maximum(stroke[1], 0.0)),
            ("torsion", torsion[0], np.abs(torsion[1])),
            ("buffer_force", part["t"], np.abs(part["axial_force"] + _stop_force(scene, part))),
            ("buffer_torque", part["t"], np.abs(part["torsion_torque"])),
            ("latch_force", part["t"], np.linalg.norm(part["latch_force"], axis=1)),
            ("penetration", part["t"], penetration.max(axis=1, initial=0.0)),
            ("tip_distance", part["t"], -part["tip_distance"]),
        ]
        for column, (wall, side) in enumerate((("plus_y", 1), ("minus_y", -1))):
            # wall 0: a measured touch of an unknown wall
            at_wall = part_touches[np.isin(part_touches["wall"], (side, 0))]
            times = np.concatenate([part["t"], at_wall["peak_time"]])
            force = np.concatenate([part["normal_force"][:, column], at_wall["peak_force"]])
            series.append((f"normal_force_{wall}", times, force))
        for name, times, values in series:
            known = np.flatnonzero(np.isfinite(values))
            row[name] = math.nan
            if known.size:
                largest = known[values[known].argmax()]
                row[name], row[f"{name}_time"] = values[largest], times[largest]
        row["tip_distance"] *= -1.0
    after = extremes[1]
    if latched is not None and scene.latch is not None:
        # as the latch closes, its spring is relaxed; its damper acts on the full speed of the tip
        state = (*latched.q.tolist(), *latched.v.tolist())
        _, _, wx, wy = plain(tip_in_cone)(state, Criteria.of(scene))
        at_closing = scene.latch.damping * math.hypot(wx, wy)
        if at_closing > after["latch_force"]:
            after["latch_force"], after["latch_force_time"] = at_closing, latch_time
    return Extremes(extremes[0], extremes[1] if parts[1].size else None)


def _stop_force(scene: Scene, samples: np.ndarray) -> np.ndarray:
    """Return the force of the stroke stops on the probe in samples, (n,), N; 0 without stops."""
    stroke, rate = samples["axial_stroke"], samples["v"][:, 4]
    force = np.zeros(samples.size)
    if scene.stops is None:
        return force
    parameters = pack(scene, 0.0, 0.0).view(np.recarray)[0]
    for side, end in ((-1, parameters.stop_compressed), (1, parameters.stop_extended)):
        for i in np.flatnonzero(side * (stroke - end) > 0.0):
            force[i], _ = plain(stop_force)(stroke[i], rate[i], side, parameters)
    return force


#: Fields of extremes in the order in which the first versions recorded them, as lists.
_FIRST_EXTREMES = tuple(
    f"{name}{end}"
    for name in (
        "axial_stroke_in",
        "axial_stroke_out",
        "torsion",
        "tip_distance",
        "penetration",
        "peak_force",  # of either wall; not read, because the touches have it with its wall
    )
    for end in ("", "_time")
)


def with_forces_of_touches(
    extremes: Extremes, touches: np.ndarray, events: Iterable[Event]
) -> Extremes:
    """Return extremes in which unknown normal forces are replaced by the peaks of the touches.

    Old recordings lack the extremes of the normal force of each wall, which are then NaN.  They
    become 0 if no touch has that wall.
    """
    latched = min((e.t for e in events if e.kind is EventKind.LATCHED), default=math.inf)
    before, after = extremes.before_latch.copy(), copy.copy(extremes.after_latch)
    is_before = touches["start"] < latched
    for row, of_part in zip(
        (before, after), (touches[is_before], touches[~is_before]), strict=True
    ):
        for wall, side in (("plus_y", 1), ("minus_y", -1)):
            name = f"normal_force_{wall}"
            if row is None or not math.isnan(row[name]):
                continue
            row[name] = 0.0
            at_wall = of_part[of_part["wall"] == side]
            if at_wall.size:
                largest = at_wall[at_wall["peak_force"].argmax()]
                row[name], row[f"{name}_time"] = largest["peak_force"], largest["peak_time"]
    return Extremes(before, after)


def extremes_to_text(extremes: Extremes) -> str:
    """Return extremes as one line of JSON, without loss of accuracy."""
    names = EXTREMES.names or ()
    named = [None if row is None else dict(zip(names, row.item(), strict=True)) for row in extremes]
    return json.dumps(dict(zip(Extremes._fields, named, strict=True)))


def extremes_from_text(text: str) -> Extremes:
    """Return the extremes from a text of :func:`extremes_to_text`; ValueError if it is invalid.

    A field that the text does not contain, because another version wrote it, becomes NaN.
    """
    extremes = np.full(2, math.nan, EXTREMES)
    try:
        before, after = (json.loads(text)[name] for name in Extremes._fields)
        for row, values in zip(extremes, (before, after), strict=True):
            if isinstance(values, list):  # written by one of the first versions
                values = dict(zip(_FIRST_EXTREMES, values, strict=True))
            if values is not None:
                for name in (name for name in EXTREMES.names or () if name in values):
                    row[name] = values[name]
        if before is None:
            raise ValueError("no extremes before the latch")
    except (TypeError, KeyError, IndexError, RecursionError) as error:
        raise ValueError(str(error)) from None
    return Extremes(extremes[0], None if after is None else extremes[1])


def if_measured(value: float) -> float | None:
    """Return a number as a float; None if it is not finite, because JSON has no NaN."""
    return float(value) if math.isfinite(value) else None
