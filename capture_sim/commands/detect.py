"""``capture-sim detect``: evaluate a recorded run again with the capture detector."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import fields

from capture_sim.base.exit_status import FAILED, OK
from capture_sim.commands.inputs import add_geometry, add_remaps, open_run
from capture_sim.commands.output import echo
from capture_sim.detection.criteria import CaptureStatus
from capture_sim.detection.nearest import in_words
from capture_sim.errors import SceneError, one_line
from capture_sim.recording.trial_check import VERDICT_TOLERANCE
from capture_sim.run.bounds import contact_text
from capture_sim.run.run import detect
from capture_sim.run.verdict import TICK, with_criteria
from capture_sim.scene.parts import Detector

DESCRIPTION = (
    "Evaluate a recorded run again, from its poses and the state of the buffer. The criteria are "
    "the recorded ones (capture/criteria), or the scene's if the recording contains none; "
    "--set changes them. Times are in s since the release."
)
FAILS = "with unchanged criteria, the verdict differs from the recorded one"
EXAMPLE = "  capture-sim detect runs/tilt_0.mcap --set detector.capture_radius=0.004"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments."""
    parser.add_argument("recording", metavar="RUN.mcap", help="file, or folder of a bag")
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


def run(options: argparse.Namespace) -> int:
    """Run the command and return its exit status."""
    changed = _limits_changed(options.overrides)
    recorded = open_run(
        options.recording,
        options.remaps,
        scene=options.scene,
        overrides=options.overrides,
        waived=options.waived,
    )
    scene = recorded.scene
    judged_by = with_criteria(scene, recorded.given.criteria, changed)
    for limit in fields(Detector):
        name, unit = limit.name, limit.metadata["unit"]
        value, of_scene = (getattr(by.detector, name) for by in (judged_by, scene))
        if value != of_scene:
            echo(f"recorded criterion: {name} = {value:g} {unit} (scene: {of_scene:g} {unit})")
    statuses = detect(recorded, judged_by)
    is_simulated = recorded.given.live.is_simulated
    label = None
    for status in statuses:
        if status.label != label:
            since = _since(status)
            late = f", reported at {status.t:.3f} s" if status.time_in_state > TICK else ""
            echo(f"{since:10.3f} s  {status.label:9} {one_line(status.reason)}{late}")
            label = status.label
    verdict = statuses[-1]
    since = _since(verdict)
    echo(f"first contact {contact_text(recorded.first_contact, recorded.contact_bounds)}")
    nearest = in_words(verdict.nearest_distance, verdict.nearest_deviation)
    if recorded.given.extremes is not None and not verdict.nearest_deviation:
        # the detector sees samples; the run itself may have come nearer between them
        nearest = f"closest approach {recorded.loads['nearest_distance'] * 1e3:.3f} mm"
    early = f", {since - verdict.may_precede:.3f} s at the earliest" if verdict.may_precede else ""
    echo(
        f"verdict: {verdict.label} since {since:.3f} s{early}; {nearest}, "
        f"{len(statuses) - 1} measurements"
    )
    if verdict.not_used:
        echo(f"measurements not used: {one_line(verdict.not_used)}")
    if not recorded.given.statuses:
        return OK
    before = recorded.statuses[-1]
    since_before = _since(before)
    tolerance = TICK if is_simulated else VERDICT_TOLERANCE
    # the time of "undecided" is not compared: on a bench, detector and recorder begin and end at
    # different times, and the last messages of both differ if a recording was cut
    is_timed = verdict.state.is_verdict or (is_simulated and before.final)
    is_near = abs(since_before - since) < tolerance
    same = before.state is verdict.state and (is_near or not is_timed)
    echo(
        f"recorded: {before.label} since {since_before:.3f} s ({one_line(before.reason)})"
        + ("; the same" if same else "; DIFFERENT")
    )
    if same or changed or options.scene is not None:
        return OK
    if recorded.given.criteria is None:
        echo(
            "the recording contains no criteria, so the scene's criteria were used; criteria that "
            "were set on the node may explain the difference"
        )
    else:
        echo(
            "criteria did not change; the recording lacks some of the detector's input, or the "
            "detector has changed"
        )
    return FAILED


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
