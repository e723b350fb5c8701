"""The bench's mechanics written a second time, for tests: bodies one by one, no shared code.

Positions of the four bodies straight from paper eq. (6) to (8) and (11); masses and
Jacobians by summation over bodies and complex-step derivatives.
"""

from __future__ import annotations

import numpy as np

from capture_sim.scene.parts import Scene

STEP = 1e-30


def body_masses(scene: Scene) -> tuple[np.ndarray, np.ndarray]:
    """Masses (4,) and inertias (4,) of chaser, cylinder, probe, target."""
    p = scene.probe
    rod = p.density * np.pi * p.radius**2 * p.length
    ball = p.density * 4 / 3 * np.pi * p.tip_radius**3
    rod_at, ball_at = -(p.tip_radius + p.length / 2), 0.0
    centre = (rod * rod_at + ball * ball_at) / (rod + ball)
    inertia = rod * (p.length**2 / 12 + p.radius**2 / 4 + (rod_at - centre) ** 2)
    inertia += ball * (2 / 5 * p.tip_radius**2 + (ball_at - centre) ** 2)
    m = np.array([scene.chaser.mass, scene.cylinder.mass, rod + ball, scene.target.mass])
    return m, np.array(
        [
            scene.chaser.inertia,
            scene.cylinder.mass * scene.cylinder.length**2 / 12,
            inertia,
            scene.target.inertia,
        ]
    )


def positions(scene: Scene, q: np.ndarray) -> np.ndarray:
    """x, y, angle of the four bodies, (4, 3)."""
    p = scene.probe
    rod = p.density * np.pi * p.radius**2 * p.length
    ball = p.density * 4 / 3 * np.pi * p.tip_radius**3
    behind = rod * (p.tip_radius + p.length / 2) / (rod + ball)
    hinge = q[0:2] + scene.buffer.hinge_offset * np.array([np.cos(q[2]), np.sin(q[2])])
    e = np.array([np.cos(q[3]), np.sin(q[3])])
    cylinder = hinge - scene.cylinder.length / 2 * e
    probe = hinge + (q[4] - behind) * e
    return np.array(
        [
            [q[0], q[1], q[2]],
            [cylinder[0], cylinder[1], q[3]],
            [probe[0], probe[1], q[3]],
            [q[5], q[6], q[7]],
        ]
    )


def tip(scene: Scene, q: np.ndarray) -> np.ndarray:
    """Position of the tip's centre, (2,), eq. (11)."""
    return np.array(
        [
            q[0] + scene.buffer.hinge_offset * np.cos(q[2]) + q[4] * np.cos(q[3]),
            q[1] + scene.buffer.hinge_offset * np.sin(q[2]) + q[4] * np.sin(q[3]),
        ]
    )


def jacobian(scene: Scene, q: np.ndarray) -> np.ndarray:
    """D positions / d q, (4, 3, 8)."""
    columns = []
    for k in range(8):
        shifted = q.astype(complex)
        shifted[k] += 1j * STEP
        columns.append(positions(scene, shifted).imag / STEP)
    return np.stack(columns, axis=-1)


def mass_matrix(scene: Scene, q: np.ndarray) -> np.ndarray:
    """M(q), (8, 8)."""
    m, inertia = body_masses(scene)
    J = jacobian(scene, q)
    weights = np.column_stack([m, m, inertia])
    return np.einsum("bik,bi,bil->kl", J, weights, J)


def bias(scene: Scene, q: np.ndarray, v: np.ndarray) -> np.ndarray:
    """b(q, v) of M q'' + b = Q, (8,): sum of J^T m (J' v), J' v by central differences."""
    m, inertia = body_masses(scene)
    J = jacobian(scene, q)
    step = 1e-5
    ahead = jacobian(scene, q + step * v) @ v
    behind = jacobian(scene, q - step * v) @ v
    rate = (ahead - behind) / (2 * step)
    weights = np.column_stack([m, m, inertia])
    return np.einsum("bik,bi,bi->k", J, weights, rate)


def buffer_forces(scene: Scene, q: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Generalised forces of the buffer, (8,), from eq. (9)."""
    b = scene.buffer
    rest = b.rest_length or scene.probe.length + scene.probe.tip_radius
    Q = np.zeros(8)
    Q[4] = -b.k_A * (q[4] - rest) - b.c_A * v[4]
    torque = -b.k_T * (q[3] - q[2]) - b.c_T * (v[3] - v[2])
    Q[3] += torque
    Q[2] -= torque
    return Q


def momentum(scene: Scene, q: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Linear x, y and angular momentum about the origin of all four bodies, (3,)."""
    m, inertia = body_masses(scene)
    at = positions(scene, q)
    rate = jacobian(scene, q) @ v
    linear = m @ rate[:, :2]
    angular = m @ (at[:, 0] * rate[:, 1] - at[:, 1] * rate[:, 0]) + inertia @ rate[:, 2]
    return np.array([*linear, angular])


def kinetic(scene: Scene, q: np.ndarray, v: np.ndarray) -> float:
    """Kinetic energy, J."""
    return float(0.5 * v @ mass_matrix(scene, q) @ v)
