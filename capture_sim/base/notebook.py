"""Tables and figures for notebooks."""

from __future__ import annotations

import html
import importlib
from collections.abc import Iterable, Sequence
from typing import Any


def html_table(caption: str, rows: Iterable[Sequence[str]], after: Sequence[str] = ()) -> str:
    """Return a table as HTML; the first cell of each row is its head, ``after`` are lines below."""
    lines = (
        f"<tr><th>{html.escape(head)}</th>"
        f"{''.join(f'<td>{html.escape(cell)}</td>' for cell in cells)}</tr>"
        for head, *cells in rows
    )
    below = "".join(f"<p>{html.escape(line)}</p>" for line in after)
    return f"<table><caption>{html.escape(caption)}</caption>{''.join(lines)}</table>{below}"


def drawn(what: Any) -> Any:
    """Return the matplotlib figure of a run, a scene or the result of a study."""
    # imported by name, because the viewing package is in a layer above what it draws
    return importlib.import_module("capture_sim").plot(what)
