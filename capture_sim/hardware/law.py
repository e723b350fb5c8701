"""The contact law of the walls outside the bench: for the loop, the simulated rig and the fit."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from capture_sim.base.compiled.kernels import entry_kernel, plain, records
from capture_sim.dynamics.model.contact import (
    friction_coefficient,
    normal_force,
    power_law,
)
from capture_sim.scene.geometry import nearest_on_wall
from capture_sim.scene.laws import FrictionLaw, returned_restitution
from capture_sim.scene.parts import Scene
from capture_sim.scene.quantities import Range, quantity

_nearest_on_wall = plain(nearest_on_wall)
_normal_force, _friction_coefficient = plain(normal_force), plain(friction_coefficient)


@entry_kernel
def _wall_forces(
    depth: np.ndarray, rate: np.ndarray, damping: float, laws: np.ndarray, force: np.ndarray
) -> None:
    """Write the normal force at each penetration (m) and rate (m/s) into ``force``, N."""
    for i in range(depth.size):
        force[i], _ = normal_force(depth[i], rate[i], damping, laws[0])


@entry_kernel
def _friction_shares(slip: np.ndarray, shares: np.ndarray) -> None:
    """Write the regularised friction coefficient for mu = 1 at each slip / slip_speed."""
    for i in range(slip.size):
        shares[i] = friction_coefficient(slip[i], 1.0, 0.0, FrictionLaw.TANH)


class Wrench(NamedTuple):
    """Wrench on the tip, about its centre, in the axes of target/cone.

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
    """Pose and velocity of the tip's centre in the frame target/cone.

    The origin is in the middle of BE, the inner edge of the cone; x points to the target.
    """

    t: float  # s
    x: float  # m
    y: float  # m
    theta: float  # rad, of the probe
    vx: float  # m/s, relative to the target
    vy: float
    omega: float  # rad/s


@dataclass(frozen=True)
class WallLaw:
    """Contact law: F_n = max(0, d^p (k + c d')) at penetration d, and friction against the slip."""

    stiffness: float = quantity(
        "N/m^p",
        Range(0.0, 1e12),
        doc="stiffness k of the walls; 0: of the scene where assumed",
    )
    exponent: float = quantity(
        "1", Range(1.0, 3.0), default=1.0, doc="exponent p of the penetration: 1 spring, 1.5 Hertz"
    )
    damping: float = quantity(  # Hunt and Crossley's, c = chi of the bench's laws
        "N s/m^(p + 1)", Range(0.0, 1e12), default=0.0, doc="damping c of the walls"
    )
    offset: float = quantity(
        "m",
        Range(-0.1, 0.1),
        default=0.0,
        doc="offset of the walls towards the tip from where the scene has them",
    )
    friction: float = quantity(
        "1", Range(0.0, 10.0), default=0.0, doc="mu of mu F_n tanh(slip / slip_speed)"
    )
    slip_speed: float = 1e-3  # m/s

    def duration(self, mass: float, speed: float) -> float:
        """Return the duration (s) of an elastic touch of a mass (kg) at an approach speed (m/s)."""
        return self._duration_factor * self._peak_depth(mass, speed) / speed

    def lasting(self, mass: float, speed: float, duration: float) -> WallLaw:
        """Return the elastic law with this exponent whose touch has a given duration (s).

        ``mass`` in kg, approach ``speed`` in m/s.
        """
        n, depth = self.exponent + 1.0, duration * speed / self._duration_factor
        stiffness = 0.5 * n * mass * speed**2 / depth**n
        return replace(self, stiffness=stiffness, damping=0.0)

    @property
    def elastic(self) -> np.ndarray:
        """The elastic force as a (1,) record for the kernels."""
        return power_law(self.stiffness, self.exponent)

    @property
    def _duration_factor(self) -> float:
        n = self.exponent + 1.0  # pi for a spring
        return 2.0 / n * math.gamma(1.0 / n) * math.gamma(0.5) / math.gamma(1.0 / n + 0.5)

    def peak_force(self, mass: float, speed: float) -> float:
        """Return the peak force (N) of an elastic touch of a mass (kg) at a speed (m/s)."""
        return float(self.stiffness * self._peak_depth(mass, speed) ** self.exponent)

    def _peak_depth(self, mass: float, speed: float) -> float:
        n = self.exponent + 1.0
        return float((0.5 * n * mass * speed**2 / self.stiffness) ** (1.0 / n))

    def normal_forces(self, depth: np.ndarray, rate: np.ndarray) -> np.ndarray:
        """Return the normal force (n,), N, at depths (m) in the scene's wall and rates (m/s)."""
        force = np.empty(len(depth))
        _wall_forces(depth + self.offset, rate, self.damping, records(self.elastic), force)
        return force

    def friction_shares(self, slip: np.ndarray) -> np.ndarray:
        """Return friction (n,) as a share of mu F_n, with the sign of the slip (m/s)."""
        shares = np.empty(len(slip))
        _friction_shares(slip / self.slip_speed, shares)
        return shares

    def restitution(self, speed: float) -> float:
        """Return the restitution of a touch at this approach speed (m/s), in closed form."""
        if self.stiffness <= 0.0 or self.damping <= 0.0:
            return 1.0
        return returned_restitution(self.damping * speed / self.stiffness)


#: A wall without stiffness: its force comes from the rig.
NO_LAW = WallLaw(0.0)


class Penetration(NamedTuple):
    """Depth and distance (m) of the tip in a wall, rates (m/s), normal in the target's axes."""

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
        """Return the penetration of the tip in each wall, at the scene's position of the walls."""
        return self._penetration(tip, 1.0), self._penetration(tip, -1.0)

    def deepest(self, tip: TipState) -> Penetration:
        """Return the penetration in the wall that the tip is deepest in, or closest to."""
        return max(self.penetrations(tip))

    def _penetration(self, tip: TipState, side: float) -> Penetration:
        distance, n_u, n_Y = _nearest_on_wall(-tip.x, side * tip.y, *self._wall)
        nx, ny = -n_u, side * n_Y
        rate = -(nx * tip.vx + ny * tip.vy)
        slip = tip.vy * nx - tip.vx * ny - distance * tip.omega
        return Penetration(self._radius - distance, rate, nx, ny, slip, distance)

    def wrench(self, law: WallLaw, tip: TipState) -> Wrench:
        """Return the wrench of walls with this law on the tip."""
        fx = fy = torque = 0.0
        for side in (1.0, -1.0):
            distance = _nearest_on_wall(-tip.x, side * tip.y, *self._wall)[0]
            if self._radius - distance + law.offset <= 0.0:  # outside: the usual case
                continue
            wall = self._penetration(tip, side)
            depth = wall.depth + law.offset
            elastic = law.elastic.view(np.recarray)[0]
            force, _ = _normal_force(depth, wall.rate, law.damping, elastic)
            if force > 0.0:
                slip = wall.slip / law.slip_speed
                friction = -force * _friction_coefficient(slip, law.friction, 0.0, FrictionLaw.TANH)
                fx += force * wall.nx - friction * wall.ny
                fy += force * wall.ny + friction * wall.nx
                torque -= wall.distance * friction
        return Wrench(fx, fy, tz=torque)
