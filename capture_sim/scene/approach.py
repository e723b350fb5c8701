"""The approach of the chaser to the cone, and scenes that start just before the first touch."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

from capture_sim.base.compiled.kernels import plain
from capture_sim.errors import SceneError
from capture_sim.scene.launch_motion import speed_after
from capture_sim.scene.launch_plan import coasting, plan_launch, travel_to_touch
from capture_sim.scene.parts import Cone, Initial, PlanarState, Scene
from capture_sim.scene.quantities import Checked, Range, accept, declared, quantity, replaced

#: Distance from the start to the first touch where the approach is given, m.
RUN_UP = 2e-3


@dataclass(frozen=True)
class Approach(Checked):
    """The motion of the chaser just before the first touch: free, without rail and string."""

    angle: float = quantity(
        "rad", Range(-math.pi / 2, math.pi / 2), default=0.0, doc="target's heading less chaser's"
    )
    offset: float = quantity(
        "m",
        Range(-10.0, 10.0),
        default=0.0,
        doc="chaser's path to the left of the target's centre of mass",
    )
    speed: float = quantity(
        "m/s", Range(1e-4, 10.0), default=0.1, doc="speed of the chaser at the first touch"
    )
    mouth_offset: float | None = quantity(
        "m",
        Range(-10.0, 10.0),
        default=None,
        doc="chaser's path to the left of the centre of the cone's mouth; replaces offset",
    )

    def path_offset(self, cone: Cone) -> float:
        """Return how far the chaser's path passes to the left of the target's centre of mass, m.

        This is ``offset``, or is computed from ``mouth_offset`` if that is given.  The centre of
        the cone's mouth lies ``L_T + L_c cos(beta)`` from the target's centre of mass, towards the
        chaser.  Seen along the chaser's heading, a target that is turned to the left has its mouth
        to the right of its centre of mass.
        """
        if self.mouth_offset is None:
            return self.offset
        to_mouth = cone.L_T + cone.L_c * math.cos(cone.half_angle)
        return self.mouth_offset - to_mouth * math.sin(self.angle)


#: Names of the values of the approach, as ``--set`` and sweeps accept them.
APPROACH = tuple(f"approach.{name}" for name in declared(Approach))


def approach_of(scene: Scene) -> Approach:
    """Return the approach of a scene's chaser to the cone, with ``offset``, not ``mouth_offset``.

    The chaser is assumed to move along its heading.  SceneError if its straight path misses the
    cone, if it stops before the cone, if its string cannot be planned (see
    :func:`capture_sim.scene.launch_plan.plan_launch`), or if a value of the approach is out of its
    range, e.g. an angle above 90 degrees.
    """
    chaser, target = scene.initial.chaser, scene.initial.target
    plan = plan_launch(scene)
    if not math.isfinite(plan.contact_time):
        raise SceneError(f"{scene.name}: the chaser never meets the cone")
    c, s = math.cos(chaser.theta), math.sin(chaser.theta)
    offset = c * (chaser.y - target.y) - s * (chaser.x - target.x)
    angle = math.remainder(target.theta - chaser.theta, math.tau)
    return Approach(angle, offset, plan.impact_speed)


def with_approach(approach: Approach, given: Mapping[str, float]) -> Approach:
    """Return an approach with other values, by their names in :class:`Approach`.

    An ``offset`` removes the ``mouth_offset`` of the earlier approach.  SceneError if a value is
    out of its range, or if both ``offset`` and ``mouth_offset`` are given.
    """
    if "offset" in given and given.get("mouth_offset") is not None:
        raise SceneError("approach.mouth_offset: must be given without approach.offset")
    if "offset" in given:
        approach = replace(approach, mouth_offset=None)
    return replace(approach, **given)


def approached(scene: Scene, given: Mapping[str, Any]) -> Scene:
    """Return a scene that starts just before its first touch, with the given approach.

    ``given`` has values by their names in :class:`Approach`; numbers are in SI units, texts may
    have a unit.  Values that are not given remain those of the scene's own approach.  SceneError
    if a name or a value is invalid, or if a value is not given and the scene's chaser does not
    reach the cone.
    """
    fields = declared(Approach)
    for name in given:
        if name not in fields:
            raise SceneError(f"approach.{name}: unknown field; available: {', '.join(fields)}")
    values = {
        name: accept(value, fields[name], f"approach.{name}") for name, value in given.items()
    }
    has_offset = "offset" in given or given.get("mouth_offset") is not None
    own = Approach() if has_offset and {"angle", "speed"} <= given.keys() else approach_of(scene)
    return placed(scene, with_approach(own, values))


def placed(scene: Scene, approach: Approach, run_up: float = RUN_UP) -> Scene:
    """Return a scene that starts a distance ``run_up`` (m) before the first touch.

    The chaser keeps its heading, and moves along it with the offset and the speed of ``approach``.
    The target keeps its position, is at rest, and is turned by the angle of the approach relative
    to the chaser.  Rail and string are removed.  If the straight path touches no wall, because it
    misses the cone or goes through its throat, the scene starts with the tip in front of the cone.
    """
    heading, target = scene.initial.chaser.theta, scene.initial.target
    offset, speed = approach.path_offset(scene.cone), approach.speed
    c, s = math.cos(heading), math.sin(heading)
    far = scene.buffer.hinge_offset + scene.rest_length + scene.cone.L_T + 2.0 * scene.cone.L_c
    far += scene.cone.R_c + run_up
    x, y = target.x - far * c - offset * s, target.y - far * s + offset * c
    chaser = PlanarState(x, y, heading)
    turned = PlanarState(target.x, target.y, math.remainder(heading + approach.angle, math.tau))
    scene = replaced(scene, {"initial": Initial(chaser, turned), "rail": None, "string": None})
    travel = travel_to_touch(scene)
    if not math.isfinite(travel):  # the cone lies within L_T + L_c + R_c of the centre of mass
        travel = far - scene.buffer.hinge_offset - scene.rest_length - scene.cone.L_T
        travel -= scene.cone.L_c + scene.cone.R_c + scene.probe.tip_radius
    distance = max(travel - run_up, 0.0)
    start = plain(speed_after)(speed, *coasting(scene), -run_up)
    chaser = PlanarState(x + distance * c, y + distance * s, heading, start * c, start * s)
    return replaced(scene, {"initial": Initial(chaser, turned)})  # type: ignore[no-any-return]
