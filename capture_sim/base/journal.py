"""The journal of a study: what the study has computed so far, in a file that survives a kill.

A journal is a text file that only grows.  Its first line is the head, which identifies the study;
each further line is one entry, in JSON.  Each entry is handed to the operating system at once, so
a kill of the process loses none.  An entry that comes more than 5 s after the last write to the
disk itself is written to the disk with all before it; a power cut may lose the entries since then.
A line that a kill has left incomplete is dropped when the file is opened again.  A process that
has opened a journal holds a lock on the file until the process ends or closes it.
"""

from __future__ import annotations

import fcntl
import json
import os
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from capture_sim.errors import CaptureSimError

#: Time after a write to the disk itself before a new entry makes the next one, s.
_TO_DISK = 5.0
#: The last entry of a study that is complete.
_COMPLETE = "complete"


class JournalError(CaptureSimError):
    """A journal is missing, is of another study, is in use, or cannot be read or written."""


class Journal:
    """A study's file of entries; an entry is any data that JSON can express, NaN included.

    Parameters
    ----------
    path
        File; its folder is created.
    head
        Values that identify the study, by name.  A study is continued only if its file has the
        same names with the same values; a name without a value is the same as None.
    resume
        True: continue the study in the file; the attribute ``entries`` has its entries so far.
        Without a file, a new study begins, so that a job that is queued again does what is left.
        False: begin a new study.  An earlier file with entries is renamed to ``<name>.before``,
        which replaces any older file of this name; the attribute ``replaced`` is that path if the
        earlier study was unfinished, else None.

    Raises
    ------
    JournalError
        Another process works on this study, the file cannot be written, or, with ``resume``, it is
        of another study.
    """

    def __init__(self, path: Path, head: Mapping[str, Any], *, resume: bool = False) -> None:
        self.path, self.entries = path, list[Any]()
        self.replaced: Path | None = None
        head = json.loads(_line(head))
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            self._file = _locked(path)
            lines = _whole_lines(self._file)
            self._is_complete = resume and lines[-1:] == [_COMPLETE]
            if resume and lines:
                keys = {**head, **lines[0]}  # what only one of them names differs too
                if differing := [key for key in keys if lines[0].get(key) != head.get(key)]:
                    raise JournalError(
                        f"--resume: {path}: is of another study: {', '.join(differing)} must be "
                        "the same"
                    )
                self.entries = _entries(lines)
            else:
                if len(lines) > 1:
                    before = path.with_name(f"{path.name}.before")
                    path.replace(before)
                    self.replaced = None if lines[-1] == _COMPLETE else before
                    self._file.close()
                    self._file = _locked(path)
                self._file.truncate(0)
                self._write(_line(head))
        except OSError as error:
            raise JournalError(f"{path}: cannot write: {error.strerror or error}") from None
        self._on_disk = time.monotonic()

    def add(self, entry: Any) -> None:
        """Append an entry to the file, not to ``entries``; JournalError if it cannot be written."""
        try:
            self._write(_line(entry))
            if time.monotonic() - self._on_disk > _TO_DISK:
                os.fdatasync(self._file.fileno())
                self._on_disk = time.monotonic()
        except OSError as error:
            raise JournalError(
                f"{self.path}: cannot write: {error.strerror or error}; --resume continues the "
                "study"
            ) from None

    def _write(self, line: bytes) -> None:
        while line:  # unbuffered: a full disk may take only a part
            line = line[self._file.write(line) :]

    def finish(self) -> None:
        """Write to the file that the study is complete; the file stays."""
        if not self._is_complete:
            self.add(_COMPLETE)

    def remove(self) -> None:
        """Delete the file, which a complete study no longer needs; a failure is ignored."""
        with suppress(OSError):
            self.path.unlink()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self._file.close()


def read_journal(path: Path) -> tuple[dict[str, Any], list[Any]]:
    """Return the head and the entries of a journal, without an incomplete last line.

    JournalError if the file cannot be read or is not a journal.
    """
    try:
        with path.open("rb") as file:
            lines = [json.loads(line) for line in file.read().split(b"\n")[:-1]]
            head, *entries = lines
            return dict(head), _entries([head, *entries])
    except OSError as error:
        raise JournalError(f"{path}: cannot be read: {error.strerror or error}") from None
    except (ValueError, TypeError):
        raise JournalError(f"{path}: is no journal of a study") from None


def _entries(lines: Sequence[Any]) -> list[Any]:
    return [line for line in lines[1:] if line != _COMPLETE]


def _line(data: Any) -> bytes:
    # numbers of numpy as Python's
    return json.dumps(data, default=lambda number: number.item()).encode() + b"\n"


def _locked(path: Path) -> Any:
    """Open a file for reading and appending, lock it against other processes, and return it.

    A missing file is created.  JournalError if another process holds the lock.
    """
    while True:
        file = path.open("a+b", buffering=0)
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            if os.path.samestat(os.fstat(file.fileno()), path.stat()):
                return file
        except BlockingIOError:
            file.close()
            raise JournalError(f"{path}: another process works on this study") from None
        except FileNotFoundError:
            pass  # its owner has just finished
        file.close()


def _whole_lines(file: Any) -> list[Any]:
    """Return the head and the entries of a file, and cut off all after the last complete line.

    The result is empty if the file does not begin with a head.
    """
    file.seek(0)
    lines, end = [], 0
    for line in file.read().splitlines(keepends=True):
        try:
            if not line.endswith(b"\n"):
                break
            lines.append(json.loads(line))
        except ValueError:
            break
        end += len(line)
    file.truncate(end)
    return lines if lines and isinstance(lines[0], dict) else []
