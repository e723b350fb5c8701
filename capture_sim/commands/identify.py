"""``capture-sim identify``."""

from __future__ import annotations

import argparse
import math

from capture_sim.commands import FAILED, OK
from capture_sim.commands.compiling import compile_first
from capture_sim.commands.inputs import (
    add_geometry,
    add_overrides,
    add_release,
    add_remaps,
    not_negative,
    open_run,
    scene_of,
    whole,
)
from capture_sim.commands.output import echo, print_table
from capture_sim.recording.measured import (
    launch_of,
    measurements,
    release_of,
    release_recorded,
    touches_of,
)
from capture_sim.scene.paths import ALIASES, value_of
from capture_sim.studies.identify import RELEASE, identify, is_explained

DESCRIPTION = (
    "Fit parameters of the scene to a recorded or measured run: c_rr (rolling resistance of both "
    "vehicles), e, mu, c_A, or any number of the scene as buffer.k_A. Poses, stroke and torsion "
    "are fitted, and the first touches where they were recorded. Where the recording does not show "
    "when the chaser was released, that is fitted as well, beginning at --release. Prints values "
    "with standard errors. Exit status 1 when the model does not explain what was measured, or a "
    "parameter does not show in it."
)
EXAMPLE = "  capture-sim identify measured.mcap c_rr e mu c_A --scene tilt_0"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments."""
    parser.add_argument("recording", metavar="RUN.mcap")
    add_remaps(parser)
    parser.add_argument("parameters", nargs="+", metavar="PARAMETER")
    add_geometry(parser)
    parser.add_argument(
        "--until",
        type=not_negative,
        default=math.inf,
        metavar="S",
        help="leave out what was measured later",
    )
    add_release(parser)
    parser.add_argument(
        "--fix-release",
        action="store_true",
        help="do not fit when the chaser was released: it is known to better than 0.1 ms",
    )
    parser.add_argument(
        "--touches",
        type=whole(),
        default=4,
        metavar="N",
        help="touches that are fitted by time and peak force; 0 none (default: 4)",
    )
    parser.add_argument(
        "--touch-noise",
        nargs=2,
        type=not_negative,
        default=(2e-4, 2.0),
        metavar=("S", "N"),
        help="standard deviations of a touch's time and peak force (default: 2e-4 2)",
    )
    parser.add_argument(
        "--starts", type=whole(), default=10, metavar="N", help="searches at most (default: 10)"
    )
    add_overrides(parser)


def run(options: argparse.Namespace) -> int:
    """Do it; return the exit status."""
    recorded = open_run(options.recording, options.remaps)
    scene = scene_of(recorded, options.scene, options.overrides)
    measured = measurements(recorded, options.release)
    names = list(options.parameters)
    known = options.release is None and release_recorded(recorded) is not None
    if not known and not options.fix_release and RELEASE not in names:
        names.append(RELEASE)
    compile_first()
    touches, source = None, ""
    if options.touches > 0:
        found, source = touches_of(recorded, options.release, scene)
        if found is not None:
            touches = found.of(slice(options.touches)).with_noise(*options.touch_noise)
    fit = identify(
        scene,
        measured,
        names,
        plan=launch_of(recorded, scene),
        touches=touches,
        until=options.until,
        starts=options.starts,
    )
    # a release that is not recorded counts from the first pose, as --release does
    counted_from = release_of(recorded, None if known else 0.0)
    given = (release_of(recorded, options.release) - counted_from) / 1e9
    rows = []
    for name, value, error in zip(fit.names, fit.values, fit.errors, strict=True):
        notes = ["at the bound of its range"] if name in fit.at_bound else []
        if name == RELEASE:
            began, value = given, value + given
            notes.append(f"s after the {'recorded release' if known else 'first pose'}")
        else:
            began = value_of(scene, name)
        share = f"{error / abs(value):.2%}" if value else "-"
        row = [name, f"{value:.6g}", f"{error:.2g}", share, f"{began:.6g}", ", ".join(notes)]
        rows.append(row)
    print_table(["parameter", "value", "+-", "%", "began at", ""], rows)
    for i, first in enumerate(fit.names):
        for j, second in enumerate(fit.names[:i]):
            if abs(fit.correlation[i, j]) > 0.9:
                echo(f"{second} and {first} are hard to separate: {fit.correlation[i, j]:+.2f}")
    echo(
        f"chi2 {fit.chi2:.3g} for each degree of freedom (1: all but noise is explained), "
        f"{fit.touches} touches, {fit.evaluations} simulations"
    )
    if fit.touches:
        echo(f"touches are those of {source}")
    elif options.touches > 0:
        echo("no touches: neither events nor a force that is sampled fast enough")
    changes = [
        f"--set {path}={value:.9g}"
        for name, value in zip(fit.names, fit.values, strict=True)
        if name != RELEASE
        for path in ALIASES.get(name, (name,))
    ]
    echo(" ".join(changes))
    for name in fit.undetermined:
        echo(
            f"{name}: what was measured does not depend on it; the value is where the search began"
        )
    if not is_explained(fit):
        echo(
            "the model does not explain what was measured: the errors are widened by "
            f"{fit.chi2**0.5:.3g}, and may still be too small"
        )
        return FAILED
    return FAILED if fit.undetermined else OK
