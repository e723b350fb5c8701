"""Curves, touches, states and events of a run in rerun."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import rerun as rr

from capture_sim.samples import Phase
from capture_sim.viewing import style
from capture_sim.viewing.rerun_stream import RunStream
from capture_sim.viewing.source import ViewableRun, normal_force_with_peaks

_MM = 1e3


class Plot(NamedTuple):
    """One diagram: name of its entities, title with unit, and its curves' names."""

    entity: str
    title: str
    curves: tuple[str, ...] = ("",)


PLOTS = (
    Plot("contact_force", "contact force, N; dots: peaks"),
    Plot("axial_stroke", "axial stroke, mm"),
    Plot("torsion", "torsion, mrad"),
    Plot("distance", "tip to BE, mm"),
    Plot("speed", "speed, mm/s; target light", ("chaser", "target")),
    Plot("string_tension", "string tension, N"),
    Plot(
        "energy",
        "energy, mJ; dissipated light",
        ("kinetic", "dissipated", "elastic"),
    ),
)


class PlotLog:
    """Logs a run's curves, by the entities of :data:`PLOTS`.

    Parameters
    ----------
    stream
        Of the run.
    colour
        Of the run.
    """

    def __init__(self, stream: RunStream, colour: str) -> None:
        self._stream = stream
        self._colour = style.rgb(colour)

    def styles(self) -> None:
        """Log colours, widths and names of the curves."""
        light = style.light(self._colour)
        for plot in PLOTS:
            names = [f"{self._stream.name} {curve}".strip() for curve in plot.curves]
            colours = [self._colour, light, self._colour][: len(names)]
            widths = [1.8, 1.8, 0.8][: len(names)]
            # the peaks are what is looked for: no averaging of rows that share a pixel
            highest = rr.components.AggregationPolicy.Max
            policy = highest if plot.entity == "contact_force" else None
            self._stream.static(
                self._path(plot.entity),
                rr.SeriesLines(
                    colors=colours, names=names, widths=widths, aggregation_policy=policy
                ),
            )
        self._stream.static(
            self._path("contact_force") + "/touches",
            rr.SeriesPoints(
                colors=self._colour,
                markers="circle",
                marker_sizes=3.5,
                names=f"{self._stream.name} touches",
            ),
        )
        for lane, colours_of in (("phase", style.PHASES), ("verdict", style.STATES)):
            self._stream.static(
                self._lane(lane),
                rr.StateConfiguration(
                    values=list(colours_of),
                    labels=list(colours_of),
                    colors=[style.rgb(colour) for colour in colours_of.values()],
                ),
            )

    def curves(self, samples: np.ndarray, *, force: bool = True) -> None:
        """Log the curves of a stretch of samples, (n,) of dtype SAMPLE.

        What was not measured (not a number) is left out.
        """
        t = samples["t"]
        if force:
            self._curve("contact_force", t, samples["normal_force"].sum(axis=1))
        self._curve("axial_stroke", t, samples["axial_stroke"] * _MM)
        self._curve("torsion", t, samples["torsion"] * _MM)
        self._curve("distance", t, samples["tip_distance"] * _MM)
        v = samples["v"]
        speed = np.hypot(v[:, [0, 5]], v[:, [1, 6]])
        self._curve("speed", t, speed * _MM)
        self._curve("string_tension", t, samples["string_tension"])
        ledger = [samples["kinetic"], _sum(samples, "dissipated_"), _sum(samples, "elastic_")]
        self._curve("energy", t, np.stack(ledger, axis=-1) * _MM)

    def touches(self, run: ViewableRun) -> None:
        """Log the force with every touch in it, and a mark at each touch's peak."""
        self._curve("contact_force", *normal_force_with_peaks(run))
        ordered = run.touches[np.argsort(run.touches["peak_time"], kind="stable")]
        self.mark_touches(ordered["peak_time"], ordered["peak_force"])

    def mark_touches(self, t: np.ndarray, force: np.ndarray) -> None:
        """Mark touches by the time and the force of their peaks, (n,) s and N."""
        self._stream.scalars(self._path("contact_force") + "/touches", t, force)

    def states(self, lane: str, t: np.ndarray, states: list[str]) -> None:
        """Log from when on which state holds, in the lane ``phase`` or ``verdict``."""
        self._stream.columns(self._lane(lane), t, rr.StateChange, state=states)

    def events(self, run: ViewableRun) -> None:
        """Log the events as text."""
        texts = [event_text(event.kind.label, event.detail) for event in run.events]
        self.note(np.array([event.t for event in run.events]), texts)

    def note(self, t: np.ndarray, texts: list[str]) -> None:
        """Log lines of text, at (n,) s."""
        self._stream.columns(
            f"events/{self._stream.name}",
            t,
            rr.TextLog,
            text=[f"{self._stream.name}: {text}" for text in texts],
            level=["INFO"] * len(texts),
        )

    def _path(self, plot: str) -> str:
        return f"plots/{plot}/{self._stream.name}"

    def _lane(self, lane: str) -> str:
        return f"states/{self._stream.name}/{lane}"

    def _curve(self, plot: str, t: np.ndarray, values: np.ndarray) -> None:
        known = np.isfinite(values if values.ndim == 1 else values.sum(axis=1))
        if known.any():
            self._stream.scalars(self._path(plot), t[known], values[known])


def event_text(kind: str, detail: str) -> str:
    """Return an event in one line."""
    return f"{kind}, {detail}" if detail else kind


def _sum(samples: np.ndarray, prefix: str) -> np.ndarray:
    """Return the sum of all fields whose names begin so, (n,)."""
    names = [name for name in samples.dtype.names or () if name.startswith(prefix)]
    return np.sum([samples[name] for name in names], axis=0)


def phases(run: ViewableRun) -> tuple[np.ndarray, list[str]]:
    """Return from when on which phase holds; the touches by their located ends.

    Returns
    -------
    times : ndarray (n,)
        s, ascending.
    names : list of str
        One each.
    """
    t = run.samples["t"]
    phase = np.where(
        run.samples["phase"] == Phase.CONTACT, int(Phase.FREE), run.samples["phase"]
    ).astype(int)
    starts = np.flatnonzero(np.diff(phase, prepend=-1))
    changes = [(float(t[i]), Phase(int(phase[i])).name.lower()) for i in starts]

    def beneath(when: float) -> str:
        return next(name for start, name in reversed(changes) if start <= when or start == t[0])

    touches = []
    for start, end in _merged(run.touches):
        touches.append((start, "contact"))
        touches.append((end, beneath(end)))
    inside = [
        (when, name)
        for when, name in changes
        if not any(start < when < end for start, end in _merged(run.touches))
    ]
    ordered = sorted([*inside, *touches], key=lambda change: change[0])
    return np.array([when for when, _ in ordered]), [name for _, name in ordered]


def _merged(touches: np.ndarray) -> list[tuple[float, float]]:
    """Return the intervals with any touch, by time."""
    merged: list[tuple[float, float]] = []
    for start, end in sorted(zip(touches["start"].tolist(), touches["end"].tolist(), strict=True)):
        if merged and start <= merged[-1][1]:
            merged[-1] = (merged[-1][0], max(end, merged[-1][1]))
        else:
            merged.append((start, end))
    return merged


def verdicts(run: ViewableRun) -> tuple[np.ndarray, list[str]]:
    """Return from when on the detector was in which state, times (n,), s, and names."""
    times: list[float] = []
    names: list[str] = []
    for status in run.statuses:
        name = status.state.label
        if not names or names[-1] != name:
            times.append(status.t)
            names.append(name)
    return np.array(times), names
