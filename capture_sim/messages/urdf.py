r"""The bench as a URDF and as transforms, for display in RViz, Foxglove and other tools.

The motion is planar: bodies lie at z = 0.  The scene gives the masses of the vehicles, but not
their sizes, so the boxes are for display only.  For this reason, links have no inertia either.

    world -- chaser/base_link -- chaser/cylinder -- chaser/probe -- chaser/tip
          \- target/base_link -- target/cone

``chaser/base_link`` and ``target/base_link`` are the centres of mass; ``chaser/cylinder`` is
the hinge, and ``chaser/probe`` is the hinge displaced along the probe by the stroke.
``chaser/tip`` is the centre of the tip's sphere.  ``target/cone`` is the centre of the cone's inner
edge BE, with the orientation of the target.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import NamedTuple
from xml.etree import ElementTree

import numpy as np

from capture_sim.messages.convert import (
    CHASER_FRAME,
    CONE_FRAME,
    HINGE_JOINT,
    SLIDE_JOINT,
    TARGET_FRAME,
    TIP_FRAME,
    WORLD,
)
from capture_sim.scene.parts import Scene

CYLINDER_FRAME = "chaser/cylinder"
PROBE_FRAME = "chaser/probe"

# dimensions for display only, m
_HALF_WIDTH, _HEIGHT = 0.11, 0.06
_REAR = 0.13  # centre of mass to the rear
_CYLINDER_RADIUS = 0.012
_PLATE = 0.002  # thickness of the cone's plates
_PLATES = 16
_COLOURS = {
    "chaser": "0.30 0.45 0.70 1",
    "target": "0.55 0.55 0.58 1",
    "steel": "0.8 0.8 0.8 1",
    "cone": "0.85 0.65 0.25 0.6",
}


class Transform(NamedTuple):
    """Pose of a frame in its parent frame; the rotation is about z."""

    parent: str
    child: str
    x: float  # m
    y: float  # m
    yaw: float  # rad


class Box(NamedTuple):
    """Extent of a vehicle's body in its own frame, m."""

    back: float
    front: float
    half_width: float

    @property
    def corners(self) -> np.ndarray:
        """Closed outline, (5, 2), m."""
        x0, x1, y = self.back, self.front, self.half_width
        return np.array([[x0, -y], [x1, -y], [x1, y], [x0, y], [x0, -y]])


def chaser_box(scene: Scene) -> Box:
    """Return the box of the chaser's body; it ends just in front of the hinge."""
    return Box(-_REAR, scene.buffer.hinge_offset + _CYLINDER_RADIUS, _HALF_WIDTH)


def target_box(scene: Scene) -> Box:
    """Return the box of the target's body; it starts just behind BE."""
    return Box(-0.9 * scene.cone.L_T, _REAR, _HALF_WIDTH)


def moving_transforms(scene: Scene, q: Sequence[float]) -> Iterator[Transform]:
    """Yield the transforms that vary with the motion, from q (8,), m and rad."""
    yield Transform(WORLD, CHASER_FRAME, q[0], q[1], q[2])
    yield Transform(WORLD, TARGET_FRAME, q[5], q[6], q[7])
    yield Transform(CHASER_FRAME, CYLINDER_FRAME, scene.buffer.hinge_offset, 0.0, q[3] - q[2])
    yield Transform(CYLINDER_FRAME, PROBE_FRAME, q[4] - scene.rest_length, 0.0, 0.0)


def static_transforms(scene: Scene) -> Iterator[Transform]:
    """Yield the constant transforms."""
    yield Transform(PROBE_FRAME, TIP_FRAME, scene.rest_length, 0.0, 0.0)
    yield Transform(TARGET_FRAME, CONE_FRAME, -scene.cone.L_T, 0.0, 0.0)


def urdf(scene: Scene) -> str:
    """Return the robot description: XML text of both vehicles, buffer, probe and cone."""
    robot = ElementTree.Element("robot", name="capture_bench")
    for name, colour in _COLOURS.items():
        material = ElementTree.SubElement(robot, "material", name=name)
        ElementTree.SubElement(material, "color", rgba=colour)
    ElementTree.SubElement(robot, "link", name=WORLD)

    _body(_link(robot, CHASER_FRAME), "chaser", chaser_box(scene))
    cylinder = _link(robot, CYLINDER_FRAME)
    length = scene.cylinder.length
    _rod(cylinder, "steel", _CYLINDER_RADIUS, length, -0.5 * length)
    _ball(cylinder, "steel", _CYLINDER_RADIUS)
    probe = _link(robot, PROBE_FRAME)
    start = scene.rest_length - scene.probe.tip_radius - scene.probe.length
    _rod(probe, "steel", scene.probe.radius, scene.probe.length, start + 0.5 * scene.probe.length)
    _ball(_link(robot, TIP_FRAME), "steel", scene.probe.tip_radius)

    _body(_link(robot, TARGET_FRAME), "target", target_box(scene))
    _plates(_link(robot, CONE_FRAME), scene)

    _joint(robot, "chaser", "planar", WORLD, CHASER_FRAME, axis="0 0 1")
    _joint(robot, "target", "planar", WORLD, TARGET_FRAME, axis="0 0 1")
    hinge = _joint(
        *(robot, HINGE_JOINT, "revolute", CHASER_FRAME, CYLINDER_FRAME),
        *(scene.buffer.hinge_offset, "0 0 1"),
    )
    _limit(hinge, -math.pi, math.pi)
    slide = _joint(robot, SLIDE_JOINT, "prismatic", CYLINDER_FRAME, PROBE_FRAME, axis="1 0 0")
    # without stops, the probe may slide in up to its tip
    inwards, outwards = scene.rest_length - scene.probe.tip_radius, scene.rest_length
    if scene.stops is not None:
        inwards = scene.stops.compression
    if scene.outward_stroke is not None:
        outwards = scene.outward_stroke
    _limit(slide, -inwards, outwards)
    for t in static_transforms(scene):
        _joint(robot, t.child.replace("/", "_"), "fixed", t.parent, t.child, t.x)
    ElementTree.indent(robot)
    return ElementTree.tostring(robot, encoding="unicode", xml_declaration=True)


