"""Output that several commands share: lines of text, progress, text files, JSON and plots.

Drawing modules are imported inside the functions that use them, so that a command without plots
does not wait for matplotlib and rerun.
"""

from __future__ import annotations

import gc
import json
import multiprocessing
import os
import shlex
import signal
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import BrokenExecutor, ProcessPoolExecutor
from contextlib import contextmanager
from contextvars import ContextVar
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from rich.console import Console

from capture_sim.base.files import discard_parts, write_text
from capture_sim.base.interrupts import end_with_parent
from capture_sim.base.tables import note_printed
from capture_sim.errors import CaptureSimError, one_line

if TYPE_CHECKING:
    from rich.progress import Progress as Bar

    from capture_sim.run.run import Run


class DrawingError(CaptureSimError):
    """Raised if a process that draws files was lost."""


#: Plot of several runs side by side.
OVERVIEW = "overview.png"
#: All runs for rerun.
RRD = "runs.rrd"
#: Message of a command that was interrupted while it drew.
IMAGES_MISSING = "the files named above are complete, other plots and rerun files are missing"
#: Time between two lines of progress without a terminal, s.
_PAUSE = 10.0


def echo(text: str) -> None:
    """Print text and flush it at once; control characters except line ends become blanks."""
    note_printed(text)
    print("".join(c if c.isprintable() or c == "\n" else " " for c in text), flush=True)


def warn(text: str) -> None:
    """Print a warning on standard error, in one line."""
    print(f"capture-sim: {one_line(text)}", file=sys.stderr, flush=True)


#: Time after which a task has a speed, s.
_FIRST_SPEED = 1.0


class Progress:
    """Progress of a long command: a bar on a terminal, otherwise a line every 10 s."""

    def __init__(self, unit: str = "runs") -> None:
        self._unit = unit
        self._bar: Bar | None = None
        self._tasks: dict[str, Any] = {}
        self._began: dict[str, tuple[float, int]] = {}
        self._said = time.monotonic()

    def __enter__(self) -> Progress:
        if sys.stderr.isatty():
            from rich.progress import MofNCompleteColumn, TextColumn, TimeRemainingColumn
            from rich.progress import Progress as Bar

            columns = (
                *Bar.get_default_columns()[:-1],
                MofNCompleteColumn(),
                TextColumn("{task.fields[rate]}"),
                TimeRemainingColumn(),
            )
            self._bar = Bar(*columns, console=Console(stderr=True), transient=True)
            self._bar.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        if self._bar is not None:
            self._bar.stop()

    def at(self, name: str, done: int, count: int | None) -> None:
        """Show that ``done`` of ``count`` units of a task are done, and the estimated time left.

        ``count`` is None where it is not known; no time is estimated then.  Each ``name`` is a task
        of its own, with its own bar and time.
        """
        now = time.monotonic()
        began, before = self._began.setdefault(name, (now, done))
        # what an archive or a journal has comes at once, and is no speed
        speed = (done - before) / (now - began) if now > began + _FIRST_SPEED else 0.0
        rate = f"{speed:.3g} {self._unit}/s" if speed else ""
        if self._bar is not None:
            if name not in self._tasks:
                self._tasks[name] = self._bar.add_task(name, total=count, rate="")
            self._bar.update(self._tasks[name], completed=done, total=count, rate=rate)
        elif speed and now - self._said > _PAUSE:
            self._said = now
            of, left = "", ""
            if count is not None:
                of, left = f" of {count}", f", about {(count - done) / speed:.0f} s left"
            print(f"{name}: {done}{of} {self._unit}, {rate}{left}", file=sys.stderr, flush=True)


#: What a command gives for ``--json``.
GIVEN: ContextVar[list[Any]] = ContextVar("given")


def give(make: Callable[[], Any]) -> None:
    """Note the results of a command, which ``--json`` prints in place of its text.

    ``make`` returns them; without ``--json`` it is not called.
    """
    given = GIVEN.get(None)
    if given is not None:
        given.append(make())


def write_json(path: Path, data: Any) -> Path:
    """Write data as a JSON file; return its path.  See :func:`json_text`."""
    return write_text(path, json_text(data))


def json_text(data: Any) -> str:
    """Return data as JSON.

    NumPy arrays become lists with null for NaN.  Any other NaN raises ValueError.
    """

    def plain(array: np.ndarray) -> object:
        values = array.astype(object)
        values[np.isnan(array)] = None
        return values.tolist()

    return json.dumps(data, indent=2, allow_nan=False, default=plain) + "\n"


def command_line() -> str:
    """Return the command line as it was typed, with quotes where a shell needs them."""
    return shlex.join(["capture-sim", *sys.argv[1:]])


