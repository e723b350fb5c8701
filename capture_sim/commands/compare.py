"""``capture-sim compare``: compare two runs, e.g. a measured and a simulated run."""

from __future__ import annotations

import argparse
import math
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from capture_sim.base.exit_status import FAILED, OK
from capture_sim.base.software import software_versions
from capture_sim.base.tables import Section, print_table, transcript
from capture_sim.commands.compiling import compile_first
from capture_sim.commands.inputs import (
    add_geometry,
    add_release,
    add_remaps,
    folder_beside,
    not_negative,
    prepare_folder,
)
from capture_sim.commands.output import command_line, drawing, echo, give, warn
from capture_sim.commands.recordings import RecordingReader
from capture_sim.errors import RecordingError
from capture_sim.run.loads import if_measured
from capture_sim.run.run import Run
from capture_sim.run.touches import Touches
from capture_sim.studies.compare.agreement import Agreement, agreement
from capture_sim.studies.compare.compare import (
    MIN_SAMPLES,
    Gap,
    Side,
    characteristics,
    gaps,
    overlap,
    pair_touches,
    sides,
)
from capture_sim.studies.fit.files import read_calibrated
from capture_sim.studies.fit.new_trial import agreement_of
from capture_sim.studies.fit.prediction import read_placement

DESCRIPTION = (
    "Compare two runs, e.g. measured and simulated, aligned at their first contacts: strokes and "
    "times, the touches one by one, and the poses over time. Write a plot. Each number comes "
    "from the finest series that both runs have; the table names it. Strokes, torsion and closest "
    "approach cover the whole run, including the latched phase. Scenes given by name are "
    "simulated. With --calibrated, say whether a trial agrees with a calibrated bench: its "
    "residuals, parameters and placement. With --simulated, compare a recording with its own scene "
    "simulated again."
)
IDENTICAL = "identical"
#: Standard deviations of the start poses that are expected of a new trial.
PLACEMENT = "1 mm, 5 mrad"
#: A difference larger than this multiple of the value of A is not printed in percent.
_LARGEST_SHARE = 10.0
#: Fields of a touch in JSON.
_OF_TOUCHES = ("start", "peak", "lasted", "impulse", "wall")
#: Maximum number of rows in the printed list of touches.
SHOWN = 12
FAILS = (
    "with --simulated, the samples of a simulated recording differ; with --calibrated, the "
    "trial does not agree"
)
GIVES = "numbers, touches and differences, without a plot,"
EXAMPLE = "  capture-sim compare measured.mcap --scene tilt_0 --simulated --out compared"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments."""
    parser.set_defaults(intermixed=True)
    parser.add_argument("a", metavar="A", help="recording (file, or folder of a bag) or scene")
    parser.add_argument("b", metavar="B", nargs="?", help="recording or scene to compare with A")
    parser.add_argument(
        "--simulated",
        action="store_true",
        help="compare the recording A with its scene, simulated again",
    )
    parser.add_argument(
        "--tolerance",
        type=not_negative,
        default=0.0,
        help="with --simulated, accept differences of coordinates up to this value, m and rad "
        "(default: 0, bit-identical)",
    )
    parser.add_argument(
        "--window",
        type=not_negative,
        default=1.0,
        metavar="S",
        help="compare this time after the first contact, s (default: 1)",
    )
    parser.add_argument(
        "--calibrated",
        type=Path,
        metavar="DIR",
        help="compare the recording A with the bench of capture-sim calibrate: its folder, or its "
        "calibration.json. The exit status is 1 if they do not agree",
    )
    parser.add_argument(
        "--placement",
        metavar="'LENGTH, ANGLE'",
        help="with --calibrated, expect the start poses within these standard deviations of the "
        f"scene's (default: '{PLACEMENT}')",
    )
    add_geometry(parser)
    add_release(parser)
    add_remaps(parser)
    parser.add_argument(
        "--out",
        type=Path,
        help="write the plot to this folder (default: next to the recording A; for a scene, the "
        "current folder)",
    )


def run(options: argparse.Namespace) -> int:
    """Run the command and return its exit status."""
    if options.calibrated is not None:
        return _with_calibration(options)
    if options.placement is not None:
        raise RecordingError("--placement: must be given with --calibrated")
    if options.simulated == (options.b is not None):
        raise RecordingError("compare: must have either a second run B or --simulated")
    options.out = options.out or folder_beside(options.a)
    prepare_folder(options.out)
    with transcript() as shown:
        return _run(options, shown)


def _run(options: argparse.Namespace, shown: Sequence[str | Section]) -> int:
    """Compare two runs and return the exit status; ``shown`` is what has been printed so far."""
    sources = [options.a, *filter(None, [options.b])]
    runs = list(map(RecordingReader.of(options).run_or_scene, sources))
    labels = [f"{letter} {source}" for letter, source in zip("AB", sources, strict=False)]
    status, is_identical = OK, None
    if options.simulated:
        runs.append(_simulated(runs[0]))
        labels.append(f"B {runs[0].scene.name}, simulated")
        if runs[0].is_exact:
            found = agreement(*runs)
            is_identical = found.identical
            _print_agreement(found, runs[0])
            status = OK if found.within(options.tolerance) else FAILED
            has_no_contact = runs[0].first_contact is None and runs[1].first_contact is None
            if has_no_contact or (is_identical and not options.json):
                give(lambda: {"bit_identical": is_identical})
                return status
    pair = sides(*runs)
    if options.json:
        over = min(options.window, _check_window(*pair, options.window))
        give(lambda: {"bit_identical": is_identical, **_as_data(pair, labels, over)})
    else:
        over = _compare(*pair, labels, options)
        _draw(pair, labels, over, list(shown), options)
    return status


def _as_data(pair: tuple[Side, Side], labels: list[str], over: float) -> dict[str, object]:
    """Return the comparison over the time ``over``, s after the contacts, as data for JSON."""
    a, b = pair
    sampled = a.touches is None or b.touches is None
    numbers = [characteristics(side, sampled=sampled) for side in pair]
    names = dict.fromkeys(name for of_side in numbers for name in of_side)
    touches: list[dict[str, object]] = []
    if a.touches is not None and b.touches is not None:
        both = [
            t.within(side.contact, over)
            for t, side in zip((a.touches, b.touches), pair, strict=True)
        ]
        touches = [
            {
                "is_ambiguous": found.is_ambiguous,
                **{
                    letter: None
                    if k is None
                    else {name: if_measured(float(getattr(of, name)[k])) for name in _OF_TOUCHES}
                    for letter, of, k in zip("ab", both, found[:2], strict=True)
                },
            }
            for found in pair_touches(*both)
        ]
    return {
        "a": labels[0],
        "b": labels[1],
        "window": over,
        "figures": {
            name: {
                letter: {"value": of[name].value, "source": of[name].source}
                for letter, of in zip("ab", numbers, strict=True)
                if name in of
            }
            for name in names
        },
        "first_contact_bounds": {
            letter: None if bounds is None else [if_measured(bounds.low), if_measured(bounds.high)]
            for letter, side in zip("ab", pair, strict=True)
            for bounds in [side.run.contact_bounds]
        },
        "touches": touches,
        "differences": [
            {
                "series": gap.series,
                "part": gap.part.label,
                "rms": gap.rms,
                "largest": gap.largest,
                "at": gap.at,
            }
            for gap in gaps(a.measured, b.measured, a.contact, b.contact, over)
        ],
    }


def _with_calibration(options: argparse.Namespace) -> int:
    """Print whether a trial agrees with a calibrated bench; return the exit status."""
    if options.b is not None or options.simulated:
        raise RecordingError("--calibrated: must be given with one recording A alone")
    calibrated = read_calibrated(options.calibrated)
    placement = read_placement(options.placement or PLACEMENT)
    run = RecordingReader.of(options).run(options.a)
    for finding in calibrated.findings:
        warn(f"{calibrated.path}: {calibrated.verdict}: {finding}")
    compile_first()
    found = agreement_of(run, calibrated, placement)
    rows = [
        [test.name, f"{test.statistic:.4g}", f"{test.freedom}", f"{test.p:.2g}"]
        for test in (found.noise, found.parameters, found.placement)
    ]
    print_table(["", "chi2", "expected", "p"], rows)
    echo(found.sentence)
    tests = (found.noise, found.parameters, found.placement)
    give(lambda: {"agrees": found.agrees, "tests": [test._asdict() for test in tests]})
    return OK if found.agrees else FAILED


def _simulated(run: Run) -> Run:
    """Simulate the scene of a run again, and return the simulated run.

    If the run has exact samples, the thrust that they contain is applied again.
    """
    from capture_sim.run.simulation import applied_again, simulate

    compile_first()
    return simulate(run.scene, control=applied_again(run) if run.is_exact else None)


def _print_agreement(found: Agreement, recorded: Run) -> None:
    """Print how closely the samples of a recording agree with a new simulation of its scene."""
    echo(f"{found.compared} of {recorded.samples.size} samples compared")
    if found.foreign:
        echo(f"  {found.foreign} samples do not match this run: another publisher or another run")
    if found.missing:
        echo(f"  {found.missing} samples of the run were not recorded")
    if found.identical:
        echo("bit-identical, including the events")
    for difference in found.differences:
        echo(
            f"  {difference.name:20} differs by at most {difference.largest:.3g}, "
            f"first at {difference.first:.4f} s"
        )
    if not found.same_events:
        echo("  the events differ")
    if not found.same_trace:
        echo("  the contact traces differ")
    for line in sorted(set(recorded.origin.software) ^ set(software_versions())):
        echo(f"  {'then' if line in recorded.origin.software else 'now'}: {line}")


def _compare(a: Side, b: Side, labels: list[str], options: argparse.Namespace) -> float:
    """Print the comparison of two runs; return the time compared, s after the first contact."""
    ended = _check_window(a, b, options.window)
    for label in labels:
        echo(label)
    if b.turned:
        echo(f"poses of B turned by {math.degrees(b.turned):+.3g} deg: its frame is not that of A")
    _print_characteristics(a, b)
    for label, side in (("A", a), ("B", b)):
        if side.contact_may_be_late:
            echo(
                f"{label} is aligned at the first force in {side.contact_source}; a touch "
                "between its samples may have started earlier"
            )
    _print_touches(a, b, options.window)
    over = min(options.window, ended)
    echo(
        f"\nB - A over {over:.4g} s after the first contact, poses relative to it"
        + (
            f" (--window is {options.window:g} s, but one run ends there):"
            if over < options.window
            else ":"
        )
    )
    rows = [
        _gap_row(gap, over, _source(a.sources[gap.series], b.sources[gap.series]))
        for gap in gaps(a.measured, b.measured, a.contact, b.contact, options.window)
    ]
    print_table(["", "rms", "peak", "at s", "source"], rows)
    return over


def _draw(
    pair: tuple[Side, Side],
    labels: list[str],
    over: float,
    shown: Sequence[str | Section],
    options: argparse.Namespace,
) -> None:
    """Draw the comparison, and write the page with what was printed."""
    with drawing("no plot: {error}"):
        from capture_sim.viewing.canvas import save
        from capture_sim.viewing.studies import draw_comparison
        from capture_sim.viewing.study_page import drawn, save_page

        against = "simulated" if options.simulated else Path(options.b).stem
        path = options.out / f"{Path(options.a).stem}_vs_{against}.png"
        figure = draw_comparison(pair, labels, over)
        echo(f"plot in {save(figure, path)}")
        asked = {"command": command_line()} | {text[0]: text[2:] for text in labels}
        title = f"{Path(options.a).stem} compared with {against}"
        pictures = drawn({"From the first contact on": figure})
        echo(f"page in {save_page(path.with_suffix('.html'), title, asked, pictures, shown)}")


def _check_window(a: Side, b: Side, window: float) -> float:
    """Return the time after the first contact that the measurements of both runs cover, s.

    It is the largest time of all quantities that both runs have, at least 0.

    Raises
    ------
    RecordingError
        The runs have no quantity in common, or no quantity has ``MIN_SAMPLES`` samples of each run
        within the window or within the time that both runs cover.
    """
    mine, theirs = a.measured, b.measured
    shared = [name for name in mine if name in theirs]
    if not shared:
        raise RecordingError("the recordings have no measured quantity in common")
    ends = [min(mine[name].t[-1] - a.contact, theirs[name].t[-1] - b.contact) for name in shared]
    ended = max(0.0, *ends)

    def most(until: float) -> int:
        return max(
            int(overlap(mine[n], theirs[n], a.contact, b.contact, until)[1].min()) for n in shared
        )

    if most(ended) < MIN_SAMPLES:
        raise RecordingError(
            f"the recordings have only {ended:.4g} s after the first contact in common, with "
            f"fewer than {MIN_SAMPLES} samples"
        )
    if most(window) < MIN_SAMPLES:
        rates = {n: min(mine[n].rate, theirs[n].rate) for n in shared}
        finest = max(rates, key=lambda n: rates[n])
        raise RecordingError(
            f"--window {window:g} s: must be {MIN_SAMPLES / rates[finest]:.4g} s ({MIN_SAMPLES} "
            f"samples of the {finest}: {_source(a.sources[finest], b.sources[finest])}) "
            f"to {ended:.4g} s, where one of the recordings ends"
        )
    return float(ended)


def _gap_row(gap: Gap, over: float, source: str) -> list[str]:
    """Return the table row of a difference B - A: name, rms, peak, time of the peak and source.

    ``over`` is the compared time, s after the first contact.  If the samples of both runs cover
    only a part of it, the row names this part.
    """
    unit, factor = gap.part.unit, gap.part.factor
    name = f"{gap.series}.{gap.part.label}".rstrip(".")
    whole = gap.begin < 0.02 * over and gap.end > 0.98 * over
    note = source + ("" if whole else f", {gap.begin:.4g} to {gap.end:.4g} s")
    if gap.largest == 0.0:
        return [f"{name} {unit}", IDENTICAL, "", "", note]
    rms, largest = _difference(gap.rms * factor, ""), _difference(gap.largest * factor)
    return [f"{name} {unit}", rms, largest, f"{gap.at:.3f}", note]


def _print_characteristics(a: Side, b: Side) -> None:
    sampled = a.touches is None or b.touches is None
    of_a, of_b = (characteristics(recording, sampled=sampled) for recording in (a, b))
    rows = []
    for name in [*of_a, *(name for name in of_b if name not in of_a)]:
        in_a, in_b = of_a.get(name), of_b.get(name)
        digits = 0 if name == "touches" else 4
        cells = ["-" if x is None else f"{x.value:z.{digits}f}" for x in (in_a, in_b)]
        gap = share = "-"
        if in_a is not None and in_b is not None:
            off = in_b.value - in_a.value
            gap = IDENTICAL if not off else _difference(off) if digits else f"{off:+.0f}"
            if off:
                share = _percent(in_a.value, in_b.value, 10.0**-digits, 2)
        source = _source(*("" if x is None else x.source for x in (in_a, in_b)))
        rows.append([name, *cells, gap, share, source])
    print_table(["", "A", "B", "B - A", "%", "source"], rows)


def _print_touches(a: Side, b: Side, window: float) -> None:
    """Print a table of the touches of both runs in pairs, and a summary of each.

    Only touches within ``window``, s after the first contact, are listed.
    """
    both: list[Touches] = []
    for label, side in (("A", a), ("B", b)):
        if side.touches is None:
            echo(f"\n{label} has no list of touches: {side.touch_source}")
        else:
            both.append(side.touches.within(side.contact, window))
    if len(both) < 2:
        return
    echo(
        f"\ntouches within {window:g} s, paired by wall, order, time, peak and duration, from "
        f"{_source(a.touch_source, b.touch_source)} (+ or -: the wall; blank: not known; "
        "a touch without a partner has its own row; ?: another pair would fit nearly as well):"
    )
    rows = []
    columns = [list(_touch_rows(touches)) for touches in both]
    pairs = pair_touches(*both)
    for number, (i, k, is_ambiguous) in enumerate(pairs, start=1):
        wall_a, start_a, peak_a, lasted_a, impulse_a = _NO_TOUCH if i is None else columns[0][i]
        wall_b, start_b, peak_b, lasted_b, impulse_b = _NO_TOUCH if k is None else columns[1][k]
        rows.append(
            [
                f"{number}{'?' if is_ambiguous else ''}",
                f"{wall_a} {wall_b}",
                *(_number(x, 3) for x in (start_a, start_b)),
                _number(start_b - start_a, 3, "+"),
                *(_number(x, 2) for x in (peak_a, peak_b)),
                _percent(peak_a, peak_b, 0.01),
                *(_number(x, 3) for x in (lasted_a, lasted_b)),
                *(_number(x, 5) for x in (impulse_a, impulse_b)),
                _percent(impulse_a, impulse_b, 1e-5),
            ]
        )
    head = ["", "A B", "start A, ms", "B", "B - A", "peak A, N", "B", "%", "lasts A, ms", "B"]
    print_table([*head, "impulse A, N s", "B", "%"], rows[:SHOWN])
    if len(rows) > SHOWN:
        echo(f"    and {len(rows) - SHOWN} more in the plot")
    for label, touches, other in zip("AB", both, (1, 0), strict=True):
        if touches.start.size:
            impulse = float(touches.impulse.sum())
            number_text = f"{touches.start.size} touch{'es' if touches.start.size > 1 else ''}"
            alone = sum(pair[other] is None for pair in pairs)
            echo(
                f"  {label}: {number_text}, peak {np.nanmax(touches.peak):.2f} N"
                + (f", impulse {impulse:.5f} N s" if math.isfinite(impulse) else "")
                + (f", {alone} without a partner" if alone else "")
            )


_NO_TOUCH = (" ", math.nan, math.nan, math.nan, math.nan)


def _touch_rows(touches: Touches) -> Iterator[tuple[str, float, float, float, float]]:
    """Yield wall, start (ms), peak (N), duration (ms) and impulse (N s) of each touch.

    The wall is "+" or "-", or " " if it is not known.
    """
    signs = [{1: "+", -1: "-"}.get(int(wall), " ") for wall in touches.wall]
    ms = touches.start * 1e3
    yield from zip(signs, ms, touches.peak, touches.lasted * 1e3, touches.impulse, strict=True)


def _number(value: float, digits: int, sign: str = "") -> str:
    return f"{value:{sign}.{digits}f}" if math.isfinite(value) else "-"


def _difference(value: float, sign: str = "+") -> str:
    """Return a difference as text: with four decimals, or as e.g. 3e-07 if all four would be 0."""
    return f"{value:{sign}.4f}" if abs(value) >= 5e-5 else f"{value:{sign}.0e}"


def _percent(mine: float, theirs: float, shown: float, digits: int = 1) -> str:
    """Return the difference ``theirs - mine`` in percent of ``mine``, or "-" without a percentage.

    There is no percentage if ``mine`` is printed as zero or is NaN, or if the difference is more
    than ten times ``mine``.  ``shown`` is the value of the last printed digit of ``mine``.
    """
    if not abs(mine) >= 0.5 * shown:  # NaN too
        return "-"
    share = (theirs - mine) / abs(mine)
    return f"{share:+z.{digits}%}" if abs(share) <= _LARGEST_SHARE else "-"


def _source(mine: str, theirs: str) -> str:
    if mine == theirs or not theirs:
        return mine
    return f"A {mine}; B {theirs}" if mine else theirs
