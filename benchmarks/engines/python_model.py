"""The bench's equations in plain Python numbers, as one tunes them where NumPy is too slow.

Written for the benchmark, from the paper's eq. (1) to (9) and body by body; it shares no code
with :mod:`capture_sim.model`.  On vectors of two, Python's own numbers are two to three
times as fast as :mod:`benchmarks.engines.numpy_model`.  The same text runs with
``numpy.longdouble``, which is how the references in ``benchmarks/references`` are made.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from capture_sim.scene.parts import Scene

#: Friction laws known here; "clamp" is what Exudyn offers.
FRICTION_LAWS = ("tanh", "clamp", "none")


class Contact(NamedTuple):
    """The tip against one wall."""

    gap: Any  # m; negative is penetration
    rate: Any  # of the gap, m/s
    slip: Any  # of the tip along the wall's tangent (normal turned by +90 degrees), m/s
    normal: tuple[Any, Any]  # unit vector from the wall to the tip, world
    point: tuple[Any, Any]  # of contact, world, m


class PythonModel:
    """Two vehicles, buffer, cone and contact; no supports, rail, string, latch or stops.

    Parameters
    ----------
    scene
        With the Lankarani-Nikravesh law.
    real
        ``float``, or ``numpy.longdouble`` for references.
    friction
        One of :data:`FRICTION_LAWS`.

    Attributes
    ----------
    touching : list of bool (2,)
        Whether the walls on +y and -y push; set by whoever integrates.
    chi : list of real (2,)
        Hysteresis damping of the present touches, N s/m^2.5; set by whoever integrates.
    """

    def __init__(
        self, scene: Scene, real: Callable[[Any], Any] = float, friction: str = "tanh"
    ) -> None:
        if scene.contact.law != "lankarani_nikravesh" or friction not in FRICTION_LAWS:
            raise ValueError("this model knows one contact law and three of friction")
        self.real = real
        self.friction = friction
        # math is faster than NumPy on single numbers, but has no extended precision
        library: Any = math if real is float else np
        self.sin, self.cos = library.sin, library.cos
        self.sqrt, self.tanh = library.sqrt, library.tanh
        self.dtype: Any = np.float64 if real is float else np.longdouble
        self._set_bodies(scene)
        self._set_contact(scene)
        self.touching = [False, False]
        self.chi = [real(0.0), real(0.0)]

    def _set_bodies(self, scene: Scene) -> None:
        real = self.real
        pi = 4 * np.arctan(np.longdouble(1))  # rounded to double where real is float
        p = scene.probe
        density, r_p, L_p, R_t = map(real, (p.density, p.radius, p.length, p.tip_radius))
        rod = density * real(pi) * r_p**2 * L_p
        ball = density * 4 / real(3) * real(pi) * R_t**3
        self.m_P = rod + ball
        self.d = rod * (R_t + L_p / 2) / self.m_P
        I_P = rod * (L_p**2 / 12 + r_p**2 / 4 + (R_t + L_p / 2 - self.d) ** 2)
        I_P += ball * (R_t**2 * 2 / 5 + self.d**2)
        self.m_S, I_S = real(scene.chaser.mass), real(scene.chaser.inertia)
        self.m_T, self.I_T = real(scene.target.mass), real(scene.target.inertia)
        self.m_C, self.L_C = real(scene.cylinder.mass), real(scene.cylinder.length)
        I_C = self.m_C * self.L_C**2 / 12
        self.M_0 = np.diag(np.array([self.m_S, self.m_S, I_S, I_C + I_P, 0], self.dtype))
        b = scene.buffer
        self.a, self.k_A, self.c_A, self.k_T, self.c_T = map(
            real, (b.hinge_offset, b.k_A, b.c_A, b.k_T, b.c_T)
        )
        self.h_0 = L_p + R_t if b.rest_length is None else real(b.rest_length)
        self.R_t = R_t

    def _set_contact(self, scene: Scene) -> None:
        real, cone = self.real, scene.cone
        L_T, R_c, L_c, beta = map(real, (cone.L_T, cone.R_c, cone.L_c, cone.half_angle))
        self.L_c = L_c
        # walls in the target's frame: inner end, and direction out to the lip
        self.walls = [
            (-L_T, side * R_c, -self.cos(beta), side * self.sin(beta)) for side in (1, -1)
        ]
        sigma = 0
        for material in (scene.contact.tip, scene.contact.wall):
            sigma = sigma + (1 - real(material.nu) ** 2) / real(material.E)
        self.K = 4 * self.sqrt(self.R_t) / (3 * sigma)
        self.damping = real(3) / 4 * (1 - real(scene.contact.restitution) ** 2)
        self.v_0_floor = real(scene.contact.min_approach_speed)
        self.mu, self.v_eps = (
            real(scene.friction.mu),
            real(scene.friction.slip_regularization_speed),
        )

    def latch(self, wall: int, approach: Any) -> None:
        """Begin a touch of a wall (0: +y, 1: -y) at an approach speed, m/s."""
        self.touching[wall] = True
        self.chi[wall] = self.damping * self.K / max(approach, self.v_0_floor)

    def release(self, wall: int) -> None:
        """End a touch."""
        self.touching[wall] = False

    def contact(self, y: Sequence[Any], wall: int) -> Contact:
        """Return how the tip stands to a wall (0: +y, 1: -y) in the state ``y``."""
        x_S, y_S, th_S, th_P, h, x_T, y_T, th_T = y[:8]
        vx_S, vy_S, om_S, om_P, dh, vx_T, vy_T, om_T = y[8:16]
        cS, sS, cP, sP = self.cos(th_S), self.sin(th_S), self.cos(th_P), self.sin(th_P)
        cT, sT = self.cos(th_T), self.sin(th_T)
        # the tip's centre and its velocity
        rx, ry = x_S + self.a * cS + h * cP, y_S + self.a * sS + h * sP
        vx = vx_S - self.a * om_S * sS + dh * cP - h * om_P * sP
        vy = vy_S + self.a * om_S * cS + dh * sP + h * om_P * cP
        # nearest point of the wall, sought in the target's frame
        px, py = cT * (rx - x_T) + sT * (ry - y_T), cT * (ry - y_T) - sT * (rx - x_T)
        ex, ey, ax, ay = self.walls[wall]
        along = min(max((px - ex) * ax + (py - ey) * ay, 0), self.L_c)
        qx, qy = ex + along * ax, ey + along * ay
        distance = self.sqrt((px - qx) ** 2 + (py - qy) ** 2)
        ux, uy = (px - qx) / distance, (py - qy) / distance
        nx, ny = cT * ux - sT * uy, sT * ux + cT * uy
        ox, oy = cT * qx - sT * qy, sT * qx + cT * qy  # from the target's centre
        # material of the tip against material of the wall, at the point of contact
        wx = vx + om_P * distance * ny - (vx_T - om_T * oy)
        wy = vy - om_P * distance * nx - (vy_T + om_T * ox)
        return Contact(
            gap=distance - self.R_t,
            rate=wx * nx + wy * ny,
            slip=wy * nx - wx * ny,
            normal=(nx, ny),
            point=(x_T + ox, y_T + oy),
        )

    def normal_force(self, contact: Contact, wall: int) -> Any:
        """Return F_n of eq. (1), N; it never pulls."""
        if contact.gap >= 0:
            return self.real(0.0)
        penetration = -contact.gap
        force = penetration * self.sqrt(penetration) * (self.K - self.chi[wall] * contact.rate)
        return max(force, self.real(0.0))

    def friction_coefficient(self, slip: Any) -> Any:
        """Return friction per normal force, with the sign of the slip (m/s)."""
        if self.friction == "tanh":
            return self.mu * self.tanh(slip / self.v_eps)
        if self.friction == "clamp":
            return self.mu * min(max(slip / self.v_eps, -1), 1)
        return self.real(0.0)

    def rate_of_change(self, y: np.ndarray) -> np.ndarray:
        """Return dy/dt; ``y`` is q (8,), v (8,) and, if it has them, both impulses (2,)."""
        values = y.tolist() if self.real is float else list(y)
        x_T, y_T = values[5], values[6]
        th_S, th_P, h = values[2], values[3], values[4]
        om_S, om_P, dh = values[10], values[11], values[12]
        cS, sS, cP, sP = self.cos(th_S), self.sin(th_S), self.cos(th_P), self.sin(th_P)
        a, half, r = self.a, self.L_C / 2, h - self.d

        # Jacobians of the centres of mass of cylinder and probe, eq. (6), and what their
        # accelerations have beside J q''
        J_C = np.array(
            [[1, 0, -a * sS, half * sP, 0], [0, 1, a * cS, -half * cP, 0]], dtype=self.dtype
        )
        J_P = np.array([[1, 0, -a * sS, -r * sP, cP], [0, 1, a * cS, r * cP, sP]], self.dtype)
        hinge_x, hinge_y = -a * om_S**2 * cS, -a * om_S**2 * sS
        g_C = np.array([hinge_x + half * om_P**2 * cP, hinge_y + half * om_P**2 * sP], self.dtype)
        g_P = np.array(
            [
                hinge_x - r * om_P**2 * cP - 2 * dh * om_P * sP,
                hinge_y - r * om_P**2 * sP + 2 * dh * om_P * cP,
            ],
            self.dtype,
        )
        M = self.M_0 + self.m_C * (J_C.T @ J_C) + self.m_P * (J_P.T @ J_P)
        Q = -self.m_C * (J_C.T @ g_C) - self.m_P * (J_P.T @ g_P)

        torque = -self.k_T * (th_P - th_S) - self.c_T * (om_P - om_S)
        Q[2] -= torque
        Q[3] += torque
        Q[4] += -self.k_A * (h - self.h_0) - self.c_A * dh
        target = [self.real(0.0)] * 3
        force = [self.real(0.0), self.real(0.0)]
        for wall in (0, 1):
            if not self.touching[wall]:
                continue
            contact = self.contact(values, wall)
            force[wall] = F_n = self.normal_force(contact, wall)
            F_t = -F_n * self.friction_coefficient(contact.slip)
            nx, ny = contact.normal
            fx, fy = F_n * nx - F_t * ny, F_n * ny + F_t * nx
            Q[0] += fx
            Q[1] += fy
            Q[2] += a * (cS * fy - sS * fx)
            Q[3] += h * (cP * fy - sP * fx) - (contact.gap + self.R_t) * F_t
            Q[4] += cP * fx + sP * fy
            ox, oy = contact.point[0] - x_T, contact.point[1] - y_T
            target[0] -= fx
            target[1] -= fy
            target[2] -= ox * fy - oy * fx

        rates = np.empty_like(y)
        rates[:8] = y[8:16]
        rates[8:13] = self.solve(M, Q)
        rates[13], rates[14] = target[0] / self.m_T, target[1] / self.m_T
        rates[15] = target[2] / self.I_T
        if y.shape[0] > 16:
            rates[16], rates[17] = force
        return rates

    def solve(self, M: np.ndarray, Q: np.ndarray) -> np.ndarray:
        """Return M^-1 Q, (5,)."""
        if self.real is float:
            return np.asarray(np.linalg.solve(M, Q))
        # LAPACK has no extended precision: elimination without pivoting, M being definite
        M, Q = M.copy(), Q.copy()
        for k in range(4):
            for i in range(k + 1, 5):
                factor = M[i, k] / M[k, k]
                M[i, k:] -= factor * M[k, k:]
                Q[i] -= factor * Q[k]
        for k in range(4, -1, -1):
            Q[k] = (Q[k] - np.dot(M[k, k + 1 :], Q[k + 1 :])) / M[k, k]
        return Q
