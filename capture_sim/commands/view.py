"""``capture-sim view``."""

from __future__ import annotations

import argparse
import dataclasses
from pathlib import Path

from capture_sim.commands.arguments import OK, add_release, prepare_folder
from capture_sim.commands.opening import Opened, open_runs
from capture_sim.commands.showing import draw, say
from capture_sim.errors import RecordingError

HELP = "draw recorded runs"
DESCRIPTION = (
    "Draw recorded runs: a picture of each, all side by side, and a recording for rerun. "
    "Experiments given by name are run first."
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments."""
    parser.add_argument(
        "runs", nargs="+", metavar="RUN", help="recorded .mcap files, bags' folders, or names"
    )
    parser.add_argument(
        "--out", type=Path, default=Path(), help="folder of the pictures (default: .)"
    )
    parser.add_argument(
        "--save", type=Path, metavar="FILE.rrd", help="rerun file (default: OUT/runs.rrd)"
    )
    parser.add_argument(
        "--figures",
        action="store_true",
        help="also the paper's figures, the runs overlaid, as SVG and PNG in OUT/figures",
    )
    parser.add_argument(
        "--window",
        nargs=2,
        type=float,
        metavar=("FROM", "TO"),
        help="only this time, s since the release, as fine as the integrator went",
    )
    parser.add_argument(
        "--scene",
        metavar="EXPERIMENT",
        help="whose geometry a bench has whose recording does not say it",
    )
    add_release(parser)


def run(options: argparse.Namespace) -> int:
    """Do it; return the exit status."""
    window = None if options.window is None else (options.window[0], options.window[1])
    if window is not None and not window[0] < window[1]:
        raise RecordingError(f"--window {window[0]:g} {window[1]:g} s: allowed is FROM < TO")
    prepare_folder(options.out)
    opened = open_runs(options.runs, options.scene, options.release)
    if window is not None:
        opened = [_seen_closely(one, window) for one in opened]
    runs = [one.run for one in opened]
    labels = [one.label for one in opened]
    draw(runs, labels, options.out, options.save, pictures=window is None)
    if options.figures:
        _draw_figures(runs, labels, options.out / "figures", window)
    return OK


def _seen_closely(one: Opened, window: tuple[float, float]) -> Opened:
    from capture_sim.viewing.resolving import cut, resolved

    cut_or_resolved = cut if one.measured else resolved
    return dataclasses.replace(one, run=cut_or_resolved(one.run, window))


def _draw_figures(
    runs: list, labels: list[str], folder: Path, window: tuple[float, float] | None
) -> None:
    from capture_sim.viewing.canvas import save_both
    from capture_sim.viewing.figures import FIGURES, OVER_TIME
    from capture_sim.viewing.resolving import resolved_or_not
    from capture_sim.viewing.snapshots import snapshots

    if window is None:
        # else they are already
        runs = [resolved_or_not(run) for run in runs]
    for name, figure in FIGURES.items():
        aligned = {"aligned": True} if name in OVER_TIME and len(runs) > 1 else {}
        save_both(figure(runs, labels=labels, **aligned), folder / name)
    if window is None:
        save_both(snapshots(runs, labels=labels), folder / "snapshots")
    say(f"figures of the paper in {folder}")
