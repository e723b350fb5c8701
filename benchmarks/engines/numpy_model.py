"""The bench's equations in NumPy, as a user of SciPy would write them down.

Vectors and Jacobians straight from the paper's eq. (1) to (9), body by body; it shares no
code with :mod:`capture_sim.model`.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from capture_sim.scene.parts import Scene


def direction(angle: float) -> np.ndarray:
    """Return the unit vector at an angle (rad), (2,)."""
    return np.array([np.cos(angle), np.sin(angle)])


def turned(vector: np.ndarray) -> np.ndarray:
    """Return a vector turned by +90 degrees, (2,)."""
    return np.array([-vector[1], vector[0]])


def cross(a: np.ndarray, b: np.ndarray) -> float:
    """Return the z component of a x b."""
    return float(a[0] * b[1] - a[1] * b[0])


class Contact(NamedTuple):
    """The tip against one wall, in the world."""

    gap: float  # m; negative is penetration
    rate: float  # of the gap, m/s
    slip: float  # along the tangent, the normal turned by +90 degrees, m/s
    normal: np.ndarray  # (2,) from the wall to the tip's centre
    point: np.ndarray  # (2,) of the wall, m


class NumpyModel:
    """Two vehicles, buffer, cone and contact; no supports, rail, string, latch or stops.

    Parameters
    ----------
    scene
        With the Lankarani-Nikravesh law, and friction by tanh or none.

    Attributes
    ----------
    touching : list of bool (2,)
        Whether the walls on +y and -y push.
    chi : list of float (2,)
        Hysteresis damping of the present touches, N s/m^2.5.
    """

    def __init__(self, scene: Scene) -> None:
        if scene.contact.law != "lankarani_nikravesh" or scene.friction.law not in ("tanh", "none"):
            raise ValueError(f"{scene.name}: the NumPy model has no such contact or friction law")
        p = scene.probe
        rod = p.density * np.pi * p.radius**2 * p.length
        ball = p.density * 4.0 / 3.0 * np.pi * p.tip_radius**3
        middle = p.tip_radius + p.length / 2.0
        self.m_P = rod + ball
        self.d = rod * middle / self.m_P
        I_P = rod * (p.length**2 / 12.0 + p.radius**2 / 4.0 + (middle - self.d) ** 2)
        I_P += ball * (0.4 * p.tip_radius**2 + self.d**2)
        self.m_S, self.I_S = scene.chaser.mass, scene.chaser.inertia
        self.m_C, self.half_C = scene.cylinder.mass, scene.cylinder.length / 2.0
        self.I_CP = self.m_C * scene.cylinder.length**2 / 12.0 + I_P
        self.m_T, self.I_T = scene.target.mass, scene.target.inertia
        self.buffer, self.h_0, self.R_t = scene.buffer, p.length + p.tip_radius, p.tip_radius
        if scene.buffer.rest_length is not None:
            self.h_0 = scene.buffer.rest_length
        cone, sides = scene.cone, np.array([1.0, -1.0])
        # of the walls, in the target's frame: inner ends, and directions out to the lips
        self.inner = np.column_stack([[-cone.L_T, -cone.L_T], sides * cone.R_c])
        self.along = np.column_stack(
            [np.full(2, -np.cos(cone.half_angle)), sides * np.sin(cone.half_angle)]
        )
        self.L_c = cone.L_c
        tip, wall = scene.contact.tip, scene.contact.wall
        sigma = (1.0 - tip.nu**2) / tip.E + (1.0 - wall.nu**2) / wall.E
        self.K = 4.0 * np.sqrt(p.tip_radius) / (3.0 * sigma)
        self.damping = 0.75 * (1.0 - scene.contact.restitution**2)
        self.v_0_floor = scene.contact.min_approach_speed
        self.mu = scene.friction.mu if scene.friction.law == "tanh" else 0.0
        self.v_eps = scene.friction.slip_regularization_speed
        self.touching = [False, False]
        self.chi = [0.0, 0.0]

    def latch(self, wall: int, approach: float) -> None:
        """Begin a touch of a wall (0: +y, 1: -y) at an approach speed, m/s."""
        self.touching[wall] = True
        self.chi[wall] = self.damping * self.K / max(approach, self.v_0_floor)

    def release(self, wall: int) -> None:
        """End a touch."""
        self.touching[wall] = False

    def contact(self, q: np.ndarray, v: np.ndarray, wall: int) -> Contact:
        """Return how the tip stands to a wall (0: +y, 1: -y)."""
        e_S, e_P = direction(q[2]), direction(q[3])
        tip = q[0:2] + self.buffer.hinge_offset * e_S + q[4] * e_P
        tip_rate = v[0:2] + self.buffer.hinge_offset * v[2] * turned(e_S) + v[4] * e_P
        tip_rate = tip_rate + q[4] * v[3] * turned(e_P)
        x_T = direction(q[7])
        to_world = np.column_stack([x_T, turned(x_T)])
        p = to_world.T @ (tip - q[5:7])
        along = np.clip((p - self.inner[wall]) @ self.along[wall], 0.0, self.L_c)
        nearest = self.inner[wall] + along * self.along[wall]
        distance = np.linalg.norm(p - nearest)
        normal = to_world @ (p - nearest) / distance
        arm = to_world @ nearest
        slide = tip_rate - distance * v[3] * turned(normal) - v[5:7] - v[7] * turned(arm)
        return Contact(
            gap=float(distance - self.R_t),
            rate=float(slide @ normal),
            slip=float(slide @ turned(normal)),
            normal=normal,
            point=q[5:7] + arm,
        )

    def normal_force(self, contact: Contact, wall: int) -> float:
        """Return F_n of eq. (1), N; it never pulls."""
        penetration = max(-contact.gap, 0.0)
        return float(max(penetration**1.5 * (self.K - self.chi[wall] * contact.rate), 0.0))

    def rate_of_change(self, y: np.ndarray) -> np.ndarray:
        """Return dy/dt (16,) of q and v."""
        q, v = y[:8], y[8:]
        a, b = self.buffer.hinge_offset, self.buffer
        h, spin, swing = q[4], v[3], v[2]
        e_S, e_P = direction(q[2]), direction(q[3])
        n_S, n_P = turned(e_S), turned(e_P)
        r = h - self.d
        zero, unit = np.zeros(2), np.eye(2)

        # Jacobians over (x_S, y_S, theta_S, theta_P, h) of cylinder, probe and tip, and the
        # part of the accelerations that is not J q''
        J_C = np.column_stack([unit, a * n_S, -self.half_C * n_P, zero])
        J_P = np.column_stack([unit, a * n_S, r * n_P, e_P])
        J_tip = np.column_stack([unit, a * n_S, h * n_P, e_P])
        g_C = -a * swing**2 * e_S + self.half_C * spin**2 * e_P
        g_P = -a * swing**2 * e_S - r * spin**2 * e_P + 2.0 * v[4] * spin * n_P
        M = np.diag([self.m_S, self.m_S, self.I_S, self.I_CP, 0.0])
        M = M + self.m_C * J_C.T @ J_C + self.m_P * J_P.T @ J_P
        Q = -self.m_C * J_C.T @ g_C - self.m_P * J_P.T @ g_P

        torque = -b.k_T * (q[3] - q[2]) - b.c_T * (spin - swing)
        axial = -b.k_A * (h - self.h_0) - b.c_A * v[4]
        Q = Q + np.array([0.0, 0.0, -torque, torque, axial])
        on_target, torque_target = np.zeros(2), 0.0
        for wall in (0, 1):
            if self.touching[wall]:
                contact = self.contact(q, v, wall)
                F_n = self.normal_force(contact, wall)
                F_t = -self.mu * F_n * np.tanh(contact.slip / self.v_eps)
                force = F_n * contact.normal + F_t * turned(contact.normal)
                Q = Q + J_tip.T @ force
                Q[3] -= (contact.gap + self.R_t) * F_t
                on_target = on_target - force
                torque_target -= cross(contact.point - q[5:7], force)
        chaser = np.linalg.solve(M, Q)
        return np.concatenate([v, chaser, on_target / self.m_T, [torque_target / self.I_T]])
