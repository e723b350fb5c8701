"""The bench's equations in NumPy, as a user of SciPy would write them down.

Vectors and Jacobians straight from the paper's eq. (1) to (9), body by body; it shares no code with
:mod:`capture_sim.dynamics.model`.  The same text runs in extended precision, which is how the
references in
``benchmarks/references`` are made.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from capture_sim.scene.parts import Scene

#: Friction laws known here; "clamp" is what Exudyn has.
FRICTION_LAWS = ("tanh", "clamp", "none")


def direction(angle: Any) -> np.ndarray:
    """Return the unit vector at an angle (rad), (2,)."""
    return np.array([np.cos(angle), np.sin(angle)])


def turned(vector: np.ndarray) -> np.ndarray:
    """Return a vector turned by +90 degrees, (2,)."""
    return np.array([-vector[1], vector[0]])


class Contact(NamedTuple):
    """The tip against one wall, in the world."""

    gap: Any  # m; negative is penetration
    rate: Any  # of the gap, m/s
    slip: Any  # along the tangent, the normal turned by +90 degrees, m/s
    normal: np.ndarray  # (2,) from the wall to the tip's centre
    arm: np.ndarray  # (2,) from the target's centre to the point of contact, m


class Model:
    """Two vehicles, buffer, cone and contact; no supports, rail, string, latch or stops.

    Parameters
    ----------
    scene
        With the Lankarani-Nikravesh law, and one of :data:`FRICTION_LAWS`.
    real
        ``float``, or ``numpy.longdouble`` for references.

    Attributes
    ----------
    touching : list of bool (2,)
        True for each of the walls +y and -y that pushes; set by the integrator.
    chi : list of real (2,)
        Hysteresis damping of the present touches, N s/m^2.5.
    evaluations : int
        Of the equations of motion.
    """

    def __init__(self, scene: Scene, real: Any = float) -> None:
        law, self.friction = scene.contact.law, scene.friction.law
        if law != "lankarani_nikravesh" or self.friction not in FRICTION_LAWS:
            raise ValueError(f"{scene.name}: this model knows one contact law, three of friction")
        self.real = real
        p, b, cone = scene.probe, scene.buffer, scene.cone
        density, radius, length, R_t = map(real, (p.density, p.radius, p.length, p.tip_radius))
        pi = real(4 * np.arctan(np.longdouble(1)))
        rod, ball = density * pi * radius**2 * length, density * 4 / real(3) * pi * R_t**3
        self.m_P, middle = rod + ball, R_t + length / 2
        self.d = rod * middle / self.m_P
        I_P = rod * (length**2 / 12 + radius**2 / 4 + (middle - self.d) ** 2)
        I_P += ball * (R_t**2 * 2 / 5 + self.d**2)
        self.m_C, L_C = real(scene.cylinder.mass), real(scene.cylinder.length)
        self.half_C, self.R_t = L_C / 2, R_t
        self.m_T, self.I_T = real(scene.target.mass), real(scene.target.inertia)
        m_S, I_S = real(scene.chaser.mass), real(scene.chaser.inertia)
        self.M_0 = np.diag(np.array([m_S, m_S, I_S, self.m_C * L_C**2 / 12 + I_P, 0], real))
        springs = (b.hinge_offset, b.k_A, b.c_A, b.k_T, b.c_T)
        self.a, self.k_A, self.c_A, self.k_T, self.c_T = map(real, springs)
        self.h_0 = length + R_t if b.rest_length is None else real(b.rest_length)
        # of the walls on +y and -y, in the target's frame: inner ends, directions out to the lips
        L_T, R_c, beta, self.L_c = map(real, (cone.L_T, cone.R_c, cone.half_angle, cone.L_c))
        self.inner = np.array([[-L_T, R_c], [-L_T, -R_c]])
        self.along = np.array([[-np.cos(beta), np.sin(beta)], [-np.cos(beta), -np.sin(beta)]])
        sigma = sum(
            (1 - real(part.nu) ** 2) / real(part.E)
            for part in (scene.contact.tip, scene.contact.wall)
        )
        self.K = 4 * np.sqrt(R_t) / (3 * sigma)
        self.damping = real(3) / 4 * (1 - real(scene.contact.restitution) ** 2)
        self.v_0_floor = real(scene.contact.min_approach_speed)
        self.mu, self.v_eps = map(
            real, (scene.friction.mu, scene.friction.slip_regularization_speed)
        )
        self.touching, self.chi = [False, False], [real(0), real(0)]
        self.evaluations = 0

    def latch(self, wall: int, approach: Any) -> None:
        """Begin a touch of a wall (0: +y, 1: -y) at an approach speed, m/s."""
        self.touching[wall] = True
        self.chi[wall] = self.damping * self.K / max(approach, self.v_0_floor)

    def release(self, wall: int) -> None:
        """End a touch."""
        self.touching[wall] = False

    def contact(self, y: np.ndarray, wall: int) -> Contact:
        """Return how the tip stands to a wall (0: +y, 1: -y) in the state ``y``."""
        q, v = y[:8], y[8:16]
        e_S, e_P = direction(q[2]), direction(q[3])
        tip = q[0:2] + self.a * e_S + q[4] * e_P
        tip_rate = v[0:2] + self.a * v[2] * turned(e_S) + v[4] * e_P + q[4] * v[3] * turned(e_P)
        x_T = direction(q[7])
        to_world = np.column_stack([x_T, turned(x_T)])
        p = to_world.T @ (tip - q[5:7])
        along = min(max((p - self.inner[wall]) @ self.along[wall], 0), self.L_c)
        nearest = self.inner[wall] + along * self.along[wall]
        distance = np.sqrt((p - nearest) @ (p - nearest))
        normal, arm = to_world @ (p - nearest) / distance, to_world @ nearest
        # material of the tip against material of the wall, at the point of contact
        slide = tip_rate - distance * v[3] * turned(normal) - v[5:7] - v[7] * turned(arm)
        gap = distance - self.R_t
        return Contact(gap, slide @ normal, slide @ turned(normal), normal, arm)

    def gap(self, y: np.ndarray, wall: int) -> tuple[Any, Any]:
        """Return the gap (m) of a wall and its rate (m/s)."""
        return self.contact(y, wall)[:2]

    def normal_force(self, y: np.ndarray, wall: int) -> Any:
        """Return F_n of a wall in touch, N."""
        return self._force(self.contact(y, wall), wall)

    def _force(self, contact: Contact, wall: int) -> Any:
        """Return F_n of eq. (1), N; it never pulls."""
        penetration = max(-contact.gap, 0)
        force = penetration * np.sqrt(penetration) * (self.K - self.chi[wall] * contact.rate)
        return max(force, self.real(0))

    def friction_coefficient(self, slip: Any) -> Any:
        """Return friction per normal force, with the sign of the slip (m/s)."""
        if self.friction == "tanh":
            return self.mu * np.tanh(slip / self.v_eps)
        if self.friction == "clamp":
            return self.mu * min(max(slip / self.v_eps, -1), 1)
        return self.real(0)

    def rate_of_change(self, _: Any, y: np.ndarray) -> np.ndarray:
        """Return dy/dt; ``y`` is q (8,), v (8,) and, if it has them, both impulses (2,)."""
        self.evaluations += 1
        q, v = y[:8], y[8:16]
        h, spin, swing, r = q[4], v[3], v[2], q[4] - self.d
        e_S, e_P = direction(q[2]), direction(q[3])
        n_S, n_P = turned(e_S), turned(e_P)
        zero, unit = np.zeros(2, y.dtype), np.eye(2, dtype=y.dtype)
        # Jacobians over (x_S, y_S, theta_S, theta_P, h) of cylinder, probe and tip, and the part
        # of the accelerations that is not J q''
        J_C = np.column_stack([unit, self.a * n_S, -self.half_C * n_P, zero])
        J_P = np.column_stack([unit, self.a * n_S, r * n_P, e_P])
        J_tip = np.column_stack([unit, self.a * n_S, h * n_P, e_P])
        g_C = -self.a * swing**2 * e_S + self.half_C * spin**2 * e_P
        g_P = -self.a * swing**2 * e_S - r * spin**2 * e_P + 2 * v[4] * spin * n_P
        M = self.M_0 + self.m_C * J_C.T @ J_C + self.m_P * J_P.T @ J_P
        Q = -self.m_C * J_C.T @ g_C - self.m_P * J_P.T @ g_P
        torque = -self.k_T * (q[3] - q[2]) - self.c_T * (spin - swing)
        Q[2] -= torque
        Q[3] += torque
        Q[4] -= self.k_A * (h - self.h_0) + self.c_A * v[4]
        rates = np.zeros_like(y)
        for wall in (0, 1):
            if self.touching[wall]:
                contact = self.contact(y, wall)
                F_n = self._force(contact, wall)
                F_t = -F_n * self.friction_coefficient(contact.slip)
                force = F_n * contact.normal + F_t * turned(contact.normal)
                Q += J_tip.T @ force
                Q[3] -= (contact.gap + self.R_t) * F_t
                rates[13:15] -= force / self.m_T
                rates[15] -= turned(contact.arm) @ force / self.I_T
                if y.size > 16:
                    rates[16 + wall] = F_n
        rates[:8] = v
        rates[8:13] = np.linalg.solve(M, Q) if self.real is float else eliminated(M, Q)
        return rates


def eliminated(M: np.ndarray, Q: np.ndarray) -> np.ndarray:
    """Return M^-1 Q without pivoting, M being definite: LAPACK has no extended precision."""
    M, Q = M.copy(), Q.copy()
    last = Q.size - 1
    for k in range(last):
        for i in range(k + 1, Q.size):
            factor = M[i, k] / M[k, k]
            M[i, k:] -= factor * M[k, k:]
            Q[i] -= factor * Q[k]
    for k in range(last, -1, -1):
        Q[k] = (Q[k] - M[k, k + 1 :] @ Q[k + 1 :]) / M[k, k]
    return Q
