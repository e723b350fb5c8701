"""Summary plots: of one run, of several runs overlaid, and of several runs side by side."""

from __future__ import annotations

from collections.abc import Sequence
from string import ascii_lowercase
from typing import Any, NamedTuple

import numpy as np
from matplotlib import patheffects
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle
from matplotlib.ticker import NullLocator

from capture_sim.dynamics.samples import EventKind
from capture_sim.messages.urdf import Box, chaser_box, target_box
from capture_sim.run.first_contact import first_touch
from capture_sim.run.run import Run
from capture_sim.run.simulation import simulate
from capture_sim.scene.parts import Scene
from capture_sim.viewing import shapes, source, style
from capture_sim.viewing.canvas import (
    columns_for,
    draw_shapes,
    dress,
    new_figure,
    rows_of_axes,
)
from capture_sim.viewing.curves import (
    DISTANCE,
    STROKE,
    TORSION,
    PlottedRun,
    Quantity,
    Window,
    plotted_runs,
)
from capture_sim.viewing.drawing import draw_quantity, draw_trajectory, frame_bounds
from capture_sim.viewing.figures import sheet

_MM = 1e3  # in a metre: drawings are in mm
#: Points; sizes of a block in inches.
_FONT = 13.5
_ENDS = np.array([-1.0, 1.0])
_BLOCK = 13.53  # inches, height of a run in the overview, without its title
_COLUMN = 40  # letters of a title that a column of the overview is wide
_SMALLEST_FORCE = 0.05  # N, lower end of the logarithmic axis
_LETTER_HEIGHT = 14.0  # points, of a letter above its dot, or below it

_OVERLAID = ("impact_force", "distance", "axial_performance", "torsional_performance")


def plot(*runs: Any, labels: Sequence[str] | None = None) -> Figure:
    """Return a plot of one run, of several runs overlaid, or of a study, as a matplotlib figure.

    Several runs are aligned at their first touch.  Of a study it is the main figure: the map, the
    curve or the distributions of a sweep, the front of a design, the values of a calibration.

    Parameters
    ----------
    runs
        Runs from :func:`capture_sim.simulate` or :func:`capture_sim.read_run`.  Or one scene, which
        is simulated; one result of :func:`capture_sim.calibrate` or of
        :func:`capture_sim.studies.search.design.design_buffer`; or one table from
        :func:`capture_sim.sweep`.
    labels
        One name for each run; None for the names of the scenes.

    Raises
    ------
    TypeError
        An argument is no run, e.g. a list of runs or the name of a scene.
    ValueError
        There is no run, no run of a sweep could be computed, or several runs have another number
        of labels.

    Examples
    --------
    >>> import capture_sim
    >>> soft = capture_sim.simulate("tilt_p10", {"buffer.k_A": 400})
    >>> figure = capture_sim.plot(capture_sim.simulate("tilt_p10"), soft, labels=["500", "400"])
    >>> [axes.get_title(loc="left") for axes in figure.axes]
    ['(a)', '(b)', '(c)', '(d)']
    """
    if len(runs) == 1 and (figure := _of_study(runs[0])) is not None:
        return figure
    for run in runs:
        if not isinstance(run, Run):
            raise TypeError(
                f"plot({type(run).__name__}): must be runs, one argument each, e.g. "
                "plot(result_1, result_2)"
            )
    if len(runs) == 1:
        return draw_run(runs[0], None if labels is None else plotted_runs(runs, labels)[0].label)
    return sheet(_OVERLAID, runs, labels=labels)


def _of_study(what: Any) -> Figure | None:
    """Return the main figure of a scene or the result of a study; None of anything else."""
    if isinstance(what, Run):
        return None  # before the studies are loaded
    from capture_sim.studies.fit.result import Calibration
    from capture_sim.studies.search.design import Design
    from capture_sim.viewing.calibration import draw_calibration
    from capture_sim.viewing.design import draw_design
    from capture_sim.viewing.sweep import draw_table

    if isinstance(what, Scene):
        return draw_run(simulate(what))
    if isinstance(what, Design):
        return draw_design(what, what.knee if what.rows else None)
    if isinstance(what, Calibration):
        return draw_calibration(what)["values"]
    inputs = getattr(what, "attrs", {}).get("inputs")
    is_table = inputs is not None and {*inputs, "max_normal_force"} <= {*what.columns}
    return draw_table(what) if is_table else None


