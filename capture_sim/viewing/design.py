"""Plots of a design: the buffers that were tried, over pairs of objectives, and the best ones."""

from __future__ import annotations

import itertools
import math
import textwrap
from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullFormatter, ScalarFormatter

from capture_sim.run.simulation import simulate
from capture_sim.studies.evaluate.dispersion import CAPTURED_LEFT
from capture_sim.studies.evaluate.limits import CAPTURE_RANGE, Measure
from capture_sim.studies.evaluate.outcome import CAPTURED
from capture_sim.studies.search.design import Design
from capture_sim.studies.search.evaluator import Candidate, costs_of
from capture_sim.viewing import style
from capture_sim.viewing.canvas import subplots

#: Axes show the front with this factor of room; on linear axes, this share of its range.
_ROOM, _LINEAR_ROOM = 1.7, 0.3


#: Height of a number, of the height of the panel of values.
_NUMBER_HEIGHT = 0.045


def draw_design(design: Design, picked: int | None = None) -> Figure:
    """Return the figure of a design.

    It has a panel for each pair of objectives, with all candidates (the buffers that were tried)
    and the front.  With one objective it has one, over the first other load with a limit, else over
    the largest inward stroke.  A further panel shows the values of the rows (the buffers that the
    design offers), or, if there is at most one row, the progress of the search.  If there are rows,
    the last panel shows force over stroke of some of them.
    ``picked`` is the index of the row that the user has picked; None if none is.
    """
    objectives = design.requirements.objectives
    pairs = list(itertools.combinations(objectives, 2))
    if not pairs:
        limited = [each for each in design.requirements.limits if each.key != objectives[0].key]
        key = limited[0].key if limited else "max_axial_stroke_in"
        pairs = [(Measure(key), objectives[0])]
    several = len(design.rows) > 1
    # one more panel each: the search's progress or the rows' values, and force over stroke
    count = len(pairs) + 1 + bool(design.rows)
    columns = min(count, 3)
    figure, panels = subplots(
        0.5 + 6.6 * columns, 6.4 * math.ceil(count / columns) + 0.8, -(-count // columns), columns
    )
    used = list(panels.flat)
    for panel, (across, up) in zip(used, pairs, strict=False):
        third = next((each for each in objectives if each not in (across, up)), None)
        _draw_pair(panel, design, across, up, picked, third if len(objectives) > 2 else None)
    if several:
        _draw_values(used[len(pairs)], design, picked)
    else:
        _draw_progress(used[len(pairs)], design)
    if design.rows:
        _draw_springs(used[len(pairs) + 1], design, picked)
    for panel in used[count:]:
        panel.set_axis_off()
    handles, labels = used[0].get_legend_handles_labels()
    by_label = dict(zip(labels, handles, strict=True))
    figure.legend(
        by_label.values(), by_label.keys(), loc="outside lower center", ncols=5, fontsize=11
    )
    figure.suptitle(_title(design, int(9.0 * figure.get_figwidth())), fontsize=13)
    return figure


def _title(design: Design, width: int) -> str:
    limits = ", ".join(limit.text for limit in design.requirements.limits)
    title = f"{design.scene.name}: {len(design.history)} buffers"
    return "\n".join([title, *textwrap.wrap(f"limits: {limits}", width)]) if limits else title


def _draw_values(axes: Axes, design: Design, picked: int | None) -> None:
    """Draw the values that were searched, of each row, as parallel coordinates.

    Each value is drawn as its place in its search range, from 0 to 1.
    """
    variables = design.variables
    colours = _colours(len(design.rows))
    at = np.arange(len(variables))
    ends = []
    for number, (row, colour) in enumerate(zip(design.rows, colours, strict=True), 1):
        shares = [each.position(row.candidate.values[each.name]) for each in variables]
        is_picked = number - 1 == picked
        axes.plot(at, shares, "o-", color=colour, lw=3.0 if is_picked else 1.5)
        ends.append((float(shares[-1]), number))
    height = -math.inf
    for share, number in sorted(ends):  # no number on another one
        height = max(share, height + _NUMBER_HEIGHT)
        axes.text(at[-1] + 0.06, height, str(number), va="center", fontsize=11)
    axes.set_xticks(
        at,
        [
            f"{each.name.removeprefix('buffer.')}\n{each.low:.3g} to {each.high:.3g}\n{each.unit}"
            for each in variables
        ],
    )
    axes.set_xlim(-0.3, len(variables) - 0.6)
    axes.set_ylim(-0.03, 1.03)
    axes.set_ylabel("place in the search range")
    axes.set_title("values of the rows", fontsize=12)


def _colours(count: int) -> np.ndarray:
    """Return colours of ``count`` rows, (count, 4) RGBA, for the panels of values and forces."""
    return np.asarray(colormaps["viridis"](np.linspace(0.0, 0.9, count)))


def _draw_springs(axes: Axes, design: Design, picked: int | None) -> None:
    """Draw the axial force of the buffer over its inward stroke in the whole run.

    Drawn are all rows and the scene's own buffer, each only if it captures.  A dot is the largest
    force of the table, which a stop or a seat may bear and which may lie between two samples.
    """
    last = len(design.rows) - 1
    runs = [
        (f"row {k + 1}" if last else "design", row.candidate) for k, row in enumerate(design.rows)
    ]
    colours = (*_colours(last + 1), style.PURPLE)
    for (name, candidate), colour in zip([*runs, ("own", design.own)], colours, strict=True):
        if candidate.verdict != CAPTURED:
            continue
        run = simulate(design.scene_of(candidate))
        samples, loads = run.samples, run.loads
        stroke, force = -samples["axial_stroke"] * 1e3, samples["axial_force"]
        is_picked = name == f"row {(design.knee if picked is None else picked) + 1}"
        axes.plot(stroke, force, color=colour, lw=2.0 if is_picked else 0.9, label=name)
        k = int(np.searchsorted(samples["t"], loads["max_buffer_force_time"]))
        k = min(k, len(samples) - 1)
        peak = math.copysign(loads["max_buffer_force"], force[k])
        axes.plot(stroke[k], peak, "o", color=colour, ms=6)
    axes.set_xlabel("axial stroke, inwards  [mm]")
    axes.set_ylabel("force of the buffer  [N]")
    axes.set_title("whole run; dots: largest force", fontsize=12)
    axes.legend(fontsize=11, ncols=2 if last > 5 else 1)


def _of(candidates: Sequence[Candidate], measure: Measure) -> np.ndarray:
    """Return the values of a load of candidates, (n,), in the unit of tables; NaN without one."""
    values = [each.loads.get(measure.key, math.nan) for each in candidates]
    return np.array(values, dtype=float) * measure.load.factor


def _draw_pair(
    axes: Axes,
    design: Design,
    across: Measure,
    up: Measure,
    picked: int | None,
    third: Measure | None = None,
) -> None:
    """Draw candidates, front, knee, picked row, the scene's own buffer and limits over two loads.

    ``across`` is on the horizontal axis, ``up`` on the vertical one.  The front has the colours of
    the load ``third``, if it is given.
    """
    history = design.history
    stays = design.requirements.allow_leaving
    held = [x for x in history if x.verdict == CAPTURED and (stays or not x.left_again)]
    parts = {
        "no capture": (style.LIGHT, [x for x in history if x.verdict != CAPTURED]),
        CAPTURED_LEFT: (
            style.VERDICTS[CAPTURED_LEFT].colour,
            [x for x in history if x.verdict == CAPTURED and x.left_again and not stays],
        ),
        "a limit exceeded": (style.ORANGE, [x for x in held if not x.feasible]),
        "feasible": (style.GREEN, [x for x in held if x.feasible]),
    }
    for label, (colour, candidates) in parts.items():
        if candidates:
            at = _of(candidates, across), _of(candidates, up)
            # thousands of points: as pixels in an SVG
            axes.plot(*at, ".", color=colour, label=label, ms=4, alpha=0.6, rasterized=True)
    is_line = {across.key, up.key} == {each.key for each in design.requirements.objectives}
    front = _of(design.front, across), _of(design.front, up)
    look: dict[str, Any] = {"color": style.BLUE, "lw": 1.5, "ms": 5}
    if is_line and len(design.front) > 1:
        # no buffer between two of the front is known to be on the straight line between them
        whole = [each for each, _ in design.whole_front]
        if across.key != design.requirements.objectives[0].key:
            whole.reverse()
        line = _of(whole, across), _of(whole, up)
        axes.plot(*line, "-", drawstyle="steps-post", color=style.BLUE, lw=1.5, label="front")
        axes.plot(*front, "o", label="rows", color=style.BLUE, ms=5)
    elif design.front and third is not None:
        values = _of(design.front, third)
        marks = axes.scatter(*front, c=values, cmap="viridis", s=50, zorder=3, label="front")
        axes.figure.colorbar(marks, ax=axes, label=f"{third.meaning}  [{third.load.shown_in}]")
    elif design.front:
        axes.plot(*front, "o", label="front" if len(design.front) > 1 else "design", **look)
    if len(design.rows) > 1:
        for number, row in enumerate(design.rows, 1):
            at_row = _of([row.candidate], across)[0], _of([row.candidate], up)[0]
            # neighbours of a dense front: above and below in turn
            above = (4, 4) if number % 2 else (-12, -13)
            axes.annotate(str(number), at_row, above, textcoords="offset points", fontsize=11)
    for label, index, marker in (
        ("knee", next((k for k, row in enumerate(design.rows) if row.is_knee), None), "*"),
        ("picked", picked, "o"),
    ):
        if index is None or (label == "picked" and design.rows[index].is_knee):
            continue
        row = design.rows[index]
        fill = "none" if label == "picked" else style.BLACK
        at = _of([row.candidate], across), _of([row.candidate], up)
        name = "design" if len(design.rows) == 1 else label
        axes.plot(*at, marker, color=style.BLACK, mfc=fill, ms=15, label=name)
    own = _of([design.own], across), _of([design.own], up)
    axes.plot(*own, "D", color=style.PURPLE, ms=9, label="scene's own buffer")
    for limit in design.requirements.limits:
        at_limit = limit.value * limit.load.factor
        look = {"color": style.VERMILION, "ls": "--", "lw": 2.0, "label": "limit"}
        if limit.key == across.key:
            axes.axvline(at_limit, **look)
        if limit.key == up.key:
            axes.axhline(at_limit, **look)
    if up.key == CAPTURE_RANGE and design.requirements.least_range:
        axes.axhline(design.requirements.least_range * 100.0, color=style.VERMILION, ls="--")
    for name, measure, values, own_value in (
        ("x", across, front[0], own[0]),
        ("y", up, front[1], own[1]),
    ):
        shown = (
            values if values.size else _of([x for x in history if x.verdict == CAPTURED], measure)
        )
        _set_scale(axes, name, measure, np.append(shown, own_value))
    axes.set_xlabel(f"{across.meaning}  [{across.load.shown_in}]")
    axes.set_ylabel(f"{up.meaning}  [{up.load.shown_in}]")


def _set_scale(axes: Axes, name: str, measure: Measure, values: np.ndarray) -> None:
    """Set the scale of an axis, "x" or "y", so that it shows some values with room around them.

    It is logarithmic if there are values and all are positive, else linear.  A capture range always
    has a linear axis of -4 to 104 %.
    """
    values = values[np.isfinite(values)]
    set_limits = axes.set_xlim if name == "x" else axes.set_ylim
    positive = values[values > 0.0]
    if measure.key == CAPTURE_RANGE:
        set_limits(-4.0, 104.0)
        return
    if positive.size < values.size or not values.size:
        width = max(float(np.ptp(values)) if values.size else 0.0, 1.0)
        low, high = (values.min(), values.max()) if values.size else (0.0, 1.0)
        set_limits(low - _LINEAR_ROOM * width, high + _LINEAR_ROOM * width)
        return
    (axes.set_xscale if name == "x" else axes.set_yscale)("log")
    set_limits(positive.min() / _ROOM, positive.max() * _ROOM)
    axis = axes.xaxis if name == "x" else axes.yaxis
    decades = math.log10(positive.max() / positive.min() * _ROOM**2)
    # numbers without powers, and some between the decades
    axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0) if decades < 3.0 else (1.0,)))
    axis.set_major_formatter(ScalarFormatter())
    axis.set_minor_formatter(NullFormatter())


def _draw_progress(axes: Axes, design: Design) -> None:
    """Draw the best value of the first objective so far over the number of the candidate.

    Only candidates that keep all limits count.  Those that were judged with random draws have a
    curve of their own.
    """
    objective = design.requirements.objectives[0]
    for name, is_drawn, colour in (
        ("scene alone", False, style.BLUE),
        ("with draws", True, style.PURPLE),
    ):
        numbered = [
            (number, each)
            for number, each in enumerate(design.history, 1)
            if each.feasible and (each.share is not None) == is_drawn
        ]
        if numbered:
            best = np.minimum.accumulate(
                costs_of([each for _, each in numbered], [objective])[:, 0]
            )
            numbers = [number for number, _ in numbered]
            values = np.exp(best) if objective.sign > 0.0 else -100.0 * best
            axes.step(numbers, values, color=colour, label=name, where="post")
    axes.set_xlim(0, len(design.history) + 1)
    axes.set_xlabel("candidate")
    axes.set_ylabel(f"best {objective.meaning} so far  [{objective.load.shown_in}]")
    if axes.lines:
        axes.legend(fontsize=12)
