"""Loads and main results of a run, and tables of several runs."""

from __future__ import annotations

import copy
import functools
import json
import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from capture_sim.base.compiled.kernels import plain
from capture_sim.detection.criteria import CaptureStatus, Criteria
from capture_sim.dynamics.model.equations import tip_in_cone
from capture_sim.dynamics.samples import EXTREMES, TOUCH, Event, EventKind, Extremes
from capture_sim.run.series import at_rate
from capture_sim.scene.parts import Scene


def first_cluster(touches: np.ndarray) -> np.ndarray:
    """Return the touches of the first contact, (m,) of dtype TOUCH, of a run's touches (n,).

    A light tip chatters on the wall before it slides.  The first contact is with the wall touched
    first.  It ends when the tip touches the other wall, or when a pause is longer than the chatter
    before it (from the start of the first touch to the start of the last).  After a single touch
    there is no chatter yet: the pause belongs to the contact if it is shorter than the contact
    that follows.
    """
    ordered = touches[np.argsort(touches["start"], kind="stable")]
    # as plain numbers: NumPy is slow with single ones
    start, end, wall = (ordered[name].tolist() for name in ("start", "end", "wall"))
    count = _count_chatter(start, end, wall)
    return ordered[: _count_first_contact(start, end, count)]


def first_contact_end(events: Iterable[Event], now: float) -> float | None:
    """Return the end of the first contact, s; None if it has not ended at time ``now``, s."""
    starts = [event for event in events if event.kind is EventKind.TOUCH]
    start = [event.t for event in starts]
    end = [math.inf] * len(start)
    for touch in (event.touch for event in events if event.touch is not None):
        end = [touch["end"] if t == touch["start"] else e for t, e in zip(start, end, strict=True)]
    count = _count_chatter(start, end, [event.wall for event in starts])
    if count == 0:
        return None
    may_continue = count < 2 or now - end[count - 1] <= start[count - 1] - start[0]
    if may_continue and count == len(start):
        return None
    contact_end = float(end[_count_first_contact(start, end, count) - 1])
    return contact_end if math.isfinite(contact_end) else None


def _count_chatter(start: Sequence[float], end: Sequence[float], wall: Sequence[int]) -> int:
    """Return the number of touches from the first to the end of its chatter, by their starts."""
    size = next((k for k, side in enumerate(wall) if side != wall[0]), len(start))
    for count in range(2, size):
        if start[count] - end[count - 1] > start[count - 1] - start[0]:
            return count
    return size


def _count_first_contact(start: Sequence[float], end: Sequence[float], count: int) -> int:
    """Return how many of the first ``count`` touches are the first contact: one, or all."""
    is_single = count > 1 and start[1] - end[0] > end[count - 1] - start[1]
    return 1 if is_single else count


def impact_speed(events: Iterable[Event]) -> float | None:
    """Return the speed of the chaser relative to the target at the first touch, m/s.

    None without a touch, NaN if it was not measured.
    """
    touch = first_touch(events)
    if touch is None:
        return None
    return math.hypot(touch.v[0] - touch.v[5], touch.v[1] - touch.v[6])


def first_touch(events: Iterable[Event]) -> Event | None:
    """Return the event of the first touch; None without one."""
    return next((event for event in events if event.kind is EventKind.TOUCH), None)


class Load(NamedTuple):
    """A load of a run: its key in results, its fields of EXTREMES, and its unit in tables."""

    key: str
    meaning: str
    unit: str  # SI
    shown_in: str  # unit in tables
    factor: float  # from unit to shown_in
    extremes: tuple[str, ...]
    least: bool = False  # True: minimum, not maximum


