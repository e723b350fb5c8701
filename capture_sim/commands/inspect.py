"""``capture-sim inspect``: say what recordings are worth before they are evaluated."""

from __future__ import annotations

import argparse

from capture_sim.base.exit_status import BAD_INPUT, FAILED, OK
from capture_sim.base.tables import print_table
from capture_sim.commands.inputs import add_geometry, add_release, add_remaps
from capture_sim.commands.output import echo, give, warn
from capture_sim.errors import CaptureSimError, one_line
from capture_sim.plausibility.check import check_names
from capture_sim.plausibility.rules import Grade
from capture_sim.recording.bag import read_bag, remap_of
from capture_sim.recording.inspection import SeriesRow, as_data, missing_for, series_rows
from capture_sim.recording.read import run_of
from capture_sim.run.bounds import contact_text
from capture_sim.run.run import Run
from capture_sim.scene.loading import load_scene

DESCRIPTION = (
    "Say what recordings are worth before anything is judged or fitted: a row for each topic with "
    "rate, gaps, clock, noise, range and use; the rules of plausibility that are broken; what is "
    "missing for detect, compare and calibrate. Any MCAP file or bag is accepted. "
    "Times are in s since the release."
)
FAILS = "a rule of grade 'refused' is broken"
GIVES = "everything, a list with all recordings,"
EXAMPLE = "  capture-sim inspect measured.mcap --scene tilt_0"
_HEAD = (
    "topic",
    "type",
    "messages",
    "rate\nHz",
    "gap\ns",
    "first\ns",
    "last\ns",
    "stamp -\narrival s",
    "noise",
    "range",
    "used for",
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments."""
    parser.add_argument(
        "recordings", nargs="+", metavar="RUN", help="recorded files, or folders of bags"
    )
    add_geometry(parser)
    add_release(parser)
    add_remaps(parser)


def run(options: argparse.Namespace) -> int:
    """Run the command and return its exit status."""
    check_names(options.waived)
    scene = None if options.scene is None else load_scene(options.scene)
    remaps = dict(map(remap_of, options.remaps))
    status, data, rows = OK, [], []
    inspected: list[tuple[str, Run]] = []
    for path in options.recordings:
        try:
            bag = read_bag(path, remaps=remaps, release=options.release)
            read = run_of(bag, scene)
            read = read.replaced(waived=(*read.waived, *options.waived))
            data.append(as_data(bag, read))
            rows += [(path, row) for row in series_rows(bag, read)]
            inspected.append((path, read))
        except CaptureSimError as error:  # the others count all the same
            warn(one_line(str(error)))
            status = BAD_INPUT
            continue
        for line in (*bag.left_out, *bag.problems):
            warn(f"{path}: {line}")
        if any(doubt.grade is Grade.REFUSED for doubt in read.doubts):
            status = status or FAILED
    give(lambda: data)
    for path, read in inspected:
        _print_judgement(path if len(options.recordings) > 1 else "", read)
    if rows:
        echo("")
        _print_rows(rows)
    return status


def _print_rows(rows: list[tuple[str, SeriesRow]]) -> None:
    """Print the topics of all recordings as one table."""
    several = len({path for path, _ in rows}) > 1
    cells = []
    for path, row in rows:
        own = [row.topic, row.type, str(row.messages)]
        own += [_number(row.rate, ".4g"), _number(row.gap, ".3g")]
        own += [_number(row.first, ".3f"), _number(row.last, ".3f"), _number(row.clock, ".4g")]
        own += [row.noise or "-", row.range or "-", row.use]
        cells.append([path, *own] if several else own)
    print_table(["recording", *_HEAD] if several else _HEAD, cells, left=2 if several else 1)


def _number(value: float | None, kind: str) -> str:
    return "-" if value is None else format(value, kind)


def _print_judgement(path: str, read: Run) -> None:
    """Print the plausibility rules that a run breaks, and the data that other commands lack.

    The other commands are detect, compare and calibrate.  ``path`` starts each line, if not empty.
    """
    where = f"{path}: " if path else ""
    for doubt in read.doubts:
        echo(f"{where}{doubt.line}")
    if not read.doubts:
        echo(f"{where}no rule is broken that was applied")
    by_reason: dict[str, list[str]] = {}
    for rule, reason in read.unapplied:
        by_reason.setdefault(reason, []).append(rule.name)
    for reason, names in by_reason.items():
        echo(f"{where}not applied, {reason}: {', '.join(names)}")
    if read.contact_bounds is not None:
        echo(f"{where}first contact: {contact_text(read.first_contact, read.contact_bounds)}")
    for command, lacking in missing_for(read).items():
        text = f"not possible without {'; '.join(lacking)}" if lacking else "can be run"
        echo(f"{where}{command}: {text}")
