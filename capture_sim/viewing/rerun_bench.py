"""Drawings of a run's bench in rerun: a view in 3D, and a close-up of the tip in the cone.

The motion is planar, so all heights are chosen for a clear picture only.  The axis of the buffer is
at z = 0 and the bodies of both vehicles are below it.  The upper half of the cone is not drawn, so
that the tip can be seen from above.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import rerun as rr

from capture_sim.dynamics.samples import Phase
from capture_sim.messages.urdf import chaser_box, target_box
from capture_sim.scene.parts import Cone, Scene
from capture_sim.viewing import shapes, style
from capture_sim.viewing.rerun_stream import RunStream

_MM = 1e3  # in a metre: drawings are in mm
#: Length of the arrow of the contact force, m for 1 N; no arrow is longer than _LONGEST_ARROW, m.
FORCE_SCALE = 3e-3
_LONGEST_ARROW = 0.12
_STRING_PERIOD = 0.01  # s, between two positions of the string

# for the eye, m
_BODY_TOP, _BODY_HEIGHT = -0.03, 0.06
_BALL_RADIUS = 0.014
_FLOOR = _BODY_TOP - _BODY_HEIGHT - 2 * _BALL_RADIUS
_STRING_Y = -0.17  # beside the bodies, over a pulley behind the target
_PULLEY_RADIUS, _PULLEY_BEHIND = 0.02, 0.18

_BLACK, _DARK, _GREY = (style.rgb(colour) for colour in (style.BLACK, style.DARK, style.GREY))
_LATCHED = style.rgb(style.PHASES["latched"])
_X_AXIS = rr.Quaternion(xyzw=[0.0, np.sqrt(0.5), 0.0, np.sqrt(0.5)])  # turns z to x
_Y_AXIS = rr.Quaternion(xyzw=[np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5)])  # turns z to -y


class BenchLog:
    """Logs the drawings of a scene's bench to a rerun recording, with the tip in the run's colour.

    The constructor logs all shapes once.  :meth:`motion` then moves them.  ``colour`` is
    ``#RRGGBB``.
    """

    def __init__(self, stream: RunStream, scene: Scene, colour: str) -> None:
        self._stream, self._scene, self._colour = stream, scene, style.rgb(colour)
        self._map = f"{stream.name}/close_up"
        self._highest = 0.0  # place of the hanging mass so far, m
        #: Distance from the tip's centre back to the collar that the spring pushes, m.
        self._collar = scene.probe.tip_radius + 0.5 * scene.probe.length
        target, chaser = scene.initial.target, scene.initial.chaser
        height = _BODY_TOP - _BODY_HEIGHT / 2
        self._pulley = np.array([target.x + _PULLEY_BEHIND, chaser.y + _STRING_Y, height])
        self._log_bodies()
        self._log_buffer()
        self._log_surroundings()
        self._log_close_up()

    def motion(self, samples: np.ndarray, touching: np.ndarray) -> None:
        """Log the positions of all moving shapes and the contact force at the samples' times.

        ``samples``: (n,) of dtype SAMPLE.  ``touching``: (n,) bool, True where the tip touches the
        cone.
        """
        t, q = samples["t"], samples["q"]
        for entity, body in (("chaser", shapes.CHASER), ("target", shapes.TARGET)):
            pose = q[:, list(body)]
            self._move(entity, t, translation=_level(pose[:, :2]), quaternion=_yaw(pose[:, 2]))
        hinge = np.tile([self._scene.buffer.hinge_offset, 0.0, 0.0], (len(t), 1))
        self._move("chaser/cylinder", t, translation=hinge, quaternion=_yaw(samples["torsion"]))
        along, stretch = np.zeros((len(t), 3)), np.ones((len(t), 3))
        along[:, 0], stretch[:, 0] = q[:, shapes.H], q[:, shapes.H] - self._collar
        self._move("chaser/cylinder/probe", t, translation=along)
        self._move("chaser/cylinder/spring", t, scale=stretch)
        self._move_string(samples)
        self._move_tip(samples, touching)

    def trail(self, samples: np.ndarray, touching: np.ndarray) -> None:
        """Log the whole path of the tip as lines without a time.

        ``samples``: (n,) of dtype SAMPLE.  ``touching``: (n,) bool, True where the tip touches the
        cone.  In the close-up, the line is thin and black, thick in the run's colour in contact,
        and green while the latch holds the tip.  In 3D it is one line in the run's colour.
        """
        above = self._scene.probe.tip_radius + 0.001
        strip = _level(shapes.tip_in_world(self._scene, samples["q"]), above)
        self._shape("trail", rr.LineStrips3D([strip], radii=0.0012, colors=self._colour))
        path = shapes.tip_in_cone(samples) * _MM
        self._draw("path", rr.LineStrips2D([path], radii=0.3, colors=_BLACK, draw_order=20.0))
        ends = np.flatnonzero(np.diff(np.concatenate([[0], touching.astype(np.int8), [0]])))
        pieces = [path[a : b + 1] for a, b in zip(ends[::2], ends[1::2], strict=True)]
        thick = rr.LineStrips2D(pieces, radii=0.9, colors=self._colour, draw_order=21.0)
        self._draw("path_in_contact", thick)
        latched = [path[samples["phase"] == Phase.LATCHED]]
        strip = rr.LineStrips2D(latched, radii=0.6, colors=_LATCHED, draw_order=22.0)
        self._draw("path_latched", strip)

    def trail_piece(self, samples: np.ndarray) -> None:
        """Log one more piece of the tip's path in the close-up, at the time of the last sample.

        ``samples``: (n,) of dtype SAMPLE.  The pieces join only if the first sample is the last
        sample of the previous piece.
        """
        strips = [shapes.tip_in_cone(samples) * _MM]
        self._stream.columns(
            f"{self._map}/trail", samples["t"][-1:], rr.LineStrips2D, strips=strips
        )

    # shapes

    def _shape(self, entity: str, archetype: rr.AsComponents) -> None:
        self._stream.static(f"{self._stream.name}/world/{entity}", archetype)

    def _draw(self, entity: str, archetype: rr.AsComponents) -> None:
        self._stream.static(f"{self._map}/{entity}", archetype)

    def _log_bodies(self) -> None:
        scene, supports = self._scene, self._scene.supports
        for entity, box, balls, grey in (
            ("chaser", chaser_box(scene), supports and supports.chaser.balls, 175),
            ("target", target_box(scene), supports and supports.target.balls, 120),
        ):
            half = [(box.front - box.back) / 2, box.half_width, _BODY_HEIGHT / 2]
            centre = [(box.back + box.front) / 2, 0.0, _BODY_TOP - _BODY_HEIGHT / 2]
            look: dict[str, Any] = {"colors": (grey, grey, grey), "fill_mode": "solid"}
            self._shape(f"{entity}/body", rr.Boxes3D(centers=[centre], half_sizes=[half], **look))
            if balls:
                places = [(x, y, _FLOOR + _BALL_RADIUS) for x, y in balls]
                shown = rr.Points3D(places, radii=_BALL_RADIUS, colors=_GREY)
                self._shape(f"{entity}/balls", shown)
        vertices, triangles = cone_mesh(scene.cone)
        colour = (*style.rgb(style.CONE), 255)
        mesh = rr.Mesh3D(
            vertex_positions=vertices, triangle_indices=triangles, albedo_factor=colour
        )
        self._shape("target/cone", mesh)
        for side, name in ((1, "plus"), (-1, "minus")):
            face = _level(shapes.wall(scene.cone, side) - (scene.cone.L_T, 0.0))
            self._shape(f"target/wall_{name}", rr.LineStrips3D([face], radii=0.003, colors=_DARK))

    def _log_buffer(self) -> None:
        scene, probe, cylinder = self._scene, self._scene.probe, "chaser/cylinder"
        rods = [  # entity, from, to along the probe's axis, radius, colour
            ("housing", -max(scene.cylinder.length, 1e-3), 0.0, 1.5, _GREY),
            ("probe/rod", -probe.tip_radius - probe.length, -probe.tip_radius, 0.6, _DARK),
            ("probe/collar", -self._collar - 0.002, -self._collar + 0.002, 2.0, _DARK),
        ]
        stops = {"extension": scene.outward_stroke}
        if scene.stops is not None:
            stops["compression"] = -scene.stops.compression
        for name, stroke in stops.items():
            if stroke is not None:
                x = scene.rest_length - self._collar + stroke
                rods.append((f"stop_{name}", x - 0.001, x + 0.001, 2.4, _BLACK))
        for name, rear, front, thickness, colour in rods:
            rod = rr.Cylinders3D(
                lengths=front - rear,
                radii=thickness * probe.radius,
                centers=[(rear + front) / 2, 0.0, 0.0],
                quaternions=_X_AXIS,
                colors=colour,
                fill_mode="solid",
            )
            self._shape(f"{cylinder}/{name}", rod)
        tip = rr.Points3D([(0.0, 0.0, 0.0)], radii=probe.tip_radius, colors=self._colour)
        self._shape(f"{cylinder}/probe/tip", tip)
        # a coil as long as the unit, which the motion stretches
        angle = np.linspace(0.0, 18 * np.pi, 145)
        coil = 1.5 * probe.radius * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
        points = np.column_stack([angle / angle[-1], coil])
        spring = rr.LineStrips3D([points], radii=0.0014, colors=_GREY)
        self._shape(f"{cylinder}/spring", spring)

    def _log_surroundings(self) -> None:
        scene, start = self._scene, self._scene.initial.chaser
        if scene.rail is not None:
            along = np.array([np.cos(start.theta), np.sin(start.theta), 0.0])
            side = np.array([-along[1], along[0], 0.0]) * 0.05
            place = np.array([start.x, start.y, _FLOOR + 0.004])
            ends = [place - 0.13 * along, place + (scene.rail.length + 0.13) * along]
            strips = [[end + s for end in ends] for s in (side, -side)]
            self._shape("rail", rr.LineStrips3D(strips, radii=0.004, colors=_GREY))
        if scene.string is not None:
            self._shape("string", rr.LineStrips3D.from_fields(colors=_BLACK, radii=0.0015))
            mass = rr.Boxes3D(half_sizes=[0.02, 0.02, 0.025], colors=_BLACK, fill_mode="solid")
            self._shape("hanging_mass", mass)
            pulley = rr.Cylinders3D(
                lengths=0.015,
                radii=_PULLEY_RADIUS,
                centers=[self._pulley],
                quaternions=_Y_AXIS,
                colors=_GREY,
                fill_mode="solid",
            )
            self._shape("pulley", pulley)
        self._shape("contact_force", rr.Arrows3D.from_fields(colors=_BLACK, radii=0.003))

    def _log_close_up(self) -> None:
        """Log the shapes of the close-up: the cone from above, in its own frame, mm.

        The frame's origin is the centre of BE, x is the target's +x and y the target's +y.
        """
        scene = self._scene
        # 2D views count y downwards
        self._stream.static(self._map, rr.Transform3D(scale=[1.0, -1.0, 1.0]))
        for name, shape in shapes.cone_shapes(scene).items():
            if not shape.line:
                continue  # a wall's body
            look: dict[str, Any] = {"colors": style.rgb(shape.line), "radii": 0.25 * shape.width}
            strip = rr.LineStrips2D([shape.points * _MM], **look)
            self._draw(name.replace(" ", "_").replace("+", "plus_").replace("-", "minus_"), strip)
        for side, (*_, label) in style.WALLS.items():
            # behind the wall, where the tip never is
            place = shapes.wall(scene.cone, side).mean(axis=0) * _MM + 11.3 * np.array([1.0, side])
            look = {"radii": 0.01, "colors": _DARK, "labels": label, "show_labels": True}
            self._draw(f"name_{'plus' if side > 0 else 'minus'}", rr.Points2D([place], **look))
        thin = rr.LineStrips2D.from_fields(radii=0.3, colors=_BLACK, draw_order=20.0)
        self._draw("trail", thin)
        self._draw(
            "tip", rr.Points2D.from_fields(radii=scene.probe.tip_radius * _MM, draw_order=-5.0)
        )
        self._draw("centre", rr.Points2D.from_fields(radii=1.0, colors=_BLACK, draw_order=50.0))
        arrow = rr.Arrows2D.from_fields(radii=0.9, colors=_BLACK, draw_order=60.0)
        self._draw("contact_force", arrow)

    # motion

    def _move(self, entity: str, t: np.ndarray, **values: Any) -> None:
        self._stream.columns(f"{self._stream.name}/world/{entity}", t, rr.Transform3D, **values)

    def _move_string(self, samples: np.ndarray) -> None:
        """Log the string from the chaser over the pulley, and the hanging mass at its end.

        Nothing is logged if the scene has no string or no sample has a mass height.
        """
        periods = np.floor(samples["t"] / _STRING_PERIOD + 1e-6)
        drawn = samples[np.flatnonzero(np.diff(periods, prepend=-1.0))]
        drawn = drawn[np.isfinite(drawn["mass_height"])]
        if self._scene.string is None or not drawn.size:
            return
        r = _PULLEY_RADIUS
        strips = np.tile(self._pulley, (len(drawn), 4, 1)) + np.array(
            [[0, 0, r], [0, 0, r], [r, 0, 0], [r, 0, -0.05]]
        )
        strips[:, 0, 0] = drawn["q"][:, 0]
        # below its highest place so far: a live view gets the samples in pieces
        self._highest = max(self._highest, float(drawn["mass_height"].max()))
        strips[:, 3, 2] += drawn["mass_height"] - self._highest
        entity = f"{self._stream.name}/world/string"
        self._stream.columns(entity, drawn["t"], rr.LineStrips3D, strips=list(strips))
        self._move("hanging_mass", drawn["t"], translation=strips[:, 3])

    def _move_tip(self, samples: np.ndarray, touching: np.ndarray) -> None:
        scene, t, columns = self._scene, samples["t"], self._stream.columns
        origin = _level(shapes.tip_in_world(scene, samples["q"]), scene.probe.tip_radius + 0.002)
        # an arrow that leaves the view shows nothing
        force = np.nan_to_num(samples["contact_force"]) * FORCE_SCALE
        length = np.linalg.norm(force, axis=1, keepdims=True)
        force *= np.minimum(1.0, _LONGEST_ARROW / np.maximum(length, 1e-12))
        entity = f"{self._stream.name}/world/contact_force"
        columns(entity, t, rr.Arrows3D, vectors=_level(force), origins=origin)
        places = shapes.tip_in_cone(samples) * _MM
        tint = np.where(touching[:, None], self._colour, style.light(self._colour))
        tint[samples["phase"] == Phase.LATCHED] = _LATCHED
        tint = tint.astype(np.uint8)
        columns(f"{self._map}/tip", t, rr.Points2D, positions=places, colors=tint)
        columns(f"{self._map}/centre", t, rr.Points2D, positions=places)
        theta = samples["q"][:, shapes.TARGET[2]]
        turned = (force[:, 0] + 1j * force[:, 1]) * np.exp(-1j * theta) * _MM
        vectors = np.stack([turned.real, turned.imag], axis=-1)
        columns(f"{self._map}/contact_force", t, rr.Arrows2D, vectors=vectors, origins=places)


def cone_mesh(cone: Cone, count: int = 48) -> tuple[np.ndarray, np.ndarray]:
    """Return the lower half of the cone (z <= 0) as a mesh in the target's base frame.

    The first array has the vertices, (2 count, 3), m: ``count`` points on BE, then ``count`` on the
    lip.  The second array has the triangles, (2 count - 2, 3), as indices of vertices.
    """
    angle = np.linspace(np.pi, 2 * np.pi, count)
    rings = [
        np.stack([np.full(count, x - cone.L_T), r * np.cos(angle), r * np.sin(angle)], axis=-1)
        for x, r in shapes.wall(cone, 1)
    ]
    first = np.arange(count - 1)
    quads = np.stack([first, first + 1, first + count, first + count + 1], axis=-1)
    return np.concatenate(rings), np.concatenate([quads[:, [0, 1, 2]], quads[:, [1, 3, 2]]])


def _level(points: np.ndarray, z: float = 0.0) -> np.ndarray:
    """Return planar points (n, 2) as points in space (n, 3), all at the height ``z``, m."""
    return np.column_stack([points, np.full(len(points), z)])


def _yaw(angle: np.ndarray) -> np.ndarray:
    """Return rotations about z as quaternions x, y, z, w, (n, 4), from angles (n,), rad."""
    zero = np.zeros(len(angle))
    return np.column_stack([zero, zero, np.sin(0.5 * angle), np.cos(0.5 * angle)])
