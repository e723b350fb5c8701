"""Plots of one run, or of several runs overlaid.

The functions that draw a figure take runs (:class:`capture_sim.Run`, one or a sequence) and return
a figure of matplotlib; :func:`capture_sim.viewing.canvas.save` saves it.

Common keywords:

- ``labels``: one name for each run, instead of the scenes' names.
- ``window``: start and end of the drawn time, s.  The times are those of the plot's time axis.  For
  the path, the force over the stroke and the energies they are s since the release.
- ``aligned``: True to count each run's time from its first touch.

If there are more runs than colours (10), quantities over time are drawn as the range, the middle
half and the median of all runs.  Paths and forces over the stroke are then thin lines in one
colour.

Touches of a light tip last a fraction of a millisecond, less than a sample period: give runs
through :func:`capture_sim.viewing.source.resolved` to draw them with samples inside every touch.
"""

from __future__ import annotations

import string
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.transforms import Bbox

from capture_sim.run.first_contact import first_touch
from capture_sim.run.run import Run
from capture_sim.viewing import style
from capture_sim.viewing.canvas import columns_for, draw_shapes, hide_unused, subplots
from capture_sim.viewing.curves import (
    PANELS,
    STROKE,
    VELOCITIES,
    PlottedRun,
    Quantity,
    Runs,
    Window,
    are_many,
    common_window,
    energy_layers,
    has_ledger,
    held_by,
    plotted_runs,
    time_label,
)
from capture_sim.viewing.drawing import (
    draw_end,
    draw_markers,
    draw_quantity,
    draw_trajectory,
    line_look,
    run_look,
)
from capture_sim.viewing.shapes import TARGET, placed, state_shapes, tip_in_world, wall
from capture_sim.viewing.source import (
    SHORTEST_WINDOW,
    start_word,
    time_window,
)

_OUTSIDE = 3  # entries beyond which a legend covers too much of its axes
_ENTRY = 2.3  # inches, about the width of an entry of a legend
_MARGIN = 0.02  # m, round the vehicles
_PANEL = 5.4  # inches, width of a picture of a strip


class Picture(NamedTuple):
    """A plot of runs: the name of its file, its title, and the call that draws it."""

    name: str
    title: str
    draw: Callable[[], Figure]


def pictures_of(
    runs: Runs, labels: Sequence[str] | None = None, window: Window | None = None
) -> list[Picture]:
    """Return all plots that apply to runs; each is drawn when its ``draw`` is called.

    ``window`` is the drawn time, s since the release.  Without it, several runs are aligned at
    their first touch.  If a run has no energies, e.g. a measured run, there are no plots of
    energies, of the force over the stroke, and of the penetration.  With more than 10 runs there
    are no plots of energies and no views from above.  With a window there are no views from above.
    """
    plotted = plotted_runs(runs, labels)
    several = [each.run for each in plotted]
    names = [each.label for each in plotted]
    alike: dict[str, Any] = {"labels": names, "window": window}
    over = alike | {"aligned": window is None and len(several) > 1}
    simulated, few = all(map(has_ledger, several)), not are_many(plotted)
    drawn: list[tuple[str, str, Callable[..., Figure], dict[str, Any], bool]] = [
        *(
            (name, panel.title, partial(over_time, name), over, simulated or name != "intrusion")
            for name, panel in PANELS.items()
        ),
        ("trajectory", "Path of the tip", trajectory, alike, True),
        ("load_stroke", "Force over stroke of the axial buffer", load_stroke, alike, simulated),
        ("velocities", "Velocities", velocities, over, True),
        ("energies", "Where the energy is", energies, alike, simulated and few),
        ("snapshots", "From above", snapshots, {"labels": names}, window is None and few),
    ]
    return [
        Picture(name, title, partial(draw, several, **keywords))
        for name, title, draw, keywords, applies in drawn
        if applies
    ]


def over_time(
    panel: str,
    runs: Runs,
    *,
    labels: Sequence[str] | None = None,
    window: Window | None = None,
    aligned: bool = False,
) -> Figure:
    """Draw a quantity over time; ``panel`` is its key in :data:`.curves.PANELS`."""
    shown = plotted_runs(runs, labels, aligned=aligned)
    figure, [[axes]] = subplots(8.0, 4.6)
    _draw_over_time([axes], [PANELS[panel]], shown, window)
    contact = PANELS[panel].located is None
    if contact or len(shown) > 1:
        entries = len(shown) + (len(held_by(shown)) if contact else 0)
        _label_runs(axes, shown, contact=contact, outside=entries > _OUTSIDE)
    return figure