#: Reported extremes of a run; :func:`loads_of` returns four keys for each.
LOADS = (
    Load("max_axial_stroke_in", "stroke inwards", "m", "mm", 1e3, ("axial_stroke_in",)),
    Load("max_axial_stroke_out", "stroke outwards", "m", "mm", 1e3, ("axial_stroke_out",)),
    Load("max_torsion", "torsion", "rad", "mrad", 1e3, ("torsion",)),
    Load("max_buffer_force", "force of the buffer", "N", "N", 1.0, ("buffer_force",)),
    Load("max_buffer_torque", "torque of the buffer", "N m", "N m", 1.0, ("buffer_torque",)),
    Load(
        "max_normal_force",
        "peak normal force",
        *("N", "N", 1.0),
        ("normal_force_plus_y", "normal_force_minus_y"),
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


#: A stroke or an angle below this is round-off, m and rad.
_ROUND_OFF = 1e-15


def loads_of(extremes: Extremes, touches: np.ndarray) -> dict[str, Any]:
    """Return the loads of a run by name, SI units.

    Every load of :data:`LOADS` has four keys: ``max_torsion`` over the whole run, latch included,
    ``max_torsion_before_latch`` until the latch closes (the whole run if it never does), and their
    times ``max_torsion_time`` and ``max_torsion_before_latch_time``, s since the release.  A load
    that never occurs is 0, with time None; a load that was not measured is None.  Two further keys
    are ``touches``, their number, and ``first_contact_impulse``, N s.  ``touches`` are (n,) of
    dtype TOUCH.
    """
    # as plain numbers: access to the fields of a record is slow
    rows: list[Any] = [row.item() for row in extremes if row is not None]
    loads: dict[str, Any] = {}
    for load, keys, columns in _columns_of_loads():
        before = _peak(load, columns, rows[:1])
        whole = before if len(rows) == 1 else _peak(load, columns, rows)
        loads[keys[0]], loads[keys[1]] = whole
        loads[keys[2]], loads[keys[3]] = before
    del loads["max_latch_force_before_latch"], loads["max_latch_force_before_latch_time"]
    loads["touches"] = int(touches.size)
    loads["first_contact_impulse"] = _if_measured(first_cluster(touches)["impulse"].sum())
    return loads


@functools.cache
def _columns_of_loads() -> list[tuple[Load, list[str], list[tuple[int, int]]]]:
    """Return each load, its keys, and the positions of its extremes in EXTREMES and their times."""
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
    """Return a load in some rows of extremes, and its time."""
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


#: Share of the cylinder behind the probe beyond which a stroke inwards is implausible: a real
#: spring or damper needs the rest.
_USABLE_SHARE = 0.5


def plausible_stroke(scene: Scene) -> float:
    """Return the stroke inwards that the cylinder plausibly has room for, m.

    It is half of the room behind the probe at rest; infinite with stops, which end the stroke.
    """
    if scene.stops is not None:
        return math.inf
    behind_hinge = scene.probe.length + scene.probe.tip_radius - scene.rest_length
    return _USABLE_SHARE * max(scene.cylinder.length - behind_hinge, 0.0)


def implausible_stroke(scene: Scene, stroke: float | None) -> str:
    """Return a warning on a stroke inwards (m) that the cylinder has no room for; else empty."""
    if not stroke or stroke <= plausible_stroke(scene):
        return ""
    return (
        f"stroke inwards {stroke * 1e3:.4g} mm is more than half of the cylinder's room, and "
        "nothing ends it: set stops.compression, or a stiffer buffer"
    )


def sampled_extremes(
    scene: Scene, samples: np.ndarray, touches: np.ndarray, events: Iterable[Event]
) -> Extremes:
    """Return the extremes of a run from its samples, touches and events only.

    The peaks of touches come from ``touches``, the force of the latch as it closes from its event.
    Strokes, torsion, penetration and the buffer's force come from the samples, so peaks between two
    samples are missed.  A quantity that was not measured is NaN.
    """
    latched = next((event for event in events if event.kind is EventKind.LATCHED), None)
    latch_time = math.inf if latched is None else latched.t
    parts = [samples[samples["t"] < latch_time], samples[samples["t"] >= latch_time]]
    is_before = touches["start"] < latch_time
    touches_of_part = touches[is_before], touches[~is_before]
    extremes = np.zeros(2, EXTREMES)
    for row, part, part_touches in zip(extremes, parts, touches_of_part, strict=True):
        # a latched tip does not press on the walls
        penetration = np.where(part["normal_force"] > 0.0, part["penetration"], 0.0)
        series = [
            ("axial_stroke_in", part["t"], np.maximum(-part["axial_stroke"], 0.0)),
            ("axial_stroke_out", part["t"], np.maximum(part["axial_stroke"], 0.0)),
            ("torsion", part["t"], np.abs(part["torsion"])),
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
        # the spring is relaxed then; the damper acts on the full speed of the tip
        state = (*latched.q.tolist(), *latched.v.tolist())
        _, _, wx, wy = plain(tip_in_cone)(state, Criteria.of(scene))
        at_closing = scene.latch.damping * math.hypot(wx, wy)
        if at_closing > after["latch_force"]:
            after["latch_force"], after["latch_force_time"] = at_closing, latch_time
    return Extremes(extremes[0], extremes[1] if parts[1].size else None)


def _stop_force(scene: Scene, samples: np.ndarray) -> np.ndarray:
    """Return the force of the stroke stops on the probe in samples, (n,), N."""
    stops, stroke = scene.stops, samples["axial_stroke"]
    force = np.zeros(samples.size)
    if stops is None:
        return force
    for side, end in ((-1.0, -stops.compression), (1.0, stops.extension)):
        if end is None:
            continue
        beyond = side * (stroke - end)
        push = stops.stiffness * beyond + side * stops.damping * samples["v"][:, 4]
        force -= np.where(beyond > 0.0, side * np.maximum(push, 0.0), 0.0)
    return force


#: The numbers of a part, in the recordings of the first commits.
_FIRST_EXTREMES = tuple(
    f"{name}{end}"
    for name in (
        "axial_stroke_in",
        "axial_stroke_out",
        "torsion",
        "tip_distance",
        "penetration",
        "peak_force",  # of either wall: in the touches as well, with the wall
    )
    for end in ("", "_time")
)


def with_forces_of_touches(
    extremes: Extremes, touches: np.ndarray, events: Iterable[Event]
) -> Extremes:
    """Return extremes of a run with the walls' forces, where they lack them, from its touches."""
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
    """Return extremes as a line of JSON, exactly."""
    names = EXTREMES.names or ()
    named = [None if row is None else dict(zip(names, row.item(), strict=True)) for row in extremes]
    return json.dumps(dict(zip(Extremes._fields, named, strict=True)))


def extremes_from_text(text: str) -> Extremes:
    """Return the extremes in a text of :func:`extremes_to_text`; ValueError if it is invalid.

    What a text of another version lacks is NaN: not recorded.
    """
    extremes = np.full(2, math.nan, EXTREMES)
    try:
        before, after = (json.loads(text)[name] for name in Extremes._fields)
        for row, values in zip(extremes, (before, after), strict=True):
            if isinstance(values, list):  # of a list each place had a meaning
                values = dict(zip(_FIRST_EXTREMES, values, strict=True))
            if values is not None:
                for name in (name for name in EXTREMES.names or () if name in values):
                    row[name] = values[name]
        if before is None:
            raise ValueError("no extremes before the latch")
    except (TypeError, KeyError, IndexError, RecursionError) as error:
        raise ValueError(str(error)) from None
    return Extremes(extremes[0], None if after is None else extremes[1])


def summarize(
    name: str,
    scene: Scene,
    samples: np.ndarray,
    touches: np.ndarray,
    events: Sequence[Event],
    status: CaptureStatus | None,
    wall_time: float | None,
    extremes: Extremes | None = None,
    problems: Sequence[str] = (),
    made_by: Mapping[str, Any] | None = None,
) -> dict[str, Any]:
    """Return the main results of a run, SI units; None without contact, verdict or wall time.

    The loads are those of :func:`loads_of`.  Without the bench's ``extremes`` they come from the
    samples, and ``loads_from`` names the sample rate.  ``energy_residual`` is the largest residual
    of the ledger at the samples of ``run.rate``, as in the tables of sweeps.  ``problems`` are the
    reasons why the run or its recording is incomplete, which may change every result.  ``made_by``
    is what made the run.
    """
    sampled, rate = extremes is None, scene.run.rate
    if extremes is None:
        extremes = sampled_extremes(scene, samples, touches, events)
    first = first_cluster(touches)
    has_contact = first.size > 0
    touch, speed = first_touch(events), impact_speed(events)
    is_unmeasured = touch is not None and speed is not None and math.isnan(speed)
    simulated = float(samples["t"][-1]) if samples.size else 0.0
    return {
        "name": name,
        "verdict": None if status is None else status.state.label,
        "left_again": status is not None and status.left_again,
        "not_used": "" if status is None else status.not_used,
        "problems": list(problems),
        "impact_speed": None if is_unmeasured else speed,
        "impact_speed_missing": touch.detail if touch is not None and is_unmeasured else "",
        "first_contact_time": float(first["start"].min()) if has_contact else None,
        "first_contact_duration": float(first["end"].max() - first["start"].min())
        if has_contact
        else None,
        "first_contact_touches": int(first.size),
        "first_contact_peak_force": _if_measured(first["peak_force"].max())
        if has_contact
        else None,
        "normal_impulse": _if_measured(touches["impulse"].sum()),
        **loads_of(extremes, touches),
        "loads_from": f"samples at {_sample_rate(samples):.4g} Hz" if sampled else "integration",
        "energy_residual": _largest(samples["energy_residual"][at_rate(samples["t"], rate)]),
        "wall_time": wall_time,
        "real_time_factor": simulated / wall_time if wall_time else None,
        "made_by": dict(made_by or {}),
    }


def _sample_rate(samples: np.ndarray) -> float:
    """Return the sample rate of a run, Hz, from its median interval; 0 if unknown."""
    interval = float(np.median(np.diff(samples["t"]))) if samples.size > 1 else 0.0
    return 1.0 / interval if interval > 0.0 else 0.0


def _if_measured(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None


def _largest(values: np.ndarray) -> float | None:
    """Return the largest magnitude; None if it was not measured."""
    largest = float(np.abs(values).max(initial=0.0))
    return _if_measured(largest)


class _Column(NamedTuple):
    """One column of the table: group, name and unit in its head, and its number."""

    group: str
    name: str
    unit: str
    key: str
    form: str
    factor: float = 1.0


_COLUMNS = (
    _Column("", "experiment", "", "name", "{}"),
    _Column("", "verdict", "", "verdict", "{}"),
    _Column("contact", "speed", "m/s", "impact_speed", "{:.4f}"),
    _Column("contact", "time", "s", "first_contact_time", "{:.3f}"),
    _Column("contact", "lasts", "ms", "first_contact_duration", "{:.1f}", 1e3),
    _Column("contact", "n", "", "first_contact_touches", "{}"),
    _Column("touch", "n", "", "touches", "{}"),
    _Column("touch", "peak", "N", "max_normal_force", "{:.1f}"),
    _Column("buffer", "in", "mm", "max_axial_stroke_in", "{:.2f}", 1e3),
    _Column("buffer", "out", "mm", "max_axial_stroke_out", "{:.2f}", 1e3),
    _Column("buffer", "torsion", "mrad", "max_torsion", "{:.2f}", 1e3),
    _Column("buffer", "force", "N", "max_buffer_force", "{:.1f}"),
    _Column("latch", "force", "N", "max_latch_force", "{:.1f}"),
    _Column("", "to BE", "mm", "nearest_distance", "{:.2f}", 1e3),
)
#: Label of the row below a run whose latch closed.
_UNTIL_LATCH = "  until latch"
#: Label of the row below an incomplete run.
_INCOMPLETE = "  INCOMPLETE"

#: Meaning of the heads of the table.
LEGEND = (
    "Loads are peak values of the whole run; the second row counts until the latch closed.",
    "n: touches. Contact: the first one, with the wall met first, until the chatter ends.",
    "Buffer: strokes inwards and outwards, torsion, axial force of spring, damper and stops.",
    "To BE: closest approach of the tip's centre to the centre of BE, the inner edge of the cone.",
)


def heads() -> list[tuple[str, str, str]]:
    """Return group, name and unit of every column; neighbours of one group share it."""
    return [(column.group, column.name, column.unit) for column in _COLUMNS]


def rows(
    summaries: Sequence[dict[str, Any]], names: Sequence[str] | None = None
) -> list[list[str]]:
    """Return summaries as texts in the units of :func:`heads`; '-' for None.

    A run whose latch closed has a second row with its loads until then; an incomplete run has a
    row that marks it.  ``names`` replaces the names of the scenes in the first column.
    """
    table_rows = []
    first_column = [summary["name"] for summary in summaries] if names is None else names
    for name, summary in zip(first_column, summaries, strict=True):
        row = [name, *(_text(column, summary[column.key]) for column in _COLUMNS[1:])]
        if summary["left_again"]:
            row[1] += ", left"
        table_rows.append(row)
        if summary["max_latch_force_time"] is not None:
            values = (summary.get(f"{column.key}_before_latch") for column in _COLUMNS[1:])
            cells = (
                "" if value is None else _text(column, value)
                for column, value in zip(_COLUMNS[1:], values, strict=True)
            )
            table_rows.append([_UNTIL_LATCH, *cells])
        if summary["problems"]:
            table_rows.append([_INCOMPLETE, *[""] * (len(_COLUMNS) - 1)])
    return table_rows


def _text(column: _Column, value: Any) -> str:
    if value is None or (column.key == "max_latch_force" and not value):
        return "-"
    return column.form.format(value if column.factor == 1.0 else value * column.factor)


#: Key of a row of ``results.json``: file of the recording beside it; null without one.
RECORDING = "recording"
#: Keys of such a row that do not say what was measured.
NOT_NUMBERS = {RECORDING, "wall_time", "real_time_factor", "made_by"}
#: Value of the keys that are no number, where a row lacks them.
_MISSING: dict[str, Any] = {
    "verdict": None,
    "left_again": False,
    "not_used": "",
    "problems": [],
    "impact_speed_missing": "",
    "loads_from": "integration",
    "made_by": {},
    RECORDING: None,
}
#: Texts where these keys are not null.
_TEXTS_OR_NULL = ("verdict", RECORDING)


def row_from(entry: object, where: str) -> dict[str, Any]:
    """Return a row of ``results.json``, of any version: a key that it lacks has its default.

    ValueError, which begins with ``where``, if the entry is no such row.
    """
    if not isinstance(entry, dict) or not isinstance(entry.get("name"), str):
        raise ValueError(f"{where}: name: must be a text")
    row = {**dict.fromkeys(_number_keys()), **copy.deepcopy(_MISSING), **entry}
    for key, value in row.items():
        default = _MISSING.get(key)
        if key in _number_keys():
            is_right = value is None or (
                isinstance(value, int | float) and not isinstance(value, bool)
            )
        elif key in _TEXTS_OR_NULL:
            is_right = value is None or isinstance(value, str)
        else:
            is_right = default is None or isinstance(value, type(default))
        if not is_right:
            raise ValueError(f"{where}: {key} = {json.dumps(value)[:40]}: must be {_kind(key)}")
    return row


def row_without_results(name: str, problem: str) -> dict[str, Any]:
    """Return the row of a recording that gives no results, with the reason."""
    return {**row_from({"name": name}, name), "problems": [problem]}


def _kind(key: str) -> str:
    default = "" if key in _TEXTS_OR_NULL else _MISSING.get(key)
    kinds = {str: "a text", bool: "true or false", list: "a list", dict: "an object"}
    text = kinds.get(type(default), "a number")
    return f"{text} or null" if text == "a number" or key in _TEXTS_OR_NULL else text


@functools.cache
def _number_keys() -> frozenset[str]:
    """Return the keys of a row whose value is a number or null."""
    of_runs = {
        *("impact_speed", "first_contact_time", "first_contact_duration", "energy_residual"),
        *("first_contact_touches", "first_contact_peak_force", "normal_impulse"),
        *("wall_time", "real_time_factor"),
    }
    nothing = Extremes(np.zeros(1, EXTREMES)[0], None)
    return frozenset(of_runs | loads_of(nothing, np.zeros(0, TOUCH)).keys())


def table(summaries: Sequence[dict[str, Any]], names: Sequence[str] | None = None) -> str:
    """Return summaries as a text table with units in its head, and notes.

    ``names`` replaces the names of the scenes.  It fits 100 columns unless a name is longer than 17
    letters.
    """
    from capture_sim.base.tables import table_text  # rich: only where a table is printed

    if names is not None:
        summaries = [{**row, "name": name} for row, name in zip(summaries, names, strict=True)]
    # the group is over the column of its longest name, so that it needs no room
    widest = {column.group: column for column in sorted(_COLUMNS, key=lambda c: len(c.name))}
    head = [
        f"{column.group if column is widest[column.group] else ''}\n{column.name}\n{column.unit}"
        for column in _COLUMNS
    ]
    text = table_text(head, rows(summaries), left=2, gap=1)
    return "\n".join([text, "", *LEGEND, *notes(summaries)])


def notes(summaries: Sequence[dict[str, Any]]) -> list[str]:
    """Return notes on completeness, accuracy and speed of the runs of a table."""
    lines = [
        f"{s['name']}: incomplete: {'; '.join(s['problems'][:3])}."
        for s in summaries
        if s["problems"]
    ]
    lines += [
        f"{s['name']}: loads are peaks of {s['loads_from']}, which may miss larger ones between "
        "them; loads of touches, and of the latch as it closes, are located."
        for s in summaries
        if s["loads_from"] != "integration"
    ]
    lines += [
        f"{s['name']}: {s['impact_speed_missing']}." for s in summaries if s["impact_speed_missing"]
    ]
    residuals = [s["energy_residual"] for s in summaries if s["energy_residual"] is not None]
    if residuals:
        lines.append(f"The energy ledger closes to {max(residuals):.0e} J.")
    factors = [s["real_time_factor"] for s in summaries if s["real_time_factor"]]
    if factors:
        low, high = (f"{f:.0f}" if f >= 10 else f"{f:.1f}" for f in (min(factors), max(factors)))
        span_text = low if low == high else f"{low} to {high}"
        lines.append(f"Run at {span_text} times real time.")
    return lines + [made_by_text(s["name"], s["made_by"]) for s in summaries if s.get("made_by")]


def made_by_text(name: str, made_by: Mapping[str, Any]) -> str:
    """Return a run's origin as a line: scene, hash, overrides, seed and version."""
    parts = [f"scene {made_by['scene']}"] if "scene" in made_by else []
    if parts and "scene_sha256" in made_by:
        parts[0] += f" ({made_by['scene_sha256'][:12]})"
    if made_by.get("overrides"):
        parts.append("with " + ", ".join(made_by["overrides"]))
    if made_by.get("seed") is not None:
        parts.append(f"seed {made_by['seed']}")
    own = [line for line in made_by.get("software", ()) if line.startswith("capture_sim ")]
    return f"{name}: {made_by.get('source', 'unknown source')}: {'; '.join([*parts, *own])}."
