"""Tables for notebooks."""

from __future__ import annotations

import html
from collections.abc import Iterable, Sequence


def html_table(caption: str, rows: Iterable[Sequence[str]], after: Sequence[str] = ()) -> str:
    """Return a table as HTML; the first cell of each row is its head, ``after`` are lines below."""
    lines = (
        f"<tr><th>{html.escape(head)}</th>"
        f"{''.join(f'<td>{html.escape(cell)}</td>' for cell in cells)}</tr>"
        for head, *cells in rows
    )
    below = "".join(f"<p>{html.escape(line)}</p>" for line in after)
    return f"<table><caption>{html.escape(caption)}</caption>{''.join(lines)}</table>{below}"