def sheet(panels: Sequence[str], runs: Runs, *, labels: Sequence[str] | None = None) -> Figure:
    """Draw four quantities, in two rows of two, over the same time axis.

    ``panels`` are four keys of :data:`capture_sim.viewing.curves.PANELS`.  Several runs are aligned
    at their first touch.
    """
    shown = plotted_runs(runs, labels, aligned=isinstance(runs, Sequence) and len(runs) > 1)
    figure, axes_grid = subplots(12.5, 8.2, 2, 2, sharex=True)
    _draw_over_time(axes_grid.flat, [PANELS[panel] for panel in panels], shown, None)
    for letter, axes in zip("abcd", axes_grid.flat, strict=True):
        axes.set_title(f"({letter})", fontsize=style.FONT, loc="left")
    for axes in axes_grid[0]:
        axes.set_xlabel("")
    _label_runs(axes_grid[1, 0], shown, outside=True)
    return figure


def trajectory(
    runs: Runs, *, labels: Sequence[str] | None = None, window: Window | None = None
) -> Figure:
    """Draw the path of the tip's centre in the cone's frame, of all runs in one plot."""
    shown = plotted_runs(runs, labels, window=window)
    figure, [[axes]] = subplots(7.4, 7.6, grid=None)
    draw_trajectory(axes, shown)
    if len(shown) == 1:
        draw_end(axes, shown[0])
    return figure


def velocities(
    runs: Runs,
    *,
    labels: Sequence[str] | None = None,
    window: Window | None = None,
    aligned: bool = False,
) -> Figure:
    """Draw velocities along x and y and angular velocities; chaser on the left, target right."""
    shown = plotted_runs(runs, labels, aligned=aligned)
    figure, rows = subplots(11.0, 8.2, 3, 2, sharex=True, sharey="row")
    for column, (vehicle, axes) in enumerate(zip(("chaser", "target"), rows.T, strict=True)):
        _draw_over_time(axes, [row[column] for row in VELOCITIES], shown, window)
        axes[0].set_title(vehicle, fontsize=style.FONT, fontweight="bold")
    for axes in rows[:-1].flat:
        axes.set_xlabel("")
    for left, right in rows:
        left.set_ylabel(left.get_ylabel().replace("  [", "\n["))
        right.set_ylabel("")
    _label_runs(rows[0, 1], shown, outside=True)
    return figure


