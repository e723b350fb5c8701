"""A bench that is not capture_sim's: own equations, own contact, fixed steps of RK4.

It has what real benches have and the model has not: drag, a cable's force, hysteresis of the
buffer.  Of ``capture_sim`` it takes the numbers of a scene only.  Mass matrix and forces follow
from the bodies' Jacobians; touches are not located, but resolved by steps of 2 us.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numba
import numpy as np

from capture_sim.scene.parts import Scene

compiled = numba.njit(cache=True)
#: Steps, s: near a wall, while the latch holds the tip, elsewhere.
NEAR, LATCHED, FREE = 2e-6, 2e-5, 5e-5
#: Gap below which steps are short, m.
CLOSE = 2e-4
#: Displacement over which the hysteresis builds up, m (Dahl, 1968).
DAHL = 2e-4


class Besides(NamedTuple):
    """What the bench has besides the model, SI."""

    tilt: tuple[float, float] = (0.0, 0.0)  # slope of the floor
    drag: tuple[float, float] = (0.0, 0.0)  # of chaser and target, N s/m
    cable: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)  # N: x, y of chaser; of target
    hysteresis: float = 0.0  # of the axial buffer, N


def numbers(scene: Scene, besides: Besides) -> np.ndarray:
    """Return the plant's constants, in the order in which :func:`rates` takes them apart."""
    p, c, cone, b = scene.probe, scene.cylinder, scene.cone, scene.buffer
    e = scene.contact.restitution
    assert scene.supports is not None
    assert scene.latch is not None
    probe, chaser, target = scene.probe.mass, scene.chaser, scene.target
    total = chaser.mass + c.mass + probe
    h_0 = scene.rest_length
    ahead = c.mass * (b.hinge_offset - c.length / 2.0)
    ahead += probe * (b.hinge_offset + h_0 - p.com_offset)
    values = [chaser.mass, chaser.inertia, target.mass, target.inertia, c.mass, c.inertia]
    values += [probe, p.inertia, p.com_offset, b.hinge_offset, c.length / 2.0, h_0]
    values += [b.k_A, b.c_A, b.k_T, b.c_T, b.friction]
    values += [p.tip_radius, cone.L_T, cone.R_c, cone.L_c, cone.half_angle]
    values += [scene.contact_stiffness, 0.75 * (1.0 - e * e), scene.contact.min_approach_speed]
    values += [scene.friction.mu, scene.friction.slip_regularization_speed]
    values += [scene.latch.radius, scene.latch.stiffness, scene.latch.damping]
    values += [scene.supports.rolling_regularization_speed, scene.gravity]
    values += [*besides.tilt, *besides.drag, *besides.cable, besides.hysteresis]
    for support, weight, at in (
        (scene.supports.chaser, total, ahead / total),
        (scene.supports.target, target.mass, 0.0),
    ):
        places = np.array(support.balls)
        loads = np.linalg.solve(
            np.array([np.ones(3), places[:, 0] - at, places[:, 1]]),
            np.array([weight * scene.gravity, 0.0, 0.0]),
        )
        values += [*np.column_stack([places, support.c_rr * loads]).ravel()]
    return np.array(values, dtype=float)


@compiled
def wall_gap(x: float, y: float, side: float, P: np.ndarray) -> tuple[float, float, float]:
    """Return gap (m) and normal of the tip at x, y in the target's frame to a wall."""
    R_t, L_T, R_c, L_c, beta = P[17], P[18], P[19], P[20], P[21]
    tx, ty = -math.cos(beta), side * math.sin(beta)
    ox, oy = x + L_T, y - side * R_c
    along = min(max(ox * tx + oy * ty, 0.0), L_c)
    dx, dy = ox - along * tx, oy - along * ty
    distance = math.hypot(dx, dy)
    return distance - R_t, dx / distance, dy / distance


@compiled
def rolling(
    vx: float, vy: float, w: float, heading: float, balls: np.ndarray, eps: float
) -> tuple[float, float, float]:
    """Return the rolling resistance on a vehicle: force (N, N) and moment (N m)."""
    fx = fy = m = 0.0
    c, s = math.cos(heading), math.sin(heading)
    for i in range(3):
        bx, by = balls[3 * i], balls[3 * i + 1]
        rx, ry = c * bx - s * by, s * bx + c * by
        ux, uy = vx - w * ry, vy + w * rx
        g = balls[3 * i + 2] / math.sqrt(ux * ux + uy * uy + eps * eps)
        fx -= g * ux
        fy -= g * uy
        m -= rx * g * uy - ry * g * ux
    return fx, fy, m


