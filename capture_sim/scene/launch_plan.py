"""The plan of a launch: the mass on the string and its height, for a wanted impact speed.

The string pulls the chaser with the acceleration a until the mass has sunk by its drop height H.
Then the chaser coasts, with the deceleration a_c, to the first touch, at the distance D from its
release.  :mod:`capture_sim.scene.launch_motion` has both motions.  Energy gives

    v_impact^2 = 2 a H - 2 a_c (D - H)

which is solved for the drop height H or, through a, for the mass.  A chaser with drag needs more of
both, found by Brent's method.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from typing import NamedTuple

from capture_sim.base.compiled.kernels import plain
from capture_sim.errors import SceneError
from capture_sim.scene.cache import depends_on
from capture_sim.scene.geometry import tip_motion, travel_to_wall
from capture_sim.scene.launch_motion import (
    coasting_acceleration,
    pulled_acceleration,
    speed_after,
    time_after,
)
from capture_sim.scene.parts import Scene

_pulled, _coasting = plain(pulled_acceleration), plain(coasting_acceleration)
_speed_after, _time_after = plain(speed_after), plain(time_after)

#: A mass on the string is lighter, kg.
_HEAVIEST = 1e9


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


#: Fields that the resistance to the chaser's straight motion depends on.
RESISTANCE = ("chaser", "cylinder", "probe", "floor", "supports", "gravity")


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


def pull_along(scene: Scene) -> float:
    """Return the force of a tilted floor and of a cable on the chaser along its heading, N."""
    heading, (x, y), mass = scene.initial.chaser.theta, scene.pull, scene.chaser_total_mass
    x, y = mass * x + scene.chaser.cable_x, mass * y + scene.chaser.cable_y
    return x * math.cos(heading) + y * math.sin(heading)


def resistance(scene: Scene) -> float:
    """Return the resistance to the chaser's straight motion along its heading, N.

    It is its rolling resistance, less the pull of a cable and of a floor that descends ahead.
    """
    force = -pull_along(scene)
    if scene.supports is not None:
        force += scene.supports.chaser.c_rr * scene.chaser_total_mass * scene.gravity
    return force


def coasting(scene: Scene) -> tuple[float, float]:
    """Return acceleration (m/s^2) and damping (1/s) of a chaser that coasts."""
    mass = scene.chaser_total_mass
    return _coasting(resistance(scene), mass), scene.chaser.drag / mass


def _sink(scene: Scene, hanging_mass: float) -> tuple[float, float]:
    """Return acceleration (m/s^2) and damping (1/s) of a chaser that a mass (kg) pulls."""
    assert scene.string is not None
    pulley, mass = scene.string.pulley_mass, scene.chaser_total_mass
    acceleration = _pulled(hanging_mass, scene.gravity, resistance(scene), mass, pulley)
    return acceleration, scene.chaser.drag / (mass + hanging_mass + pulley)


def expected_speed(scene: Scene, plan: LaunchPlan, travel: float) -> float:
    """Return the speed (m/s) that the chaser should have after a travel (m) from the release.

    It is that before the first touch.  It is computed from the travel, not from the time since the
    release, which a real bench does not know exactly.
    """
    if plan.hanging_mass > 0.0 and travel < plan.drop_height:
        return _speed_after(0.0, *_sink(scene, plan.hanging_mass), max(travel, 0.0))
    return _speed_after(plan.landing_speed, *coasting(scene), travel - plan.drop_height)


def expected_time(scene: Scene, plan: LaunchPlan, travel: float) -> float:
    """Return the time (s after the release) at which the chaser has moved by ``travel`` (m).

    It is that before the first touch.  The result is ``inf`` if the chaser does not come so far.
    """
    if plan.landing_speed == 0.0:
        return math.inf
    if plan.hanging_mass > 0.0 and travel < plan.drop_height:
        return _time_after(0.0, *_sink(scene, plan.hanging_mass), max(travel, 0.0))
    coasted = _time_after(plan.landing_speed, *coasting(scene), travel - plan.drop_height)
    return plan.landing_time + coasted


def _launched(scene: Scene, mass: float, height: float, travel: float) -> LaunchPlan:
    """Return the launch by a hanging mass (kg) from a height (m); 0 and 0 without a string."""
    if scene.string is None:
        landing, landing_time = math.hypot(scene.initial.chaser.vx, scene.initial.chaser.vy), 0.0
    else:
        sink = _sink(scene, mass)
        landing, landing_time = (f(0.0, *sink, height) for f in (_speed_after, _time_after))
    impact, contact = 0.0, math.inf
    if landing > 0.0 and math.isfinite(travel):
        impact, coasted = (
            f(landing, *coasting(scene), travel - height) for f in (_speed_after, _time_after)
        )
        contact = landing_time + coasted
    return LaunchPlan(mass, height, impact, landing, landing_time, contact, travel)


def _solved(impact: Callable[[float], float], speed: float, low: float, high: float) -> float:
    """Return the argument between two others that gives an impact speed (m/s), which rises."""
    from scipy.optimize import brentq  # slow to load, and hardly ever needed

    if impact(low) >= speed:  # a drag that changes the last digits
        return low
    return float(brentq(lambda x: impact(x) - speed, low, high, xtol=1e-15, rtol=1e-15))


def plan_launch(scene: Scene) -> LaunchPlan:
    """Compute the plan of a scene's launch, in closed form if the chaser has no drag.

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
    travel = travel_to_touch(scene)
    if scene.string is None:
        return _launched(scene, 0.0, 0.0, travel)
    string, g = scene.string, scene.gravity
    m = scene.chaser_total_mass
    friction = resistance(scene)
    if not math.isfinite(travel):
        raise SceneError(
            f"string.impact_speed: the chaser's straight path {_miss(scene)}, so no speed of the "
            "launch gives an impact"
        )
    assert scene.rail is not None
    coast, longest, is_damped = -coasting(scene)[0], scene.rail.length, scene.chaser.drag > 0.0
    v, mass, height = string.impact_speed, string.hanging_mass, string.drop_height

    def impact_of(mass: float, height: float) -> float:
        return _launched(scene, mass, height, travel).impact_speed

    if mass is not None and _sink(scene, mass)[0] <= 0.0:
        raise SceneError(
            f"string.hanging_mass = {mass!r} kg: must be > {friction / g:.6g}, "
            "the mass that overcomes rolling resistance, the floor's tilt and the cable"
        )
    if height is None:
        assert v is not None
        assert mass is not None
        height = (v * v + 2.0 * coast * travel) / (2.0 * (_sink(scene, mass)[0] + coast))
        if is_damped and height <= longest:
            fastest = impact_of(mass, longest)
            if fastest < v:
                raise SceneError(
                    f"string.impact_speed = {v!r} m/s: must be <= {fastest:.6g}, what this mass "
                    "gives if it lands where the rail ends"
                )
            height = _solved(partial(impact_of, mass), v, height, longest)
    if height > longest:
        raise SceneError(
            f"string.drop_height = {height!r} m: must be <= {longest:g}, "
            "rail.length: the mass must land before the rail ends"
        )
    if mass is None:
        assert v is not None
        # height is at most the travel, so a > 0 whenever v > 0
        a = (v * v + 2.0 * coast * (travel - height)) / (2.0 * height)
        mass = (a * (m + string.pulley_mass) + friction) / (g - a) if a < g else math.inf
        heaviest = mass
        while is_damped and heaviest < _HEAVIEST and impact_of(heaviest, height) < v:
            heaviest *= 2.0
        if heaviest >= _HEAVIEST:
            raise SceneError(
                f"string.drop_height = {height!r} m: must be > "
                f"{(v * v + 2.0 * coast * travel) / (2.0 * (g + coast)):.6g}, "
                f"the least that gives {v!r} m/s in free fall"
            )
        if is_damped:
            mass = _solved(lambda mass: impact_of(mass, height), v, mass, heaviest)
    return _launched(scene, mass, height, travel)
