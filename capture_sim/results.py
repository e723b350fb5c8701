"""A run in a few numbers, and several runs in a table."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from capture_sim.samples import Event, EventKind
from capture_sim.scene import Scene

#: A cluster of touches ends when none follows for this long, s.
CLUSTER_GAP = 0.05


def first_cluster(touches: np.ndarray) -> np.ndarray:
    """Return the touches of the first contact.

    A light tip chatters before it slides: touches that follow each other within 50 ms
    are one contact.

    Parameters
    ----------
    touches
        (n,) of dtype TOUCH, in order of their ends.
    """
    ordered = touches[np.argsort(touches["start"], kind="stable")]
    if ordered.size == 0:
        return ordered
    end = np.maximum.accumulate(ordered["end"])
    breaks = np.flatnonzero(ordered["start"][1:] - end[:-1] > CLUSTER_GAP)
    return ordered[: breaks[0] + 1] if breaks.size else ordered


def impact_speed(events: Iterable[Event]) -> float | None:
    """Return the speed of the chaser against the target at the first touch, m/s."""
    for event in events:
        if event.kind is EventKind.TOUCH:
            return math.hypot(event.v[0] - event.v[5], event.v[1] - event.v[6])
    return None


def summarize(
    scene: Scene,
    samples: np.ndarray,
    touches: np.ndarray,
    events: Sequence[Event],
    verdict: str,
    wall_time: float | None,
) -> dict[str, Any]:
    """Return the run in a few numbers, SI units; None where there was no contact or no clock."""
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
        "max_axial_stroke": float(np.abs(samples["axial_stroke"]).max(initial=0.0)),
        "max_torsion": float(np.abs(samples["torsion"]).max(initial=0.0)),
        "nearest_distance": float(samples["tip_distance"].min(initial=math.inf)),
        "energy_residual": float(np.abs(samples["energy_residual"]).max(initial=0.0)),
        "wall_time": wall_time,
        "real_time_factor": simulated / wall_time if wall_time else None,
    }


_COLUMNS = (
    ("experiment", "name", "", 1.0, "{}"),
    ("verdict", "verdict", "", 1.0, "{}"),
    ("impact", "impact_speed", "m/s", 1.0, "{:.4f}"),
    ("at", "first_contact_time", "s", 1.0, "{:.4f}"),
    ("contact", "first_contact_duration", "ms", 1e3, "{:.1f}"),
    ("touches", "first_contact_touches", "", 1.0, "{}"),
    ("peak", "first_contact_peak_force", "N", 1.0, "{:.1f}"),
    ("all", "touches", "touches", 1.0, "{}"),
    ("peak of all", "peak_force", "N", 1.0, "{:.1f}"),
    ("stroke", "max_axial_stroke", "mm", 1e3, "{:.2f}"),
    ("torsion", "max_torsion", "mrad", 1e3, "{:.2f}"),
    ("nearest", "nearest_distance", "mm", 1e3, "{:.2f}"),
    ("residual", "energy_residual", "J", 1.0, "{:.1e}"),
    ("x real time", "real_time_factor", "", 1.0, "{:.0f}"),
)


def table(summaries: Sequence[dict[str, Any]]) -> str:
    """Return summaries as a table for people, with units in its head."""
    rows = [[head for head, *_ in _COLUMNS], [unit for _, _, unit, _, _ in _COLUMNS]]
    for summary in summaries:
        row = []
        for _, key, _, factor, form in _COLUMNS:
            value = summary[key]
            if value is None:
                row.append("-")
            else:
                row.append(form.format(value * factor if factor != 1.0 else value))
        rows.append(row)
    widths = [max(len(row[i]) for row in rows) for i in range(len(_COLUMNS))]
    lines = [
        "  ".join(
            cell.ljust(w) if i < 2 else cell.rjust(w)
            for i, (cell, w) in enumerate(zip(row, widths, strict=True))
        ).rstrip()
        for row in rows
    ]
    lines.insert(2, "-" * max(map(len, lines)))
    return "\n".join(lines)
