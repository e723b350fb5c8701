"""Runs side by side as one rerun recording with its layout inside.

``rerun runs.rrd`` then opens with, for every run, the bench in 3D and a close-up of the
tip in the cone, and below them the runs' forces, strokes and distances in common plots.
"""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from capture_sim.errors import RecordingError
from capture_sim.scene import Scene
from capture_sim.viewing import bench_model, palette
from capture_sim.viewing.geometry import (
    CHASER,
    TARGET,
    Box,
    H,
    chaser_box,
    circle,
    target_box,
    tip_bound,
    tip_in_cone,
    tip_in_world,
    wall,
)
from capture_sim.viewing.source import (
    ViewableRun,
    distinct_names,
    first_touch,
    headline,
    impact_speed,
    in_contact,
    normal_force_with_peaks,
    verdict,
)

TIMELINE = "sim_time"
ALIGNED = "since_first_touch"

_MM = 1e3
_FORCE_SCALE = 3e-3  # m of arrow for 1 N
_STRING_EVERY = 10  # samples between two positions of the string

_BLACK = palette.rgb(palette.BLACK)
_DARK = (60, 60, 60)
_SIDES = (("plus", 1), ("minus", -1))

_X_AXIS = rr.Quaternion(xyzw=[0.0, np.sqrt(0.5), 0.0, np.sqrt(0.5)])  # turns z to x
_Y_AXIS = rr.Quaternion(xyzw=[np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5)])  # turns z to -y


def save_rrd(runs: Sequence[ViewableRun], path: Path | str) -> Path:
    """Save runs side by side as one rerun recording.

    Parameters
    ----------
    runs
        At least one; runs of the same name are numbered.
    path
        File to write; one that exists is replaced.

    Returns
    -------
    Path
        Of the file.

    Raises
    ------
    RecordingError
        The file cannot be written.
    """
    path = Path(path)
    names = distinct_names([run.scene.name for run in runs])
    colours = [palette.RUNS[i % len(palette.RUNS)] for i in range(len(runs))]
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        # rerun writes in the background and tells of no error: see that it could
        with tempfile.TemporaryFile(dir=path.parent):
            pass
        recording = rr.RecordingStream("capture_sim", recording_id=None)
        recording.save(path, default_blueprint=_blueprint(runs, names))
        for run, name, colour in zip(runs, names, colours, strict=True):
            _RunLogger(recording, run, name, colour).log()
        _log_limits(recording, runs)
        recording.flush()
        recording.disconnect()
    except OSError as error:
        raise RecordingError(f"{path}: cannot write: {error.strerror or error}") from None
    return path


