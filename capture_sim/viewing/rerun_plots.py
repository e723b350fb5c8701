"""Curves, touches, states and events of a run in rerun."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import rerun as rr

from capture_sim.samples import Phase
from capture_sim.viewing import style
from capture_sim.viewing.rerun_stream import RunStream
from capture_sim.viewing.source import ViewableRun, normal_force_with_peaks

_MM = 1e3


class Plot(NamedTuple):
    """One diagram: name of its entities, title with unit, values of samples, curves' names."""

    entity: str
    title: str
    values: Callable[[np.ndarray], np.ndarray]  # (n,) or (n, k) of samples (n,)
    curves: tuple[str, ...] = ("",)


def _speeds(samples: np.ndarray) -> np.ndarray:
    return np.hypot(samples["v"][:, [0, 5]], samples["v"][:, [1, 6]]) * _MM


def _ledger(samples: np.ndarray) -> np.ndarray:
    names = samples.dtype.names or ()
    parts = [
        np.sum([samples[name] for name in names if name.startswith(prefix)], axis=0)
        for prefix in ("kinetic", "dissipated_", "elastic_")
    ]
    return np.stack(parts, axis=-1) * _MM


PLOTS = (
    Plot("contact_force", "contact force, N; dots: peaks", lambda s: s["normal_force"].sum(axis=1)),
    Plot("axial_stroke", "axial stroke, mm", style.STROKE.of),
    Plot("torsion", "torsion, mrad", style.TORSION.of),
    Plot("distance", "tip to BE, mm", style.DISTANCE.of),
    Plot("speed", "speed, mm/s; target light", _speeds, ("chaser", "target")),
    Plot("string_tension", "string tension, N", lambda s: s["string_tension"]),
    Plot(
        "energy",
        "energy, mJ; dissipated light",
        _ledger,
        ("kinetic", "dissipated", "elastic"),
    ),
)


class PlotLog:
    """Logs a run's curves in its colour, by the entities of :data:`PLOTS`."""

    def __init__(self, stream: RunStream, colour: str) -> None:
        self._stream, self._colour = stream, style.rgb(colour)
        self._touches = f"{self._path('contact_force')}/touches"
        self._log_styles()

    def _log_styles(self) -> None:
        """Log colours, widths and names of the curves."""
        static, name, colour = self._stream.static, self._stream.name, self._colour
        for plot in PLOTS:
            k = len(plot.curves)
            # the peaks are what is looked for: no averaging of rows that share a pixel
            highest = rr.components.AggregationPolicy.Max
            lines = rr.SeriesLines(
                colors=[colour, style.light(colour), colour][:k],
                names=[f"{name} {curve}".strip() for curve in plot.curves],
                widths=[1.8, 1.8, 0.8][:k],
                aggregation_policy=highest if plot.entity == "contact_force" else None,
            )
            static(self._path(plot.entity), lines)
        look = {"colors": colour, "markers": "circle", "marker_sizes": 3.5}
        static(self._touches, rr.SeriesPoints(names=f"{name} touches", **look))  # type: ignore[arg-type]
        for lane, colours_of in (("phase", style.PHASES), ("verdict", style.STATES)):
            words = list(colours_of)
            colours = [style.rgb(colour) for colour in colours_of.values()]
            shown = rr.StateConfiguration(values=words, labels=words, colors=colours)
            static(f"states/{name}/{lane}", shown)

    def curves(self, samples: np.ndarray, *, force: bool = True) -> None:
        """Log the curves of samples, (n,); what is not measured (NaN) is left out."""
        for plot in PLOTS[0 if force else 1 :]:
            values = plot.values(samples)
            known = np.isfinite(values if values.ndim == 1 else values.sum(axis=1))
            if known.any():
                self._stream.scalars(self._path(plot.entity), samples["t"][known], values[known])

    def touches(self, run: ViewableRun) -> None:
        """Log the force with every touch in it, and a mark at each touch's peak."""
        t, force = normal_force_with_peaks(run)
        known = np.isfinite(force)
        self._stream.scalars(self._path("contact_force"), t[known], force[known])
        ordered = run.touches[np.argsort(run.touches["peak_time"], kind="stable")]
        self.mark_touches(ordered["peak_time"], ordered["peak_force"])

    def mark_touches(self, t: np.ndarray, force: np.ndarray) -> None:
        """Mark touches by the time and the force of their peaks, (n,) s and N."""
        self._stream.scalars(self._touches, t, force)

    def states(self, lane: str, t: np.ndarray, states: list[str]) -> None:
        """Log from when on which state holds, in the lane ``phase`` or ``verdict``."""
        self._stream.columns(f"states/{self._stream.name}/{lane}", t, rr.StateChange, state=states)

    def events(self, run: ViewableRun) -> None:
        """Log the events as text."""
        texts = [event_text(event.kind.label, event.detail) for event in run.events]
        self.note(np.array([event.t for event in run.events]), texts)

    def note(self, t: np.ndarray, texts: list[str]) -> None:
        """Log lines of text, at (n,) s."""
        name = self._stream.name
        lines = [f"{name}: {text}" for text in texts]
        level = ["INFO"] * len(texts)
        self._stream.columns(f"events/{name}", t, rr.TextLog, text=lines, level=level)

    def _path(self, plot: str) -> str:
        return f"plots/{plot}/{self._stream.name}"


def event_text(kind: str, detail: str) -> str:
    """Return an event in one line."""
    return f"{kind}, {detail}" if detail else kind


def phases(run: ViewableRun) -> tuple[np.ndarray, list[str]]:
    """Return from when on which phase holds; the touches by their located ends.

    Returns
    -------
    times : ndarray (n,)
        s, ascending.
    names : list of str
        One each.
    """
    t, phase = run.samples["t"], run.samples["phase"].astype(int)
    phase[phase == Phase.CONTACT] = Phase.FREE
    starts = np.flatnonzero(np.diff(phase, prepend=-1))
    # of the walls together
    inside: list[list[float]] = []
    for start, end in sorted(run.touches[["start", "end"]].tolist()):
        if inside and start <= inside[-1][1]:
            inside[-1][1] = max(inside[-1][1], end)
        else:
            inside.append([start, end])
    beneath = phase[starts][
        np.maximum(np.searchsorted(t[starts], [end for _, end in inside], side="right") - 1, 0)
    ]
    changes = [
        (float(t[i]), Phase(int(phase[i])).label)
        for i in starts
        if not any(start < t[i] < end for start, end in inside)
    ]
    for (start, end), after in zip(inside, beneath, strict=True):
        changes += [(start, "contact"), (end, Phase(int(after)).label)]
    changes.sort(key=lambda change: change[0])
    return np.array([when for when, _ in changes]), [name for _, name in changes]


def verdicts(run: ViewableRun) -> tuple[np.ndarray, list[str]]:
    """Return from when on the detector was in which state, times (n,), s, and names."""
    times: list[float] = []
    names: list[str] = []
    for status in run.statuses:
        if not names or names[-1] != status.state.label:
            times.append(status.t)
            names.append(status.state.label)
    return np.array(times), names
