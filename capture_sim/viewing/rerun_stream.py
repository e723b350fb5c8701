"""Where a run is logged in a rerun recording: its prefix and its timelines.

Two timelines: ``sim_time`` holds the whole run; ``since_first_touch`` counts from each run's
first touch, so that runs lie over each other, and holds only what happens around the contact.
A viewer opens a timeline at its beginning: the second one makes it open shortly before the
touch.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import rerun as rr

from capture_sim.viewing.source import ViewableRun, contacts, decided_at, first_touch

SIM_TIME = "sim_time"
ALIGNED = "since_first_touch"

#: The aligned timeline begins this long before the first touch, s.
LEAD = 0.1
#: ... and ends this long after the last touch or the verdict, s.
_TRAIL = 0.15


class Span(NamedTuple):
    """What the aligned timeline holds of a run: from when to when, and its zero; s."""

    touch: float
    begin: float
    end: float


def aligned_span(run: ViewableRun) -> Span | None:
    """Return the span of a run's contact; None for a run without samples of one.

    Of a run that is cut to a window, it is no longer than the window: a viewer opens at the
    first sample, and what happened outside does not widen the axes.
    """
    touch, t = first_touch(run), run.samples["t"]
    if touch is None or t[-1] < touch.t - LEAD:
        return None
    last = max((end for _, end in contacts(run)), default=touch.t)
    decided = decided_at(run)
    end = max(last, touch.t if decided is None else decided) + _TRAIL
    if t[0] > end:
        return None
    return Span(touch.t, max(touch.t - LEAD, float(t[0])), min(end, float(t[-1])))


class RunStream:
    """Logs one run.

    Parameters
    ----------
    recording
        Of rerun.
    name
        The run's prefix.
    span
        What of it goes on the aligned timeline; None for nothing.
    """

    def __init__(self, recording: rr.RecordingStream, name: str, span: Span | None = None) -> None:
        self.name = name
        self._recording = recording
        self._span = span

    def static(self, path: str, *archetypes: rr.AsComponents) -> None:
        """Log what holds at all times, under the full path of an entity."""
        self._recording.log(path, *archetypes, static=True)

    def columns(
        self, path: str, t: np.ndarray, archetype: Any, **values: Sequence | np.ndarray
    ) -> None:
        """Log values over time, under the full path of an entity.

        Parameters
        ----------
        path
            Of the entity.
        t
            (n,) ascending, s since the start.
        archetype
            A class of rerun with a ``columns`` method.
        values
            (n, ...) each, its arguments.
        """
        first = last = 0
        if self._span is not None:
            # with the sample before, so that something is there from the beginning on
            first = max(int(np.searchsorted(t, self._span.begin, side="right")) - 1, 0)
            last = max(int(np.searchsorted(t, self._span.end, side="right")), first)
        self._send(path, t, slice(0, first), archetype, values, None)
        self._send(path, t, slice(first, last), archetype, values, self._span)
        self._send(path, t, slice(last, len(t)), archetype, values, None)

    def _send(
        self, path: str, t: np.ndarray, rows: slice, archetype: Any, values: dict, span: Span | None
    ) -> None:
        t = t[rows]
        if len(t) == 0:
            return
        indexes = [rr.TimeColumn(SIM_TIME, duration=t)]
        if span is not None:
            indexes.append(rr.TimeColumn(ALIGNED, duration=np.maximum(t, span.begin) - span.touch))
        columns = archetype.columns(**{name: value[rows] for name, value in values.items()})
        self._recording.send_columns(path, indexes=indexes, columns=columns)

    def scalars(self, path: str, t: np.ndarray, values: np.ndarray) -> None:
        """Log one curve (n,), or several of one entity (n, k)."""
        if values.ndim == 1:
            self.columns(path, t, rr.Scalars, scalars=values)
        else:
            self.columns(path, t, _Rows(values.shape[1]), scalars=values)

    def document(self, path: str, text: str) -> None:
        """Log a text in Markdown."""
        self.static(path, rr.TextDocument(text, media_type=rr.MediaType.MARKDOWN))

    def property(self, **values: Any) -> None:
        """Log properties of the run."""
        self._recording.send_property(self.name, rr.AnyValues(**values))


class _Rows:
    """Several scalars a row, as rerun wants them."""

    def __init__(self, width: int) -> None:
        self._width = width

    def columns(self, scalars: np.ndarray) -> rr.ComponentColumnList:
        """Return the rows (n, width) as columns."""
        flat = rr.Scalars.columns(scalars=scalars.ravel())
        return flat.partition(np.full(len(scalars), self._width))
