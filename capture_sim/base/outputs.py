"""Which files an output may replace: those that this package has written as the same kind.

A recording of a trial is lost if a forgotten suffix lets a page take its name.  Therefore a command
replaces a file only if the file is of the kind that is written and has this package's mark, and
never a file that it was given as input.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from pathlib import Path
from typing import NamedTuple

from capture_sim.errors import RecordingError

#: Bytes at the begin and at the end of a file in which its mark is looked for.
_LENGTH = 65536
#: What this package's files contain; the last three are of plots, tables and designs of early
#: versions.
_MARKS = (
    *(b"capture_sim", b"capture-sim", b"Matplotlib version", b'"nearest_distance"'),
    b'"refusal": ',
)
#: First bytes of each kind of file.
_MAGIC = {
    b"\x89MCAP": "an MCAP recording",
    b"\x89PNG": "a PNG image",
    b"PK\x03\x04": "a ZIP file",
    b"RRF": "a rerun file",
    b"PAR1": "a Parquet table",
    b"<svg": "an SVG image",
    b"<?xml": "an SVG image",
    b"<!doctype html": "an HTML page",
    b"{": "a JSON file",
    b"[": "a JSON file",
    b"\x7fELF": "a library",
}
#: Files that mark the other texts and tables of their folder as this package's.
_COMPANIONS = ("results.json", "design.json", "calibration.json")


class _Guard(NamedTuple):
    inputs: frozenset[Path]
    overwrites: bool


_guard: ContextVar[_Guard | None] = ContextVar("guard", default=None)


@contextmanager
def guarded_outputs(inputs: Collection[Path], *, overwrites: bool) -> Iterator[None]:
    """Check each output in the block, see :func:`check_replaceable`.

    ``inputs``: files that must not be replaced.  ``overwrites``: replace other files of any origin.
    """
    guard = _Guard(frozenset(path.resolve() for path in inputs), overwrites)
    token = _guard.set(guard)
    try:
        yield
    finally:
        _guard.reset(token)


def check_replaceable(path: Path, new: Path | None = None) -> None:
    """Raise RecordingError if the file at ``path`` must not be replaced in a guarded block.

    ``new``: the complete file that is to replace it; None if it is not written yet.
    """
    guard = _guard.get()
    if guard is None or not path.is_file():
        return
    if path.resolve() in guard.inputs:
        raise RecordingError(f"{path}: is an input of this command: give --out another name")
    if guard.overwrites:
        return
    kind = _kind(path)
    if new is not None and (wanted := _kind(new)) != kind:
        raise RecordingError(
            f"{path}: is {kind}, not {wanted}: give --out another name, or --overwrite"
        )
    if not _is_ours(path, new):
        raise RecordingError(
            f"{path}: exists, and capture-sim has not written it: give --out another name, or "
            "--overwrite"
        )


def _kind(path: Path) -> str:
    with path.open("rb") as file:
        head = file.read(64).lstrip().lower()
    return next((name for magic, name in _MAGIC.items() if head.startswith(magic.lower())), "text")


def _is_ours(path: Path, new: Path | None) -> bool:
    """Return True if a file has this package's mark, or is a text or table beside one that has it.

    A table also counts if it has the columns of the new one.
    """
    if _is_marked(path) or not path.stat().st_size:
        return True
    if _kind(path) not in ("text", "a Parquet table"):
        return False
    if new is None and path.suffix == ".csv":  # its columns will tell
        return True
    companions = (f"{path.stem}_made_by.json", *_COMPANIONS)
    if any(_is_marked(path.with_name(name)) for name in companions):
        return True
    return new is not None and _first_line(path) == _first_line(new) != b""


def _is_marked(path: Path) -> bool:
    try:
        with path.open("rb") as file:
            head = file.read(_LENGTH)
            file.seek(max(0, path.stat().st_size - _LENGTH))
            tail = file.read()
    except OSError:
        return False
    return any(mark in part for mark in _MARKS for part in (head, tail))


def _first_line(path: Path) -> bytes:
    with path.open("rb") as file:
        return file.readline(_LENGTH).strip()
