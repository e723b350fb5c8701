"""Tables of text, as commands print and write them."""

from __future__ import annotations

import io
from collections.abc import Iterable, Sequence

from rich import box
from rich.console import Console
from rich.table import Table

#: Width of a table that is not printed on a terminal: that of its contents.
_UNLIMITED = 10_000


def make_table(
    head: Sequence[str], rows: Iterable[Sequence[str]], *, left: int = 1, gap: int = 2
) -> Table:
    """Return a table; the first ``left`` columns are aligned to the left.

    ``gap`` is the number of blanks between columns, at least 1.  A head may have several lines.
    """
    table = Table(box=box.SIMPLE_HEAD, pad_edge=False, show_edge=False, padding=(0, gap - 1, 0, 0))
    for number, name in enumerate(head):
        table.add_column(name, justify="left" if number < left else "right", no_wrap=True)
    for row in rows:
        table.add_row(*row)
    return table


def print_table(head: Sequence[str], rows: Iterable[Sequence[str]], *, left: int = 1) -> None:
    """Print a table; without a terminal as wide as its contents and without bold text."""
    console = Console(highlight=False, markup=False, emoji=False)
    if not console.is_terminal:
        console.width = _UNLIMITED
    console.print(make_table(head, rows, left=left, gap=4))


def table_text(
    head: Sequence[str], rows: Iterable[Sequence[str]], *, left: int = 1, gap: int = 2
) -> str:
    """Return a table as plain text."""
    text = io.StringIO()
    console = Console(file=text, width=_UNLIMITED, highlight=False, markup=False, emoji=False)
    console.print(make_table(head, rows, left=left, gap=gap))
    return "\n".join(line.rstrip() for line in text.getvalue().splitlines())
