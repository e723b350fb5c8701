"""Logging of one run to a rerun recording, under the run's name and on two timelines.

The timeline ``sim_time`` has the whole run, in s since the release.  The timeline
``since_first_touch`` counts from each run's first touch, so that several runs are overlaid, and has
only the time around the contact.  A viewer opens a timeline at its beginning, so a recording with
``since_first_touch`` opens shortly before the first touch.
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

#: The timeline ``since_first_touch`` begins this long before the first touch, s.
LEAD = 0.1
#: It ends this long after the last touch or the verdict, whichever is later, s.
_TRAIL = 0.15


class Span(NamedTuple):
    """The part of a run on the timeline ``since_first_touch``: first touch, begin and end.

    All three are in s since the release; the timeline is zero at ``touch``.
    """

    touch: float
    begin: float
    end: float


def aligned_span(run: Run, samples: np.ndarray) -> Span | None:
    """Return the part of a run around its contact, for the timeline ``since_first_touch``.

    It is from :data:`LEAD` before the first touch to 0.15 s after the last touch or the verdict,
    whichever is later.  ``samples``: the samples that are drawn, (n,) of dtype SAMPLE, perhaps only
    those of a window.  The part is cut to their time, so that a viewer opens at the first of them,
    and events outside do not widen the axes.  The result is None if the run has no touch, or if no
    sample lies in this time.
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
    """Logs one run to a rerun recording, under paths that contain its name.

    All data with a time are on the timeline ``sim_time``; data within ``span`` are also on
    ``since_first_touch``.  With ``span`` None, no data are on that second timeline.
    """

    def __init__(self, recording: rr.RecordingStream, name: str, span: Span | None = None) -> None:
        self.name = name
        self._recording = recording
        self._span = span

    def static(self, path: str, *archetypes: rr.AsComponents) -> None:
        """Log data without a time; ``path`` is the full path in the recording."""
        self._recording.log(path, *archetypes, static=True)

    def columns(
        self, path: str, t: np.ndarray, archetype: Any, **values: Sequence | np.ndarray
    ) -> None:
        """Log values over time, under the full path ``path`` in the recording.

        ``t``: ascending times, (n,), s since the release.  ``archetype``: class of rerun.
        ``values``: fields of that class by name, each with n rows.
        """
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
        """Log one curve, (n,), or k curves, (n, k), under one path; ``t``: times, (n,), s."""
        self.columns(path, t, rr.Scalars, scalars=values)

    def scene(self, title: str, scene: Scene) -> None:
        """Log the scene's YAML under a title, as a Markdown text without a time."""
        text = f"# {title}\n\n```yaml\n{scene.to_yaml()}\n```\n"
        document = rr.TextDocument(text, media_type=rr.MediaType.MARKDOWN)
        self.static(f"{self.name}/scene", document)

    def property(self, **values: Any) -> None:
        """Log properties of the run by name: single values that the viewer lists."""
        self._recording.send_property(self.name, rr.AnyValues(**values))
