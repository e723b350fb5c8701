"""What walls do to the tip: a law of contact in plain Python, for rigs and for the fit."""

from __future__ import annotations

import math
from typing import NamedTuple

from capture_sim.kernels import plain
from capture_sim.model.contact import returned_restitution
from capture_sim.model.geometry import nearest_on_wall
from capture_sim.scene.parts import Scene

_nearest_on_wall = plain(nearest_on_wall)


class Wrench(NamedTuple):
    """On the tip, about its centre, in the axes of target/cone.

    The vehicles move in the plane: only ``fx``, ``fy`` and ``tz`` do work on them.
    """

    fx: float = 0.0  # N
    fy: float = 0.0
    fz: float = 0.0
    tx: float = 0.0  # N m
    ty: float = 0.0
    tz: float = 0.0

    @property
    def force(self) -> float:
        """Magnitude of the force, N."""
        return math.hypot(*self[:3])

    @property
    def torque(self) -> float:
        """Magnitude of the torque, N m."""
        return math.hypot(*self[3:])


NO_WRENCH = Wrench()


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
    """F_n = max(0, d^p (k + c d')) at a penetration d, and friction against the slip."""

    stiffness: float  # k, N/m^p; 0 for no wall
    exponent: float = 1.0  # p: 1 for a spring, 1.5 for Hertz
    damping: float = 0.0  # c, N s/m^(p + 1): Hunt and Crossley's, c = chi of the bench's laws
    offset: float = 0.0  # m, of the walls towards the tip from where the scene has them
    friction: float = 0.0  # mu of mu F_n tanh(slip / slip_speed)
    slip_speed: float = 1e-3  # m/s

    def restitution(self, speed: float) -> float:
        """Return the restitution of a touch at this approach speed (m/s), in closed form."""
        if self.stiffness <= 0.0 or self.damping <= 0.0:
            return 1.0
        return returned_restitution(self.damping * speed / self.stiffness)

    def within(self, max_force: float) -> WallLaw:
        """Return the law with the same restitution, no stiffer than this at a depth of 1 m (N)."""
        share = min(1.0, max_force / self.stiffness)
        return self._replace(stiffness=share * self.stiffness, damping=share * self.damping)


NO_LAW = WallLaw(0.0)


def duration_factor(exponent: float) -> float:
    """Return C of the elastic touch that lasts C max_depth / speed: pi for a spring."""
    n = exponent + 1.0
    return 2.0 / n * math.gamma(1.0 / n) * math.gamma(0.5) / math.gamma(1.0 / n + 0.5)


def max_stiffness(exponent: float, mass: float, speed: float, duration: float) -> float:
    """Return the stiffness (N/m^p) whose elastic touch of a mass (kg) lasts so long, s."""
    depth = duration * speed / duration_factor(exponent)
    return 0.5 * (exponent + 1.0) * mass * speed**2 / depth ** (exponent + 1.0)


class Penetration(NamedTuple):
    """The tip in a wall: penetration and distance (m), rates (m/s), normal in target's axes."""

    depth: float  # below 0 outside
    rate: float
    nx: float
    ny: float
    slip: float
    distance: float


class Walls:
    """The cone's two walls."""

    def __init__(self, scene: Scene) -> None:
        self._wall, self._radius = scene.cone.wall, scene.probe.tip_radius

    def penetrations(self, tip: TipState) -> tuple[Penetration, Penetration]:
        """Return how far the tip is in each wall, where the scene has them."""
        return self._penetration(tip, 1.0), self._penetration(tip, -1.0)

    def deepest(self, tip: TipState) -> Penetration:
        """Return the penetration of the wall that the tip is deepest in, or nearest to."""
        return max(self.penetrations(tip))

    def _penetration(self, tip: TipState, side: float) -> Penetration:
        distance, n_u, n_Y = _nearest_on_wall(-tip.x, side * tip.y, *self._wall)
        nx, ny = -n_u, side * n_Y
        rate = -(nx * tip.vx + ny * tip.vy)
        slip = tip.vy * nx - tip.vx * ny - distance * tip.omega
        return Penetration(self._radius - distance, rate, nx, ny, slip, distance)

    def wrench(self, law: WallLaw, tip: TipState) -> Wrench:
        """Return what walls of this law do to the tip."""
        fx = fy = torque = 0.0
        for wall in self.penetrations(tip):
            depth = wall.depth + law.offset
            if depth > 0.0:
                force = depth**law.exponent * (law.stiffness + law.damping * wall.rate)
                force = max(force, 0.0)
                friction = -law.friction * force * math.tanh(wall.slip / law.slip_speed)
                fx += force * wall.nx - friction * wall.ny
                fy += force * wall.ny + friction * wall.nx
                torque -= wall.distance * friction
        return Wrench(fx, fy, tz=torque)
