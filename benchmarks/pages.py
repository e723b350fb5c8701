"""How a benchmark is asked and how it answers: its options, Markdown, the measured parts of a page.

A page's prose stands in the page.  What was measured stands between two marks, and only that is
written anew, each part with its date, its machine and the state of the kernels.
"""

from __future__ import annotations

import argparse
import math
import statistics
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from benchmarks.machine import OthersAtWork, stamp
from capture_sim.files import whole_file

DOCS = Path(__file__).resolve().parent.parent / "docs"
_BEGIN, _END = "<!-- measured: {} -->", "<!-- end of measured -->"


def arguments(doc: str | None, parts: Sequence[str] = (), **options: Any) -> argparse.Namespace:
    """Read the command line: ``parts`` to choose from, options by name as (default, help)."""
    parser = argparse.ArgumentParser(
        description=doc, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    if parts:
        parser.add_argument("parts", nargs="*", choices=[[], *parts], help="default: all")
    for name, (default, text) in options.items():
        kind = Path if default is None else type(default)
        shown = text if default is None else f"{text} ({default})"
        parser.add_argument(f"--{name}", type=kind, default=default, help=shown)
    parser.add_argument("--dry", action="store_true", help="only show what was measured")
    found = parser.parse_args()
    if parts:
        found.parts = found.parts or list(parts)
    return found


class Page:
    """A page in docs/ of which parts are measured.

    Parameters
    ----------
    name
        Of the file, without ``.md``.
    dry
        Only show.
    """

    def __init__(self, name: str, dry: bool = False) -> None:
        self.path, self.dry, self._others = DOCS / f"{name}.md", dry, OthersAtWork()

    def write(self, part: str, *lines: str) -> None:
        """Put lines into a part of the page, stamped; what follows is measured from now on."""
        text = "\n".join([*lines, "", stamp(self._others.cores())])
        print(f"== {part}\n\n{text}\n", flush=True)
        if not self.dry:
            page = filled(self.path.read_text(encoding="utf-8"), {part: text})
            with whole_file(self.path) as file:
                file.write_text(page, encoding="utf-8")
        self._others = OthersAtWork()


def filled(page: str, parts: dict[str, str]) -> str:
    """Return a page with these texts in its parts of these names."""
    for name, text in parts.items():
        head, begin, rest = page.partition(_BEGIN.format(name))
        _, end, tail = rest.partition(_END)
        if not end:
            raise SystemExit(f"the page has no part {name!r}")
        page = f"{head}{begin}\n\n{text.strip()}\n\n{end}{tail}"
    return page


def table(head: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    """Return a Markdown table that reads well as plain text, first column to the left."""
    lines = [[str(cell) for cell in line] for line in (head, *rows)]
    widths = [max(3, *(len(line[i]) for line in lines)) for i in range(len(head))]
    lines.insert(1, ["-" * widths[0], *("-" * (width - 1) + ":" for width in widths[1:])])
    return "\n".join(
        f"| {line[0].ljust(widths[0])} | "
        + " | ".join(cell.rjust(width) for cell, width in zip(line[1:], widths[1:], strict=True))
        + " |"
        for line in lines
    )


def seconds(value: float) -> str:
    """Return a time with its unit, three digits."""
    if not math.isfinite(value):
        return "-"
    units = (("s", 1.0), ("ms", 1e3), ("us", 1e6), ("ns", 1e9))
    unit, factor = next(((u, f) for u, f in units if value * f >= 0.9995), units[-1])
    digits = max(0, 2 - math.floor(math.log10(max(value * factor, 1e-12))))
    return f"{value * factor:.{min(digits, 3)}f} {unit}"


def error(value: float) -> str:
    """Return an error, two digits."""
    return f"{value:.1e}" if math.isfinite(value) else "-"


def ratio(value: float) -> str:
    """Return a ratio, three digits at most."""
    if not math.isfinite(value):
        return "-"
    return f"{value:.2f}" if value < 10.0 else f"{value:.3g}" if value < 1000.0 else f"{value:.0f}"


class Spread(NamedTuple):
    """Median and quartiles of repeated measurements."""

    median: float
    low: float
    high: float

    @classmethod
    def of(cls, values: Sequence[float]) -> Spread:
        """Return the spread of values; NaN of none."""
        if not len(values):
            return cls(math.nan, math.nan, math.nan)
        low, high = np.percentile(values, [25, 75]).tolist()
        return cls(statistics.median(values), low, high)

    def __str__(self) -> str:
        return f"{seconds(self.low)} to {seconds(self.high)}"
