"""Export of runs to one rerun recording (``.rrd``) that also contains the viewer's layout.

``rerun runs.rrd`` opens it, paused shortly before the first touch (if no run has a touch, at the
first sample).  It shows the bench of each run in 3D, a close-up of the tip in the cone, and the
curves of all runs in common diagrams.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import rerun as rr

from capture_sim.base.files import whole_file
from capture_sim.errors import RecordingError
from capture_sim.run.first_contact import impact_speed
from capture_sim.run.run import Run
from capture_sim.scene.parts import as_name
from capture_sim.viewing import style
from capture_sim.viewing.curves import PlottedRun, Window, has_ledger, plotted_runs
from capture_sim.viewing.rerun_bench import BenchLog
from capture_sim.viewing.rerun_layout import blueprint
from capture_sim.viewing.rerun_plots import PLOTS, PlotLog, phases, verdicts
from capture_sim.viewing.rerun_stream import RunStream, Span, aligned_span
from capture_sim.viewing.source import (
    distinct_names,
    headline,
    verdict,
)


def save_rrd(
    runs: Sequence[Run],
    path: Path | str,
    labels: Sequence[str] | None = None,
    window: Window | None = None,
) -> Path:
    """Save runs as one rerun recording; return its path.

    ``labels`` are the runs' names; None takes the names of their scenes.  Equal names are numbered.
    ``window`` is the start and end of the time to save, s since the release; None saves all of it.
    Data are saved at the runs' samples, see :func:`capture_sim.viewing.source.resolved`.

    Raises
    ------
    RecordingError
        The file cannot be written.
    CaptureSimError
        A run has no sample in the window.
    ValueError
        There is no run, or the number of labels is not the number of runs.
    """
    path, plotted = Path(path), plotted_runs(runs, labels, window=window)
    # a file's name may be none that a path in the viewer can have
    names = distinct_names([as_name(each.label) for each in plotted])
    titles = [headline(each.run, each.label).replace("\n", " ") for each in plotted]
    spans = [aligned_span(each.run, each.samples) for each in plotted]
    layout = blueprint(
        [each.scene for each in plotted],
        names,
        titles,
        aligned=any(span is not None for span in spans),
        span=_common_span([span for span in spans if span is not None]),
        ranges=_ranges(plotted, spans),
        energies=any(has_ledger(run) for run in runs),
    )
    recording = rr.RecordingStream("capture_sim", recording_id=None)
    # written here: rerun writes in the background, and waits for ever if the disk is full
    memory = recording.memory_recording()
    recording.send_blueprint(layout, make_active=False)
    for plotted_run, name, span, title in zip(plotted, names, spans, titles, strict=True):
        _log_run(RunStream(recording, name, span), plotted_run, title)
    _log_limits(recording, plotted)
    try:
        with whole_file(path) as part:
            part.write_bytes(memory.drain_as_bytes())
    except OSError as error:
        raise RecordingError(f"{path}: cannot write: {error.strerror or error}") from None
    return path


def _common_span(spans: Sequence[Span]) -> Window | None:
    """Return the earliest begin and the latest end, s since each run's first touch.

    The result is None if ``spans`` is empty.
    """
    if not spans:
        return None
    return min(s.begin - s.touch for s in spans), max(s.end - s.touch for s in spans)


def _ranges(plotted: Sequence[PlottedRun], spans: Sequence[Span | None]) -> dict[str, Window]:
    """Return the least and greatest value of each diagram, by its key in :data:`PLOTS`.

    Only the runs' samples within their spans count.  A diagram without finite values is absent.
    """
    parts = []
    for each, span in zip(plotted, spans, strict=True):
        if span is not None:
            t = each.samples["t"]
            parts.append(each.samples[(t >= span.begin) & (t <= span.end)])
    ranges = {}
    for entity, plot in PLOTS.items():
        values = np.concatenate([plot.quantity.of(part).ravel() for part in parts] or [np.zeros(0)])
        values = values[np.isfinite(values)]
        if values.size:
            ranges[entity] = float(values.min()), float(values.max())
    return ranges


def _log_run(stream: RunStream, plotted_run: PlottedRun, title: str) -> None:
    run, scene, samples = plotted_run.run, plotted_run.scene, plotted_run.samples
    bench = BenchLog(stream, scene, plotted_run.colour)
    bench.motion(samples, plotted_run.touching)
    bench.trail(samples, plotted_run.touching)
    plots = PlotLog(stream, plotted_run.colour)
    plots.curves(samples, force=False)
    plots.touches(plotted_run)
    plots.states("phase", *phases(run, samples))
    plots.states("verdict", *verdicts(run))
    plots.events(run)
    stream.scene(title, scene)
    stream.property(
        title=scene.title,
        verdict=verdict(run),
        impact_speed=impact_speed(run.events),
        scene=scene.to_yaml(),
    )


def _log_limits(recording: rr.RecordingStream, plotted: Sequence[PlottedRun]) -> None:
    """Log the radius of the capture zone and the buffer's stops as horizontal lines.

    A diagram has such lines only if they are the same for all runs.
    """
    # as long as the longest run on either timeline
    longest = max(plotted, key=lambda each: float(each.samples["t"][-1]))
    stream = RunStream(recording, "", aligned_span(longest.run, longest.samples))
    times = longest.samples["t"][:: max(len(longest.samples) // 500, 1)]
    for entity, plot in PLOTS.items():
        limits, *others = {plot.quantity.limits(each.scene) for each in plotted}
        for name, value, colour in limits if not others else ():
            path = f"plots/{entity}/{name.replace(', ', '_').replace(' ', '_')}"
            stream.static(path, rr.SeriesLines(colors=style.rgb(colour), names=name, widths=1.2))
            stream.scalars(path, times, np.full(len(times), value))
