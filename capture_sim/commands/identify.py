"""``capture-sim identify``: fit parameters of a scene to one recorded run."""

from __future__ import annotations

import argparse
import math
from functools import partial
from typing import Any

from capture_sim.base.exit_status import FAILED, OK
from capture_sim.base.tables import print_table
from capture_sim.commands.calibrate import print_starts
from capture_sim.commands.compiling import compile_first
from capture_sim.commands.inputs import (
    add_geometry,
    add_overrides,
    add_release,
    add_remaps,
    not_negative,
    open_run,
    whole,
)
from capture_sim.commands.output import Progress, echo, give
from capture_sim.run.loads import if_measured
from capture_sim.run.origin import Release
from capture_sim.scene.paths import ALIASES, get, paths_of
from capture_sim.studies.calibration.calibrate import TOUCH_NOISE
from capture_sim.studies.calibration.parameters import SENSOR_ERRORS
from capture_sim.studies.identify import RELEASE, Fit, identify, is_explained

DESCRIPTION = (
    "Fit parameters of the scene to one recorded or measured run: c_rr (rolling resistance of both "
    "vehicles), e, mu, c_A, any number of the scene, e.g. buffer.k_A, or an error of a sensor, "
    "e.g. delay.buffer. The fit uses poses, stroke and torsion up to the first launcher/hold after "
    "the release, and the first touches if they are recorded. The start poses are fitted as well, "
    "and the release if the recording does not contain it. Print the values with standard errors. "
    "For several trials of one bench, see capture-sim calibrate."
)
FAILS = "a test of the fit fails, with the reason, or the measurements do not depend on a parameter"
GIVES = "values, errors and tests"
EXAMPLE = "  capture-sim identify measured.mcap c_rr e mu c_A --scene tilt_0"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments."""
    parser.add_argument("recording", metavar="RUN.mcap", help="file, or folder of a bag")
    add_remaps(parser)
    parser.add_argument(
        "parameters",
        nargs="+",
        metavar="PARAMETER",
        help="c_rr, e, mu, c_A, or a field of the scene",
    )
    add_geometry(parser)
    parser.add_argument(
        "--until",
        type=not_negative,
        default=math.inf,
        metavar="S",
        help="use only measurements up to this time, s since the release (default: up to the first "
        "launcher/hold after the release, otherwise all)",
    )
    add_release(parser)
    parser.add_argument(
        "--fix-release",
        action="store_true",
        help="do not fit the release time; use if it is known to better than 0.1 ms",
    )
    parser.add_argument(
        "--touches",
        type=whole(),
        default=4,
        metavar="N",
        help="fit the time and peak force of the first N touches; 0 for none (default: 4)",
    )
    parser.add_argument(
        "--touch-noise",
        nargs=2,
        type=not_negative,
        metavar=("S", "N"),
        help="set the standard deviations of a touch's time, s, and peak force, N (default: for "
        "touches found in a sampled force, 0.29 of its sample interval and its noise; for counted "
        "touches, 0.29 of the messages' interval and 2; otherwise 2e-4 2)",
    )
    parser.add_argument(
        "--starts",
        type=whole(),
        default=10,
        metavar="N",
        help="search at most N times: once, then from draws around the result (default: 10, of "
        "which five are made unless one of them finds a better place; 1 leaves out the tests)",
    )
    add_overrides(parser)


def run(options: argparse.Namespace) -> int:
    """Run the command and return its exit status."""
    recorded = open_run(
        options.recording,
        options.remaps,
        scene=options.scene,
        overrides=options.overrides,
        release=options.release,
        waived=options.waived,
    )
    scene = recorded.scene
    names = list(options.parameters)
    known = recorded.origin.release is Release.STAMP
    if not known and not options.fix_release and RELEASE not in names:
        names.append(RELEASE)
    compile_first()
    touches, source = None, ""
    if options.touches > 0:
        found, source = recorded.resolved_touches
        if found is not None:
            touches = found.of(slice(options.touches))
            if options.touch_noise is not None:
                touches = touches.with_noise(*options.touch_noise)
            touches = touches.with_default_noise(*TOUCH_NOISE)
    with Progress("simulations") as progress:
        fit = identify(
            scene,
            recorded,
            names,
            touches=touches,
            until=options.until,
            starts=options.starts,
            report=partial(progress.at, "identify"),
        )
    # a release that is not recorded counts from the first pose, as --release does
    given = 0.0 if known else recorded.origin.after_first_pose
    rows = []
    for name, value, error in zip(fit.names, fit.values, fit.errors, strict=True):
        notes = ["at the limit of its range"] if name in fit.at_bound else []
        if name == RELEASE:
            began, value = given, value + given
            notes.append(f"s after the {'recorded release' if known else 'first pose'}")
        elif name in SENSOR_ERRORS:
            began = SENSOR_ERRORS[name].value
        else:
            began = float(get(scene, paths_of(scene, name)[0]))
        share = f"{error / abs(value):.2%}" if value else "-"
        row = [name, f"{value:.6g}", f"{error:.2g}", share, f"{began:.6g}", ", ".join(notes)]
        rows.append(row)
    give(_as_data(fit))
    print_table(["parameter", "value", "+-", "%", "start", ""], rows)
    for i, first in enumerate(fit.names):
        for j, second in enumerate(fit.names[:i]):
            if abs(fit.correlation[i, j]) > 0.9:
                echo(f"{second} and {first} are hard to separate: {fit.correlation[i, j]:+.2f}")
    print_starts(fit.calibration)
    assert fit.calibration.problem is not None
    frame = fit.calibration.problem.trials[0].frame
    if frame.is_far:
        echo(f"the frame of the poses is {frame.text} against the scene's: taken out")
    echo(
        f"chi2 {fit.chi2:.3g} per degree of freedom (1: residuals at the noise floor), "
        f"{fit.touches} touches, {fit.evaluations} simulations"
    )
    if fit.touches:
        echo(f"touches from {source}")
    elif options.touches > 0:
        echo("no touches: the recording has no events and no force sampled fast enough")
    changes = [
        f"--set {path}={value:.9g}"
        for name, value in zip(fit.names, fit.values, strict=True)
        if name != RELEASE and name not in SENSOR_ERRORS
        for path in ALIASES.get(name, (name,))
    ]
    echo(" ".join(changes))
    for name in fit.undetermined:
        echo(f"{name}: the measurements do not depend on it; the value is the start value")
    for finding in fit.findings:
        echo(f"not found: {finding.line}")
    if not is_explained(fit):
        echo(
            "the model does not explain the measurements: the standard errors are scaled by "
            f"{fit.chi2**0.5:.3g} and may still be too small"
        )
        return FAILED
    return FAILED if fit.undetermined or fit.findings else OK


def _as_data(fit: Fit) -> dict[str, Any]:
    """Return the values of a fit in SI units, and its tests, as data for JSON."""
    return {
        "parameters": {
            name: {"value": value, "error": if_measured(error)}
            for name, value, error in zip(
                fit.names, fit.values.tolist(), fit.errors.tolist(), strict=True
            )
        },
        "correlation": fit.correlation,
        "chi2": fit.chi2,
        "touches": fit.touches,
        "at_bound": list(fit.at_bound),
        "undetermined": list(fit.undetermined),
        "findings": [finding.line for finding in fit.findings],
        "is_explained": is_explained(fit),
    }
