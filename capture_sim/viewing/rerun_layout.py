"""The layout with which a rerun recording opens: views, cameras, axis ranges and time panel."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from types import MappingProxyType

import rerun as rr
import rerun.blueprint as rrb

from capture_sim.scene.parts import Scene
from capture_sim.viewing.curves import Window
from capture_sim.viewing.rerun_plots import PLOTS
from capture_sim.viewing.rerun_stream import ALIGNED, SIM_TIME
from capture_sim.viewing.shapes import wall

_MM = 1e3  # in a metre: drawings are in mm
_PLAYED = 5.0  # s (wall), that a short timeline takes at least
_MAX_LABELS = 6  # of an axis
_CONTACT = ("contact_force", "distance", "axial_stroke", "torsion")  # diagrams of the first tab
_LABEL_SHARE = 0.08  # of a diagram's width, between labels of its time: 70 of 830 pixels
_MARGIN = 0.05  # of a range, beyond a tick that widens it
_WHITE = rrb.Background(color=(255, 255, 255), kind=rrb.BackgroundKind.SolidColor)


def blueprint(
    scenes: Sequence[Scene],
    names: Sequence[str],
    titles: Sequence[str],
    *,
    aligned: bool,
    live: bool = False,
    energies: bool = True,
    span: Window | None = None,
    ranges: Mapping[str, Window] = MappingProxyType({}),
) -> rrb.Blueprint:
    """Return the layout: a 3D view and a close-up of each run, and diagrams that all runs share.

    Parameters
    ----------
    scenes
        Scene of each run.
    names
        Name of each run: the first part of the paths under which its data are logged.
    titles
        Title of each run's 3D view.
    aligned
        True to open on the time since each run's first touch, False on simulated time.
    live
        True to follow the newest data, False to open paused at the beginning.
    energies
        False to leave out the diagram of energies, e.g. for measured runs, which have none.
    span
        Start and end, s since the first touch, of the diagrams' time axes.  The shorter it is, the
        slower the playback.  None: rerun chooses the time axes.
    ranges
        Least and greatest value of a diagram by its key in :data:`PLOTS`, in the diagram's unit.
        A range with fewer than two labelled ticks is widened, see :func:`ticked`.
    """
    rows = [
        rrb.Horizontal(
            _bench(scene, name, title),
            _close_up(scene, name, live=live),
            column_shares=[1.5, 1.0],
        )
        for scene, name, title in zip(scenes, names, titles, strict=True)
    ]
    if len(rows) == 1:
        rows = [rrb.Vertical(*rows[0].contents, row_shares=[1.0, 1.4])]
    length = math.inf if span is None else span[1] - span[0]
    time_axis = None if span is None else _time_axis(*labelled(*span))
    entities = ["speed", "energy"] if energies else ["speed"]
    # slack long before the contact, which is all that the aligned time shows
    if any(scene.string is not None for scene in scenes):
        entities.append("string_tension")
    lanes = rrb.StateTimelineView(origin="/states", name="phase and verdict")
    texts = [rrb.TextDocumentView(origin=f"/{name}/scene", name=name) for name in names]
    tabs = rrb.Tabs(
        rrb.Vertical(*_diagrams(_CONTACT, ranges, time_axis), name="contact"),
        rrb.Vertical(
            *(*_diagrams(entities, ranges, time_axis), lanes),
            row_shares=[*[1.0] * len(entities), 0.75 + 0.3 * len(names)],  # two lanes for each run
            name="speeds and phases",
        ),
        rrb.TextLogView(origin="/events", name="events"),
        rrb.Grid(*texts, name="parameters"),
        active_tab=0,
    )
    return rrb.Blueprint(
        rrb.Horizontal(rrb.Vertical(*rows), tabs, column_shares=[1.0, 1.1]),
        rrb.TimePanel(
            timeline=ALIGNED if aligned else SIM_TIME,
            state="collapsed",
            playback_speed=1.0 if live else min(0.1, length / _PLAYED),
            play_state="following" if live else "paused",
        ),
        rrb.BlueprintPanel(state="hidden"),
        rrb.SelectionPanel(state="hidden"),
    )


def _bench(scene: Scene, name: str, title: str) -> rrb.Spatial3DView:
    """Return the 3D view of a run, seen obliquely from above and from the side of -y.

    The world's x axis points to the right.  ``name``: first part of the run's paths; ``title``:
    title of the view.
    """
    y, middle = scene.initial.target.y, 0.03
    middle += 0.5 * (scene.initial.chaser.x + scene.initial.target.x)
    eye = rrb.EyeControls3D(
        kind=rrb.Eye3DKind.Orbital,
        position=(middle, y - 0.325, 0.42),
        look_target=(middle, y - 0.03, -0.04),
        eye_up=(0.0, 0.0, 1.0),
    )
    look = {"background": _WHITE, "line_grid": False, "eye_controls": eye}
    return rrb.Spatial3DView(origin=f"/{name}/world", name=title, **look)  # type: ignore[arg-type]


def _close_up(scene: Scene, name: str, *, live: bool) -> rrb.Spatial2DView:
    """Return the view of the tip in the cone from above, mm, with a margin around the cone.

    The margin is one tip diameter along the axis and 3 mm across it.  ``live``: show all pieces of
    the tip's path up to the present time, not only the newest piece.
    """
    lip, margin = wall(scene.cone, 1)[1] * _MM, scene.probe.tip_radius * _MM
    # live, all pieces of the trail so far, not only the newest
    so_far = rrb.VisibleTimeRanges(
        timeline=SIM_TIME,
        start=rrb.TimeRangeBoundary.infinite(),
        end=rrb.TimeRangeBoundary.cursor_relative(),
    )
    return rrb.Spatial2DView(
        origin=f"/{name}",
        contents=f"/{name}/close_up/**",
        name=f"{name}: in the cone, mm",
        background=_WHITE,
        visual_bounds=rrb.VisualBounds2D(
            x_range=(lip[0] - 2 * margin, 2 * margin), y_range=(-lip[1] - 3.0, lip[1] + 3.0)
        ),
        overrides={f"/{name}/close_up/trail": so_far} if live else None,
    )


def ticked(low: float, high: float) -> Window:
    """Return an axis range that contains ``low`` to ``high`` and at least two labelled ticks.

    Rerun labels only the multiples of a power of ten.  A curve from -8 to 8 would thus have a
    label at 0 only, so its range is widened beyond -10 and 10.  A range without width is returned
    unchanged.
    """
    if not high > low:
        return low, high
    step = 10.0 ** math.ceil(math.log10((high - low) / _MAX_LABELS))
    before, after = math.ceil(low / step) - 1, math.floor(high / step) + 1
    margin = _MARGIN * (high - low)
    if min(-low, high) > 0.5 * step:
        return min(low, -step - margin), max(high, step + margin)
    while after - before < 3:  # fewer than two multiples between them
        if after * step - high < low - before * step:
            high, after = after * step + margin, after + 1
        else:
            low, before = before * step - margin, before - 1
    return low, high


def labelled(start: float, end: float) -> Window:
    """Return a time range, s, from ``start`` to ``end`` or later, with at least three labels.

    Rerun labels only the multiples of a power of ten of seconds, and only if the labels are far
    enough apart.  A range without width is returned unchanged.
    """
    if not end > start:
        return start, end
    step = 10.0 ** math.ceil(math.log10(_LABEL_SHARE * (end - start)))
    third = (math.ceil(start / step) + 2) * step
    return start, max(end, third + _MARGIN * (end - start))


def _time_axis(start: float, end: float) -> rrb.TimeAxis:
    ends = [rr.TimeRangeBoundary.absolute(seconds=second) for second in (start, end)]
    return rrb.TimeAxis(view_range=rr.TimeRange(*ends))


def _diagram(
    entity: str, ranges: Mapping[str, Window], time_axis: rrb.TimeAxis | None = None
) -> rrb.TimeSeriesView:
    legend = rrb.PlotLegend(corner=rrb.Corner2D.RightTop, visible=entity == "distance")
    axis = None
    if entity in ranges and ticked(*ranges[entity]) != ranges[entity]:
        axis = rrb.ScalarAxis(range=ticked(*ranges[entity]))
    return rrb.TimeSeriesView(
        origin=f"/plots/{entity}",
        name=PLOTS[entity].title,
        plot_legend=legend,
        axis_x=time_axis,
        axis_y=axis,
    )


def _diagrams(
    entities: Sequence[str], ranges: Mapping[str, Window], time_axis: rrb.TimeAxis | None
) -> list[rrb.View]:
    """Return one diagram for each entity, a key of :data:`PLOTS`, with the same time axis.

    The caller puts them one above the other.  Each is then about half as wide as the window, which
    leaves room for the labels of the time axis.
    """
    return [_diagram(entity, ranges, time_axis) for entity in entities]
