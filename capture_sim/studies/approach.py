"""How the chaser comes to the cone: relative angle, lateral offset and speed at the touch."""

from __future__ import annotations

import math
from dataclasses import fields, replace

from capture_sim.errors import SceneError
from capture_sim.launch.plan import plan_launch, rolling_force, travel_to_touch
from capture_sim.scene.parts import Initial, PlanarState, Scene


def placed(
    scene: Scene, angle: float, offset: float, speed: float, run_up: float = 2e-3
) -> Scene | None:
    """Return a scene that starts just before the first touch, approached as asked.

    The chaser keeps its heading, the target its place; the target stands turned by ``angle``
    (rad) against the chaser, whose path passes ``offset`` (m) to the left of the target's
    centre of mass and which meets the cone at ``speed`` (m/s).  Rail and string are taken
    off.  None if the straight path passes the cone by.

    Raises
    ------
    SceneError
        If a value is out of its range.
    """
    heading, target = scene.initial.chaser.theta, scene.initial.target
    c, s = math.cos(heading), math.sin(heading)
    far = scene.buffer.hinge_offset + scene.rest_length + scene.cone.L_T + 2.0 * scene.cone.L_c
    far += scene.cone.R_c + run_up
    x, y = target.x - far * c - offset * s, target.y - far * s + offset * c
    chaser = PlanarState(x, y, heading)
    turned = PlanarState(target.x, target.y, math.remainder(heading + angle, math.tau))
    scene = replace(scene, initial=Initial(chaser, turned), rail=None, string=None)
    way = travel_to_touch(scene) - run_up
    if not math.isfinite(way):
        return None
    slowing = rolling_force(scene) / scene.chaser_total_mass
    start = math.sqrt(speed * speed + 2.0 * slowing * run_up)
    chaser = PlanarState(x + way * c, y + way * s, heading, start * c, start * s)
    return replace(scene, initial=Initial(chaser, turned))


def approach_of(scene: Scene) -> tuple[float, float, float]:
    """Return where a scene lies in an envelope: angle (rad), offset (m) and speed (m/s).

    Raises
    ------
    SceneError
        If the straight path passes the cone by.
    """
    chaser, target = scene.initial.chaser, scene.initial.target
    plan = plan_launch(scene)
    if not math.isfinite(plan.contact_time):
        raise SceneError(f"{scene.name}: the chaser never meets the cone")
    c, s = math.cos(chaser.theta), math.sin(chaser.theta)
    offset = c * (chaser.y - target.y) - s * (chaser.x - target.x)
    return math.remainder(target.theta - chaser.theta, math.tau), offset, plan.impact_speed


def other_parts(scene: Scene, other: Scene) -> list[str]:
    """Return the parts in which the benches of two scenes differ.

    Where the vehicles start, what launches them, what is sampled and measured is no matter of
    the bench.
    """
    free = {"name", "title", "initial", "rail", "string", "run", "sensors"}
    return [
        part.name
        for part in fields(Scene)
        if part.name not in free and getattr(scene, part.name) != getattr(other, part.name)
    ]
