"""The bench of a run in rerun: in three dimensions, and the tip in the cone from above."""

from __future__ import annotations

from typing import Any

import numpy as np
import rerun as rr

from capture_sim.scene.parts import Scene
from capture_sim.viewing import bench_model, style
from capture_sim.viewing.rerun_stream import RunStream
from capture_sim.viewing.shapes import (
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

_MM = 1e3
#: Length of the force's arrow, m for 1 N, and where it ends.
FORCE_SCALE = 3e-3
_LONGEST_ARROW = 0.12
_STRING_PERIOD = 0.01  # s, between two positions of the string

_BLACK = style.rgb(style.BLACK)
_DARK = style.rgb(style.DARK)
_GREY = style.rgb(style.GREY)
_SIDES = (("plus", 1, "+y wall"), ("minus", -1, "-y wall"))
_X_AXIS = rr.Quaternion(xyzw=[0.0, np.sqrt(0.5), 0.0, np.sqrt(0.5)])  # turns z to x
_Y_AXIS = rr.Quaternion(xyzw=[np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5)])  # turns z to -y


class BenchLog:
    """Logs the bench: shapes once, motion for any stretch of samples.

    Parameters
    ----------
    stream
        Of the run.
    scene
        What is on its bench.
    colour
        Of the run.
    """

    def __init__(self, stream: RunStream, scene: Scene, colour: str) -> None:
        self._stream = stream
        self._scene = scene
        self._colour = style.rgb(colour)
        self._world = f"{stream.name}/world"
        self._map = f"{stream.name}/close_up"

    def shapes(self) -> None:
        """Log all that does not change."""
        self._log_bodies()
        self._log_buffer()
        self._log_surroundings()
        self._log_close_up()

    def motion(self, samples: np.ndarray, touching: np.ndarray) -> None:
        """Log where everything is.

        Parameters
        ----------
        samples
            (n,) of dtype SAMPLE.
        touching
            (n,) bool, whether the tip touches.
        """
        t, q = samples["t"], samples["q"]
        for entity, body in (("chaser", CHASER), ("target", TARGET)):
            pose = q[:, list(body)]
            self._move(entity, t, translation=_level(pose[:, :2]), quaternion=_yaw(pose[:, 2]))
        hinge = np.tile([self._scene.buffer.hinge_offset, 0.0, 0.0], (len(t), 1))
        self._move("chaser/cylinder", t, translation=hinge, quaternion=_yaw(samples["torsion"]))
        along = np.zeros((len(t), 3))
        along[:, 0] = q[:, H]
        self._move("chaser/cylinder/probe", t, translation=along)
        stretch = np.ones((len(t), 3))
        stretch[:, 0] = q[:, H] - self._collar
        self._move("chaser/cylinder/spring", t, scale=stretch)
        self._move_string(samples)
        self._move_tip(samples, touching)

    def trail(self, samples: np.ndarray, touching: np.ndarray) -> None:
        """Log the tip's way, (n,) samples: thin, and thick where it touches."""
        tip = tip_in_world(self._scene, samples["q"])
        above = np.full((len(tip), 1), self._scene.probe.tip_radius + 0.001)
        strip = np.concatenate([tip, above], axis=1)
        self._stream.static(
            f"{self._world}/trail", rr.LineStrips3D([strip], radii=0.0012, colors=self._colour)
        )
        way = tip_in_cone(samples) * _MM
        self._stream.static(
            f"{self._map}/way", rr.LineStrips2D([way], radii=0.3, colors=_BLACK, draw_order=20.0)
        )
        ends = np.flatnonzero(np.diff(np.concatenate([[0], touching.astype(np.int8), [0]])))
        pieces = [way[a : b + 1] for a, b in zip(ends[::2], ends[1::2], strict=True)]
        self._stream.static(
            f"{self._map}/way_in_contact",
            rr.LineStrips2D(pieces, radii=0.9, colors=self._colour, draw_order=21.0),
        )

    def trail_piece(self, samples: np.ndarray) -> None:
        """Log the next piece of the tip's way, seen together with those before it."""
        strips = [tip_in_cone(samples) * _MM]
        self._stream.columns(
            f"{self._map}/trail", samples["t"][-1:], rr.LineStrips2D, strips=strips
        )

    # shapes

    @property
    def _collar(self) -> float:
        """How far the collar that the spring pushes sits behind the tip's centre, m."""
        return self._scene.probe.tip_radius + 0.5 * self._scene.probe.length

    def _shape(self, entity: str, *archetypes: rr.AsComponents) -> None:
        self._stream.static(f"{self._world}/{entity}", *archetypes)

    def _log_bodies(self) -> None:
        scene = self._scene
        supports = scene.supports
        for entity, box, balls, grey in (
            ("chaser", chaser_box(scene), supports and supports.chaser.balls, 175),
            ("target", target_box(scene), supports and supports.target.balls, 120),
        ):
            self._shape(f"{entity}/body", _body(box, grey))
            if balls:
                height = bench_model.FLOOR + bench_model.BALL_RADIUS
                places = [(x, y, height) for x, y in balls]
                self._shape(
                    f"{entity}/balls",
                    rr.Points3D(places, radii=bench_model.BALL_RADIUS, colors=_GREY),
                )
        vertices, triangles = bench_model.cone_mesh(scene.cone)
        self._shape(
            "target/cone",
            rr.Mesh3D(
                vertex_positions=vertices,
                triangle_indices=triangles,
                albedo_factor=(*style.rgb(style.CONE), 255),
            ),
        )
        for name, side, _ in _SIDES:
            face = wall(scene.cone, side) - (scene.cone.L_T, 0.0)
            self._shape(
                f"target/wall_{name}", rr.LineStrips3D([_level(face)], radii=0.003, colors=_DARK)
            )

    def _log_buffer(self) -> None:
        scene = self._scene
        radius = scene.probe.radius
        length = max(scene.cylinder.length, 1e-3)
        self._shape("chaser/cylinder/housing", _rod(-length, 0.0, 1.5 * radius, _GREY))
        rear = -scene.probe.tip_radius - scene.probe.length
        self._shape(
            "chaser/cylinder/probe/rod", _rod(rear, -scene.probe.tip_radius, 0.6 * radius, _DARK)
        )
        collar = -self._collar
        self._shape(
            "chaser/cylinder/probe/collar", _rod(collar - 0.002, collar + 0.002, 2 * radius, _DARK)
        )
        self._shape(
            "chaser/cylinder/probe/tip",
            rr.Points3D([(0.0, 0.0, 0.0)], radii=scene.probe.tip_radius, colors=self._colour),
        )
        # one length unit of spring; the motion stretches it
        self._shape(
            "chaser/cylinder/spring",
            rr.LineStrips3D([bench_model.helix(1.5 * radius)], radii=0.0014, colors=_GREY),
        )
        if scene.stops is not None:
            rest = scene.rest_length - self._collar
            for name, stroke in (
                ("compression", -scene.stops.compression),
                ("extension", scene.stops.extension),
            ):
                x = rest + stroke
                self._shape(
                    f"chaser/cylinder/stop_{name}",
                    _rod(x - 0.001, x + 0.001, 2.4 * radius, _BLACK),
                )

    def _log_surroundings(self) -> None:
        scene = self._scene
        start = scene.initial.chaser
        if scene.rail is not None:
            along = np.array([np.cos(start.theta), np.sin(start.theta), 0.0])
            side = np.array([-along[1], along[0], 0.0]) * 0.05
            place = np.array([start.x, start.y, bench_model.FLOOR + 0.004])
            ends = [place - 0.13 * along, place + (scene.rail.length + 0.13) * along]
            strips = [[end + s for end in ends] for s in (side, -side)]
            self._shape("rail", rr.LineStrips3D(strips, radii=0.004, colors=_GREY))
        if scene.string is not None:
            self._shape("string", rr.LineStrips3D.from_fields(colors=_BLACK, radii=0.0015))
            self._shape(
                "hanging_mass",
                rr.Boxes3D(half_sizes=[0.02, 0.02, 0.025], colors=_BLACK, fill_mode="solid"),
            )
            self._shape(
                "pulley",
                rr.Cylinders3D(
                    lengths=0.015,
                    radii=bench_model.PULLEY_RADIUS,
                    centers=[bench_model.pulley_place(scene)],
                    quaternions=_Y_AXIS,
                    colors=_GREY,
                    fill_mode="solid",
                ),
            )
        self._shape("contact_force", rr.Arrows3D.from_fields(colors=_BLACK, radii=0.003))

    def _log_close_up(self) -> None:
        """Log the cone as seen from above, in its own frame, mm."""
        scene, stream = self._scene, self._stream
        # 2D views count y downwards
        stream.static(self._map, rr.Transform3D(scale=[1.0, -1.0, 1.0]))
        for name, side, label in _SIDES:
            face = wall(scene.cone, side) * _MM
            stream.static(
                f"{self._map}/wall_{name}",
                rr.LineStrips2D([face], radii=1.2, colors=_DARK),
            )
            # behind the wall, where the tip never is
            behind = face.mean(axis=0) + 16.0 * np.array([1.0, side]) * np.sqrt(0.5)
            stream.static(
                f"{self._map}/name_{name}",
                rr.Points2D([behind], radii=0.01, colors=_DARK, labels=label, show_labels=True),
            )
            bound = tip_bound(scene.cone, scene.probe.tip_radius, side) * _MM
            stream.static(
                f"{self._map}/tip_bound_{name}",
                rr.LineStrips2D([bound], radii=0.25, colors=_GREY),
            )
        zone = circle(np.zeros(2), scene.detector.capture_radius) * _MM
        stream.static(
            f"{self._map}/capture_zone",
            rr.LineStrips2D([zone], radii=0.5, colors=style.rgb(style.GREEN)),
        )
        stream.static(
            f"{self._map}/trail",
            rr.LineStrips2D.from_fields(radii=0.3, colors=_BLACK, draw_order=20.0),
        )
        radius = scene.probe.tip_radius * _MM
        stream.static(f"{self._map}/tip", rr.Points2D.from_fields(radii=radius, draw_order=-5.0))
        stream.static(
            f"{self._map}/centre",
            rr.Points2D.from_fields(radii=1.0, colors=_BLACK, draw_order=50.0),
        )
        stream.static(
            f"{self._map}/contact_force",
            rr.Arrows2D.from_fields(radii=0.9, colors=_BLACK, draw_order=60.0),
        )

    # motion

    def _move(self, entity: str, t: np.ndarray, **values: Any) -> None:
        self._stream.columns(f"{self._world}/{entity}", t, rr.Transform3D, **values)

    def _move_string(self, samples: np.ndarray) -> None:
        if self._scene.string is None:
            return
        beats = np.floor(samples["t"] / _STRING_PERIOD + 1e-6)
        few = samples[np.flatnonzero(np.diff(beats, prepend=-1.0))]
        few = few[np.isfinite(few["mass_height"])]
        if not few.size:
            return
        strings = bench_model.string_ends(self._scene, few["q"])
        masses = bench_model.mass_places(self._scene, few["mass_height"])
        hanging = strings[:, 1:] + (bench_model.PULLEY_RADIUS, 0.0, -bench_model.PULLEY_RADIUS)
        strips = np.concatenate([strings, hanging, masses[:, None]], axis=1)
        self._stream.columns(
            f"{self._world}/string", few["t"], rr.LineStrips3D, strips=list(strips)
        )
        self._move("hanging_mass", few["t"], translation=masses)

    def _move_tip(self, samples: np.ndarray, touching: np.ndarray) -> None:
        scene, t = self._scene, samples["t"]
        above = np.full((len(t), 1), scene.probe.tip_radius + 0.002)
        origin = np.concatenate([tip_in_world(scene, samples["q"]), above], axis=1)
        # an arrow beyond the view tells nothing
        force = np.nan_to_num(samples["contact_force"]) * FORCE_SCALE
        length = np.linalg.norm(force, axis=1, keepdims=True)
        force *= np.minimum(1.0, _LONGEST_ARROW / np.maximum(length, 1e-12))
        self._stream.columns(
            f"{self._world}/contact_force", t, rr.Arrows3D, vectors=_level(force), origins=origin
        )
        places = tip_in_cone(samples) * _MM
        tint = np.where(touching[:, None], self._colour, style.light(self._colour))
        self._stream.columns(
            f"{self._map}/tip", t, rr.Points2D, positions=places, colors=tint.astype(np.uint8)
        )
        self._stream.columns(f"{self._map}/centre", t, rr.Points2D, positions=places)
        c, s = np.cos(samples["q"][:, TARGET[2]]), np.sin(samples["q"][:, TARGET[2]])
        fx, fy = force.T * _MM
        vectors = np.stack([c * fx + s * fy, c * fy - s * fx], axis=-1)
        self._stream.columns(
            f"{self._map}/contact_force", t, rr.Arrows2D, vectors=vectors, origins=places
        )


def _level(points: np.ndarray) -> np.ndarray:
    """Return points of the plane (n, 2) in space, (n, 3)."""
    return np.concatenate([points, np.zeros((len(points), 1))], axis=1)


def _yaw(angle: np.ndarray) -> np.ndarray:
    return bench_model.yaw_quaternions(angle)


def _rod(
    x_rear: float, x_front: float, radius: float, colour: tuple[int, int, int]
) -> rr.Cylinders3D:
    """Return a cylinder along x, m."""
    return rr.Cylinders3D(
        lengths=x_front - x_rear,
        radii=radius,
        centers=[(x_rear + x_front) / 2, 0.0, 0.0],
        quaternions=_X_AXIS,
        colors=colour,
        fill_mode="solid",
    )


def _body(box: Box, grey: int) -> rr.Boxes3D:
    height = bench_model.BODY_HEIGHT
    return rr.Boxes3D(
        centers=[(box.back + box.front) / 2, 0.0, bench_model.BODY_TOP - height / 2],
        half_sizes=[(box.front - box.back) / 2, box.half_width, height / 2],
        colors=(grey, grey, grey),
        fill_mode="solid",
    )
