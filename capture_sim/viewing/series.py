"""Lines over time, of one run or of several in one diagram, drawn with matplotlib.

As in the paper, a line is solid while the tip touches the cone and dashed while it does not.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes

from capture_sim.viewing import palette
from capture_sim.viewing.canvas import SMALL
from capture_sim.viewing.source import (
    ViewableRun,
    distinct_names,
    first_touch,
    in_contact,
    start_word,
    time_window,
)

_ENTRY = 2.3  # inches, about the width of an entry of a legend
_FREE = (0, (4.0, 2.2))  # dashes


class Shown(NamedTuple):
    """A run as it is drawn: its name, colour, and from when its time counts."""

    run: ViewableRun
    label: str
    colour: str
    origin: float  # s
    touching: np.ndarray  # (n,) bool, of its samples

    @property
    def time(self) -> np.ndarray:
        """Times of the samples as drawn, (n,), s."""
        return np.asarray(self.run.samples["t"]) - self.origin


class Trace(NamedTuple):
    """A curve from elsewhere, to be drawn over a run's: another engine, a measurement."""

    label: str
    t: np.ndarray  # (n,), s, on the axis that is drawn
    values: np.ndarray  # (n,) or (n, k), SI units


def as_shown(
    runs: ViewableRun | Sequence[ViewableRun],
    labels: Sequence[str] | None = None,
    *,
    aligned: bool = False,
) -> list[Shown]:
    """Give every run its label, colour and origin of time.

    Parameters
    ----------
    runs
        One, or several.
    labels
        One each; None takes the scenes' names.
    aligned
        Count each run's time from its first touch.

    Raises
    ------
    ValueError
        There is no run, or not one label each.
    """
    several = list(runs) if isinstance(runs, Sequence) else [runs]
    if not several:
        raise ValueError("no run to draw")
    names = distinct_names([run.scene.name for run in several]) if labels is None else labels
    if len(names) != len(several):
        raise ValueError(f"{len(names)} labels for {len(several)} runs")
    # a single run is drawn black, as it is in print
    colours = palette.RUNS if len(several) > 1 else (palette.BLACK,)
    shown = []
    for i, (run, name) in enumerate(zip(several, names, strict=True)):
        touch = first_touch(run)
        origin = touch.t if aligned and touch is not None else 0.0
        shown.append(Shown(run, name, colours[i % len(colours)], origin, in_contact(run)))
    return shown


def common_window(
    shown: Iterable[Shown], window: tuple[float, float] | None = None
) -> tuple[float, float]:
    """Return the time to draw, s on the axis: as asked, or from before contact to verdict."""
    if window is not None:
        return window
    windows = [
        (start - s.origin, end - s.origin) for s in shown for start, end in [time_window(s.run)]
    ]
    return min(start for start, _ in windows), max(end for _, end in windows)


def draw_line(
    axes: Axes,
    one: Shown,
    values: np.ndarray,
    window: tuple[float, float],
    *,
    width: float = 1.8,
) -> None:
    """Draw values of the samples, (n,): solid in contact, dashed out of it.

    Only what lies in the window is drawn, so that the axis fits it.
    """
    t = one.time
    inside = (t >= window[0]) & (t <= window[1])
    t, values, touching = t[inside], values[inside], one.touching[inside]
    # a stretch between two samples belongs to the earlier of them
    before = np.concatenate([touching[:1], touching[:-1]])
    free = np.where(touching & before, np.nan, values)
    solid = np.where(touching | before, values, np.nan)
    axes.plot(t, free, color=one.colour, lw=0.8 * width, ls=_FREE)
    axes.plot(t, solid, color=one.colour, lw=1.15 * width, solid_capstyle="butt")


def label_runs(
    axes: Axes,
    shown: Sequence[Shown],
    traces: Sequence[Trace] = (),
    *,
    contact: bool = True,
    outside: bool = False,
) -> None:
    """Explain colours and dashes in a legend, in the axes or, of all axes, above the figure."""
    if len(shown) > 1:
        for one in shown:
            axes.plot([], [], color=one.colour, lw=2.6, label=one.label)
    tone = shown[0].colour if len(shown) == 1 else palette.GREY
    if contact:
        axes.plot([], [], color=tone, lw=2.0, label="in contact")
        axes.plot([], [], color=tone, lw=1.5, ls=_FREE, label="no contact")
    for i, trace in enumerate(traces):
        axes.plot([], [], color=trace_colour(i), lw=0, marker="o", ms=5, label=trace.label)
    if outside:
        figure = axes.get_figure(root=True)
        if figure is not None:
            handles, names = axes.get_legend_handles_labels()
            for other in figure.axes:
                if other is not axes:
                    more = other.get_legend_handles_labels()
                    handles, names = handles + more[0], names + more[1]
            columns = min(len(names), int(figure.get_figwidth() // _ENTRY))
            figure.legend(handles, names, loc="outside upper center", ncols=columns, fontsize=SMALL)
    else:
        axes.legend(fontsize=SMALL, framealpha=0.9, loc="best", handlelength=2.2)


def trace_colour(i: int) -> str:
    """Return the colour of the i-th curve from elsewhere."""
    return (palette.ORANGE, palette.SKY, palette.PURPLE)[i % 3]


def finish_time_axis(axes: Axes, shown: Sequence[Shown], window: tuple[float, float]) -> None:
    """Set limits, grid and the label of the time axis."""
    axes.set_xlim(window)
    axes.grid(color=palette.LIGHT, lw=0.6)
    axes.set_axisbelow(True)
    axes.set_xlabel(f"{time_label(shown)}  [s]")


def time_label(shown: Sequence[Shown]) -> str:
    """Return from when time counts, in words."""
    if any(one.origin for one in shown):
        return "time since the first touch"
    words = {start_word(one.run.scene) for one in shown}
    return f"time since the {words.pop() if len(words) == 1 else 'start'}"
