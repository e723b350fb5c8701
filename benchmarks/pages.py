"""The frame of a benchmark: its options, its parts, repeated timing, the measured parts of a page.

A page's prose stands in the page.  What was measured stands between two marks, and only that is
written anew, each part with its date, its machine and the state of the kernels.
"""

from __future__ import annotations

import argparse
import math
import os
import statistics
import tempfile
import time
from collections.abc import Callable, Container, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from benchmarks.machine import OthersAtWork, stamp
from capture_sim.base.files import whole_file
from capture_sim.dynamics.compilation import compile_kernels

DOCS = Path(__file__).resolve().parent.parent / "docs"
#: Pages of measurements only, with their pictures.
EVIDENCE = DOCS / "evidence"
_BEGIN, _END = "<!-- measured: {} -->", "<!-- end of measured -->"


#: Measures a part of a page in an empty folder; returns its lines, none where it has no text.
Part = Callable[[argparse.Namespace, Path], Sequence[str]]


def write_parts(
    page: str | None,
    doc: str | None,
    parts: Mapping[str, Part],
    *,
    untimed: Container[str] = (),
    **options: Any,
) -> None:
    """Run a benchmark as its command line asks: the parts that are named, or all.

    Parameters
    ----------
    page
        Name without ``.md`` of the page whose parts are written, in docs/evidence/ or else in
        docs/. None: the parts are only shown.
    doc
        What ``--help`` shows.
    parts
        What measures them, by name.
    untimed
        Names of those without times: on a busy machine they are as good.
    options
        Default and help by name; None as default stands for a path.
    """
    parser = argparse.ArgumentParser(
        description=doc, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("parts", nargs="*", choices=[[], *parts], help="default: all")
    for name, (default, text) in options.items():
        kind = Path if default is None else type(default)
        shown = text if default is None else f"{text} ({default})"
        parser.add_argument(f"--{name}", type=kind, default=default, help=shown)
    parser.add_argument("--dry", action="store_true", help="only show what was measured")
    asked = parser.parse_args()
    # nodes that are started, and the processes of this benchmark, have a domain of their own
    os.environ.setdefault("ROS_DOMAIN_ID", own_domain())
    os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    compile_kernels()
    for name in asked.parts or parts:
        others = OthersAtWork()
        with tempfile.TemporaryDirectory(prefix=f"{page}_") as folder:
            os.environ["ROS_LOG_DIR"] = folder
            lines = parts[name](asked, Path(folder))
        if not lines:
            continue
        text = "\n".join([*lines, "", stamp(others.cores(), timed=name not in untimed)])
        print(f"== {name}\n\n{text}\n", flush=True)
        if page is not None and not asked.dry:
            path = page_path(page)
            whole = filled(path.read_text(encoding="utf-8"), {name: text})
            with whole_file(path) as file:
                file.write_text(whole, encoding="utf-8")


def page_path(name: str) -> Path:
    """Return the path of a page: in docs/evidence/, or else in docs/."""
    evidence = EVIDENCE / f"{name}.md"
    return evidence if evidence.is_file() else DOCS / f"{name}.md"


def own_domain() -> str:
    """Return a ROS domain for this process that no test session chooses: those have 1 to 101.

    Ports of the domains from 102 to 214 may be taken by any outgoing connection on Linux.
    """
    return str(215 + os.getpid() % 17)


def repeated(
    work: Callable[[], object], times: int = 5, clock: Callable[[], float] = time.perf_counter
) -> list[float]:
    """Return what each of some repetitions takes, s."""
    took = []
    for _ in range(times):
        began = clock()
        work()
        took.append(clock() - began)
    return took


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
