"""How a rerun recording opens: its views, cameras, bounds and time."""

from __future__ import annotations

import math
from collections.abc import Sequence

import rerun.blueprint as rrb

from capture_sim.scene.parts import Scene
from capture_sim.viewing.rerun_plots import PLOTS
from capture_sim.viewing.rerun_stream import ALIGNED, SIM_TIME
from capture_sim.viewing.shapes import wall

_MM = 1e3
_PLAYED = 5.0  # s (wall), that a short timeline takes at least
_WHITE = rrb.Background(color=(255, 255, 255), kind=rrb.BackgroundKind.SolidColor)


def blueprint(
    scenes: Sequence[Scene],
    names: Sequence[str],
    titles: Sequence[str],
    *,
    aligned: bool,
    live: bool = False,
    energies: bool = True,
    length: float = math.inf,
) -> rrb.Blueprint:
    """Return the layout of runs side by side and overlaid.

    Parameters
    ----------
    scenes, names, titles
        Of each run: what is on its bench, its prefix, its headline.
    aligned
        Open on the time since the first touch; otherwise on simulated time.
    live
        Follow what comes, instead of standing still at the beginning.
    energies
        Whether they are known: those of a measured run are not.
    length
        Of the timeline it opens on, s: a short one is played slower.
    """
    string = any(scene.string is not None for scene in scenes)
    rows = []
    for scene, name, title in zip(scenes, names, titles, strict=True):
        bench = rrb.Spatial3DView(
            origin=f"/{name}/world",
            name=title,
            background=_WHITE,
            line_grid=False,
            eye_controls=_eye(scene),
        )
        close_up = rrb.Spatial2DView(
            origin=f"/{name}",
            contents=f"/{name}/close_up/**",
            name=f"{name}: in the cone, mm",
            background=_WHITE,
            visual_bounds=_bounds(scene),
            # of the trail's pieces all that have come, not only the newest
            overrides={f"/{name}/close_up/trail": _all_so_far()} if live else None,
        )
        rows.append(rrb.Horizontal(bench, close_up, column_shares=[1.5, 1.0]))
    if len(rows) == 1:
        rows = [rrb.Vertical(*rows[0].contents, row_shares=[1.0, 1.4])]
    return rrb.Blueprint(
        rrb.Horizontal(
            rrb.Vertical(*rows),
            rrb.Tabs(
                _time_series(
                    len(names),
                    energies=energies,
                    string=string and not aligned,
                ),
                # slack long before the contact, which is all that the aligned time shows
                *([_tension()] if string and aligned else []),
                rrb.TextLogView(origin="/events", name="events"),
                rrb.Grid(
                    *(rrb.TextDocumentView(origin=f"/{name}/scene", name=name) for name in names),
                    name="parameters",
                ),
                active_tab=0,
            ),
            column_shares=[1.15, 1.0],
        ),
        rrb.TimePanel(
            timeline=ALIGNED if aligned else SIM_TIME,
            state="collapsed",
            playback_speed=1.0 if live else min(0.1, length / _PLAYED),
            play_state="following" if live else "paused",
        ),
        rrb.BlueprintPanel(state="hidden"),
        rrb.SelectionPanel(state="hidden"),
    )


def _tension() -> rrb.TimeSeriesView:
    return rrb.TimeSeriesView(origin="/plots/string_tension", name="string tension, N")


def _all_so_far() -> rrb.VisibleTimeRanges:
    return rrb.VisibleTimeRanges(
        timeline=SIM_TIME,
        start=rrb.TimeRangeBoundary.infinite(),
        end=rrb.TimeRangeBoundary.cursor_relative(),
    )


def _time_series(count: int, *, energies: bool, string: bool) -> rrb.Vertical:
    """Return the diagrams, one above the other in two columns over the same time."""
    plots = {
        plot.entity: rrb.TimeSeriesView(
            origin=f"/plots/{plot.entity}",
            name=plot.title,
            plot_legend=rrb.PlotLegend(
                corner=rrb.Corner2D.RightTop, visible=plot.entity == "distance"
            ),
        )
        for plot in PLOTS
        if string or plot.entity != "string_tension"
    }
    states = rrb.StateTimelineView(origin="/states", name="phase and verdict")
    rows: list[tuple[rrb.View, ...]] = [
        (plots["contact_force"], plots["distance"]),
        (plots["axial_stroke"], plots["torsion"]),
    ]
    lanes = 0.75 + 0.3 * count  # two for each run
    last = [plots[name] for name in ("speed", "energy", "string_tension") if name in plots]
    if not energies:
        last.remove(plots["energy"])
    rows += [tuple(last[:2]), (states, *last[2:])]
    return rrb.Vertical(
        *(rrb.Horizontal(*pair) for pair in rows), row_shares=[1, 1, 1, lanes], name="time series"
    )


def _eye(scene: Scene) -> rrb.EyeControls3D:
    """Look down on the bench, along the approach, from the chaser's left."""
    middle = 0.5 * (scene.initial.chaser.x + scene.initial.target.x) + 0.03
    return rrb.EyeControls3D(
        kind=rrb.Eye3DKind.Orbital,
        position=(middle, scene.initial.target.y - 0.325, 0.42),
        look_target=(middle, scene.initial.target.y - 0.03, -0.04),
        eye_up=(0.0, 0.0, 1.0),
    )


def _bounds(scene: Scene) -> rrb.VisualBounds2D:
    """Show the cone and a tip's width around it."""
    lip = wall(scene.cone, 1)[1] * _MM
    margin = scene.probe.tip_radius * _MM
    return rrb.VisualBounds2D(
        x_range=(lip[0] - 2 * margin, 2 * margin), y_range=(-lip[1] - 3.0, lip[1] + 3.0)
    )
