"""``capture-sim compare``."""

from __future__ import annotations

import argparse
from pathlib import Path

from capture_sim.commands.arguments import OK, not_negative, prepare_folder
from capture_sim.commands.showing import say
from capture_sim.errors import RecordingError

HELP = "hold two recordings against each other, as measured and simulated"
DESCRIPTION = (
    "Hold two recordings against each other, as measured and simulated, aligned at their first "
    "contacts: differences of peak force, strokes and times, with a diagram."
)
_UNITS = {"x": ("mm", 1e3), "y": ("mm", 1e3), "theta": ("mrad", 1e3)}
_SERIES = {"stroke": ("mm", 1e3), "torsion": ("mrad", 1e3), "force": ("N", 1.0)}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments."""
    parser.add_argument("a", metavar="A.mcap")
    parser.add_argument("b", metavar="B.mcap")
    parser.add_argument(
        "--window",
        type=not_negative,
        default=1.0,
        metavar="S",
        help="time after the first contact that is compared (default: 1)",
    )
    parser.add_argument(
        "--out", type=Path, default=Path(), help="folder of the diagram (default: .)"
    )


def run(options: argparse.Namespace) -> int:
    """Do it; return the exit status."""
    from capture_sim.analysis.comparison import gaps
    from capture_sim.commands.recorded import open_run
    from capture_sim.recording.measured import characteristics, first_contact, measurements

    prepare_folder(options.out)
    runs = [open_run(path) for path in (options.a, options.b)]
    contacts = []
    for path, recorded in zip((options.a, options.b), runs, strict=True):
        met = first_contact(recorded)
        if met is None:
            raise RecordingError(f"{path}: no contact in it to align with")
        contacts.append(met)
    labels = [f"A {options.a}", f"B {options.b}"]
    a, b = (characteristics(recorded) for recorded in runs)
    for label in labels:
        say(label)
    say(f"{'':32} {'A':>16} {'B':>16} {'B - A':>12} {'%':>8}")
    for name in [*a, *(name for name in b if name not in a)]:
        mine, theirs = a.get(name), b.get(name)
        cells = ["-" if x is None else f"{x:.4f}" for x in (mine, theirs)]
        gap = share = "-"
        if mine is not None and theirs is not None:
            gap = f"{theirs - mine:+.4f}"
            share = f"{(theirs - mine) / mine:+.2%}" if mine else "-"
        say(f"{name:32} {cells[0]:>16} {cells[1]:>16} {gap:>12} {share:>8}")
    measured = [measurements(recorded) for recorded in runs]
    say(f"\nA - B over {options.window:g} s from the first contact on, poses from there:")
    for found in gaps(measured[0], measured[1], contacts[0], contacts[1], options.window):
        unit, factor = _SERIES.get(found.name) or _UNITS[found.name.split(".")[-1]]
        say(
            f"  {found.name:14} rms {found.rms * factor:10.4f} {unit:5} "
            f"largest {found.largest * factor:+10.4f} {unit:5} at {found.at:.3f} s"
        )
    try:
        from capture_sim.viewing.comparison import save_comparison
    except ImportError as error:
        say(f"no diagram: {error}")
        return OK
    shifted = [m.shifted(-met) for m, met in zip(measured, contacts, strict=True)]
    path = options.out / f"{runs[0].name}_compared.png"
    say(f"diagram in {save_comparison(shifted, labels, options.window, path)}")
    return OK