class _RunLogger:
    """Logs one run under its own prefix."""

    def __init__(
        self, recording: rr.RecordingStream, run: ViewableRun, name: str, colour: str
    ) -> None:
        self._recording = recording
        self._run = run
        self._name = name
        self._colour = palette.rgb(colour)
        touch = first_touch(run)
        self._touch_time = 0.0 if touch is None else touch.t

    def log(self) -> None:
        """Log everything."""
        self._recording.send_property(
            self._name,
            rr.AnyValues(
                title=self._run.scene.title,
                verdict=verdict(self._run),
                impact_speed=impact_speed(self._run),
                scene=self._run.scene.to_yaml(),
            ),
        )
        self._log_bodies()
        self._log_buffer()
        self._log_surroundings()
        self._log_tip()
        self._log_close_up()
        self._log_plots()

    def _static(self, entity: str, *archetypes: rr.AsComponents) -> None:
        self._recording.log(f"{self._name}/{entity}", *archetypes, static=True)

    def _columns(
        self, path: str, t: np.ndarray, *columns: rr.ComponentColumnList, own: bool = True
    ) -> None:
        indexes = [
            rr.TimeColumn(TIMELINE, duration=t),
            rr.TimeColumn(ALIGNED, duration=t - self._touch_time),
        ]
        self._recording.send_columns(
            f"{self._name}/{path}" if own else path,
            indexes=indexes,
            columns=[column for listed in columns for column in listed],
        )

    def _log_bodies(self) -> None:
        scene, samples = self._run.scene, self._run.samples
        supports = scene.supports
        for entity, body, box, balls, grey in (
            ("chaser", CHASER, chaser_box(scene), supports and supports.chaser.balls, 175),
            ("target", TARGET, target_box(scene), supports and supports.target.balls, 120),
        ):
            q = samples["q"][:, list(body)]
            place = np.concatenate([q[:, :2], np.zeros((len(q), 1))], axis=1)
            turn = bench_model.yaw_quaternions(q[:, 2])
            self._columns(
                f"world/{entity}",
                samples["t"],
                rr.Transform3D.columns(translation=place, quaternion=turn),
            )
            self._static(f"world/{entity}/body", _body(box, grey))
            if balls:
                height = bench_model.FLOOR + bench_model.BALL_RADIUS
                self._static(
                    f"world/{entity}/balls",
                    rr.Points3D(
                        [(x, y, height) for x, y in balls],
                        radii=bench_model.BALL_RADIUS,
                        colors=palette.rgb(palette.GREY),
                    ),
                )
        vertices, triangles = bench_model.cone_mesh(scene.cone)
        self._static(
            "world/target/cone",
            rr.Mesh3D(
                vertex_positions=vertices,
                triangle_indices=triangles,
                albedo_factor=(*palette.rgb(palette.SKY), 255),
            ),
        )
        for name, side in _SIDES:
            face = wall(scene.cone, side) - (scene.cone.L_T, 0.0)
            edge = np.concatenate([face, np.zeros((2, 1))], axis=1)
            self._static(
                f"world/target/wall_{name}",
                rr.LineStrips3D([edge], radii=0.003, colors=_DARK),
            )

    def _log_buffer(self) -> None:
        scene, samples = self._run.scene, self._run.samples
        t, q = samples["t"], samples["q"]
        hinge = np.tile([scene.buffer.a, 0.0, 0.0], (len(t), 1))
        turn = bench_model.yaw_quaternions(samples["torsion"])
        self._columns(
            "world/chaser/cylinder", t, rr.Transform3D.columns(translation=hinge, quaternion=turn)
        )
        length = max(scene.cylinder.length, 1e-3)
        self._static(
            "world/chaser/cylinder/housing",
            rr.Cylinders3D(
                lengths=length,
                radii=1.5 * scene.probe.radius,
                centers=[-length / 2, 0.0, 0.0],
                quaternions=_X_AXIS,
                colors=palette.rgb(palette.GREY),
                fill_mode="solid",
            ),
        )
        tip = np.zeros((len(t), 3))
        tip[:, 0] = q[:, H]
        self._columns("world/chaser/cylinder/probe", t, rr.Transform3D.columns(translation=tip))
        self._static(
            "world/chaser/cylinder/probe/rod",
            rr.Cylinders3D(
                lengths=scene.probe.length,
                radii=scene.probe.radius,
                centers=[-scene.probe.tip_radius - scene.probe.length / 2, 0.0, 0.0],
                quaternions=_X_AXIS,
                colors=_DARK,
                fill_mode="solid",
            ),
        )
        self._static(
            "world/chaser/cylinder/probe/tip",
            rr.Points3D([[0.0, 0.0, 0.0]], radii=scene.probe.tip_radius, colors=self._colour),
        )

    def _log_surroundings(self) -> None:
        scene, samples = self._run.scene, self._run.samples
        start = scene.initial.chaser
        along = np.array([np.cos(start.theta), np.sin(start.theta), 0.0])
        if scene.rail is not None:
            side = np.array([-along[1], along[0], 0.0]) * 0.05
            place = np.array([start.x, start.y, bench_model.FLOOR + 0.004])
            ends = [place - 0.13 * along, place + (scene.rail.length + 0.13) * along]
            self._static(
                "world/rail",
                rr.LineStrips3D(
                    [[end + s for end in ends] for s in (side, -side)],
                    radii=0.004,
                    colors=palette.rgb(palette.ORANGE),
                ),
            )
        if scene.string is not None:
            few = samples[::_STRING_EVERY]
            strings = bench_model.string_ends(scene, few["q"])
            masses = bench_model.mass_places(scene, few["mass_height"])
            hanging = strings[:, 1:] + (bench_model.PULLEY_RADIUS, 0.0, -bench_model.PULLEY_RADIUS)
            strips = np.concatenate([strings, hanging, masses[:, None]], axis=1)
            self._static("world/string", rr.LineStrips3D.from_fields(colors=_BLACK, radii=0.0015))
            self._columns("world/string", few["t"], rr.LineStrips3D.columns(strips=list(strips)))
            self._static(
                "world/hanging_mass",
                rr.Boxes3D(half_sizes=[0.02, 0.02, 0.025], colors=_BLACK, fill_mode="solid"),
            )
            self._columns(
                "world/hanging_mass", few["t"], rr.Transform3D.columns(translation=masses)
            )
            self._static(
                "world/pulley",
                rr.Cylinders3D(
                    lengths=0.015,
                    radii=bench_model.PULLEY_RADIUS,
                    centers=[bench_model.pulley_place(scene)],
                    quaternions=_Y_AXIS,
                    colors=palette.rgb(palette.ORANGE),
                    fill_mode="solid",
                ),
            )

    def _log_tip(self) -> None:
        scene, samples = self._run.scene, self._run.samples
        tip = tip_in_world(scene, samples["q"])
        above = np.full((len(tip), 1), scene.probe.tip_radius + 0.001)
        way = np.concatenate([tip, above], axis=1)
        self._static("world/tip_way", rr.LineStrips3D([way], radii=0.0012, colors=self._colour))
        self._static("world/contact_force", rr.Arrows3D.from_fields(colors=_BLACK, radii=0.003))
        force = samples["contact_force"] * _FORCE_SCALE
        self._columns(
            "world/contact_force",
            samples["t"],
            rr.Arrows3D.columns(
                vectors=np.concatenate([force, np.zeros((len(tip), 1))], axis=1), origins=way
            ),
        )

    def _log_close_up(self) -> None:
        """Log the tip in the cone's frame, mm, as seen from above."""
        scene, samples, t = self._run.scene, self._run.samples, self._run.samples["t"]
        # 2D views count y downwards
        self._static("close_up", rr.Transform3D(scale=[1.0, -1.0, 1.0]))
        for name, side in _SIDES:
            face = wall(scene.cone, side) * _MM
            self._static(f"close_up/wall_{name}", rr.LineStrips2D([face], radii=1.2, colors=_DARK))
            bound = tip_bound(scene.cone, scene.probe.tip_radius, side) * _MM
            self._static(
                f"close_up/tip_bound_{name}",
                rr.LineStrips2D([bound], radii=0.25, colors=palette.rgb(palette.GREY)),
            )
        zone = circle(np.zeros(2), scene.detector.radius) * _MM
        self._static(
            "close_up/capture_zone",
            rr.LineStrips2D([zone], radii=0.5, colors=palette.rgb(palette.GREEN)),
        )
        places = tip_in_cone(samples) * _MM
        self._static("close_up/way", rr.LineStrips2D([places], radii=0.3, colors=_BLACK))
        touching = in_contact(self._run)[:, None]
        tint = np.where(touching, self._colour, palette.light(self._colour)).astype(np.uint8)
        radius = scene.probe.tip_radius * _MM
        self._static("close_up/tip", rr.Points2D.from_fields(radii=radius, draw_order=-5.0))
        self._columns("close_up/tip", t, rr.Points2D.columns(positions=places, colors=tint))
        self._static(
            "close_up/centre",
            rr.Points2D.from_fields(radii=1.0, colors=_BLACK, draw_order=50.0),
        )
        self._columns("close_up/centre", t, rr.Points2D.columns(positions=places))
        turn = samples["q"][:, TARGET[2]]
        c, s = np.cos(turn), np.sin(turn)
        fx, fy = samples["contact_force"].T * _FORCE_SCALE * _MM
        self._static(
            "close_up/contact_force",
            rr.Arrows2D.from_fields(radii=0.9, colors=_BLACK, draw_order=60.0),
        )
        self._columns(
            "close_up/contact_force",
            t,
            rr.Arrows2D.columns(
                vectors=np.stack([c * fx + s * fy, c * fy - s * fx], axis=-1), origins=places
            ),
        )

    def _log_plots(self) -> None:
        samples, t = self._run.samples, self._run.samples["t"]
        # the peaks are what is looked for: no averaging of rows that share a pixel
        highest = rr.components.AggregationPolicy.Max
        self._log_plot("contact_force", *normal_force_with_peaks(self._run), highest)
        self._log_plot("axial_stroke", t, samples["axial_stroke"] * _MM)
        self._log_plot("torsion", t, np.rad2deg(samples["torsion"]))
        self._log_plot("distance", t, samples["tip_distance"] * _MM)
        self._log_plot("string_tension", t, samples["string_tension"])

    def _log_plot(
        self,
        plot: str,
        t: np.ndarray,
        values: np.ndarray,
        policy: rr.components.AggregationPolicy | None = None,
    ) -> None:
        path = f"plots/{plot}/{self._name}"
        style = rr.SeriesLines(
            colors=self._colour,
            names=self._name,
            widths=1.6,
            aggregation_policy=policy,
        )
        self._recording.log(path, style, static=True)
        self._columns(path, t, rr.Scalars.columns(scalars=values), own=False)


