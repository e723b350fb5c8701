"""The tables ``results.json`` and ``results.txt`` of a folder of recorded runs.

They have a row for every recording in their folder that capture_sim has written.  The results of
other runs are never removed from them.

- Who makes runs adds a row for each.  A row is replaced if its recording is replaced (by the same
  simulated run, or with ``--overwrite``) or if the file has changed since.
- A recording without a row is read, and its row is added.  Its command was killed, or a node
  recorded it, or it was copied into the folder.  If it has no results, the row gives the reason.
- A row without a recording (``--no-record``, or the file was deleted) remains until a run with the
  same numbers is added.
- A ``results.json`` that is not such a table is renamed and kept.
"""

from __future__ import annotations

import fcntl
import json
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, NamedTuple

from capture_sim.base.files import free_path, write_text
from capture_sim.errors import CaptureSimError, one_line
from capture_sim.recording.read import read_run
from capture_sim.recording.scan import head_metadata
from capture_sim.recording.write import RUN_METADATA
from capture_sim.run.run import Run
from capture_sim.run.summary import NOT_NUMBERS, RECORDING, row_from, row_without_results
from capture_sim.run.summary_table import table

NUMBERS = "results.json"
TABLE = "results.txt"
#: Mark after the name of a row without a recording, if other rows have one.
_UNRECORDED = "*"

Row = dict[str, Any]


class Recorded(NamedTuple):
    """A run, and the path of its recording in the folder; None if it was not recorded."""

    run: Run
    path: Path | None

    @property
    def label(self) -> str:
        """Name of the run in tables and plots: the name of its recording, else of the run.

        Several recordings of one scene have different names.
        """
        return self.run.name if self.path is None else self.path.stem


class Updated(NamedTuple):
    """What an update of a folder's tables has written."""

    rows: int  # in all
    numbers: Path
    table: Path


class ResultsTable:
    """The tables of a folder to which runs are written.

    Create the object before the first recording is written, because it then notes which recordings
    of the table have been deleted.  ``warn`` gets a line if a file is not such a table.
    """

    def __init__(self, folder: Path, warn: Callable[[str], object]) -> None:
        self._folder, self._warn = folder, warn
        with suppress(OSError, ValueError, RecursionError):
            self._deleted = {row[RECORDING] for row in _rows_in(folder / NUMBERS)}
            self._deleted -= {path.name for path in folder.glob("*.mcap")}
            return
        self._deleted = set()

    def update(self, own: Sequence[Row], *, reads_others: bool = True) -> Updated:
        """Add rows to the tables of the folder.

        Recordings without a row are not read without ``reads_others``: there may be many.
        """
        with _alone(self._folder):
            rows, notes = self._merged(own, reads_others)
            text = json.dumps(rows, indent=2, allow_nan=False) + "\n"
            numbers = write_text(self._folder / NUMBERS, text)
            text = "\n".join([table(rows, labels_of(rows)), *notes])
            return Updated(len(rows), numbers, write_text(self._folder / TABLE, text + "\n"))

    def _merged(self, own: Sequence[Row], reads_others: bool) -> tuple[list[Row], list[str]]:
        """Return all rows of the folder and the notes below the table.

        ``own`` are the rows of the command, which come last.  The notes name the files that
        capture_sim did not record, and explain the mark of rows without a recording.
        """
        numbers = self._folder / NUMBERS
        rows, written = self._earlier(numbers)
        taken = {row[RECORDING] for row in own}
        read, foreign = [], []
        for path in self.recordings():
            if path.name in taken:
                continue
            known = any(row[RECORDING] == path.name for row in rows)
            if known and path.stat().st_mtime_ns < written:
                continue
            if not reads_others:
                continue
            row = row_of(path)
            if row is None:
                foreign.append(path.name)
            else:
                read.append(row)
        new = [*read, *own]
        present = {path.name for path in self._folder.glob("*.mcap")} - self._deleted
        for row in rows:
            if row[RECORDING] not in present:
                row[RECORDING] = None  # deleted, even if a run of this command has its name now
        replaced = {row[RECORDING] for row in new} - {None}
        rows = [*(row for row in rows if row[RECORDING] not in replaced), *new]
        rows = [row for i, row in enumerate(rows) if not _is_repeated(row, rows[:i], rows[i + 1 :])]
        notes = [f"Without a row, as capture_sim did not record it: {name}." for name in foreign]
        if any(row[RECORDING] for row in rows) and not all(row[RECORDING] for row in rows):
            notes.append(f"{_UNRECORDED} The run has no recording in this folder.")
        return rows, notes

    def _earlier(self, numbers: Path) -> tuple[list[Row], int]:
        """Return the rows of the folder's table, and the time of its last change, ns.

        Without a table it returns no rows and 0.  A file that is not a table of runs is renamed.
        """
        try:
            return _rows_in(numbers), numbers.stat().st_mtime_ns
        except FileNotFoundError:
            return [], 0
        except (OSError, ValueError, RecursionError) as error:
            other = free_path(numbers)
            with suppress(OSError):
                numbers.rename(other)
                self._warn(f"{numbers}: not a table of runs: {error}; kept as {other}")
            return [], 0

    def recordings(self) -> list[Path]:
        """Return the MCAP files of the folder in the order of their last change.

        Hidden files, whose names begin with a dot, are left out.
        """

        def modified(path: Path) -> tuple[int, str]:
            with suppress(OSError):
                return path.stat().st_mtime_ns, path.name
            return 0, path.name

        files = [p for p in self._folder.glob("*.mcap") if p.name[0] != "." and p.is_file()]
        return sorted(files, key=modified)


