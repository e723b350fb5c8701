"""Plots of the table of a sweep, which has one row for each run.

There are plots of the loads over one input, of the verdicts over two inputs, of the distribution
of the loads, and of the influence of each input.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.colors import ListedColormap
from matplotlib.contour import QuadContourSet
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.path import Path
from matplotlib.patheffects import AbstractPathEffect, withStroke
from matplotlib.ticker import MaxNLocator

from capture_sim.run.loads import LOADS
from capture_sim.studies.evaluate.capture_range import CaptureRange
from capture_sim.studies.evaluate.dispersion import (
    CAPTURED_LEFT,
    MAIN_LOADS,
    Indices,
    computed_rows,
    hold_probability,
    limit_probability,
    outcome_labels,
    plain_rows,
    rank_correlations,
)
from capture_sim.studies.evaluate.limits import Limit
from capture_sim.studies.evaluate.outcome import CAPTURED
from capture_sim.studies.evaluate.sweep import FAILED
from capture_sim.studies.vary.inputs import Input, is_drawn, typed_unit
from capture_sim.viewing import style
from capture_sim.viewing.canvas import columns_for, hide_unused, subplots

if TYPE_CHECKING:
    import pandas

#: Colours of outcomes: the verdicts, and captures whose tip left the capture zone again.
_OUTCOMES = {outcome: look.colour for outcome, look in style.VERDICTS.items()}
_UNCOMPUTED = style.LIGHT
#: Most panels of a map.
_MAX_PANELS = 9
_MIN_RANKED = 3
_MAX_LEVELS = 5  # of the contours
_MIN_CONTOUR = 2.5  # cells


class _Shown(NamedTuple):
    """Name and unit with which a column is plotted; SI values times ``factor`` are in this unit."""

    name: str
    unit: str
    factor: float

    @property
    def label(self) -> str:
        return f"{self.name}  [{self.unit}]" if self.unit else self.name


def _load(name: str) -> _Shown:
    load = next(load for load in LOADS if load.key == name)
    return _Shown(load.meaning, load.shown_in, load.factor)


def _input(axis: Input) -> _Shown:
    unit, factor = typed_unit(axis)
    if unit == axis.unit:
        usual = {"m": ("mm", 1e3), "rad": ("deg", math.degrees(1.0)), "1": ("", 1.0)}
        unit, factor = usual.get(unit, (unit, 1.0))
    return _Shown(axis.name, unit, factor)


def draw_sweep(
    table: pandas.DataFrame,
    axes: Sequence[Input],
    title: str,
    indices: Sequence[Indices] = (),
    limits: Sequence[Limit] = (),
    ranges: Mapping[tuple[Any, ...], CaptureRange] | None = None,
) -> dict[str, Figure]:
    """Return the figures that suit the inputs of a sweep, by name; empty if every run failed.

    ``table`` is the result of the sweep and ``axes`` are its inputs; ``title`` is the name of the
    scene.  Only inputs that are numbers are considered:

    - ``curve``: one input has several values, and all of them were run equally often.
    - ``map``: two or more inputs have several values, all combinations of these were run once, and
      no input has a distribution.
    - ``loads``: an input has a distribution, or there is neither a curve nor a map.  In the same
      cases, ``indices`` if these are given; otherwise ``tornado`` if three runs
      or more were computed and any result varies with any input.

    ``indices`` are Sobol's indices of the main loads, from runs of Saltelli's design, with their
    arrays in the order of the sorted names of the inputs.  ``limits`` are marked in the plots.
    ``ranges`` are the capture ranges that a map shows, see :func:`draw_map`.
    """
    table = table.assign(outcome=outcome_labels(table))
    numbers = [axis for axis in axes if table[axis.name].dtype.kind in "if"]
    grid = [axis for axis in numbers if len(set(axis.values)) > 1]
    drawn = [axis for axis in numbers if axis.distribution]
    draws = len(table) // math.prod(len(set(axis.values)) for axis in grid)
    is_grid = grid and len(table.groupby([axis.name for axis in grid])) * draws == len(table)
    is_curve = is_grid and len(grid) == 1
    # with a text as a further input, or with rows that repeat, a combination has several outcomes
    is_map = is_grid and len(grid) > 1 and not drawn and draws == 1
    if computed_rows(table).empty:
        return {}
    figures = {}
    if is_curve:
        figures["curve"] = draw_curve(table, grid[0], title, limits)
    elif is_map:
        figures["map"] = draw_map(table, grid, title, limits, ranges or {})
    if drawn or not (is_curve or is_map):
        figures["loads"] = draw_loads(table, title, limits)
        if indices:
            figures["indices"] = draw_indices(indices, sorted(axis.name for axis in drawn), title)
        elif len(plain_rows(computed_rows(table))) >= _MIN_RANKED:
            inputs = [axis.name for axis in numbers if table[axis.name].nunique() > 1]
            correlations = rank_correlations(table, inputs).dropna(axis=1, how="all")
            if not correlations.empty:
                figures["tornado"] = draw_tornado(table, correlations, title)
    return figures


def draw_table(table: pandas.DataFrame) -> Figure:
    """Return the main figure of the table of a sweep; ValueError if every run failed."""
    units, axes = table.attrs["units"], []
    for name, text in table.attrs["inputs"].items():
        values = () if is_drawn(text) else tuple(table[name].unique())
        axes.append(Input(name, units[name], values, is_drawn(text) or None, text=text))
    if not (figures := draw_sweep(table, axes, table.attrs["scene"])):
        raise ValueError("nothing to plot: no run of the sweep could be computed")
    return next(iter(figures.values()))


def draw_curve(table: pandas.DataFrame, axis: Input, title: str, limits: Sequence[Limit]) -> Figure:
    """Return a figure of the main loads over the values of one input, with a panel for each load.

    With one run at each value, the runs are joined by a line, and markers show their outcomes.
    With more rows than values, each panel shows single runs, the median and the band from 5 to
    95 %, and a further panel shows the probability of capture with its 95 % interval.

    A value with a run that could not be computed has a grey vertical line in the first panel.
    ``table`` must have the column ``outcome``.  Only ``limits`` of a main load of the complete run
    are drawn.
    """
    several = table[axis.name].nunique() < len(table)
    figure, panels = subplots(9.0, 12.0, len(MAIN_LOADS) + several, 1, font=12.0, sharex=True)
    x = _input(axis)
    computed = computed_rows(table)
    for panel, name in zip(panels.flat, MAIN_LOADS, strict=False):
        y = _load(name)
        if several:
            groups = computed.groupby(axis.name)[name]
            low, middle, high = (groups.quantile(q) * y.factor for q in (0.05, 0.5, 0.95))
            at = middle.index.to_numpy() * x.factor
            panel.fill_between(at, low, high, color=style.SKY, alpha=0.35, lw=0, label="5 to 95 %")
            panel.plot(at, middle, color=style.BLUE, label="median")
            single = computed[axis.name] * x.factor, computed[name] * y.factor
            panel.plot(*single, ".", color=style.GREY, ms=2.5, alpha=0.5, label="single runs")
        else:
            ordered = computed.sort_values(axis.name)
            panel.plot(
                ordered[axis.name] * x.factor, ordered[name] * y.factor, color=style.GREY, lw=1.0
            )
            for outcome, rows in ordered.groupby("outcome"):
                panel.plot(
                    rows[axis.name] * x.factor,
                    rows[name] * y.factor,
                    style.VERDICTS[str(outcome)].marker,
                    color=_OUTCOMES[str(outcome)],
                    label=outcome,
                )
        _mark_limits(panel.axhline, name, limits)
        panel.set_ylabel(f"{y.name}\n[{y.unit}]")
        panel.set_ylim(0.0, 1.1 * panel.get_ylim()[1])
    failed = table[table["verdict"] == FAILED]
    for place in failed[axis.name].unique() * x.factor:
        panels[0, 0].axvline(place, color=_UNCOMPUTED, zorder=0)
    if several:
        _draw_probability(panels[-1, 0], table, axis, x.factor)
    panels[0, 0].legend(fontsize=11, ncols=4, loc="lower left", bbox_to_anchor=(0.0, 1.0))
    panels[-1, 0].set_xlabel(x.label)
    note = f", {len(failed)} could not be computed (grey)" if len(failed) else ""
    figure.suptitle(f"{title}: {len(table)} runs{note}", fontsize=14)
    return figure


def _mark_limits(draw_line: Callable[..., Any], load: str, limits: Sequence[Limit]) -> None:
    """Draw the limits of one load as lines, each by a call of ``draw_line``.

    ``load`` is the name of the load in results.  Limits of other loads, or of this load until the
    latch closes, are not drawn.
    """
    for limit in limits:
        if limit.key == load:
            at = limit.value * limit.load.factor
            draw_line(at, color=style.VERMILION, lw=2.0, label=f"limit {at:.4g}")


def _draw_probability(panel: Axes, table: pandas.DataFrame, axis: Input, factor: float) -> None:
    groups = [(value, hold_probability(rows)) for value, rows in table.groupby(axis.name)]
    at = np.array([value for value, _ in groups]) * factor
    low, estimate, high = np.array([[p.low, p.estimate, p.high] for _, p in groups]).T
    panel.fill_between(at, low, high, color=style.GREEN, alpha=0.25, lw=0)
    panel.plot(at, estimate, "o-", color=style.GREEN)
    panel.set_ylim(-0.02, 1.02)
    panel.set_ylabel("probability of a capture\nthat lasts (95 % interval)")


def draw_map(
    table: pandas.DataFrame,
    axes: Sequence[Input],
    title: str,
    limits: Sequence[Limit] = (),
    ranges: Mapping[tuple[Any, ...], CaptureRange] | None = None,
) -> Figure:
    """Return a map of the outcomes over two inputs in colours, with contours of the peak force.

    ``axes`` are two or more inputs of a sweep, and ``table`` has one run for each combination of
    their values, with the column ``outcome``.  The two inputs with the most values are the x and y
    axes of the map.  Each combination of the values of all other inputs has its own panel, but only
    the first nine combinations, in ascending order of their values, are drawn.

    If ``limits`` are given, a cross marks each run that exceeds one of them, and ``table`` must
    have the column ``exceeded``.  The title of a panel gives the capture range if ``ranges`` has
    one, else the share of the runs that are captured.  The keys of ``ranges`` are the values of
    the inputs that are not on the x and y axes; the key is ``()`` if there are no such inputs.
    """
    across, up = sorted(axes, key=lambda axis: -len(set(axis.values)))[:2]
    across, up = (axis for axis in axes if axis in (across, up))
    others = [axis.name for axis in axes if axis not in (across, up)]
    pages = list(table.groupby(others, sort=True)) if others else [("", table)]
    columns = min(len(pages), 3)
    rows = math.ceil(min(len(pages), _MAX_PANELS) / columns)
    figure, panels = subplots(
        1.0 + 5.2 * columns, 1.6 + 4.6 * rows, rows, columns, grid=None, font=12.0
    )
    levels = _levels(table["max_normal_force"].to_numpy(float))
    for panel, (values, page) in zip(panels.flat, pages, strict=False):
        _draw_verdicts(panel, page, across, up, levels)
        if limits:
            exceeding = page[page["exceeded"] != ""]
            panel.plot(
                exceeding[across.name] * _input(across).factor,
                exceeding[up.name] * _input(up).factor,
                "x",
                color=style.BLACK,
                ms=5,
            )
        shown = zip(
            [axis for axis in axes if axis.name in others],
            values if isinstance(values, tuple) else (values,),
            strict=False,
        )
        captured, left = (
            float((page["outcome"] == outcome).mean()) for outcome in (CAPTURED, CAPTURED_LEFT)
        )
        share = f"{captured:.1%} captured and not left again"
        found = (ranges or {}).get(values if isinstance(values, tuple) else ())
        if found is not None:
            share = f"capture range {found.share * 100.0:.1f} +- {found.error * 100.0:.1f} %"
            for at in found.edges:
                x, y = (v * _input(axis).factor for v, axis in zip(at, (across, up), strict=True))
                panel.plot(x, y, "o", color=style.BLACK, mfc="white", ms=3.5, zorder=6)
        share += f"\nbesides, {left:.1%} captured and left again" if left else ""
        where = ", ".join(
            f"{axis.name} = {value * _input(axis).factor:.4g} {_input(axis).unit}"
            for axis, value in shown
        )
        panel.set_title(f"{where}\n{share}".strip(), fontsize=12)
    for panel in panels.flat[len(pages) :]:
        panel.set_axis_off()
    given = set(table["outcome"])
    patches: list[Artist] = [
        Patch(facecolor=look.colour, label=outcome, hatch=look.hatch, edgecolor="white")
        for outcome, look in style.VERDICTS.items()
        if outcome in given
    ]
    if FAILED in given:
        patches.append(Patch(color=_UNCOMPUTED, label="not computed"))
    if any(found.edges for found in (ranges or {}).values()):
        look: dict[str, Any] = {"ls": "", "color": style.BLACK, "mfc": "white", "ms": 3.5}
        patches.append(Line2D([], [], marker="o", label="edge, by bisection", **look))
    if limits:
        texts = ", ".join(limit.text for limit in limits)
        label = f"exceeds a limit: {texts}"
        patches.append(Line2D([], [], marker="x", ls="", color=style.BLACK, label=label))
    figure.legend(handles=patches, loc="outside lower center", ncols=6 if columns > 1 else 3)
    cut = f"; the first {_MAX_PANELS} of {len(pages)} maps" if len(pages) > _MAX_PANELS else ""
    contours = "contours: peak normal force [N]"
    figure.suptitle(f"{title}: {len(table)} runs{cut}; {contours}", fontsize=13)
    return figure


def _levels(force: np.ndarray) -> np.ndarray:
    """Return the levels of the force contours of a map, N, which all its panels share.

    ``force`` has the peak force of every run of the map, N.  The result is empty if no run has a
    touch.
    """
    known = force[np.isfinite(force) & (force > 0.0)]
    if not known.size:
        return np.empty(0)
    return np.asarray(MaxNLocator(_MAX_LEVELS + 1).tick_values(known.min(), known.max()))


def _draw_verdicts(
    panel: Axes, page: pandas.DataFrame, across: Input, up: Input, levels: np.ndarray
) -> None:
    names = [*_OUTCOMES, FAILED]
    numbers = page.assign(number=page["outcome"].map(names.index))
    grid = numbers.pivot(index=up.name, columns=across.name, values="number")
    force = page.pivot(index=up.name, columns=across.name, values="max_normal_force")
    x, y = _input(across), _input(up)
    places = grid.columns.to_numpy(float) * x.factor, grid.index.to_numpy(float) * y.factor
    colours = ListedColormap([*_OUTCOMES.values(), _UNCOMPUTED])
    panel.pcolormesh(
        *places, grid.to_numpy(), cmap=colours, vmin=-0.5, vmax=len(names) - 0.5, shading="nearest"
    )
    force = force.where(force > 0.0)  # none around the runs without a touch
    if min(force.shape) > 1 and force.notna().to_numpy().any():
        lines = panel.contour(*places, force.to_numpy(), levels, colors=style.BLACK, linewidths=0.8)
        _drop_short_contours(lines, [_MIN_CONTOUR * np.diff(at).min() for at in places])
        # read on dark colours too
        halo: list[AbstractPathEffect] = [withStroke(linewidth=2.0, foreground="white")]
        lines.set_path_effects(halo)
        for text in panel.clabel(lines, fontsize=9):
            text.set_path_effects(halo)
    panel.set_xlabel(x.label)
    panel.set_ylabel(y.label)


def _drop_short_contours(lines: QuadContourSet, least: Sequence[float]) -> None:
    """Remove pieces of contours that are both narrower and lower than ``least``.

    Such a piece encircles a single run.  ``least`` is a width and a height, in the units of the
    plot.
    """
    paths = []
    for path in lines.get_paths():
        pieces = path.to_polygons(closed_only=False)
        kept = [Path(piece) for piece in pieces if (np.ptp(piece, axis=0) >= least).any()]
        paths.append(Path.make_compound_path(*kept))
    lines.set_paths(paths)


def draw_loads(table: pandas.DataFrame, title: str, limits: Sequence[Limit]) -> Figure:
    """Return a figure with a histogram of each main load, stacked by the outcomes of the runs.

    An outcome is a verdict, or a capture whose tip left the capture zone again.  Lines mark the
    95 % and 99 % quantiles of a load over all computed runs, and its limits.  The title gives the
    number of captures that last and, with ``limits``, the number of runs that meet all of them.
    Additional draws near the edges of the distributions are left out.  ``table`` must have the
    column ``outcome``.
    """
    figure, panels = subplots(13.0, 8.5, 2, 2, font=12.0)
    plain = plain_rows(table)
    computed = computed_rows(plain)
    for panel, name in zip(panels.flat, MAIN_LOADS, strict=True):
        shown = _load(name)
        parts = {
            outcome: (computed.loc[computed["outcome"] == outcome, name] * shown.factor).dropna()
            for outcome in _OUTCOMES
        }
        parts = {outcome: values for outcome, values in parts.items() if len(values)}
        panel.hist(
            list(parts.values()),
            bins=min(40, max(8, round(math.sqrt(len(computed))))),
            stacked=True,
            color=[_OUTCOMES[outcome] for outcome in parts],
            hatch=[style.VERDICTS[outcome].hatch for outcome in parts],
            edgecolor="white",
            linewidth=0.0,
            label=list(parts),
        )
        for share, line in ((0.95, "--"), (0.99, ":")):
            panel.axvline(
                computed[name].quantile(share) * shown.factor,
                color=style.BLACK,
                ls=line,
                label=f"{share * 100:g} % of the runs are below",
            )
        _mark_limits(panel.axvline, name, limits)
        panel.set_xlabel(shown.label)
        panel.set_ylabel("runs")
        panel.yaxis.set_major_locator(MaxNLocator(integer=True))
    entries: dict[str, Any] = {}
    for panel in panels.flat:  # each limit is of one load
        for handle, label in zip(*panel.get_legend_handles_labels(), strict=True):
            entries.setdefault(label, handle)
    figure.legend(
        list(entries.values()), list(entries), loc="outside lower center", ncols=4, fontsize=11
    )
    p = hold_probability(table)
    interval = f"95 % interval {p.low:.1%} to {p.high:.1%}"
    note = f", {p.failed} could not be computed" if p.failed else ""
    if limits:
        kept = limit_probability(table, limits)
        note += f"; all limits met in {kept.met}"
    figure.suptitle(
        f"{title}: captured and not left again {p.met} of {p.computed} runs ({interval}){note}",
        fontsize=14,
    )
    return figure


def draw_tornado(table: pandas.DataFrame, correlations: pandas.DataFrame, title: str) -> Figure:
    """Return a figure of the rank correlation of each input with each result, as bars.

    ``correlations`` has one row for each input and one column for each result: main loads, and
    ``captured`` (1 or 0).  A NaN is drawn as 0.  ``table`` only gives the number of runs in the
    title.  The input with the strongest correlation with any result is at the top.
    """
    order = correlations.abs().max(axis=1).sort_values(ascending=False).index
    runs = len(plain_rows(computed_rows(table)))
    titles = [_load(name).name if name in MAIN_LOADS else "capture" for name in correlations]
    figure, panels = _bar_panels(list(order), titles, f"{title}: effect of the inputs, {runs} runs")
    for panel, name in zip(panels, correlations, strict=True):
        values = correlations.loc[order, name].fillna(0.0)
        colours = [style.VERMILION if value < 0 else style.BLUE for value in values]
        bars = panel.barh(range(len(order)), values, color=colours, height=0.7)
        panel.bar_label(bars, [f"{value:+.2f}" for value in values], padding=3, fontsize=9.5)
        panel.set_xlim(-1.3, 1.3)
    figure.supxlabel("rank correlation (Spearman)", fontsize=12)
    return figure


def draw_indices(indices: Sequence[Indices], inputs: Sequence[str], title: str) -> Figure:
    """Return a figure of Sobol's first-order and total indices as bars, with 95 % intervals.

    ``indices`` has one element, and the figure one panel, for each load.  ``inputs`` are the names
    of the inputs, in the order of the arrays of ``indices``.  The input with the largest total
    index for any load is at the top.
    """
    order = np.argsort(-np.max([found.total for found in indices], axis=0), kind="stable")
    titles = [_load(found.load).name for found in indices]
    headline = f"{title}: effect of the inputs, {indices[0].used} base samples"
    figure, panels = _bar_panels([inputs[i] for i in order], titles, headline)
    at = np.arange(len(order))
    for panel, found in zip(panels, indices, strict=True):
        for place, values, interval, colour, label in (
            (at - 0.2, found.first, found.first_interval, style.BLUE, "first"),
            (at + 0.2, found.total, found.total_interval, style.SKY, "total"),
        ):
            bars: dict[str, Any] = {
                "xerr": interval[order],
                "color": colour,
                "label": label,
                "capsize": 3,
            }
            panel.barh(place, values[order], 0.38, **bars)
    panels[-1].legend(fontsize=11)
    figure.supxlabel("Sobol index: share of the variance, 95 % interval", fontsize=12)
    return figure


def _bar_panels(
    inputs: Sequence[str], titles: Sequence[str], headline: str
) -> tuple[Figure, list[Axes]]:
    """Return a figure with an empty panel for each title, and the list of these panels.

    ``inputs`` are the labels of the bars, from top to bottom, at y = 0, 1, 2 and so on.
    ``headline`` is the title of the figure.
    """
    columns = columns_for(len(titles))
    rows = math.ceil(len(titles) / columns)
    height = 1.2 + rows * (0.7 + 0.5 * len(inputs))
    figure, panels = subplots(
        3.0 + 3.4 * columns, height, rows, columns, grid="x", font=12.0, sharex=True, sharey=True
    )
    used = list(panels.flat)[: len(titles)]
    hide_unused(panels, used)
    for panel, title in zip(used, titles, strict=True):
        panel.axvline(0.0, color=style.BLACK, lw=0.8)
        panel.set_title(title, fontsize=12)
    panels[0, 0].set_yticks(range(len(inputs)), list(inputs))
    panels[0, 0].set_ylim(len(inputs) - 0.5, -0.5)
    figure.suptitle(headline, fontsize=14)
    return figure, used
