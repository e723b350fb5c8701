"""Runs side by side as one rerun recording with its layout inside.

``rerun runs.rrd`` then opens, paused shortly before the first touch, with the bench of every run
in 3D and a close-up of the tip in the cone, and beside them the runs' curves in common diagrams.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import rerun as rr

from capture_sim.errors import RecordingError
from capture_sim.files import whole_file
from capture_sim.results import impact_speed
from capture_sim.scene.parts import as_name
from capture_sim.viewing import style
from capture_sim.viewing.curves import has_ledger
from capture_sim.viewing.rerun_bench import BenchLog
from capture_sim.viewing.rerun_layout import blueprint
from capture_sim.viewing.rerun_plots import PlotLog, phases, verdicts
from capture_sim.viewing.rerun_stream import RunStream, aligned_span
from capture_sim.viewing.source import (
    ViewableRun,
    distinct_names,
    headline,
    in_contact,
    verdict,
)

_MM = 1e3


def save_rrd(
    runs: Sequence[ViewableRun], path: Path | str, labels: Sequence[str] | None = None
) -> Path:
    """Save at least one run as one rerun recording; return its path.

    ``labels`` names the runs; None takes the scenes' names, numbered where they are the same.

    Raises
    ------
    RecordingError
        The file cannot be written.
    """
    path = Path(path)
    if labels is None:
        labels = distinct_names([run.scene.name for run in runs])
    # a file may be called what no path in the viewer can be
    names = distinct_names([as_name(label) for label in labels])
    titles = [
        headline(run, label).replace("\n", " ") for run, label in zip(runs, labels, strict=True)
    ]
    spans = [aligned_span(run) for run in runs]
    layout = blueprint(
        [run.scene for run in runs],
        names,
        titles,
        aligned=any(span is not None for span in spans),
        length=max((span.end - span.begin for span in spans if span is not None), default=np.inf),
        energies=any(has_ledger(run) for run in runs),
    )
    recording = rr.RecordingStream("capture_sim", recording_id=None)
    # written by us: rerun writes in the background, and waits for ever for a disk that is full
    memory = recording.memory_recording()
    recording.send_blueprint(layout, make_active=False)
    for i, (run, name, span) in enumerate(zip(runs, names, spans, strict=True)):
        _log_run(RunStream(recording, name, span), run, titles[i], style.run_colour(i))
    _log_limits(recording, runs)
    try:
        with whole_file(path) as part:
            part.write_bytes(memory.drain_as_bytes())
    except OSError as error:
        raise RecordingError(f"{path}: cannot write: {error.strerror or error}") from None
    return path


def _log_run(stream: RunStream, run: ViewableRun, title: str, colour: str) -> None:
    touching = in_contact(run)
    bench = BenchLog(stream, run.scene, colour)
    bench.motion(run.samples, touching)
    bench.trail(run.samples, touching)
    plots = PlotLog(stream, colour)
    plots.curves(run.samples, force=False)
    plots.touches(run)
    plots.states("phase", *phases(run))
    plots.states("verdict", *verdicts(run))
    plots.events(run)
    stream.scene(title, run.scene)
    stream.property(
        title=run.scene.title,
        verdict=verdict(run),
        impact_speed=impact_speed(run.events),
        scene=run.scene.to_yaml(),
    )


def _log_limits(recording: rr.RecordingStream, runs: Sequence[ViewableRun]) -> None:
    """Log as level lines what the runs share: capture radius and stops."""
    limits: list[tuple[str, str, str, float]] = []
    if len(radii := {run.scene.detector.capture_radius for run in runs}) == 1:
        limits.append(("distance", "capture radius", style.ZONE, radii.pop()))
    stops = runs[0].scene.stops
    if stops is not None and {run.scene.stops for run in runs} == {stops}:
        limits.append(("axial_stroke", "stop, inwards", style.GREY, -stops.compression))
        limits.append(("axial_stroke", "stop, outwards", style.GREY, stops.extension))
    # as long as the longest run on either timeline
    longest = max(runs, key=lambda run: float(run.samples["t"][-1]))
    stream = RunStream(recording, "", aligned_span(longest))
    few = longest.samples["t"][:: max(len(longest.samples) // 500, 1)]
    for plot, name, colour, value in limits:
        path = f"plots/{plot}/{name.replace(', ', '_').replace(' ', '_')}"
        stream.static(path, rr.SeriesLines(colors=style.rgb(colour), names=name, widths=1.2))
        stream.scalars(path, few, np.full(len(few), value * _MM))