@compiled
def tip_of(z: np.ndarray, P: np.ndarray) -> tuple[float, float, float, float]:
    """Return the tip's position and velocity relative to the target's material, target's frame."""
    a = P[9]
    cS, sS, cP, sP = math.cos(z[2]), math.sin(z[2]), math.cos(z[3]), math.sin(z[3])
    rx, ry = z[0] + a * cS + z[4] * cP - z[5], z[1] + a * sS + z[4] * sP - z[6]
    ux = z[8] - a * z[10] * sS + z[12] * cP - z[4] * z[11] * sP - z[13] + z[15] * ry
    uy = z[9] + a * z[10] * cS + z[12] * sP + z[4] * z[11] * cP - z[14] - z[15] * rx
    c, s = math.cos(z[7]), math.sin(z[7])
    return c * rx + s * ry, c * ry - s * rx, c * ux + s * uy, c * uy - s * ux


@compiled
def rates(z: np.ndarray, P: np.ndarray, mode: np.ndarray) -> np.ndarray:
    """Return the rates of change of the state (17,).

    It is q (8,), v (8,) and the share of the hysteresis.  ``mode``: approach speeds at both walls
    (0: no touch), 1 where latched, the tip where it latched (2,), 1 where the target is held.
    """
    dz = np.zeros(17)
    m_S, I_S, m_T, I_T, m_C, I_C, m_P, I_P = P[0], P[1], P[2], P[3], P[4], P[5], P[6], P[7]
    d, a, half, h_0 = P[8], P[9], P[10], P[11]
    cS, sS, cP, sP = math.cos(z[2]), math.sin(z[2]), math.cos(z[3]), math.sin(z[3])
    w, nu, h, hd = z[10], z[11], z[4], z[12]
    r = h - d
    # Jacobians of the centres of cylinder and probe, and their accelerations at constant rates
    J = np.zeros((2, 2, 5))
    for k, arm in enumerate((-half, r)):
        J[k, 0] = np.array([1.0, 0.0, -a * sS, -arm * sP, 0.0])
        J[k, 1] = np.array([0.0, 1.0, a * cS, arm * cP, 0.0])
    J[1, 0, 4], J[1, 1, 4] = cP, sP
    bias = np.array(
        [
            [-a * w * w * cS + half * nu * nu * cP, -a * w * w * sS + half * nu * nu * sP],
            [
                -a * w * w * cS - r * nu * nu * cP - 2.0 * hd * nu * sP,
                -a * w * w * sS - r * nu * nu * sP + 2.0 * hd * nu * cP,
            ],
        ]
    )
    M, Q = np.zeros((5, 5)), np.zeros(5)
    M[0, 0] = M[1, 1] = m_S
    M[2, 2], M[3, 3] = I_S, I_C + I_P
    gx, gy = P[31] * P[32], P[31] * P[33]
    for k, m in enumerate((m_C, m_P)):
        M += m * (np.outer(J[k, 0], J[k, 0]) + np.outer(J[k, 1], J[k, 1]))
        Q += m * ((gx - bias[k, 0]) * J[k, 0] + (gy - bias[k, 1]) * J[k, 1])
    fx, fy, moment = rolling(z[8], z[9], w, z[2], P[41:50], P[30])
    Q[0] += m_S * gx + fx - P[34] * z[8] + P[36]
    Q[1] += m_S * gy + fy - P[34] * z[9] + P[37]
    Q[2] += moment
    twist, rate = z[3] - z[2], nu - w
    torque = P[14] * twist + P[15] * rate
    Q[2] += torque
    Q[3] -= torque
    # Dahl's friction of size P[40], beside Coulomb's of the scene, which is regularised
    dz[16] = hd / DAHL * (1.0 - z[16] * (1.0 if hd > 0.0 else -1.0))
    Q[4] -= P[12] * (h - h_0) + P[13] * hd + P[40] * z[16] + P[16] * math.tanh(hd / 1e-4)
    tx, ty, wx, wy = tip_of(z, P)
    fx = fy = tip = 0.0
    Tx = Ty = Tm = 0.0
    if mode[2] > 0.0:
        fx = -P[28] * (tx - mode[3]) - P[29] * wx
        fy = -P[28] * (ty - mode[4]) - P[29] * wy
        Tm -= tx * fy - ty * fx
    else:
        for k in range(2):
            gap, nx, ny = wall_gap(tx, ty, 1.0 - 2.0 * k, P)
            if gap >= 0.0 or mode[k] == 0.0:
                continue
            normal = P[22] * (-gap) ** 1.5 * (1.0 - P[23] * (nx * wx + ny * wy) / mode[k])
            normal = max(normal, 0.0)
            arm = gap + P[17]
            slip = wy * nx - wx * ny - arm * (nu - z[15])
            rub = -P[25] * normal * math.tanh(slip / P[26])
            cx, cy = normal * nx - rub * ny, normal * ny + rub * nx
            fx += cx
            fy += cy
            tip -= arm * rub
            Tm -= (tx - arm * nx) * cy - (ty - arm * ny) * cx
    c, s = math.cos(z[7]), math.sin(z[7])
    Fx, Fy = c * fx - s * fy, s * fx + c * fy
    Q[0] += Fx
    Q[1] += Fy
    Q[2] += a * (cS * Fy - sS * Fx)
    Q[3] += h * (cP * Fy - sP * Fx) + tip
    Q[4] += cP * Fx + sP * Fy
    dz[:8] = z[8:16]
    dz[8:13] = np.linalg.solve(M, Q)
    if mode[5] == 0.0:
        Tx, Ty, moment = rolling(z[13], z[14], z[15], z[7], P[50:59], P[30])
        dz[13] = (Tx - Fx - P[35] * z[13] + P[38]) / m_T + gx
        dz[14] = (Ty - Fy - P[35] * z[14] + P[39]) / m_T + gy
        dz[15] = (moment + Tm) / I_T
    return dz


