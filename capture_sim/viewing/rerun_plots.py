"""Logging of a run's curves, touches, phases, verdict and events to a rerun recording."""

from __future__ import annotations

from itertools import groupby
from operator import itemgetter
from typing import NamedTuple

import numpy as np
import rerun as rr

from capture_sim.dynamics.samples import Phase
from capture_sim.run.run import Run
from capture_sim.viewing import style
from capture_sim.viewing.curves import DISTANCE, FORCE, STROKE, TORSION, PlottedRun, Quantity
from capture_sim.viewing.rerun_stream import RunStream
from capture_sim.viewing.source import every_touch


class Plot(NamedTuple):
    """A diagram of rerun: its quantity, a note at the end of its title, and names of its curves."""

    quantity: Quantity
    note: str = ""
    curves: tuple[str, ...] = ("",)

    @property
    def title(self) -> str:
        """Title of the diagram: name and unit of its quantity, then the note."""
        return f"{self.quantity.label}, {self.quantity.unit}{self.note}"


def _speeds(samples: np.ndarray) -> np.ndarray:
    return np.hypot(samples["v"][:, [0, 5]], samples["v"][:, [1, 6]])


def _ledger(samples: np.ndarray) -> np.ndarray:
    names = samples.dtype.names or ()
    parts = [
        np.sum([samples[name] for name in names if name.startswith(prefix)], axis=0)
        for prefix in ("kinetic", "dissipated_", "elastic_")
    ]
    return np.stack(parts, axis=-1)


#: All diagrams.  Each key names the folder ``plots/<key>`` of the recording's paths.
PLOTS = {
    "contact_force": Plot(FORCE, "; dots: peaks"),
    "axial_stroke": Plot(STROKE),
    "torsion": Plot(TORSION),
    "distance": Plot(DISTANCE),
    "speed": Plot(
        Quantity("Speeds", "speed", "mm/s", 1e3, _speeds), "; target light", ("chaser", "target")
    ),
    "string_tension": Plot(
        Quantity("String", "string tension", "N", 1.0, itemgetter("string_tension"))
    ),
    "energy": Plot(
        Quantity("Energies", "energy", "mJ", 1e3, _ledger),
        "; dissipated light",
        ("kinetic", "dissipated", "elastic"),
    ),
}