def load_stroke(
    runs: Runs, *, labels: Sequence[str] | None = None, window: Window | None = None
) -> Figure:
    """Draw force over stroke of the axial buffer.

    The area of the loops is the energy that the buffer dissipates.  The legend has the energy
    dissipated by the axial damper from the start of the run to the last drawn sample.
    """
    shown = plotted_runs(runs, labels, window=window)
    figure, [[axes]] = subplots(8.4, 5.0)
    many = are_many(shown)
    for number, plotted in enumerate(shown):
        samples = plotted.samples
        stroke, force = STROKE.of(samples), samples["axial_force"]
        if many:
            axes.plot(stroke, force, color=style.BLUE, lw=0.8, alpha=0.4)
            continue
        axes.plot(stroke, force, color=plotted.colour, lw=1.5)
        loops = np.stack([stroke, force], axis=-1)
        draw_markers(axes, plotted, loops, samples["t"], number, len(shown))
        dissipated = samples["dissipated_axial"][-1] * 1e3
        label = f"{plotted.label}: {dissipated:.1f} mJ in the damper"
        axes.plot([], [], label=label, **run_look(plotted))
    axes.set_xlabel(STROKE.axis)
    axes.set_ylabel("force of spring and damper  [N]")
    if not many:
        # above: inside, the loops are everywhere
        columns = 1 if len(shown) <= _OUTSIDE else 2
        figure.set_figheight(4.6 + 0.3 * -(-len(shown) // columns))
        figure.legend(loc="outside upper center", fontsize=style.SMALL, ncols=columns)
    return figure


def energies(
    runs: Runs, *, labels: Sequence[str] | None = None, window: Window | None = None
) -> Figure:
    """Draw the energies of each run as stacked layers, one panel for each run."""
    shown = plotted_runs(runs, labels, window=window)
    columns = columns_for(len(shown))
    rows = -(-len(shown) // columns)
    width = 8.4 if columns == 1 else 5.4 * columns
    figure, panels = subplots(width, 1.0 + 3.9 * rows, rows, columns, sharey=True)
    for axes, plotted in zip(panels.flat, shown, strict=False):
        t, put_in, layers = energy_layers(plotted.samples)
        if layers:
            names, colours, values = zip(*layers, strict=True)
            axes.stackplot(t, *values, labels=names, colors=colours, lw=0)
        axes.plot(t, put_in, color=style.GREY, lw=2.0, ls="--", label="put in")
        axes.set_title(plotted.label, fontsize=style.FONT, fontweight="bold")
        axes.set_xlim(t[0], max(t[-1], t[0] + SHORTEST_WINDOW))
        axes.set_xlabel(f"{time_label([plotted])}  [s]")
    for axes in panels.flat[len(shown) :]:
        axes.set_axis_off()
    for axes in panels[:, 0]:
        axes.set_ylabel("energy  [mJ]")
    legend_above(figure)
    return figure


def snapshots(runs: Runs, *, count: int = 6, labels: Sequence[str] | None = None) -> Figure:
    """Draw a run as a strip of views from above, or several runs as strips side by side.

    The views are those of :func:`snapshot_times`.

    Parameters
    ----------
    runs
        One run, or a sequence of runs.
    count
        Number of views of each run, 2 to 26.
    labels
        One name for each run; None for the names of the scenes.
    """
    shown = plotted_runs(runs, labels)
    # a single strip is laid in two columns, read line by line
    single = len(shown) == 1
    columns = 2 if single else columns_for(len(shown))
    rows = -(-count // 2) if single else count * -(-len(shown) // columns)
    figure, axes_grid = subplots(1.0, 1.0, rows, columns, grid=None, sharex=True, sharey=True)
    strips = [
        axes_grid[i // columns * count : (i // columns + 1) * count, i % columns]
        for i in range(len(shown))
    ]
    used: list[Axes] = []
    for strip, plotted in zip([axes_grid.ravel()] if single else strips, shown, strict=True):
        when = snapshot_times(plotted.run, count)
        for letter, axes, t in zip(string.ascii_lowercase, strip, when, strict=False):
            _draw_instant(axes, plotted, float(t), letter)
            used.append(axes)
        if not single:
            strip[0].set_title(plotted.label, fontsize=style.FONT + 1, fontweight="bold")
    if single:
        figure.suptitle(shown[0].label, fontsize=style.FONT + 1, fontweight="bold")
    hide_unused(axes_grid, used)
    drawn = Bbox.union([axes.dataLim for axes in used])
    left, low, right, high = drawn.padded(_MARGIN).extents
    high += 0.09 * (right - left)  # room for the caption
    axes_grid[0, 0].set(xlim=(left, right), ylim=(low, high))  # of all
    panel = _PANEL * (high - low) / (right - left) + 0.12
    figure.set_size_inches((_PANEL + 0.75) * columns, rows * panel + 1.0)
    for column in axes_grid.T:
        lowest = [axes for axes in column if axes in used][-1]
        lowest.set_xlabel("x in the world  [m]")
    for axes in axes_grid[:, 0]:
        axes.set_ylabel("y  [m]")
    _name_parts(used[0], shown[0])
    return figure


def _name_parts(axes: Axes, plotted: PlottedRun) -> None:
    """Write the names of the cone and of the tip's path into the first view."""
    q = plotted.samples["q"][0]
    lip = placed(wall(plotted.scene.cone, 1)[1:] - (plotted.scene.cone.L_T, 0.0), *q[list(TARGET)])
    look: dict[str, Any] = {"textcoords": "offset points", "fontsize": style.SMALL}
    axes.annotate("cone", tuple(lip[0]), (-3, 4), ha="right", va="center", **look)
    tip = tip_in_world(plotted.scene, q[None])[0]
    look |= {"color": plotted.colour, "ha": "right", "va": "top"}
    axes.annotate("tip's path", tuple(tip), (0, -12), **look)


def snapshot_times(run: Run, count: int) -> np.ndarray:
    """Return the times of views from above, (count,), s since the release.

    The first is the start, the second is the first touch, and the others are evenly spread to the
    end of the drawn time, shortly after the verdict.  If there is no touch, or if it is less than
    20 ms after the start, all times are evenly spread.
    """
    start, end = float(run.samples["t"][0]), time_window(run)[1]
    touch = first_touch(run.events)
    if touch is None or touch.t - start < 0.02:
        return np.linspace(start, end, count)
    return np.concatenate([[start], np.linspace(touch.t, end, count - 1)])


def state_at(run: Run, t: float) -> np.ndarray:
    """Return the coordinates q, (8,), at a time ``t``, s, interpolated between the samples."""
    samples = run.samples
    return np.array([np.interp(t, samples["t"], samples["q"][:, i]) for i in range(8)])


def legend_above(figure: Figure) -> None:
    """Replace all legends of a figure by one above it, which contains each label once."""
    for earlier in [*figure.legends, *(axes.get_legend() for axes in figure.axes)]:
        if earlier is not None:
            earlier.remove()
    entries = dict[str, Artist]()
    for axes in figure.axes:
        handles, names = axes.get_legend_handles_labels()
        entries.update(zip(names, handles, strict=True))
    columns = max(min(len(entries), int(figure.get_figwidth() // _ENTRY)), 1)
    figure.legend(
        list(entries.values()),
        list(entries),
        loc="outside upper center",
        ncols=columns,
        fontsize=style.SMALL,
    )


def _draw_instant(axes: Axes, plotted: PlottedRun, t: float, letter: str) -> None:
    run = plotted.run
    touch = first_touch(run.events)
    meaning = "first touch" if touch is not None and t == touch.t else ""
    if t == run.samples["t"][0]:
        meaning = start_word(plotted.scene)
    draw_shapes(axes, state_shapes(plotted.scene, state_at(run, t), plotted.colour))
    path = tip_in_world(plotted.scene, run.samples["q"][run.samples["t"] <= t][::5])
    axes.plot(*path.T, color=plotted.colour, lw=1.8, zorder=2.5)  # over the bodies
    axes.plot(*path[0], "o", ms=4, color=plotted.colour, mfc="white", zorder=2.6)
    axes.set_aspect("equal")
    axes.text(
        0.012,
        0.975,
        f"({letter})  {t:.3f} s {meaning}".rstrip(),
        transform=axes.transAxes,
        ha="left",
        va="top",
        fontsize=style.SMALL,
        bbox={"facecolor": "white", "edgecolor": "none", "pad": 1.5},
        zorder=9,
    )


def _draw_over_time(
    all_axes: Iterable[Axes],
    quantities: Iterable[Quantity],
    shown: Sequence[PlottedRun],
    window: Window | None,
) -> None:
    """Draw one quantity in each axes, all over the same time."""
    start, end = window = common_window(shown, window)
    for axes, quantity in zip(all_axes, quantities, strict=True):
        draw_quantity(axes, quantity, shown, window)
        # a touch at the start is not drawn on the frame
        axes.set_xlim(start - 0.01 * (end - start), end)
        if end - start < 0.01:  # long numbers
            axes.locator_params(axis="x", nbins=5)
        axes.set_xlabel(f"{time_label(shown)}  [s]")


def _label_runs(
    axes: Axes, shown: Sequence[PlottedRun], *, contact: bool = True, outside: bool = False
) -> None:
    """Add a legend of the runs' colours and, if ``contact``, of the line styles.

    It is in the axes; if ``outside``, it is above the figure and covers all axes of the figure.
    """
    if not are_many(shown):
        if len(shown) > 1:
            for plotted in shown:
                axes.plot([], [], label=plotted.label, **run_look(plotted))
        tone = shown[0].colour if len(shown) == 1 else style.GREY
        for name in held_by(shown) if contact else ():
            axes.plot([], [], color=tone, label=name, **line_look(name))
    figure = axes.get_figure(root=True)
    if outside and figure is not None:
        legend_above(figure)
    else:
        axes.legend(fontsize=style.SMALL, framealpha=0.9, loc="best", handlelength=2.2)