def draw_run(run: Run, label: str | None = None) -> Figure:
    """Return the summary figure of one run; its title has the label, or else the scene's name."""
    [plotted] = plotted_runs(run)
    title = source.headline(run, label)
    # titles have y=1.0, or matplotlib measures all ticks to place them
    top = 0.42 + 0.33 * len(title.splitlines())
    figure = new_figure(15.5, 9.25 + top, arranged=False)
    figure.suptitle(title, fontsize=19, fontweight="bold", y=0.993)
    bench, cone = rows_of_axes(figure, (1.05, 6.85), top, [(1.65, 0.95), (6.0, 0.0)])
    several = [(2.5, 0.43), (1.6, 0.43), (1.6, 0.43), (1.6, 0.0)]
    over_time = rows_of_axes(figure, (8.4, 15.38), top, several)
    bench.set_title(f"From above, {draw_bench(bench, plotted)}", fontsize=_FONT + 1, y=1.0)
    _draw_trajectory(cone, plotted, "The tip in the cone, the chaser comes from the left")
    _draw_over_time(over_time, plotted, (STROKE, TORSION, DISTANCE))
    return figure


def draw_overview(runs: Sequence[Run], labels: Sequence[str] | None = None) -> Figure:
    """Return a figure of several runs side by side, in at most three columns.

    The title of each run has its label.  Without labels, it has the scene's name, with a number if
    several runs have the same name.
    """
    shown = plotted_runs(runs, labels)
    titles = [source.headline(plotted.run, plotted.label, _COLUMN) for plotted in shown]
    columns = columns_for(len(runs))
    top = 0.2 + 0.27 * max(len(title.splitlines()) for title in titles)
    block = _BLOCK + top
    figure = new_figure(6.0 * columns, block * -(-len(runs) // columns), arranged=False)
    rows = [(1.4, 1.03), (5.0, 0.96), (2.25, 0.43), (1.9, 0.0)]
    benches = []
    for i, (plotted, title) in enumerate(zip(shown, titles, strict=True)):
        line, column = divmod(i, columns)
        sides = (6.0 * column + 1.05, 6.0 * column + 5.82)
        bench, cone, *over_time = rows_of_axes(figure, sides, top + block * line, rows)
        instants = draw_bench(bench, plotted)
        bench.set_title(title, fontsize=16, fontweight="bold", pad=12, y=1.0)
        dashed = (
            f"dashed: at the {source.start_word(plotted.scene)}"
            if " and " in instants
            else instants
        )
        bench.set_xlabel(f"x in the world  [m]   ({dashed})")
        benches.append(bench)
        _draw_trajectory(cone, plotted, "The tip in the cone")
        _draw_over_time(over_time, plotted, (DISTANCE,))
    # of one size, so that they can be compared
    for side in ("x", "y"):
        ends = np.array([getattr(axes, f"get_{side}lim")() for axes in benches])
        for axes in benches:
            axes.set(**{f"{side}lim": (ends[:, 0].min(), ends[:, 1].max())})
    return figure


def _draw_trajectory(axes: Axes, plotted: PlottedRun, title: str) -> None:
    moments = key_moments(plotted.run)
    draw_trajectory(axes, [plotted])
    draw_tip(axes, plotted.scene, moments, plotted.colour)
    if first_touch(plotted.run.events) is None:
        _widen(axes, [moment.place * _MM for moment in moments])
        path = shapes.tip_in_cone(plotted.run.samples) * _MM  # also outside of the usual range
        axes.plot(*path.T, "--", color=plotted.colour, lw=2.0)
    dress(axes, None, _FONT)
    axes.set_title(title, fontsize=_FONT + 1, y=1.0)
    axes.text(
        0.985,
        0.015,
        "\n".join(
            f"{letter}  {moment.t:.3f} s  {moment.meaning}"
            for letter, moment in zip(ascii_lowercase, moments, strict=False)
        ),
        transform=axes.transAxes,
        ha="right",
        va="bottom",
        fontsize=_FONT,
        bbox={"facecolor": "white", "edgecolor": style.LIGHT, "pad": 5},
        zorder=10,
    )


def _widen(axes: Axes, places: Sequence[np.ndarray]) -> None:
    """Enlarge the drawn range about its middle until it has all places, (2,) each, mm."""
    low, high = np.array([axes.get_xlim(), axes.get_ylim()]).T
    middle, half = 0.5 * (low + high), 0.5 * (high - low)
    share = max(float((np.abs(place - middle) / half).max()) for place in places)
    if share > 1.0:
        half = half * 1.35 * share
        axes.set(xlim=middle[0] + half[0] * _ENDS, ylim=middle[1] + half[1] * _ENDS)


def _draw_over_time(
    all_axes: Sequence[Axes], plotted: PlottedRun, quantities: Sequence[Quantity]
) -> None:
    """Draw the contact force and the quantities over time, one in each axes.

    The times at which the tip touches the cone are shaded in all axes.
    """
    run, window = plotted.run, source.time_window(plotted.run)
    loads = run.loads
    if source.has_force(run) and first_touch(run.events) is None:
        titles = ["Contact force: no touch"]
        all_axes[0].set_yticks([])
    elif source.has_force(run):
        titles = [f"Contact force: up to {source.strongest(run)[1]:.0f} N (markers: peaks)"]
        _draw_force(all_axes[0], plotted)
    else:
        titles = ["Contact force: not measured"]
        all_axes[0].set_yticks([])
    for axes, quantity in zip(all_axes[1:], quantities, strict=True):
        # when it touches is shaded here: dashes in the flights between would hide them
        draw_quantity(
            axes, quantity, [plotted._replace(touching=np.ones_like(plotted.touching))], window
        )
        axes.set_ylabel(f"{quantity.label}\n[{quantity.unit}]")
        if quantity is DISTANCE:
            [zone] = quantity.limits(plotted.scene)
            nearest = loads["nearest_distance"] * 1e3
            titles.append(f"Tip to BE: closest {nearest:.1f} mm (zone: {zone.value:g} mm)")
            _mark_verdict(axes, run, window)
            axes.set_ylabel("distance\n[mm]")
        elif quantity is STROKE:
            inwards, outwards = (loads[f"max_axial_stroke_{side}"] * 1e3 for side in ("in", "out"))
            titles.append(f"Axial buffer: whole run {inwards:.2f} mm in, {outwards:.2f} mm out")
            _mark_peaks(axes, plotted, "axial_stroke", ("axial_stroke_in", "axial_stroke_out"), 1e3)
        else:
            largest = loads["max_torsion"] * 1e3
            titles.append(f"Torsional buffer: whole run up to {largest:.2f} mrad")
            _mark_peaks(axes, plotted, "torsion", ("torsion",), 1e3)
    touches = source.every_touch(run)
    touching = [(start, end - start) for start, end in touches[["start", "end"]].tolist()]
    for axes, title in zip(all_axes, titles, strict=True):
        dress(axes, "both", _FONT)
        axes.set_title(title, fontsize=_FONT + 1, y=1.0)
        axes.broken_barh(
            touching,
            (0.0, 1.0),
            transform=axes.get_xaxis_transform(),
            facecolor=style.CONTACT,
            edgecolor=style.CONTACT,  # so that the shortest touch is a visible line
            lw=0.6,
            alpha=0.4,
            zorder=0,
        )
        axes.set_xlim(window)
        axes.tick_params(labelbottom=axes is all_axes[-1])
    near = f"the tip within {plotted.scene.detector.max_contact_gap * _MM:g} mm of a wall"
    shaded = "in contact" if source.has_force(run) else near
    all_axes[-1].set_xlabel(
        f"time since the {source.start_word(plotted.scene)}  [s]   (shaded: {shaded})"
    )


def _mark_peaks(
    axes: Axes, plotted: PlottedRun, field: str, names: Sequence[str], factor: float
) -> None:
    """Mark the loads that a title names on the curve of a field of the samples."""
    samples = plotted.run.samples
    times = [plotted.run.loads[f"max_{name}_time"] for name in names]
    at = np.array([t for t in times if t is not None])
    values = np.interp(at, samples["t"], samples[field])
    axes.plot(at, factor * values, "o", color=plotted.colour, ms=5)


def _draw_force(axes: Axes, plotted: PlottedRun) -> None:
    """Draw each wall's normal force and each touch's peak force on a logarithmic axis."""
    run, colour = plotted.run, plotted.colour
    for force in run.samples["normal_force"].T:
        axes.plot(plotted.time, np.where(force > 0.0, force, np.nan), color=colour, lw=1.6)
    every_touch = source.every_touch(run)
    for side, (marker, name) in {**style.WALLS, 0: style.NO_WALL}.items():
        touches = every_touch[every_touch["wall"] == side]
        if not touches.size and (side == 0 or np.any(every_touch["wall"] == 0)):
            continue
        when, peak = touches["peak_time"], touches["peak_force"]
        axes.vlines(when, _SMALLEST_FORCE, peak, color=colour, lw=1.0)
        label = f"{name}: {len(touches)} touch{'' if len(touches) == 1 else 'es'}"
        look: dict[str, Any] = {"color": colour, "mfc": colour if side > 0 else "white", "ms": 6}
        axes.plot(when, peak, marker, label=label, **look)
    axes.set_yscale("log")
    # numbers in place of powers, and no minor ticks: a third of the time to draw the picture
    axes.yaxis.set_major_formatter("{x:g}")
    axes.yaxis.set_minor_locator(NullLocator())
    axes.set_ylim(_SMALLEST_FORCE, 20.0 * max(source.strongest(run)[1], 1.0))
    axes.set_ylabel("normal force\n[N], log scale")
    axes.legend(loc="upper right", fontsize=_FONT - 1.5, ncols=2, framealpha=1.0)


def _mark_verdict(axes: Axes, run: Run, window: Window) -> None:
    """Mark the times of latching and of the verdict that are in the window, s since the release."""
    decided = source.decided_at(run)
    moments = [
        (e.t, "latched", style.GREY, 0.95) for e in run.events if e.kind is EventKind.LATCHED
    ]
    if decided is not None:
        first = next(status for status in run.statuses if status.state.is_verdict)
        look = style.VERDICTS[first.state.label]
        moments.append((decided, first.state.label, look.colour, 0.72))
    left = next((status.t for status in run.statuses if status.left_again), None)
    if left is not None and run.statuses[-1].left_again:
        moments.append((left, "left", style.VERDICTS[run.statuses[-1].label].colour, 0.5))
    start, end = window
    for t, text, colour, height in moments:
        if not start <= t <= end:
            continue
        # left of the line, or right where it would leave the axes
        side = -1 if t - start > 0.3 * (end - start) else 1
        axes.axvline(t, color=colour, lw=2.0)
        axes.annotate(
            text,
            (t, height),
            xycoords=axes.get_xaxis_transform(),
            xytext=(7 * side, 0),
            textcoords="offset points",
            ha="right" if side < 0 else "left",
            va="top",
            fontsize=_FONT,
            fontweight="bold",
            color=colour,
            bbox={"facecolor": "white", "edgecolor": "none", "alpha": 0.9, "pad": 1},
        )


def draw_bench(axes: Axes, plotted: PlottedRun) -> str:
    """Draw both vehicles at the first touch from above, m, and return the drawn instants in words.

    A run without a touch is drawn at its last sample.  If the chaser has moved more than 1 cm, it
    is also drawn at the start, dashed.
    """
    run, scene, start = plotted.run, plotted.scene, plotted.samples["q"][0]
    touch = first_touch(run.events)
    then = run.samples["q"][-1] if touch is None else touch.q
    moved = bool(np.linalg.norm(then[:2] - start[:2]) > 0.01)
    bodies = shapes.rail_shapes(scene) + shapes.state_shapes(scene, then, plotted.colour)
    if moved:
        bodies += shapes.state_shapes(scene, start, plotted.colour, ghost=True, both=False)
    draw_shapes(axes, bodies)
    degrees = round(float(np.rad2deg(then[shapes.TARGET[2]])))
    _name(axes, "chaser", chaser_box(scene), then[list(shapes.CHASER)], side=0.5)
    turned = f"target\n{degrees:+d}°" if degrees else "target\n0°"
    _name(axes, turned, target_box(scene), then[5:])
    axes.set_aspect("equal")
    axes.margins(0.03)
    dress(axes, None, _FONT)
    axes.set_xlabel("x in the world  [m]")
    axes.set_ylabel("y  [m]")
    when = "end of the run" if touch is None else "first touch"
    return f"at the {source.start_word(scene)} and at the {when}" if moved else f"at the {when}"


def _name(axes: Axes, text: str, box: Box, pose: np.ndarray, side: float = 0.0) -> None:
    """Write a name on a vehicle, parallel to its front-to-rear axis.

    ``side`` is the lateral offset from the middle, as a share of the vehicle's half-width.
    """
    place = np.array([[(box.back + box.front) / 2, side * box.half_width]])
    middle = shapes.placed(place, *pose)[0]
    axes.text(
        float(middle[0]),
        float(middle[1]),
        text,
        ha="center",
        va="center",
        fontsize=style.SMALL,
        rotation=float(np.rad2deg(pose[2])),
        zorder=4,  # over the ghost and the balls
        bbox={"facecolor": style.LIGHT, "edgecolor": "none", "pad": 2.0},
    )


class Moment(NamedTuple):
    """An instant at which the tip is drawn in the cone."""

    t: float  # s
    place: np.ndarray  # tip's centre in the cone's frame, (2,), m
    meaning: str


def key_moments(run: Run) -> list[Moment]:
    """Return the instants of a run at which the tip is drawn, in order of time.

    These are the first touch, the strongest touch (unless it is the first) and the latching.
    Without latching, they are the closest approach to BE instead, and the last sample if the tip's
    centre is then inside the drawn range.
    """
    samples = run.samples
    t, places = samples["t"], shapes.tip_in_cone(samples)
    found: list[Moment] = []

    def add(time: float, meaning: str) -> None:
        place = np.array([np.interp(time, t, places[:, i]) for i in (0, 1)])
        found.append(Moment(time, place, meaning))

    touch = first_touch(run.events)
    if touch is not None:
        peak_time, peak = source.strongest(run)
        touches = source.every_touch(run)
        first_end = touches["end"][touches["start"] == touch.t].min(initial=np.inf)
        if peak > 0.0 and touch.t <= peak_time <= first_end:
            add(touch.t, f"first touch, {peak:.0f} N")
        else:
            add(touch.t, "first touch")
            if peak > 0.0:
                add(peak_time, f"strongest, {peak:.0f} N")
    latched = next((e for e in run.events if e.kind is EventKind.LATCHED), None)
    if latched is not None:
        add(latched.t, "latched")
    else:
        nearest = int(np.argmin(samples["tip_distance"]))
        add(float(t[nearest]), f"closest, {samples['tip_distance'][nearest] * _MM:.1f} mm")
        (left, right), (low, high) = frame_bounds(run.drawn_scene)
        x, y = places[-1] * _MM
        if nearest == len(t) - 1:
            # as in a run that ended early: one position, one letter
            found[-1] = found[-1]._replace(meaning=f"{found[-1].meaning} (end)")
        elif left < x < right and low < y < high:
            add(float(t[-1]), "end of the run")
    return sorted(found, key=lambda moment: moment.t)


def draw_tip(axes: Axes, scene: Scene, moments: list[Moment], colour: str) -> None:
    """Draw the tip as a circle at each moment, and name the moments a, b, c, ... in order."""
    radius = scene.probe.tip_radius * _MM
    halo = [patheffects.withStroke(linewidth=3, foreground="white")]
    for i, moment in enumerate(moments):
        x, y = moment.place * _MM
        axes.add_patch(
            Circle((x, y), radius, facecolor=colour, alpha=0.14, edgecolor="none", zorder=3)
        )
        axes.add_patch(
            Circle((x, y), radius, facecolor="none", edgecolor=style.GREY, lw=1.1, zorder=3)
        )
        axes.plot(x, y, "o", ms=6.5, color=style.BLACK, mec="white", zorder=7)
        axes.annotate(
            ascii_lowercase[i],
            (x, y),
            xytext=(0.0, _LETTER_HEIGHT * (-1) ** i),
            textcoords="offset points",
            fontsize=14,
            fontweight="bold",
            ha="center",
            va="center",
            path_effects=halo,
            zorder=8,
        )