class PlotLog:
    """Logs a run's data for the diagrams of :data:`PLOTS`, for the state lanes and as events.

    ``colour`` (``#RRGGBB``) is the colour of all curves of the run.
    """

    def __init__(self, stream: RunStream, colour: str) -> None:
        self._stream, self._colour = stream, style.rgb(colour)
        self._touches = f"{self._path('contact_force')}/touches"
        self._log_styles()

    def _log_styles(self) -> None:
        """Log the colours, widths and names of curves, marks and states, without a time."""
        static, name, colour = self._stream.static, self._stream.name, self._colour
        for entity, plot in PLOTS.items():
            k = len(plot.curves)
            # the peaks matter: no averaging of rows that share a pixel
            highest = rr.components.AggregationPolicy.Max
            lines = rr.SeriesLines(
                colors=[colour, style.light(colour), colour][:k],
                names=[f"{name} {curve}".strip() for curve in plot.curves],
                widths=[1.8, 1.8, 0.8][:k],
                aggregation_policy=highest if entity == "contact_force" else None,
            )
            static(self._path(entity), lines)
        look = {"colors": colour, "markers": "circle", "marker_sizes": 3.5}
        static(self._touches, rr.SeriesPoints(names=f"{name} touches", **look))  # type: ignore[arg-type]
        for lane, colours_of in (("phase", style.PHASES), ("verdict", style.STATES)):
            words = list(colours_of)
            colours = [style.rgb(colour) for colour in colours_of.values()]
            shown = rr.StateConfiguration(values=words, labels=words, colors=colours)
            static(f"states/{name}/{lane}", shown)

    def curves(self, samples: np.ndarray, *, force: bool = True) -> None:
        """Log the curves of all diagrams from samples (n,) of dtype SAMPLE.

        Values that are not finite, i.e. were not measured, are left out.  ``force``: False leaves
        out the contact force, for a caller that logs it with :meth:`touches`.
        """
        for entity, plot in PLOTS.items():
            if force or plot.quantity is not FORCE:
                self._curve(entity, samples["t"], plot.quantity.of(samples))

    def _curve(self, entity: str, t: np.ndarray, values: np.ndarray) -> None:
        finite = np.isfinite(values if values.ndim == 1 else values.sum(axis=1))
        if finite.any():
            self._stream.scalars(self._path(entity), t[finite], values[finite])

    def touches(self, plotted: PlottedRun) -> None:
        """Log the contact force with the peaks of all touches, and a mark at each peak.

        Most touches are shorter than a sample period, so samples alone would miss their peaks.
        """
        self._curve("contact_force", *plotted.curve(FORCE))
        touches = plotted.run.touches
        ordered = touches[np.argsort(touches["peak_time"], kind="stable")]
        self.mark_touches(ordered["peak_time"], ordered["peak_force"])

    def mark_touches(self, t: np.ndarray, force: np.ndarray) -> None:
        """Log a mark at the peak of each touch.

        ``t``: times of the peaks, (n,), s since the release.  ``force``: peak forces, (n,), N.
        """
        self._stream.scalars(self._touches, t, force)

    def states(self, lane: str, t: np.ndarray, states: list[str]) -> None:
        """Log the states of the run's lane ``phase`` or ``verdict``.

        Each state lasts from its time in ``t``, (n,), s since the release, to the next one's.
        """
        self._stream.columns(f"states/{self._stream.name}/{lane}", t, rr.StateChange, state=states)

    def events(self, run: Run) -> None:
        """Log all events of the run as lines of text."""
        texts = [event_text(event.kind.label, event.detail) for event in run.events]
        self.note(np.array([event.t for event in run.events]), texts)

    def note(self, t: np.ndarray, texts: list[str]) -> None:
        """Log lines of text at the times ``t``, (n,), s; each is prefixed with the run's name."""
        name = self._stream.name
        lines = [f"{name}: {text}" for text in texts]
        level = ["INFO"] * len(texts)
        self._stream.columns(f"events/{name}", t, rr.TextLog, text=lines, level=level)

    def _path(self, plot: str) -> str:
        return f"plots/{plot}/{self._stream.name}"


def event_text(kind: str, detail: str) -> str:
    """Return the line of text for an event: its kind, and its detail unless that is empty."""
    return f"{kind}, {detail}" if detail else kind


def phases(run: Run, samples: np.ndarray) -> tuple[np.ndarray, list[str]]:
    """Return the times at which a phase begins, (n,), s since the release, and the phases' names.

    Contact begins at the located start of a touch and ends at its located end, not at a sample.
    Any other phase begins at the first sample that has it, or at the end of a touch.
    """
    t, phase = samples["t"], samples["phase"].astype(int)
    phase[phase == Phase.CONTACT] = Phase.FREE
    touches, last = every_touch(run), run.samples[-1]
    # a touch in progress at the last sample has not ended there
    is_ended = (touches["end"] < last["t"]) | (last["walls"] == 0)
    starts, ends = np.sort(touches["start"]), np.sort(touches["end"][is_ended])
    times = np.unique(np.concatenate([t[np.diff(phase, prepend=-1) != 0], starts, ends]))
    # of the walls together
    touching = np.searchsorted(starts, times, "right") > np.searchsorted(ends, times, "right")
    sampled = phase[np.maximum(np.searchsorted(t, times, "right") - 1, 0)]
    phases_at = np.where(touching, Phase.CONTACT, sampled)
    begins = np.diff(phases_at, prepend=-1) != 0
    return times[begins], [Phase(number).label for number in phases_at[begins].tolist()]


def verdicts(run: Run) -> tuple[np.ndarray, list[str]]:
    """Return when each state of the detector begins, (n,), s since the release, and its name.

    Both are empty if the detector has given no status.
    """
    firsts = [next(same) for _, same in groupby(run.statuses, key=lambda status: status.state)]
    return np.array([status.t for status in firsts]), [status.state.label for status in firsts]
