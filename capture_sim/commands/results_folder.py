"""Prints and draws the runs of a command next to others of their folder.

``overview.png`` and ``runs.rrd`` show the command's runs and the latest other recordings, up to
:data:`SHOWN` in all.
"""

from __future__ import annotations

import shutil
import sys
from collections.abc import Sequence
from pathlib import Path

from capture_sim.commands.output import draw, echo, warn
from capture_sim.errors import CaptureSimError
from capture_sim.recording.read import read_run
from capture_sim.recording.results_table import Recorded, ResultsTable, Row, plain_row
from capture_sim.recording.scan import head_metadata
from capture_sim.recording.write import RUN_METADATA
from capture_sim.run.run import Run
from capture_sim.run.summary import RECORDING
from capture_sim.run.summary_table import table

#: Largest number of runs that are drawn together, unless one command has made more.
SHOWN = 6


class ResultsFolder:
    """A folder to which a command writes runs.

    Create the object before the first recording is written, see :class:`ResultsTable`.
    """

    def __init__(self, folder: Path) -> None:
        self._folder, self._table = folder, ResultsTable(folder, warn)

    def add(self, runs: Sequence[Recorded]) -> list[Row]:
        """Print a table of the command's runs, update the folder's tables, and return the rows.

        If ``runs`` is empty, nothing is printed or written.
        """
        if not runs:
            return []
        own = [
            plain_row({**run.run.summary, RECORDING: run.path and run.path.name}) for run in runs
        ]
        labels = [run.label for run in runs]
        width = shutil.get_terminal_size().columns if sys.stdout.isatty() else None
        echo(f"\n{table(own, labels, width)}\n")
        updated = self._table.update(own)
        of = "table" if updated.rows == len(own) else f"table of all {updated.rows} runs"
        echo(f"{of} in {updated.table}, numbers in {updated.numbers}")
        return own

    def draw(self, runs: Sequence[Recorded]) -> None:
        """Draw each run of the command, and all of them beside the folder's latest other runs."""
        if not runs:
            return
        own = {run.path for run in runs}
        others: list[tuple[Run, str]] = []
        for path in reversed(self._table.recordings()):
            if len(others) + len(runs) >= SHOWN:
                break
            run = None if path in own else _drawable(path)
            if run is not None and not any(_is_copy(run, one.run) for one in runs):
                others.insert(0, (run, path.stem))
        names = [run.label for run in runs]
        draw([run.run for run in runs], names, self._folder, beside=others)


def _drawable(path: Path) -> Run | None:
    """Read a recording and return its run, to draw it beside other runs.

    None is returned if capture_sim did not record the file or if the run cannot be drawn.
    """
    from capture_sim.viewing.curves import plotted_runs

    if RUN_METADATA not in head_metadata(path):
        return None
    try:
        run = read_run(path)
        plotted_runs([run], [path.stem])
    except CaptureSimError:
        return None
    return run


def _is_copy(run: Run, other: Run) -> bool:
    """Return True if two runs are one simulated run, made twice."""
    return run.is_exact and other.is_exact and run.samples.tobytes() == other.samples.tobytes()
