"""The plan of a launch: the mass on the string and its height, for a wanted impact speed.

The string pulls the chaser with the acceleration a until the mass has sunk by its drop height H.
Then the chaser coasts, with the deceleration a_c, to the first touch, at the distance D from its
release.  :mod:`capture_sim.scene.launch_motion` has both accelerations.  Energy gives

    v_impact^2 = 2 a H - 2 a_c (D - H)

which is solved for the drop height H or, through a, for the mass.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from capture_sim.base.compiled.kernels import plain
from capture_sim.errors import SceneError
from capture_sim.scene.cache import depends_on
from capture_sim.scene.geometry import tip_motion, travel_to_wall
from capture_sim.scene.launch_motion import (
    coasting_acceleration,
    pulled_acceleration,
    speed_after,
    time_between,
)
from capture_sim.scene.parts import Scene

_pulled, _coasting = plain(pulled_acceleration), plain(coasting_acceleration)
_speed_after, _time_between = plain(speed_after), plain(time_between)


class LaunchPlan(NamedTuple):
    """Plan of a launch: mass and height on the string, and the motion that they give; SI units.

    In a scene without string, the chaser coasts from its release with its initial speed: the mass
    lands at the time 0, and ``landing_speed`` is the initial speed.  ``impact_speed`` is 0 if no
    touch is expected, e.g. because the chaser stops before.
    """

    # hanging_mass, drop_height: kg and m; zero in a scene without string
    hanging_mass: float
    drop_height: float
    impact_speed: float  # expected speed of the chaser at the first touch, m/s
    # landing_speed, landing_time: when the mass lands, m/s and s after the release
    landing_speed: float
    landing_time: float
    contact_time: float  # expected first touch, s after the release; ``inf`` if there is none
    travel: float  # of the chaser from the release to the first touch, m; ``inf`` if there is none

    @property
    def text(self) -> str:
        """The launch in words, e.g. ``0.02 kg at 0.5 m for 0.1 m/s``."""
        how = "no string"
        if self.hanging_mass > 0.0:
            how = f"{self.hanging_mass:.6g} kg at {self.drop_height:.6g} m"
        return f"{how} for {self.impact_speed:.6g} m/s"


#: Fields that the tip's place at the release depends on.
TIP_AT_RELEASE = (
    *("initial.chaser.x", "initial.chaser.y", "initial.chaser.theta", "initial.target"),
    *("buffer.hinge_offset", "buffer.rest_length", "probe"),
)


@depends_on(*TIP_AT_RELEASE)
def tip_at_release(scene: Scene) -> tuple[float, float, float, float]:
    """Return the tip's position (x, y), m, at the release, and the chaser's unit direction (x, y).

    Both are in the target's frame; the direction is that of the chaser's heading.
    """
    chaser, target = scene.initial.chaser, scene.initial.target
    s, c = math.sin(chaser.theta), math.cos(chaser.theta)
    # straight, the buffer is part of the chaser: of length 0 at the tip
    arm, pose = scene.buffer.hinge_offset + scene.rest_length, (chaser.x, chaser.y)
    q = (*pose, chaser.theta, chaser.theta, 0.0, target.x, target.y, target.theta)
    unit_rates = (c, s, *6 * (0.0,))
    sine_cosine = (s, c, s, c, math.sin(target.theta), math.cos(target.theta))
    return plain(tip_motion)((*q, *unit_rates), arm, *sine_cosine)


@depends_on(*TIP_AT_RELEASE, "cone")
def travel_to_touch(scene: Scene) -> float:
    """Return how far the chaser moves from the release to the first touch, m.

    The result is ``inf`` if the tip touches no wall.  The chaser is assumed to move straight along
    its heading, with the buffer at rest, to a target at rest.
    """
    px, py, ux, uy = tip_at_release(scene)
    cone = scene.cone
    return min(
        travel_to_wall(
            -(px + cone.L_T),
            side * py,
            -ux,
            side * uy,
            scene.probe.tip_radius,
            cone.R_c,
            cone.L_c,
            cone.half_angle,
        )
        for side in (1.0, -1.0)
    )


def _miss(scene: Scene) -> str:
    """Return how a straight path that touches no wall passes the cone."""
    px, py, ux, uy = tip_at_release(scene)
    if ux > 0.0 and abs(py - uy / ux * (px + scene.cone.L_T)) < scene.cone.R_c:
        return "goes through BE without touching the cone"
    return "misses the cone"


def resistance(scene: Scene) -> float:
    """Return the resistance to the chaser's straight motion along its heading, N.

    It is its rolling resistance, less the pull of a floor that descends ahead of it.
    """
    heading, (x, y) = scene.initial.chaser.theta, scene.pull
    force = -scene.chaser_total_mass * (x * math.cos(heading) + y * math.sin(heading))
    if scene.supports is not None:
        force += scene.supports.chaser.c_rr * scene.chaser_total_mass * scene.gravity
    return force


def expected_speed(scene: Scene, plan: LaunchPlan, travel: float) -> float:
    """Return the speed (m/s) that the chaser should have after a travel (m) from the release.

    It is that before the first touch.  It is computed from the energy, not from the time since the
    release, which a real bench does not know exactly.
    """
    landing, height = plan.landing_speed, plan.drop_height
    if height > 0.0 and travel < height:
        return landing * math.sqrt(max(travel, 0.0) / height)
    coasting = _coasting(resistance(scene), scene.chaser_total_mass)
    return _speed_after(landing, coasting, travel - height)


def expected_time(scene: Scene, plan: LaunchPlan, travel: float) -> float:
    """Return the time (s after the release) at which the chaser has moved by ``travel`` (m).

    It is that before the first touch.  The result is ``inf`` if the chaser does not come so far.
    """
    landing, height = plan.landing_speed, plan.drop_height
    if landing == 0.0:
        return math.inf
    if height > 0.0 and travel < height:
        return plan.landing_time * math.sqrt(max(travel, 0.0) / height)
    speed = expected_speed(scene, plan, travel)
    if speed == 0.0:
        return math.inf
    return plan.landing_time + _time_between(landing, speed, travel - height)


def _unlaunched(scene: Scene) -> LaunchPlan:
    """Return the plan of a scene without string, whose chaser has its speed at the release."""
    i = scene.initial.chaser
    speed = math.hypot(i.vx, i.vy)
    travel = travel_to_touch(scene)
    impact, contact = 0.0, math.inf
    if speed > 0.0 and math.isfinite(travel):
        coasting = _coasting(resistance(scene), scene.chaser_total_mass)
        impact = _speed_after(speed, coasting, travel)
    if impact > 0.0:
        contact = _time_between(speed, impact, travel)
    return LaunchPlan(0.0, 0.0, impact, speed, 0.0, contact, travel)


def plan_launch(scene: Scene) -> LaunchPlan:
    """Compute the plan of a scene's launch, in closed form.

    The scene gives two of ``string.impact_speed``, ``string.hanging_mass`` and
    ``string.drop_height``; the third is computed from them.  A scene without string has only an
    expected touch.  :func:`capture_sim.scene.loading.check_scene` checks what this function
    assumes: two values are given, and a scene with a string has a rail.

    Raises
    ------
    SceneError
        In a scene with a string, the chaser's path misses the cone, the mass cannot overcome the
        rolling resistance or would not land on the rail, or no mass gives the wanted speed from
        this height; the message names the limit.
    """
    if scene.string is None:
        return _unlaunched(scene)
    string, g = scene.string, scene.gravity
    m = scene.chaser_total_mass
    friction = resistance(scene)
    pulley = string.pulley_inertia / string.pulley_radius**2
    travel = travel_to_touch(scene)
    if not math.isfinite(travel):
        raise SceneError(
            f"string.impact_speed: the chaser's straight path {_miss(scene)}, so no speed of the "
            "launch gives an impact"
        )
    coast = -_coasting(friction, m)
    v, mass, height = string.impact_speed, string.hanging_mass, string.drop_height

    def acceleration(mass: float) -> float:
        return _pulled(mass, g, friction, m, pulley)

    if mass is not None and acceleration(mass) <= 0.0:
        raise SceneError(
            f"string.hanging_mass = {mass!r} kg: must be > {friction / g:.6g}, "
            "the mass that overcomes rolling resistance and the floor's tilt"
        )
    if height is None:
        assert v is not None
        assert mass is not None
        height = (v * v + 2.0 * coast * travel) / (2.0 * (acceleration(mass) + coast))
    assert scene.rail is not None
    if height > scene.rail.length:
        raise SceneError(
            f"string.drop_height = {height!r} m: must be <= {scene.rail.length:g}, "
            "rail.length: the mass must land before the rail ends"
        )
    if mass is None:
        assert v is not None
        # height is at most the travel, so a > 0 whenever v > 0
        a = (v * v + 2.0 * coast * (travel - height)) / (2.0 * height)
        if a >= g:
            raise SceneError(
                f"string.drop_height = {height!r} m: must be > "
                f"{(v * v + 2.0 * coast * travel) / (2.0 * (g + coast)):.6g}, "
                f"the least that gives {v!r} m/s in free fall"
            )
        mass = (a * (m + pulley) + friction) / (g - a)
    a = acceleration(mass)
    landing = _speed_after(0.0, a, height)
    impact = _speed_after(landing, -coast, travel - height)
    landing_time = _time_between(0.0, landing, height)
    contact = math.inf
    if impact > 0.0:
        contact = landing_time + _time_between(landing, impact, travel - height)
    return LaunchPlan(mass, height, impact, landing, landing_time, contact, travel)
