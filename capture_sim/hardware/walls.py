"""What walls do to the tip: a law of contact in plain Python, for rigs and for the fit."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from typing import NamedTuple

from capture_sim.kernels import plain
from capture_sim.model.geometry import nearest_on_wall
from capture_sim.scene.parts import Scene

_nearest_on_wall = plain(nearest_on_wall)

Wrench = tuple[float, float, float]  # N, N, N m: on the tip, about its centre, target's axes
NOTHING: Wrench = (0.0, 0.0, 0.0)


class TipState(NamedTuple):
    """The tip's centre in the frame target/cone: origin in the middle of BE, x to the target."""

    t: float  # s
    x: float  # m
    y: float  # m
    theta: float  # rad, of the probe
    vx: float  # m/s, against the target
    vy: float
    omega: float  # rad/s


class WallLaw(NamedTuple):
    """F_n = max(0, d^p (k + c d')) + b d' at a penetration d, and friction against the slip.

    Attributes
    ----------
    stiffness
        k, N/m^p.
    exponent
        p: 1 for a spring, 1.5 for Hertz.
    damping
        c, N s/m^(p + 1): Hunt and Crossley's, c = chi of the bench's laws.
    drag
        b, N s/m: a damper beside the spring.
    friction
        mu of mu F_n tanh(slip / slip_speed).
    slip_speed
        m/s.
    """

    stiffness: float
    exponent: float = 1.0
    damping: float = 0.0
    drag: float = 0.0
    friction: float = 0.0
    slip_speed: float = 1e-3


class Touching(NamedTuple):
    """The tip in a wall: penetration and distance (m), rates (m/s), normal in target's axes."""

    penetration: float
    rate: float
    nx: float
    ny: float
    slip: float
    distance: float


class Walls:
    """The cone's two walls."""

    def __init__(self, scene: Scene) -> None:
        self._wall, self._radius = scene.cone.wall, scene.probe.tip_radius

    def touching(self, tip: TipState) -> list[Touching]:
        """Return the walls that the tip is in."""
        found = []
        for side in (1.0, -1.0):
            distance, n_u, n_Y = _nearest_on_wall(-tip.x, side * tip.y, *self._wall)
            if distance < self._radius:
                nx, ny = -n_u, side * n_Y
                rate = -(nx * tip.vx + ny * tip.vy)
                slip = tip.vy * nx - tip.vx * ny - distance * tip.omega
                found.append(Touching(self._radius - distance, rate, nx, ny, slip, distance))
        return found

    def wrench(self, law: WallLaw, tip: TipState) -> Wrench:
        """Return what walls of this law do to the tip."""
        fx = fy = torque = 0.0
        for wall in self.touching(tip):
            force = wall.penetration**law.exponent * (law.stiffness + law.damping * wall.rate)
            force = max(force, 0.0) + law.drag * wall.rate
            rub = -law.friction * force * math.tanh(wall.slip / law.slip_speed)
            fx += force * wall.nx - rub * wall.ny
            fy += force * wall.ny + rub * wall.nx
            torque -= wall.distance * rub
        return fx, fy, torque


def contact_rig(scene: Scene, law: WallLaw) -> Callable[[TipState], Wrench]:
    """Return a contact in place of hardware: what a scene's walls, of a law, do to the tip."""
    return partial(Walls(scene).wrench, law)
