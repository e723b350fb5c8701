"""A run in a few numbers, and several runs in a table."""

from __future__ import annotations

import itertools
import json
import math
from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np

from capture_sim.samples import EXTREMES, Event, EventKind, Extremes
from capture_sim.scene.parts import Scene


def first_cluster(touches: np.ndarray) -> np.ndarray:
    """Return the touches of the first contact.

    A light tip chatters on the wall before it slides.  The first contact is with the wall met
    first and ends when the other wall is met, or when the tip stays off for longer than it has
    chattered (from the first touch's start to the last one's).  Of a single touch so far that
    cannot be said: it bounced if the pause behind it is shorter than the contact that follows.

    Parameters
    ----------
    touches
        (n,) of dtype TOUCH, in order of their ends.
    """
    ordered = touches[np.argsort(touches["start"], kind="stable")]
    start, end = ordered["start"], ordered["end"]
    return ordered[: _bounced(start, end, _chatter(start, end, ordered["wall"]))]


def first_contact_end(events: Iterable[Event], now: float) -> float | None:
    """Return when the first contact of a run ended, s; None if it has not, so far as known.

    Parameters
    ----------
    events
        Of the run so far.
    now
        How far it is, s.
    """
    begun = [event for event in events if event.kind is EventKind.TOUCH]
    start = np.array([event.t for event in begun])
    end = np.full(start.size, math.inf)
    for touch in (event.touch for event in events if event.touch is not None):
        end[start == touch["start"]] = touch["end"]
    behind = _chatter(start, end, np.array([event.wall for event in begun]))
    if behind == 0:
        return None
    still = behind < 2 or now - end[behind - 1] <= start[behind - 1] - start[0]
    if still and behind == start.size:
        return None
    last = float(end[_bounced(start, end, behind) - 1])
    return last if math.isfinite(last) else None


def _chatter(start: np.ndarray, end: np.ndarray, wall: np.ndarray) -> int:
    """Return how many touches, in order of their starts, chatter on from the first."""
    other = np.flatnonzero(wall != wall[:1])
    size = int(other[0]) if other.size else start.size
    for behind in range(2, size):
        if start[behind] - end[behind - 1] > start[behind - 1] - start[0]:
            return behind
    return size


def _bounced(start: np.ndarray, end: np.ndarray, behind: int) -> int:
    """Return how many of the chatter's touches are the first contact: one, or all."""
    alone = behind > 1 and start[1] - end[0] > end[behind - 1] - start[1]
    return 1 if alone else behind


def impact_speed(events: Iterable[Event]) -> float | None:
    """Return the speed of the chaser against the target at the first touch, m/s."""
    for event in events:
        if event.kind is EventKind.TOUCH:
            return math.hypot(event.v[0] - event.v[5], event.v[1] - event.v[6])
    return None


def extremes_in(samples: np.ndarray, events: Iterable[Event]) -> Extremes:
    """Return the extremes among the samples of a run; those between them are not known."""
    closed = next((e.t for e in events if e.kind is EventKind.LATCHED), math.inf)
    parts = [samples[samples["t"] < closed], samples[samples["t"] >= closed]]
    found = np.zeros(2, EXTREMES)
    for row, part in zip(found, parts, strict=True):
        # a latch holds the tip in place of the walls
        penetration = np.where(part["normal_force"] > 0.0, part["penetration"], 0.0)
        for name, values in (
            ("compression", np.maximum(-part["axial_stroke"], 0.0)),
            ("extension", np.maximum(part["axial_stroke"], 0.0)),
            ("torsion", np.abs(part["torsion"])),
            ("tip_distance", -part["tip_distance"]),
            ("penetration", penetration.max(axis=1, initial=0.0)),
            ("normal_force", part["normal_force"].max(axis=1, initial=0.0)),
        ):
            if values.size:
                largest = int(values.argmax())
                row[name], row[f"{name}_time"] = values[largest], part["t"][largest]
        row["tip_distance"] = -row["tip_distance"] if part.size else math.inf
    return Extremes(found[0], found[1] if parts[1].size else None)


def extremes_to_text(extremes: Extremes) -> str:
    """Return extremes as a line of JSON, exactly."""
    rows = (None if row is None else row.item() for row in extremes)
    return json.dumps(dict(zip(Extremes._fields, rows, strict=True)))


def extremes_from_text(text: str) -> Extremes:
    """Return the extremes that a line of JSON says.

    Raises
    ------
    ValueError
        It is none of :func:`extremes_to_text`.
    """
    found = np.zeros(2, EXTREMES)
    try:
        before, after = (json.loads(text)[name] for name in Extremes._fields)
        found[0] = tuple(before)
        if after is not None:
            found[1] = tuple(after)
    except (TypeError, KeyError, RecursionError) as error:
        raise ValueError(str(error)) from None
    return Extremes(found[0], None if after is None else found[1])


