"""``capture-sim detect``: evaluate a recorded run again with the capture detector."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import fields
from pathlib import Path
from typing import NamedTuple

from capture_sim.base.exit_status import BAD_INPUT, FAILED, OK
from capture_sim.commands.inputs import add_geometry, add_remaps, prepare_folder
from capture_sim.commands.output import echo, give, warn
from capture_sim.commands.recordings import RecordingReader
from capture_sim.commands.results_folder import ResultsFolder
from capture_sim.detection.criteria import CaptureStatus
from capture_sim.detection.nearest import in_words
from capture_sim.errors import CaptureSimError, SceneError, one_line
from capture_sim.recording.results_table import Recorded
from capture_sim.recording.trial_check import VERDICT_TOLERANCE
from capture_sim.run.bounds import contact_text
from capture_sim.run.run import Run, detect
from capture_sim.run.verdict import TICK, with_criteria
from capture_sim.scene.parts import Detector, Scene

DESCRIPTION = (
    "Evaluate recorded runs again, from their poses and the state of the buffer, e.g. the trials "
    "of a day as one table. The criteria are the recorded ones (capture/criteria), or the scene's "
    "if the recording has none; --set changes them. Times are in s since the release."
)
FAILS = "with unchanged criteria, the verdict differs from the recorded one"
GIVES = "the results, a list with all recordings,"
EXAMPLE = "  capture-sim detect runs/tilt_0.mcap --set detector.capture_radius=0.004"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments."""
    parser.add_argument("recordings", nargs="+", metavar="RUN", help="files, or folders of bags")
    add_remaps(parser)
    add_geometry(parser)
    parser.add_argument(
        "--set",
        action="append",
        default=[],
        dest="overrides",
        metavar="detector.FIELD=VALUE",
        help="change a criterion of the detector, in SI units; may be repeated",
    )
    parser.add_argument(
        "--out",
        type=Path,
        metavar="DIR",
        help="add the runs to the tables results.json and results.txt in this folder, e.g. that of "
        "the recordings",
    )


def run(options: argparse.Namespace) -> int:
    """Run the command and return its exit status."""
    changed = _limits_changed(options.overrides)
    several, status = len(options.recordings) > 1, OK
    judged: list[_Judged] = []
    table = None
    if options.out is not None:
        prepare_folder(options.out)
        table = ResultsFolder(options.out)
    for path in options.recordings:
        try:
            found = _judged(path, changed, options)
        except CaptureSimError as error:
            if not several:
                raise
            warn(one_line(str(error)))  # the others count all the same
            status = BAD_INPUT
            continue
        judged.append(found)
        if several:
            echo(f"{path}:")
        _print(found)
        if found.same is False and not changed and options.scene is None:
            status = status or FAILED
            echo(_why_different(found))
    give(lambda: [_as_data(found) for found in judged])
    if table is not None:
        folder = options.out.resolve()
        table.add(
            [
                Recorded(found.run, path if path.parent == folder else None)
                for found in judged
                for path in [Path(found.path).resolve()]
            ]
        )
    return status


class _Judged(NamedTuple):
    """A recording evaluated again."""

    path: str
    run: Run  # with the statuses of now
    scene: Scene  # with the criteria
    recorded: CaptureStatus | None  # last status of the detector that took part
    same: bool | None  # whether the verdict is the recorded one; None: none is recorded


def _judged(path: str, changed: set[str], options: argparse.Namespace) -> _Judged:
    """Read and evaluate a recording; the criteria are the recorded ones, less ``changed``."""
    run = RecordingReader.of(options).run(path)
    scene = with_criteria(run.scene, run.given.criteria, changed)
    statuses = detect(run, scene)
    recorded = run.statuses[-1] if run.given.statuses else None
    same = None
    if recorded is not None:
        same = _is_same(recorded, statuses[-1], run.given.live.is_simulated)
    return _Judged(path, run.replaced(statuses=tuple(statuses)), scene, recorded, same)


