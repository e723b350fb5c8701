"""``capture-sim compare``."""

from __future__ import annotations

import argparse
import math
from collections.abc import Iterator
from itertools import zip_longest

from capture_sim.commands import OK
from capture_sim.commands.inputs import add_out, add_remaps, not_negative, open_run, prepare_folder
from capture_sim.commands.output import drawing, echo, print_table
from capture_sim.errors import RecordingError
from capture_sim.recording.comparing import Comparable, characteristics, comparable, rate_of
from capture_sim.studies.compare import LEAST, Gap, gaps, overlap
from capture_sim.studies.touches import Touches

DESCRIPTION = (
    "Compare two recordings, e.g. measured and simulated, aligned at their first contacts: "
    "strokes and times, the touches one by one, and the poses over time. Write a diagram. Each "
    "number comes from the finest series that both files contain; the table names it. Strokes, "
    "torsion and closest approach cover the whole recording, including the latched phase."
)
IDENTICAL = "identical"
#: Beyond this share of A, a difference is not written in percent.
_LARGEST_SHARE = 10.0
#: Number of touches in the printed list.
SHOWN = 12
EXAMPLE = "  capture-sim compare runs/tilt_0.mcap measured.mcap --out compared"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments."""
    parser.add_argument("a", metavar="A.mcap", help="recording: file, or folder of a bag")
    parser.add_argument("b", metavar="B.mcap", help="recording to compare with A")
    parser.add_argument(
        "--window",
        type=not_negative,
        default=1.0,
        metavar="S",
        help="compare this time after the first contact, s (default: 1)",
    )
    add_remaps(parser)
    add_out(parser, ".", "write the diagram to this folder")


def run(options: argparse.Namespace) -> int:
    """Run the command and return its exit status."""
    prepare_folder(options.out)
    a, b = comparable(*(open_run(path, options.remaps) for path in (options.a, options.b)))
    measured = (a.measured(), b.measured())
    ended = _check_window(a, b, options.window)
    labels = [f"A {options.a}", f"B {options.b}"]
    for label in labels:
        echo(label)
    _print_characteristics(a, b)
    for label, of in (("A", a), ("B", b)):
        if of.contact_may_be_late:
            echo(
                f"{label} is aligned at the first force in {of.contact_source}; a touch "
                "between its samples may have started earlier"
            )
    _print_touches(a, b, options.window)
    over = min(options.window, ended)
    echo(
        f"\nB - A over {over:.4g} s after the first contact, poses relative to it"
        + (
            f" (--window is {options.window:g} s, but one recording ends there):"
            if over < options.window
            else ":"
        )
    )
    rows = [
        _gap_row(gap, over, _source(a.sources[gap.series], b.sources[gap.series]))
        for gap in gaps(*measured, a.contact, b.contact, options.window)
    ]
    print_table(["", "rms", "peak", "at s", "source"], rows)
    with drawing("no diagram: {error}"):
        from capture_sim.viewing.canvas import save
        from capture_sim.viewing.studies import draw_comparison

        path = options.out / f"{a.run.name}_compared.png"
        echo(f"diagram in {save(draw_comparison((a, b), labels, over), path)}")
    return OK


def _check_window(a: Comparable, b: Comparable, window: float) -> float:
    """Return how long both were measured after their first contacts, s.

    Raises
    ------
    RecordingError
        The window, or the time that both cover, has too few samples of every quantity.
    """
    mine, theirs = dict(a.measured().items()), dict(b.measured().items())
    shared = [name for name in mine if name in theirs]
    if not shared:
        raise RecordingError("the recordings have no measured quantity in common")
    ends = [min(mine[name].t[-1] - a.contact, theirs[name].t[-1] - b.contact) for name in shared]
    ended = max(0.0, *ends)

    def most(until: float) -> int:
        return max(
            int(overlap(mine[n], theirs[n], a.contact, b.contact, until)[1].min()) for n in shared
        )

    if most(ended) < LEAST:
        raise RecordingError(
            f"the recordings have only {ended:.4g} s after the first contact in common, with "
            f"fewer than {LEAST} samples"
        )
    if most(window) < LEAST:
        rates = {n: min(rate_of(mine[n]), rate_of(theirs[n])) for n in shared}
        finest = max(rates, key=lambda n: rates[n])
        raise RecordingError(
            f"--window {window:g} s: must be {LEAST / rates[finest]:.4g} s ({LEAST} samples of "
            f"the {finest}: {_source(a.sources[finest], b.sources[finest])}) to {ended:.4g} s, "
            "where one of the recordings ends"
        )
    return float(ended)


def _gap_row(gap: Gap, over: float, source: str) -> list[str]:
    """Return the difference of a measured number over time, as a row of the table."""
    unit, factor = gap.part.unit, gap.part.factor
    name = f"{gap.series}.{gap.part.label}".rstrip(".")
    whole = gap.begin < 0.02 * over and gap.end > 0.98 * over
    note = source + ("" if whole else f", {gap.begin:.4g} to {gap.end:.4g} s")
    if gap.largest == 0.0:
        return [f"{name} {unit}", IDENTICAL, "", "", note]
    rms, largest = _difference(gap.rms * factor, ""), _difference(gap.largest * factor)
    return [f"{name} {unit}", rms, largest, f"{gap.at:.3f}", note]


def _print_characteristics(a: Comparable, b: Comparable) -> None:
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


def _print_touches(a: Comparable, b: Comparable, window: float) -> None:
    """Print the touches one by one, paired in their order."""
    tables = []
    for label, of in (("A", a), ("B", b)):
        if of.touches is None:
            echo(f"\n{label} has no list of touches: {of.touch_source}")
        else:
            tables.append(of.touches.within(of.contact, window))
    if len(tables) < 2:
        return
    echo(
        f"\ntouches within {window:g} s, paired in order, from "
        f"{_source(a.touch_source, b.touch_source)} (+ or -: the wall; blank: not known):"
    )
    rows = []
    for i, pair in enumerate(zip_longest(*map(_touch_rows, tables))):
        (wall, start, peak, lasted, impulse), other = (each or _NO_TOUCH for each in pair)
        rows.append(
            [
                f"{i + 1}",
                f"{wall} {other[0]}",
                *(_number(x, 3) for x in (start, other[1])),
                _number(other[1] - start, 3, "+"),
                *(_number(x, 2) for x in (peak, other[2])),
                _percent(peak, other[2], 0.01),
                *(_number(x, 3) for x in (lasted, other[3], impulse, other[4])),
                _percent(impulse, other[4], 0.001),
            ]
        )
    head = ["", "A B", "start A, ms", "B", "B - A", "peak A, N", "B", "%", "lasts A, ms", "B"]
    print_table([*head, "impulse A, mN s", "B", "%"], rows[:SHOWN])
    if len(rows) > SHOWN:
        echo(f"    and {len(rows) - SHOWN} more in the diagram")
    for label, table in zip("AB", tables, strict=True):
        if table.start.size:
            impulse = float(table.impulse.sum())
            number = f"{table.start.size} touch{'es' if table.start.size > 1 else ''}"
            echo(
                f"  {label}: {number}, peak {table.peak.max():.2f} N"
                + (f", impulse {impulse * 1e3:.3f} mN s" if math.isfinite(impulse) else "")
            )


_NO_TOUCH = (" ", math.nan, math.nan, math.nan, math.nan)


def _touch_rows(touches: Touches) -> Iterator[tuple[str, float, float, float, float]]:
    """Yield wall, start (ms), peak (N), duration (ms) and impulse (mN s) of each touch."""
    signs = [{1: "+", -1: "-"}.get(int(wall), " ") for wall in touches.wall]
    ms, mNs = touches.start * 1e3, touches.impulse * 1e3
    yield from zip(signs, ms, touches.peak, touches.lasted * 1e3, mNs, strict=True)


def _number(value: float, digits: int, sign: str = "") -> str:
    return f"{value:{sign}.{digits}f}" if math.isfinite(value) else "-"


def _difference(value: float, sign: str = "+") -> str:
    """Return a difference with four decimals, or its order of magnitude if they are all 0."""
    return f"{value:{sign}.4f}" if abs(value) >= 5e-5 else f"{value:{sign}.0e}"


def _percent(mine: float, theirs: float, shown: float, digits: int = 1) -> str:
    """Return the difference in percent of ``mine``; ``-`` where that says nothing.

    That is where ``mine`` is zero as ``shown`` (its last digit), or is a tenth of the difference.
    """
    if not abs(mine) >= 0.5 * shown:  # NaN too
        return "-"
    share = (theirs - mine) / abs(mine)
    return f"{share:+z.{digits}%}" if abs(share) <= _LARGEST_SHARE else "-"


def _source(mine: str, theirs: str) -> str:
    if mine == theirs or not theirs:
        return mine
    return f"A {mine}; B {theirs}" if mine else theirs
