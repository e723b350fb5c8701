"""What several commands tell and draw: progress, the table of results, pictures."""

from __future__ import annotations

import json
import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from capture_sim.errors import RecordingError

if TYPE_CHECKING:
    from capture_sim.recording import Run
    from capture_sim.viewing.source import ViewableRun


def say(text: str) -> None:
    """Print a line at once, also into a pipe."""
    print(text, flush=True)


def compile_first() -> None:
    """Compile the kernels if this version never was, and say so: it takes a while."""
    from capture_sim.bench import compile_kernels
    from capture_sim.kernels import is_compiled

    if not is_compiled():
        say("compiling the kernels, once for this version (about ten seconds) ...")
        began = time.perf_counter()
        compile_kernels()
        say(f"compiled in {time.perf_counter() - began:.1f} s")


def summary_of(run: Run) -> dict[str, Any]:
    """Summarise a recorded run as a simulated one's ``Result.summary`` does."""
    from capture_sim.results import summarize

    verdict = run.verdict.label if run.verdict is not None else "none"
    return summarize(run.scene, run.samples, run.touches, run.events, verdict, run.wall_time)


def report(summaries: list[dict[str, Any]], folder: Path) -> None:
    """Print the table of results, and keep it and its numbers in ``folder``.

    Without a result nothing is written: what an earlier command left there is kept.
    """
    from capture_sim.results import table

    if not summaries:
        return
    text = table(summaries)
    print()
    print(text)
    print()
    try:
        (folder / "results.txt").write_text(text + "\n", encoding="utf-8")
        (folder / "results.json").write_text(
            json.dumps(summaries, indent=2, allow_nan=False) + "\n", encoding="utf-8"
        )
    except OSError as error:
        raise RecordingError(f"{folder}: cannot be written: {error.strerror}") from None
    say(f"table in {folder / 'results.txt'}, numbers in {folder / 'results.json'}")


#: Drawn of several runs side by side.
OVERVIEW = "overview.png"


def draw(
    runs: Sequence[ViewableRun],
    labels: Sequence[str],
    folder: Path,
    rrd: Path | None = None,
    *,
    pictures: bool = True,
) -> None:
    """Draw each run, all side by side, and all for rerun, where what that takes is installed.

    Parameters
    ----------
    runs
        To be drawn.
    labels
        Their names, one each, none twice: of the recordings, as a scene may have several.
    folder
        Where the pictures go.
    rrd
        The file for rerun; None for ``runs.rrd`` in the folder.
    pictures
        Whether pictures are wanted, not only the file for rerun.
    """
    if not runs:
        return
    try:
        if pictures:
            _draw_pictures(runs, labels, folder)
    except ImportError as error:
        say(f"no pictures: {error}")
    try:
        from capture_sim.viewing import save_rrd

        path = folder / "runs.rrd" if rrd is None else rrd
        say(f"for rerun in {save_rrd(runs, path, labels)}")
    except ImportError as error:
        # an ordinary workstation's ROS bears no rerun: the recording is what counts there
        say(f"no rerun file: {error}; capture-sim view makes it where rerun is installed")


def _draw_pictures(runs: Sequence[ViewableRun], labels: Sequence[str], folder: Path) -> None:
    from capture_sim.viewing import save_figure, save_overview

    for run, label in zip(runs, labels, strict=True):
        # that name is taken
        name = f"{label}_run.png" if f"{label}.png" == OVERVIEW else f"{label}.png"
        say(f"picture in {save_figure(run, folder / name, label)}")
    overview = folder / OVERVIEW
    if len(runs) > 1:
        say(f"side by side in {save_overview(runs, overview, labels)}")
    elif overview.is_file():
        overview.unlink()  # it shows other runs than those that lie beside it now
        say(f"removed {overview}: it showed earlier runs")
