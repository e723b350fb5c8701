"""The bench's mechanics a second time, for tests: four bodies one by one, no shared code.

Places of the bodies straight from paper eq. (6) to (8) and (11).  Their rates are linear in those
of the coordinates, so mass matrix, momentum and energy are sums over the bodies.
"""

from __future__ import annotations

import math

import numpy as np

from capture_sim.scene.parts import Scene


def probe_masses(scene: Scene) -> tuple[float, float, float]:
    """Mass, distance of the centre of mass behind the tip's centre, and inertia of the probe."""
    p = scene.probe
    rod = p.density * math.pi * p.radius**2 * p.length
    ball = p.density * 4.0 / 3.0 * math.pi * p.tip_radius**3
    middle = p.tip_radius + 0.5 * p.length
    behind = rod * middle / (rod + ball)
    about_tip = rod * (p.length**2 / 12.0 + p.radius**2 / 4.0 + middle**2)
    about_tip += ball * 0.4 * p.tip_radius**2
    return rod + ball, behind, about_tip - (rod + ball) * behind**2


def body_masses(scene: Scene) -> np.ndarray:
    """Mass, mass and inertia of chaser, cylinder, probe and target, (12,)."""
    m_P, _, I_P = probe_masses(scene)
    m_C, L_C = scene.cylinder.mass, scene.cylinder.length
    S, T = scene.chaser, scene.target
    values = [S.mass, S.mass, S.inertia, m_C, m_C, m_C * L_C**2 / 12.0]
    return np.array([*values, m_P, m_P, I_P, T.mass, T.mass, T.inertia])


def spread(scene: Scene, q: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Places x, y, angle of the four bodies (12,) and their rates (12,), of q (8,) and v (8,).

    Of several states at once, n, all arrays have a second axis.
    """
    cos, sin = (math.cos, math.sin) if q.ndim == 1 else (np.cos, np.sin)
    e, f = np.array([cos(q[3]), sin(q[3])]), np.array([-sin(q[3]), cos(q[3])])
    a, behind = scene.buffer.hinge_offset, probe_masses(scene)[1]
    hinge = q[:2] + a * np.array([cos(q[2]), sin(q[2])])
    hinge_rate = v[:2] + a * v[2] * np.array([-sin(q[2]), cos(q[2])])
    places, rates = [*q[:3]], [*v[:3]]
    for reach, rate in ((-0.5 * scene.cylinder.length, 0.0), (q[4] - behind, v[4])):
        places += [*(hinge + reach * e), q[3]]
        rates += [*(hinge_rate + rate * e + reach * v[3] * f), v[3]]
    return np.array([*places, *q[5:]]), np.array([*rates, *v[5:]])


def tip(scene: Scene, q: np.ndarray) -> np.ndarray:
    """Position of the tip's centre, (2,), eq. (11)."""
    a = scene.buffer.hinge_offset
    return np.array(
        [
            q[0] + a * math.cos(q[2]) + q[4] * math.cos(q[3]),
            q[1] + a * math.sin(q[2]) + q[4] * math.sin(q[3]),
        ]
    )


def jacobian(scene: Scene, q: np.ndarray) -> np.ndarray:
    """D places / d q, (12, 8)."""
    return np.column_stack([spread(scene, q, unit)[1] for unit in np.eye(8)])


def mass_matrix(scene: Scene, q: np.ndarray) -> np.ndarray:
    """M(q), (8, 8)."""
    J = jacobian(scene, q)
    return J.T @ (body_masses(scene)[:, None] * J)


def bias(scene: Scene, q: np.ndarray, v: np.ndarray) -> np.ndarray:
    """b(q, v) of M q'' + b = Q, (8,): J^T m (J' v), J' v by central differences."""
    step = 1e-5
    ahead, behind = (spread(scene, q + change * v, v)[1] for change in (step, -step))
    return jacobian(scene, q).T @ (body_masses(scene) * (ahead - behind) / (2 * step))


def buffer_forces(scene: Scene, q: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Generalised forces of the buffer, (8,), from eq. (9)."""
    b = scene.buffer
    rest = b.rest_length or scene.probe.length + scene.probe.tip_radius
    stroke, rate, torsion, twist = q[4] - rest, v[4], q[3] - q[2], v[3] - v[2]
    c_A = b.c_A if rate <= 0.0 or b.c_A_rebound is None else b.c_A_rebound
    torque = -b.k_T * torsion - b.k_T3 * torsion**3 - b.c_T * twist - b.c_T2 * abs(twist) * twist
    axial = b.preload - b.k_A * stroke - b.k_A3 * stroke**3 - c_A * rate - b.c_A2 * abs(rate) * rate
    return np.array([0.0, 0.0, -torque, torque, axial, 0.0, 0.0, 0.0])


def momentum(scene: Scene, q: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Linear x, y and angular momentum about the origin of all four bodies, (3,)."""
    places, rates = spread(scene, q, v)
    x, y, _ = places.reshape(4, 3).T
    p_x, p_y, spin = (body_masses(scene) * rates).reshape(4, 3).T
    return np.array([p_x.sum(), p_y.sum(), (x * p_y - y * p_x + spin).sum()])


def kinetic(scene: Scene, q: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Kinetic energy, J; of several states (8, n) all, (n,)."""
    return 0.5 * body_masses(scene) @ spread(scene, q, v)[1] ** 2