def _rows_in(numbers: Path) -> list[Row]:
    """Return the rows of a ``results.json``; ValueError if the file is not a table of runs."""
    entries = json.loads(numbers.read_text(encoding="utf-8"))
    if not isinstance(entries, list):
        raise ValueError("must be a list of runs")
    return [row_from(entry, f"run {i + 1}") for i, entry in enumerate(entries)]


def row_of(path: Path, run: Run | None = None) -> Row | None:
    """Return the row of a recording; None if capture_sim did not record the file.

    ``run``: the run in it; None to read it.  If the recording has no results, the row gives the
    reason.
    """
    if RUN_METADATA not in head_metadata(path):
        return None
    try:
        summary = (read_run(path) if run is None else run).summary
    except CaptureSimError as error:
        reason = one_line(str(error)).removeprefix(f"{path}: ")
        summary = row_without_results(path.stem, f"no results: {reason}")
    return plain_row({**summary, RECORDING: path.name})


def labels_of(rows: Sequence[Row]) -> list[str]:
    """Return the names of rows in the table: the name of the recording, else of the run.

    Names of runs without a recording have the mark ``*`` if at least one row has a recording.
    """
    mark = f" {_UNRECORDED}" if any(row[RECORDING] for row in rows) else ""
    return [Path(row[RECORDING]).stem if row[RECORDING] else f"{row['name']}{mark}" for row in rows]


def _is_repeated(row: Row, before: Sequence[Row], after: Sequence[Row]) -> bool:
    """Return True if a row is redundant, because another row is the same run.

    Only a row without a recording can be redundant.  The other row must be after it, or be before
    it and have a recording.
    """
    others = [*(other for other in before if other[RECORDING]), *after]
    return row[RECORDING] is None and any(_are_equal(row, other) for other in others)


def _are_equal(row: Mapping[str, Any], other: Mapping[str, Any]) -> bool:
    """Return True if two rows are the same run: equal scenes, and bit-identical results.

    Keys without a value in one of the rows are not compared, because it may be of another version.
    For the same reason, scenes are compared only if both rows contain the hash of the scene.  The
    energy residual and the source of the loads are not compared either, because they differ
    between a simulated run and its recording.
    """
    scenes = {one["made_by"].get("scene_sha256") for one in (row, other)} - {None}
    common = {
        key
        for key in (row.keys() & other.keys()) - NOT_NUMBERS - {"energy_residual", "loads_from"}
        if row[key] is not None and other[key] is not None
    }
    return (
        len(scenes) < 2
        and {"verdict", "nearest_distance"} <= common
        and all(row[key] == other[key] for key in common)
    )


def plain_row(row: Row) -> Row:
    """Return a row as it is read from JSON, e.g. with lists for tuples, its keys in their order."""
    return row_from(json.loads(json.dumps(row, allow_nan=False, default=list)), "run")


@contextmanager
def _alone(folder: Path) -> Iterator[None]:
    """Lock a folder during the block, so that only one command at a time updates its tables.

    The folder is created if it is missing.  The call waits while another command has the lock.
    """
    folder.mkdir(parents=True, exist_ok=True)
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        with suppress(OSError):  # a file system without locks
            fcntl.flock(descriptor, fcntl.LOCK_EX)
        yield
    finally:
        os.close(descriptor)
