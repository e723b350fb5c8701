"""How the chaser comes to the cone, and how far that may be off before a capture is lost.

An approach is an angle, a lateral offset and the speed at the touch.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass, replace

from capture_sim.errors import SceneError
from capture_sim.launch.plan import plan_launch, rolling_force, travel_to_touch
from capture_sim.scene.parts import Initial, PlanarState, Scene
from capture_sim.scene.quantities import Checked, Range, quantity
from capture_sim.studies.outcome import run_to_verdict

#: Multiples of a spread that are tried, in order.
SCALES = (0.25, 0.5, 0.75, 1.0, 1.25, 1.5, 2.0, 3.0, 4.0)


def placed(scene: Scene, angle: float, offset: float, speed: float, run_up: float = 2e-3) -> Scene:
    """Return a scene that starts just before the first touch, approached as asked.

    The chaser keeps its heading, the target its place; the target stands turned by ``angle``
    (rad) against the chaser, whose path passes ``offset`` (m) to the left of the target's
    centre of mass and which meets the cone at ``speed`` (m/s).  Rail and string are taken
    off.  Where the straight path touches no wall, past the cone or through its throat, the scene
    starts with the tip in front of the cone.
    """
    heading, target = scene.initial.chaser.theta, scene.initial.target
    c, s = math.cos(heading), math.sin(heading)
    far = scene.buffer.hinge_offset + scene.rest_length + scene.cone.L_T + 2.0 * scene.cone.L_c
    far += scene.cone.R_c + run_up
    x, y = target.x - far * c - offset * s, target.y - far * s + offset * c
    chaser = PlanarState(x, y, heading)
    turned = PlanarState(target.x, target.y, math.remainder(heading + angle, math.tau))
    scene = replace(scene, initial=Initial(chaser, turned), rail=None, string=None)
    travel = travel_to_touch(scene)
    if not math.isfinite(travel):  # the cone lies within L_T + L_c + R_c of the centre of mass
        travel = far - scene.buffer.hinge_offset - scene.rest_length - scene.cone.L_T
        travel -= scene.cone.L_c + scene.cone.R_c + scene.probe.tip_radius
    way = max(travel - run_up, 0.0)
    slowing = rolling_force(scene) / scene.chaser_total_mass
    start = math.sqrt(speed * speed + 2.0 * slowing * run_up)
    chaser = PlanarState(x + way * c, y + way * s, heading, start * c, start * s)
    return replace(scene, initial=Initial(chaser, turned))


def approach_of(scene: Scene) -> tuple[float, float, float]:
    """Return how a scene's chaser comes to the cone: angle (rad), offset (m), speed (m/s).

    Raises SceneError if the straight path misses the cone.
    """
    chaser, target = scene.initial.chaser, scene.initial.target
    plan = plan_launch(scene)
    if not math.isfinite(plan.contact_time):
        raise SceneError(f"{scene.name}: the chaser never meets the cone")
    c, s = math.cos(chaser.theta), math.sin(chaser.theta)
    offset = c * (chaser.y - target.y) - s * (chaser.x - target.x)
    return math.remainder(target.theta - chaser.theta, math.tau), offset, plan.impact_speed


@dataclass(frozen=True)
class Spread(Checked):
    """How far approaches differ from the nominal one."""

    speed: float = quantity("1", Range(0.0, 0.24), default=0.1, doc="share of the nominal speed")
    offset: float = quantity("m", Range(0.0, 1.0), default=2e-3, doc="lateral offset")
    angle: float = quantity("rad", Range(0.0, 0.3), default=0.02, doc="angle of the target")

    def __post_init__(self) -> None:
        super().__post_init__()
        if not (self.speed or self.offset or self.angle):
            raise SceneError("Spread: speed, offset and angle are 0: must be one above 0")


def corners(spread: Spread) -> list[tuple[float, float, float]]:
    """Return the corners, edges and faces of the box of a spread: angle, offset, speed each.

    Parts that do not differ are left out, so that nothing is run twice.
    """
    sides = [(-v, 0.0, v) if v else (0.0,) for v in (spread.angle, spread.offset, spread.speed)]
    return [(a, o, s) for a, o, s in itertools.product(*sides) if a or o or s]


def captures(scene: Scene, spread: Spread, scale: float) -> bool:
    """Whether every approach on the surface of ``scale`` times the spread ends in a capture."""
    angle, offset, speed = approach_of(scene)
    for d_angle, d_offset, d_speed in corners(spread):
        off = placed(
            scene, angle + scale * d_angle, offset + scale * d_offset, speed * (1 + scale * d_speed)
        )
        outcome = run_to_verdict(off)
        if outcome.failure or not outcome.captured:
            return False
    return True


def margin_of(scene: Scene, spread: Spread) -> float:
    """Return how many times a spread the approach may be off with every capture kept.

    Of the multiples in :data:`SCALES`, the last before the first that loses a capture at a
    corner, edge or face of the box; 0 if the smallest does.
    """
    kept = itertools.takewhile(lambda scale: captures(scene, spread, scale), SCALES)
    return max(kept, default=0.0)