def summarize(
    scene: Scene,
    samples: np.ndarray,
    touches: np.ndarray,
    events: Sequence[Event],
    verdict: str,
    wall_time: float | None,
    extremes: Extremes | None = None,
) -> dict[str, Any]:
    """Return the run in a few numbers, SI units; None where there was no contact or no clock.

    Strokes and torsion are those up to the latch; those of the held tip are named ``latched``,
    None where no latch has closed.  Without the bench's ``extremes`` they are the samples'.
    """
    before, after = extremes_in(samples, events) if extremes is None else extremes
    first = first_cluster(touches)
    met = first.size > 0
    simulated = float(samples["t"][-1]) if samples.size else 0.0
    return {
        "name": scene.name,
        "verdict": verdict,
        "impact_speed": impact_speed(events),
        "first_contact_time": float(first["start"].min()) if met else None,
        "first_contact_duration": float(first["end"].max() - first["start"].min()) if met else None,
        "first_contact_touches": int(first.size),
        "first_contact_peak_force": float(first["peak_force"].max()) if met else None,
        "touches": int(touches.size),
        "peak_force": float(touches["peak_force"].max()) if met else None,
        "normal_impulse": float(touches["impulse"].sum()),
        "max_axial_stroke": _stroke(before),
        "max_torsion": float(before["torsion"]),
        "max_penetration": max(float(before["penetration"]), 0.0),
        "max_axial_stroke_latched": None if after is None else _stroke(after),
        "max_torsion_latched": None if after is None else float(after["torsion"]),
        "nearest_distance": min(
            float(part["tip_distance"]) for part in (before, after) if part is not None
        ),
        "energy_residual": _largest(samples["energy_residual"]),
        "wall_time": wall_time,
        "real_time_factor": simulated / wall_time if wall_time else None,
    }


def _stroke(extremes: np.void) -> float:
    """Return the largest stroke of the probe, inwards or outwards, m."""
    return max(float(extremes["compression"]), float(extremes["extension"]))


def _largest(values: np.ndarray) -> float | None:
    """Return the largest magnitude; None where nothing was measured."""
    largest = float(np.abs(values).max(initial=0.0))
    return largest if math.isfinite(largest) else None


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
    _Column("first touch", "speed", "m/s", "impact_speed", "{:.4f}"),
    _Column("first touch", "time", "s", "first_contact_time", "{:.3f}"),
    _Column("first contact", "lasts", "ms", "first_contact_duration", "{:.1f}", 1e3),
    _Column("first contact", "n", "", "first_contact_touches", "{}"),
    _Column("first contact", "peak", "N", "first_contact_peak_force", "{:.1f}"),
    _Column("all touches", "n", "", "touches", "{}"),
    _Column("all touches", "peak", "N", "peak_force", "{:.1f}"),
    _Column("buffer up to", "stroke", "mm", "max_axial_stroke", "{:.2f}", 1e3),
    _Column("buffer up to", "torsion", "mrad", "max_torsion", "{:.2f}", 1e3),
    _Column("", "to BE", "mm", "nearest_distance", "{:.2f}", 1e3),
    _Column("energy", "error", "J", "energy_residual", "{:.0e}"),
)

#: What the heads of the table mean.
LEGEND = (
    "n: touches. First contact: of the wall met first, until the tip has done with chattering.",
    "Buffer: until the latch closes. To BE: smallest distance of the tip's centre to that of BE.",
    "Energy error: of the ledger.",
)


def heads() -> list[tuple[str, str, str]]:
    """Return group, name and unit of every column; neighbours of one group share it."""
    return [(column.group, column.name, column.unit) for column in _COLUMNS]


def rows(summaries: Sequence[dict[str, Any]]) -> list[list[str]]:
    """Return summaries as texts in the units of :func:`heads`, a row each; '-' for None."""
    return [[_text(column, summary[column.key]) for column in _COLUMNS] for summary in summaries]


def _text(column: _Column, value: Any) -> str:
    if value is None or value == math.inf:
        return "-"
    return column.form.format(value if column.factor == 1.0 else value * column.factor)


def table(summaries: Sequence[dict[str, Any]]) -> str:
    """Return summaries as a table for people, with units in its head.

    It fits 100 columns unless an experiment's name is longer than 14 letters.
    """
    cells = [[c.name for c in _COLUMNS], [c.unit for c in _COLUMNS], *rows(summaries)]
    widths = [max(len(row[i]) for row in cells) for i in range(len(_COLUMNS))]
    # a group's columns stand close to each other, and are as wide together as its name
    gaps = [
        "" if i == 0 else " " if c.group and c.group == _COLUMNS[i - 1].group else "  "
        for i, c in enumerate(_COLUMNS)
    ]
    groups = []
    for group, members in itertools.groupby(range(len(_COLUMNS)), lambda i: _COLUMNS[i].group):
        inside = list(members)
        span = sum(widths[i] for i in inside) + sum(len(gaps[i]) for i in inside[1:])
        if len(group) > span:
            widths[inside[0]] += len(group) - span
        groups.append(gaps[inside[0]] + group.rjust(max(span, len(group))))
    lines = ["".join(groups).rstrip()]
    for row in cells:
        padded = (
            gap + (cell.ljust(w) if i < 2 else cell.rjust(w))
            for i, (gap, cell, w) in enumerate(zip(gaps, row, widths, strict=True))
        )
        lines.append("".join(padded).rstrip())
    lines.insert(3, "-" * max(map(len, lines)))
    lines += ["", *LEGEND]
    factors = [s["real_time_factor"] for s in summaries if s["real_time_factor"]]
    if factors:
        low, high = (f"{f:.0f}" if f >= 10 else f"{f:.1f}" for f in (min(factors), max(factors)))
        span_text = low if low == high else f"{low} to {high}"
        lines.append(f"Run at {span_text} times real time.")
    return "\n".join(lines)