@compiled
def fly(z: np.ndarray, t: float, times: np.ndarray, P: np.ndarray) -> tuple[np.ndarray, float]:
    """Return the coordinates (n, 8) at times after ``t``, and the time of the first touch."""
    mode = np.zeros(6)
    mode[5] = 1.0
    found, k, first = np.zeros((times.size, 8)), 0, np.inf
    while k < times.size:
        x, y, wx, wy = tip_of(z, P)
        near = np.inf
        for wall in range(2):
            gap, nx, ny = wall_gap(x, y, 1.0 - 2.0 * wall, P)
            near = min(near, gap)
            if gap >= 0.0:
                mode[wall] = 0.0
            elif mode[wall] == 0.0:
                mode[wall] = max(-(nx * wx + ny * wy), P[24])
                if mode[2] == 0.0:
                    first, mode[5] = min(first, t), 0.0
        if mode[2] == 0.0 and math.hypot(x + P[18], y) < P[27]:
            mode[2], mode[3], mode[4], mode[5] = 1.0, x, y, 0.0
        step = FREE if near > CLOSE else NEAR
        step = LATCHED if mode[2] > 0.0 else step
        k_1 = rates(z, P, mode)
        k_2 = rates(z + 0.5 * step * k_1, P, mode)
        k_3 = rates(z + 0.5 * step * k_2, P, mode)
        k_4 = rates(z + step * k_3, P, mode)
        after = z + step / 6.0 * (k_1 + 2.0 * k_2 + 2.0 * k_3 + k_4)
        while k < times.size and times[k] <= t + step:
            share = (times[k] - t) / step
            found[k] = z[:8] + share * (after[:8] - z[:8])
            k += 1
        z, t = after, t + step
    return found, first


def motion_of(scene: Scene, besides: Besides, times: np.ndarray) -> tuple[np.ndarray, float]:
    """Return the coordinates q (n, 8) of a launched scene at times (s), and the first touch.

    The string has a hanging mass and a drop height.  On the rail the motion is one-dimensional.
    """
    P, string = numbers(scene, besides), scene.string
    assert string is not None
    assert scene.rail is not None
    start, target = scene.initial.chaser, scene.initial.target
    total = scene.chaser_total_mass
    c, s = math.cos(start.theta), math.sin(start.theta)
    along = [scene.gravity * besides.tilt[k] * total + besides.cable[k] for k in range(2)]
    push = c * along[0] + s * along[1] - float(P[41:50].reshape(3, 3)[:, 2].sum())
    q_0 = np.array([start.x, start.y, start.theta, start.theta, scene.rest_length])
    q_0 = np.concatenate([q_0, [target.x, target.y, target.theta]])
    travel, speed, t, step = 0.0, 0.0, 0.0, 2e-5
    seen = np.zeros((times.size, 8))
    k = 0
    hanging, height = float(string.hanging_mass or 0.0), float(string.drop_height or 0.0)
    while travel < scene.rail.length and t < times[-1]:
        taut = travel < height
        m, force = (total + hanging, push + hanging * scene.gravity) if taut else (total, push)
        rate = (force - besides.drag[0] * speed) / m
        middle = speed + 0.5 * step * rate
        rate = (force - besides.drag[0] * middle) / m
        while k < times.size and times[k] <= t:
            seen[k] = q_0
            seen[k, :2] += travel * c, travel * s
            k += 1
        travel, speed, t = travel + step * middle, speed + step * rate, t + step
    z = np.concatenate([q_0, [speed * c, speed * s], np.zeros(7)])
    z[:2] += travel * c, travel * s
    seen[k:], first = fly(z, t, times[k:], P)
    return seen, first
