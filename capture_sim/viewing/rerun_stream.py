"""A run's prefix and timelines in a rerun recording.

Two timelines: ``sim_time`` has the whole run; ``since_first_touch`` counts from each run's first
touch, so that runs are overlaid, and has only the time around the contact.  A viewer opens a
timeline at its beginning: the second one makes it open shortly before the touch.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import rerun as rr

from capture_sim.run.first_contact import first_touch
from capture_sim.run.run import Run
from capture_sim.scene.parts import Scene
from capture_sim.viewing.source import decided_at, every_touch

SIM_TIME = "sim_time"
ALIGNED = "since_first_touch"

#: The aligned timeline begins this long before the first touch, s.
LEAD = 0.1
#: ... and ends this long after the last touch or the verdict, s.
_TRAIL = 0.15


class Span(NamedTuple):
    """Begin and end of a run on the aligned timeline, and the touch that is its zero; s."""

    touch: float
    begin: float
    end: float


def aligned_span(run: Run, samples: np.ndarray) -> Span | None:
    """Return the span of a run's contact in its drawn samples; None if they have none of it.

    For a run that is cut to a window, it is within the window: a viewer opens at the first
    sample, and events outside do not widen the axes.
    """
    touch, t = first_touch(run.events), samples["t"]
    if touch is None or t[-1] < touch.t - LEAD:
        return None
    ends = every_touch(run)["end"].tolist()
    end = max(decided_at(run) or touch.t, *ends, touch.t) + _TRAIL
    if t[0] > end:
        return None
    return Span(touch.t, max(touch.t - LEAD, float(t[0])), min(end, float(t[-1])))


class RunStream:
    """Logs one run under its name, with ``span`` of it on the aligned timeline too."""

    def __init__(self, recording: rr.RecordingStream, name: str, span: Span | None = None) -> None:
        self.name = name
        self._recording = recording
        self._span = span

    def static(self, path: str, *archetypes: rr.AsComponents) -> None:
        """Log data without a time, under the full path of an entity."""
        self._recording.log(path, *archetypes, static=True)

    def columns(
        self, path: str, t: np.ndarray, archetype: Any, **values: Sequence | np.ndarray
    ) -> None:
        """Log values over time: the columns of an archetype, (n, ...) each, at t (n,), s."""
        span, first, last = self._span, 0, 0
        if span is not None:
            # with the sample before, so that there is data from the beginning on
            first = max(int(np.searchsorted(t, span.begin, side="right")) - 1, 0)
            last = max(int(np.searchsorted(t, span.end, side="right")), first)
        for rows in (slice(0, first), slice(first, last), slice(last, len(t))):
            if not t[rows].size:
                continue
            indexes = [rr.TimeColumn(SIM_TIME, duration=t[rows])]
            if span is not None and rows.start == first and rows.stop == last:
                since_touch = np.maximum(t[rows], span.begin) - span.touch
                indexes.append(rr.TimeColumn(ALIGNED, duration=since_touch))
            columns = archetype.columns(**{name: value[rows] for name, value in values.items()})
            self._recording.send_columns(path, indexes=indexes, columns=columns)

    def scalars(self, path: str, t: np.ndarray, values: np.ndarray) -> None:
        """Log one curve (n,), or several of one entity (n, k)."""
        self.columns(path, t, rr.Scalars, scalars=values)

    def scene(self, title: str, scene: Scene) -> None:
        """Log the scene under a title, as a text in Markdown."""
        text = f"# {title}\n\n```yaml\n{scene.to_yaml()}\n```\n"
        document = rr.TextDocument(text, media_type=rr.MediaType.MARKDOWN)
        self.static(f"{self.name}/scene", document)

    def property(self, **values: Any) -> None:
        """Log properties of the run."""
        self._recording.send_property(self.name, rr.AnyValues(**values))
