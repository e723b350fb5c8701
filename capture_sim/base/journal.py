"""The journal of a study: what it has computed so far, in a file that survives a kill.

A journal is a text file that only grows: a head, which says whose study it is, and an entry a line.
Each entry is handed to the system at once and to the disk every few seconds, so a kill loses none
and a power cut the last seconds.  A line that a kill has torn is dropped when the file is opened
again.  One process at a time has a journal: it holds a lock on the file, which ends with it.
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

#: Longest time between two writes to the disk itself, s.
_TO_DISK = 5.0
#: The last entry of a study that has ended.
_COMPLETE = "complete"


class JournalError(CaptureSimError):
    """A journal is of another study, is in use, or cannot be written."""


class Journal:
    """A study's file of entries; each is any data that JSON has, with NaN.

    Parameters
    ----------
    path
        File; its folder is made.
    head
        Whose study it is, by name: a study is continued only if all of it is the same.
    resume
        Continue the study in the file, of which ``entries`` has what it computed.  False begins
        anew; the study in the file is renamed, and ``replaced`` is its name if it was unfinished.

    Raises
    ------
    JournalError
        Another process works on this study, the file cannot be written, or, with ``resume``, there
        is none or it is of another study.
    """

    def __init__(self, path: Path, head: Mapping[str, Any], *, resume: bool = False) -> None:
        self.path, self.entries = path, list[Any]()
        self.replaced: Path | None = None
        if resume and not path.exists():
            raise JournalError(f"--resume: {path}: there is no unfinished study")
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
        """Append an entry; JournalError if it cannot be written."""
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
        """Note that the study is complete; its file stays."""
        if not self._is_complete:
            self.add(_COMPLETE)

    def remove(self) -> None:
        """Delete the file of a study that is complete."""
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
    """Return the head and the entries of a journal; JournalError if the file is none."""
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
    """Return a file, open for reading and appending, that no other process has."""
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
    """Return the entries of a file, and cut off everything after the last complete entry."""
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