@contextmanager
def reported_if_interrupted(state: str) -> Iterator[None]:
    """Add a text to the KeyboardInterrupt that Ctrl-C raises in the block.

    ``state`` says which files are complete.  The command line prints it as its last line.
    """
    try:
        yield
    except KeyboardInterrupt:
        raise KeyboardInterrupt(state) from None


@contextmanager
def drawing(lacking: str = "no plot: {error}") -> Iterator[None]:
    """Print a message and continue after the block if a drawing library cannot be imported.

    ``lacking`` is the message, in which ``{error}`` is replaced by the reason.
    """
    try:
        yield
    except ImportError as error:
        echo(lacking.format(error=error))


def draw(
    runs: Sequence[Run],
    labels: Sequence[str],
    folder: Path,
    rrd: Path | None = None,
    *,
    pictures: bool = True,
    window: tuple[float, float] | None = None,
    beside: Sequence[tuple[Run, str]] = (),
) -> None:
    """Draw each run, an overview of all runs side by side, and a file of all runs for rerun.

    If matplotlib or rerun is not installed, a message is printed instead.

    Parameters
    ----------
    runs
        Runs to draw; without a run, nothing is drawn.
    labels
        A different name for each run, which is also the name of its plot.
    folder
        Folder of the plots.
    rrd
        File for rerun; None for ``runs.rrd`` in the folder.
    pictures
        False to write only the file for rerun.
    window
        First and last time that the file for rerun shows, s since the release; None for all.
    beside
        Other runs with their names; they are drawn only in the overview and in the file for rerun.
    """
    if not runs:
        return
    together = [*(run for run, _ in beside), *runs], [*(label for _, label in beside), *labels]
    jobs: list[_Job] = []
    if pictures:
        with drawing("no plots: {error}"):
            jobs += _picture_jobs(runs, labels, folder, together)
    path = folder / RRD if rrd is None else rrd
    jobs.append(_Job("rerun file in", _save_rrd, (together[0], path, together[1], window)))
    # forked, so that each process shares what is loaded and loads what only its job needs
    fork = multiprocessing.get_context("fork")
    n_processes = min(len(jobs), len(os.sched_getaffinity(0)))
    try:
        with ProcessPoolExecutor(n_processes, fork, _begin_drawing) as pool:
            # the file for rerun first, as it takes longest to begin
            drawn = [pool.submit(job.draw, *job.arguments) for job in reversed(jobs)][::-1]
            for job, file in zip(jobs, drawn, strict=True):
                # a system's ROS has no rerun: the recording matters there
                with drawing("no rerun file: {error}; install it and run capture-sim view"):
                    echo(f"{job.title} {file.result()}")
    except (BrokenExecutor, MemoryError):
        raise DrawingError(
            "a process that draws was lost: killed, or there is too little memory; "
            f"{IMAGES_MISSING}"
        ) from None


def _begin_drawing() -> None:
    """Prepare a worker process that draws files.

    The process ignores Ctrl-C, so that it completes the file that it is drawing.  It never
    garbage-collects objects that it has inherited, because the destructor of a DDS object needs
    threads that do not exist after a fork.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    gc.freeze()
    for signum in (signal.SIGTERM, signal.SIGHUP):  # they go to the parent, too
        signal.signal(signum, signal.SIG_IGN)
    end_with_parent(discard_parts)


class _Job(NamedTuple):
    """A file to draw, and the start of the line that is printed when it is complete.

    ``draw(*arguments)`` draws the file and returns its path.
    """

    title: str
    draw: Callable[..., Path]
    arguments: tuple[Any, ...]


def _picture_jobs(
    runs: Sequence[Run],
    labels: Sequence[str],
    folder: Path,
    together: tuple[Sequence[Run], Sequence[str]],
) -> Iterator[_Job]:
    from capture_sim.viewing.plots import draw_overview, draw_run

    for run, label in zip(runs, labels, strict=True):
        # the label is the overview's name
        name = f"{label}_run.png" if f"{label}.png" == OVERVIEW else f"{label}.png"
        yield _Job("plot in", _save_picture, (draw_run, run, label, folder / name))
    if len(together[0]) > 1:
        yield _Job(
            "plots side by side in", _save_picture, (draw_overview, *together, folder / OVERVIEW)
        )


def _save_picture(draw: Callable[..., Any], runs: Any, labels: Any, path: Path) -> Path:
    from capture_sim.viewing.canvas import save

    return save(draw(runs, labels), path)


def _save_rrd(
    runs: Sequence[Run], path: Path, labels: Sequence[str], window: tuple[float, float] | None
) -> Path:
    from capture_sim.viewing.rerun_view import save_rrd

    return save_rrd(runs, path, labels, window)