def _log_limits(recording: rr.RecordingStream, runs: Sequence[ViewableRun]) -> None:
    """Log the capture radius as a line, if the runs share one."""
    radii = {run.scene.detector.radius for run in runs}
    if len(radii) != 1:
        return
    ends = np.array(
        [min(run.samples["t"][0] for run in runs), max(run.samples["t"][-1] for run in runs)]
    )
    path = "plots/distance/capture_zone"
    style = rr.SeriesLines(colors=palette.rgb(palette.YELLOW), names="capture zone", widths=1.0)
    recording.log(path, style, static=True)
    recording.send_columns(
        path,
        indexes=[rr.TimeColumn(TIMELINE, duration=ends)],
        columns=rr.Scalars.columns(scalars=np.full(2, radii.pop() * _MM)),
    )


def _blueprint(runs: Sequence[ViewableRun], names: Sequence[str]) -> rrb.Blueprint:
    white = rrb.Background(color=(255, 255, 255), kind=rrb.BackgroundKind.SolidColor)
    benches, close_ups = [], []
    for run, name in zip(runs, names, strict=True):
        benches.append(
            rrb.Spatial3DView(
                origin=f"/{name}/world",
                name=headline(run),
                background=white,
                line_grid=False,
                eye_controls=_eye(run.scene),
            )
        )
        close_ups.append(
            rrb.Spatial2DView(
                origin=f"/{name}",
                contents=f"/{name}/close_up/**",
                name=f"{name}: tip in the cone's frame, from above, mm",
                background=white,
                visual_bounds=_bounds(run.scene),
            )
        )
    plots = [
        rrb.TimeSeriesView(
            origin=f"/plots/{entity}",
            name=title,
            plot_legend=rrb.PlotLegend(corner=rrb.Corner2D.RightTop, visible=i == 0),
            axis_x=rrb.TimeAxis(view_range=_window(runs, whole=entity == "string_tension")),
        )
        for i, (entity, title) in enumerate(
            (
                ("contact_force", "normal contact force, N"),
                ("axial_stroke", "axial stroke, mm"),
                ("torsion", "torsion, deg"),
                ("distance", "tip to BE, mm"),
                ("string_tension", "string tension, N"),
            )
        )
    ]
    return rrb.Blueprint(
        rrb.Vertical(
            rrb.Horizontal(*benches),
            rrb.Horizontal(*close_ups),
            rrb.Horizontal(*plots),
            row_shares=[1.0, 1.35, 1.0],
        ),
        rrb.TimePanel(
            timeline=TIMELINE,
            state="collapsed",
            playback_speed=0.2,
            play_state="paused",
            loop_mode="selection",
            time_selection=_selection(runs),
        ),
        rrb.BlueprintPanel(state="hidden"),
        rrb.SelectionPanel(state="hidden"),
    )