def _is_same(before: CaptureStatus, verdict: CaptureStatus, is_simulated: bool) -> bool:
    tolerance = TICK if is_simulated else VERDICT_TOLERANCE
    # the time of "undecided" is not compared: on a bench, detector and recorder begin and end at
    # different times, and the last messages of both differ if a recording was cut
    is_timed = verdict.state.is_verdict or (is_simulated and before.final)
    is_near = abs(_since(before) - _since(verdict)) < tolerance
    return before.state is verdict.state and (is_near or not is_timed)


def _as_data(found: _Judged) -> dict[str, object]:
    """Return the results of a recording as for results.json, and the recorded verdict."""
    recorded = found.recorded
    return {
        **found.run.summary,
        "recording": found.path,
        "recorded_verdict": None if recorded is None else recorded.label,
        "recorded_verdict_time": None if recorded is None else _since(recorded),
        "same_as_recorded": found.same,
    }


def _print(found: _Judged) -> None:
    run, statuses = found.run, found.run.statuses
    for limit in fields(Detector):
        name, unit = limit.name, limit.metadata["unit"]
        value, of_scene = (getattr(by.detector, name) for by in (found.scene, run.scene))
        if value != of_scene:
            echo(f"recorded criterion: {name} = {value:g} {unit} (scene: {of_scene:g} {unit})")
    label = None
    for status in statuses:
        if status.label != label:
            late = f", reported at {status.t:.3f} s" if status.time_in_state > TICK else ""
            echo(f"{_since(status):10.3f} s  {status.label:9} {one_line(status.reason)}{late}")
            label = status.label
    verdict = statuses[-1]
    since = _since(verdict)
    echo(f"first contact {contact_text(run.first_contact, run.contact_bounds)}")
    nearest = in_words(verdict.nearest_distance, verdict.nearest_deviation)
    if run.given.extremes is not None and not verdict.nearest_deviation:
        # the detector sees samples; the run itself may have come nearer between them
        nearest = f"closest approach {run.loads['nearest_distance'] * 1e3:.3f} mm"
    early = f", {since - verdict.may_precede:.3f} s at the earliest" if verdict.may_precede else ""
    echo(
        f"verdict: {verdict.label} since {since:.3f} s{early}; {nearest}, "
        f"{len(statuses) - 1} measurements"
    )
    if verdict.not_used:
        echo(f"measurements not used: {one_line(verdict.not_used)}")
    if found.recorded is None:
        return
    echo(
        f"recorded: {found.recorded.label} since {_since(found.recorded):.3f} s "
        f"({one_line(found.recorded.reason)})" + ("; the same" if found.same else "; DIFFERENT")
    )


def _why_different(found: _Judged) -> str:
    """Return what may explain that a verdict is not the recorded one."""
    if found.run.given.criteria is None:
        return (
            "the recording contains no criteria, so the scene's criteria were used; criteria that "
            "were set on the node may explain the difference"
        )
    return (
        "criteria did not change; the recording lacks some of the detector's input, or the "
        "detector has changed"
    )


def _since(status: CaptureStatus) -> float:
    """Return the time at which the state of a status began, s since the release."""
    return status.t - status.time_in_state


def _limits_changed(overrides: Sequence[str]) -> set[str]:
    """Return the names of the detector's criteria that ``--set`` changes.

    Raises
    ------
    SceneError
        An override changes a field of the scene that is not a criterion of the detector.
    """
    allowed = [f.name for f in fields(Detector)]
    changed = set()
    for override in overrides:
        path, _, _ = override.partition("=")
        part, _, name = path.strip().partition(".")
        if part != "detector" or name not in allowed:
            raise SceneError(
                f"--set {override}: must be one of "
                + ", ".join(f"detector.{name}" for name in allowed)
            )
        changed.add(name)
    return changed
