"""Tables of text, as commands print and write them."""

from __future__ import annotations

import io
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass

from rich import box
from rich.cells import cell_len
from rich.console import Console
from rich.table import Table

#: Width of a table that is not printed on a terminal: that of its contents.
_UNLIMITED = 10_000
#: Blanks between the columns of a printed table.
_GAP = 4


@dataclass(frozen=True)
class Section:
    """A part of a report: lines of text, then a table, then lines; each of them may be empty."""

    name: str
    before: Sequence[str] = ()
    head: Sequence[str] = ()
    rows: Sequence[Sequence[str]] = ()
    after: Sequence[str] = ()


#: What a command prints, while a page is made of it: lines of text, and tables as sections.
_TRANSCRIPT: ContextVar[list[str | Section] | None] = ContextVar("transcript", default=None)


@contextmanager
def transcript() -> Iterator[list[str | Section]]:
    """Yield a list to which the lines and tables are added that are printed in the block."""
    shown: list[str | Section] = []
    token = _TRANSCRIPT.set(shown)
    try:
        yield shown
    finally:
        _TRANSCRIPT.reset(token)


def note_printed(what: str | Section) -> None:
    """Add what is printed to the transcript, if there is one."""
    shown = _TRANSCRIPT.get()
    if shown is not None:
        shown.append(what)


def make_table(
    head: Sequence[str], rows: Iterable[Sequence[str]], *, left: int = 1, gap: int = 2
) -> Table:
    """Return a table; the first ``left`` columns are aligned to the left, others to the right.

    ``gap`` is the number of spaces between columns, at least 1.  A name in ``head`` may have
    several lines.
    """
    table = Table(box=box.SIMPLE_HEAD, pad_edge=False, show_edge=False, padding=(0, gap - 1, 0, 0))
    for number, name in enumerate(head):
        table.add_column(name, justify="left" if number < left else "right", no_wrap=True)
    for row in rows:
        table.add_row(*row)
    return table


def print_table(head: Sequence[str], rows: Iterable[Sequence[str]], *, left: int = 1) -> None:
    """Print a table; the first ``left`` columns are aligned to the left, others to the right.

    If stdout is not a terminal, the table is as wide as its contents and has no bold text.  On a
    terminal that is too narrow, further tables below repeat the first ``left`` columns and have
    the remaining columns.  A value is cut only if it does not fit next to the first columns.
    """
    console = Console(highlight=False, markup=False, emoji=False)
    cells = [list(row) for row in rows]
    note_printed(Section("", (), head, cells))
    if not console.is_terminal:
        console.width = _UNLIMITED
    for columns in _blocks(head, cells, console.width, left, _GAP):
        shown = [[row[k] for k in columns if k < len(row)] for row in cells]
        names = [head[k] for k in columns]
        console.print(make_table(names, shown, left=left, gap=_GAP))


def _blocks(
    head: Sequence[str], rows: Sequence[Sequence[str]], width: int, left: int, gap: int
) -> list[list[int]]:
    """Return, for each table to print, the indices of the columns that fit into the width.

    Each table has the first ``left`` columns and, if there are more, at least one of these.
    """
    widths = []
    for k, name in enumerate(head):
        lines = [*name.split("\n"), *(row[k] for row in rows if k < len(row))]
        widths.append(max(map(cell_len, lines)) + gap - 1)
    first = list(range(min(left, len(head))))
    blocks = [first[:]]
    for k in range(len(first), len(head)):
        used = sum(widths[n] + 1 for n in blocks[-1])
        if used + widths[k] > width and len(blocks[-1]) > len(first):
            blocks.append(first[:])
        blocks[-1].append(k)
    return blocks


def table_text(
    head: Sequence[str],
    rows: Iterable[Sequence[str]],
    *,
    left: int = 1,
    gap: int = 2,
    width: int | None = None,
) -> str:
    """Return a table as plain text; for the arguments see :func:`make_table`.

    Columns that do not fit into ``width`` are in further tables below, as in :func:`print_table`.
    """
    text, cells = io.StringIO(), [list(row) for row in rows]
    console = Console(file=text, width=_UNLIMITED, highlight=False, markup=False, emoji=False)
    for columns in _blocks(head, cells, width or _UNLIMITED, left, gap):
        if text.tell():
            console.print()
        shown = [[row[k] for k in columns if k < len(row)] for row in cells]
        console.print(make_table([head[k] for k in columns], shown, left=left, gap=gap))
    return "\n".join(line.rstrip() for line in text.getvalue().splitlines())