def _eye(scene: Scene) -> rrb.EyeControls3D:
    """Look down on the bench, along the approach, from the chaser's left."""
    middle = 0.5 * (scene.initial.chaser.x + scene.initial.target.x) + 0.03
    return rrb.EyeControls3D(
        kind=rrb.Eye3DKind.Orbital,
        position=(middle, scene.initial.target.y - 0.34, 0.44),
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


def _action(runs: Sequence[ViewableRun]) -> tuple[float, float]:
    """Return from when to when there are touches, with a margin; or the whole time, s."""
    start, end = 0.0, max(float(run.samples["t"][-1]) for run in runs)
    touches = [touch for touch in map(first_touch, runs) if touch is not None]
    if touches:
        start = max(min(touch.t for touch in touches) - 0.1, 0.0)
        last = [float(run.touches["end"].max(initial=0.0)) for run in runs]
        end = min(end, max(last) + 0.3)
    return start, end


def _selection(runs: Sequence[ViewableRun]) -> rr.encodings.AbsoluteTimeRange:
    start, end = _action(runs)
    return rr.encodings.AbsoluteTimeRange(min=round(start * 1e9), max=round(end * 1e9))


def _window(runs: Sequence[ViewableRun], *, whole: bool) -> rrb.TimeRange:
    """Return the time that a plot shows."""
    start, end = _action(runs)
    if whole:
        start, end = 0.0, max(float(run.samples["t"][-1]) for run in runs)
    return rrb.TimeRange(
        start=rrb.TimeRangeBoundary.absolute(seconds=start),
        end=rrb.TimeRangeBoundary.absolute(seconds=end),
    )


def _body(box: Box, grey: int) -> rr.Boxes3D:
    return rr.Boxes3D(
        centers=[
            (box.back + box.front) / 2,
            0.0,
            bench_model.BODY_TOP - bench_model.BODY_HEIGHT / 2,
        ],
        half_sizes=[
            (box.front - box.back) / 2,
            box.half_width,
            bench_model.BODY_HEIGHT / 2,
        ],
        colors=(grey, grey, grey),
        fill_mode="solid",
    )
