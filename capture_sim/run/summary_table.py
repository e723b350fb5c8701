"""Main results of several runs as a table, with notes."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

from capture_sim.run.bounds import Bounds
from capture_sim.run.loads import LOADS


class _Column(NamedTuple):
    """One column of the table: its head (group, name, unit) and its value.

    The value is that of ``key`` in the summary, times ``factor``, in the format ``form``.
    """

    group: str
    name: str
    unit: str
    key: str
    form: str
    factor: float = 1.0


#: Columns of the table of runs: group, name, unit, key of the summary, form and factor.
COLUMNS = (
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
    """Return group, name and unit of every column; adjacent columns may have the same group."""
    return [(column.group, column.name, column.unit) for column in COLUMNS]


def rows(
    summaries: Sequence[dict[str, Any]], names: Sequence[str] | None = None
) -> list[list[str]]:
    """Return summaries as rows of texts, one text for each column of :func:`heads`; '-' for None.

    If the latch closed in a run, a second row has the loads until it closed.  An incomplete run has
    a further row that marks it.  ``names`` replaces the names of the runs in the first column.
    """
    table_rows = []
    first_column = [summary["name"] for summary in summaries] if names is None else names
    for name, summary in zip(first_column, summaries, strict=True):
        row = [name, *(_text(column, summary[column.key]) for column in COLUMNS[1:])]
        if summary["left_again"]:
            row[1] += ", left"
        table_rows.append(row)
        if summary["max_latch_force_time"] is not None:
            values = (summary.get(f"{column.key}_before_latch") for column in COLUMNS[1:])
            cells = (
                "" if value is None else _text(column, value)
                for column, value in zip(COLUMNS[1:], values, strict=True)
            )
            table_rows.append([_UNTIL_LATCH, *cells])
        if summary["problems"]:
            table_rows.append([_INCOMPLETE, *[""] * (len(COLUMNS) - 1)])
    return table_rows


def _text(column: _Column, value: Any) -> str:
    if value is None or (column.key == "max_latch_force" and not value):
        return "-"
    return column.form.format(value if column.factor == 1.0 else value * column.factor)


def table(
    summaries: Sequence[dict[str, Any]],
    names: Sequence[str] | None = None,
    width: int | None = None,
) -> str:
    """Return summaries as a text table with units in its head, and notes.

    ``names`` replaces the names of the runs.  Columns that do not fit into ``width`` characters are
    in a second table below.
    """
    from capture_sim.base.tables import table_text  # rich: only where a table is printed

    if names is not None:
        summaries = [{**row, "name": name} for row, name in zip(summaries, names, strict=True)]
    # the group is above the column with its longest name, so that no column becomes wider
    widest = {column.group: column for column in sorted(COLUMNS, key=lambda c: len(c.name))}
    head = [
        f"{column.group if column is widest[column.group] else ''}\n{column.name}\n{column.unit}"
        for column in COLUMNS
    ]
    text = table_text(head, rows(summaries), left=2, gap=1, width=width)
    return "\n".join([text, "", *LEGEND, *notes(summaries)])


def notes(summaries: Sequence[dict[str, Any]]) -> list[str]:
    """Return lines of notes on the runs of a table: completeness, accuracy, speed and origin."""
    lines = [
        f"{s['name']}: incomplete: {'; '.join(s['problems'][:3])}."
        for s in summaries
        if s["problems"]
    ]
    lines += [
        f"{s['name']}: loads are peaks of {s['loads_from']}: {'; '.join(_load_bounds(s))}. Others, "
        "but those of the latch as it closes, may be larger between the samples."
        for s in summaries
        if s["loads_from"] != "integration"
    ]
    lines += [
        f"{s['name']}: {s['impact_speed_missing']}." for s in summaries if s["impact_speed_missing"]
    ]
    lines += [
        f"{s['name']}: first contact {bounds.text()}."
        for s in summaries
        if (bounds := _contact_bounds(s)) is not None and bounds.is_wide
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


def _load_bounds(summary: Mapping[str, Any]) -> Iterator[str]:
    """Yield each load in a summary that sensors measured with its bounds, in words."""
    for load in LOADS:
        if not load.is_measured or summary[load.key] is None:
            continue
        low, high = (summary[f"{load.key}_{end}"] for end in ("low", "high"))
        texts = [f"{load.factor * (x or 0.0):.4g}" for x in (low, high)]
        bounds = "not known" if low is None else f"at least {texts[0]} {load.shown_in}"
        if high is not None:
            bounds = f"{texts[0]} to {texts[1]} {load.shown_in}"
        yield f"{load.meaning} {bounds}"


def _contact_bounds(summary: Mapping[str, Any]) -> Bounds | None:
    """Return the bounds of the first contact in a summary; None if it has none."""
    low, high = (summary[f"first_contact_time_{end}"] for end in ("low", "high"))
    if low is None and high is None:
        return None
    return Bounds(-math.inf if low is None else low, math.inf if high is None else high)


def made_by_text(name: str, made_by: Mapping[str, Any]) -> str:
    """Return a run's origin as one line: source, scene, hash, overrides, seed and version."""
    parts = [f"scene {made_by['scene']}"] if "scene" in made_by else []
    if parts and "scene_sha256" in made_by:
        parts[0] += f" ({made_by['scene_sha256'][:12]})"
    if made_by.get("overrides"):
        parts.append("with " + ", ".join(made_by["overrides"]))
    if made_by.get("seed") is not None:
        parts.append(f"seed {made_by['seed']}")
    own = [line for line in made_by.get("software", ()) if line.startswith("capture_sim ")]
    return f"{name}: {made_by.get('source', 'unknown source')}: {'; '.join([*parts, *own])}."