_Element = ElementTree.Element


def _link(robot: _Element, name: str) -> _Element:
    return ElementTree.SubElement(robot, "link", name=name)


def _numbers(values: Sequence[float]) -> str:
    return " ".join(f"{value:.9g}" for value in values)


def _visual(
    link: _Element, material: str, at: Sequence[float], rpy: Sequence[float] = (0, 0, 0)
) -> _Element:
    visual = ElementTree.SubElement(link, "visual")
    ElementTree.SubElement(visual, "origin", xyz=_numbers(at), rpy=_numbers(rpy))
    geometry = ElementTree.SubElement(visual, "geometry")
    ElementTree.SubElement(visual, "material", name=material)
    return geometry


def _body(link: _Element, material: str, box: Box) -> None:
    size = (box.front - box.back, 2 * box.half_width, _HEIGHT)
    _box(link, material, size, (0.5 * (box.front + box.back), 0, 0))


def _box(
    link: _Element,
    material: str,
    size: Sequence[float],
    at: Sequence[float],
    rpy: Sequence[float] = (0, 0, 0),
) -> None:
    ElementTree.SubElement(_visual(link, material, at, rpy), "box", size=_numbers(size))


def _rod(link: _Element, material: str, radius: float, length: float, middle: float) -> None:
    """Add a cylinder along x; by default, a cylinder in a URDF lies along z."""
    if length > 0.0:
        geometry = _visual(link, material, (middle, 0, 0), (0, math.pi / 2, 0))
        size = {"radius": f"{radius:.9g}", "length": f"{length:.9g}"}
        ElementTree.SubElement(geometry, "cylinder", size)


def _ball(link: _Element, material: str, radius: float) -> None:
    ElementTree.SubElement(_visual(link, material, (0, 0, 0)), "sphere", radius=f"{radius:.9g}")


def _plates(link: _Element, scene: Scene) -> None:
    """Add the cone as a ring of plates; two of them are the walls of the plane model."""
    cone = scene.cone
    lip = cone.R_c + cone.L_c * math.sin(cone.half_angle)
    width = 2.0 * lip * math.tan(math.pi / _PLATES)
    middle_x = -0.5 * cone.L_c * math.cos(cone.half_angle)
    # the plates' inner faces are the walls: the boxes lie outside of them
    radius = 0.5 * (cone.R_c + lip) + 0.5 * _PLATE * math.cos(cone.half_angle)
    middle_x += 0.5 * _PLATE * math.sin(cone.half_angle)
    for i in range(_PLATES):
        angle = 2.0 * math.pi * i / _PLATES + math.pi / 2
        middle = (middle_x, radius * math.cos(angle), radius * math.sin(angle))
        # x is along the generatrix: a plate is inclined by the half-angle, then rolled about x
        rpy = _roll_after_yaw(angle, math.pi - cone.half_angle)
        _box(link, "cone", (cone.L_c, _PLATE, width), middle, rpy)


def _roll_after_yaw(roll: float, yaw: float) -> tuple[float, float, float]:
    """Return the fixed-axis angles (URDF's rpy) of a rotation about z followed by one about x."""
    cr, sr, cy, sy = math.cos(roll), math.sin(roll), math.cos(yaw), math.sin(yaw)
    # R = Rx(roll) Rz(yaw); entries that are needed for Rz(y) Ry(p) Rx(r)
    r11, r21, r31 = cy, cr * sy, sr * sy
    r32, r33 = sr * cy, cr
    return math.atan2(r32, r33), -math.asin(r31), math.atan2(r21, r11)


def _joint(
    robot: _Element, name: str, kind: str, parent: str, child: str, x: float = 0.0, axis: str = ""
) -> _Element:
    joint = ElementTree.SubElement(robot, "joint", name=name, type=kind)
    ElementTree.SubElement(joint, "origin", xyz=_numbers((x, 0, 0)), rpy="0 0 0")
    ElementTree.SubElement(joint, "parent", link=parent)
    ElementTree.SubElement(joint, "child", link=child)
    if axis:
        ElementTree.SubElement(joint, "axis", xyz=axis)
    return joint


def _limit(joint: _Element, low: float, high: float) -> None:
    bounds = {"lower": f"{low:.9g}", "upper": f"{high:.9g}", "effort": "0", "velocity": "0"}
    ElementTree.SubElement(joint, "limit", bounds)
