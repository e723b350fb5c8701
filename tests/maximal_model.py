"""The bench a third time, for tests: four bodies in maximal coordinates, held together by forces.

Chaser S, cylinder C, probe P and target T have x, y and angle of their own (12 coordinates,
paper eq. 5).  Hinge and slide are the four constraints of eq. (6) and (7), kept by
Lagrange multipliers; the buffer acts through the vector D of eq. (8) and the energies of
eq. (9); contact forces act on probe and target at the point of contact.  Nothing of
``capture_sim`` but the scene's numbers is used: no kinematics, mass matrix, geometry,
event location or integrator (that is SciPy's DOP853).

Two readings, both from ``physics.md``: the probe's coordinate is its true centre of mass
(the paper puts it in the rod's middle), and the axial damper acts on the rate of D's
length (eq. 9 as printed, on D's rate as a vector, would also resist the probe's turning).

Coulomb's friction slides in a direction that is kept until the slip comes to zero; there the
tip sticks if it can, by a fifth and sixth constraint: no slip of the two materials at the point of
contact.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import NamedTuple

import numba
import numpy as np
from four_bodies import body_masses, probe_masses, spread
from scipy.integrate import DOP853, DenseOutput
from scipy.optimize import brentq, minimize, minimize_scalar

from capture_sim.scene.parts import BallSupport, Scene

compiled = numba.njit(cache=True)
#: Constraint violations die out at this rate, 1/s (Baumgarte 1972, critically damped).
BAUMGARTE = 100.0
#: Longest step, s: no flight between two touches is much shorter.
LONGEST_STEP = 2e-4
#: Places in a step at which events are looked for.
PLACES = np.linspace(0.0, 1.0, 9)
#: Laws of friction as numbers, for the compiled functions.
FRICTION = {"none": 0, "tanh": 1, "clamp": 2, "brown_mcphee": 3, "coulomb": 4}
#: m: a probe that has just left its seat is nearer to it than the length of its spring is known.
SEAT_ROUNDING = 1e-15
#: s: central differences along the motion.
SMALL_TIME = 1e-6


def exact_damping(e: float) -> float:
    """Damping that returns the restitution e: root of a (1 + e) = ln((1 + a) / (1 - a e))."""
    if e == 1.0:
        return 0.0
    poles = 1.0 / e

    def gap(distance: float) -> float:
        # counted from the pole at a = 1 / e, which the root may be close to
        a = poles - distance
        return a * (1.0 + e) - math.log1p(a) + math.log(e * distance)

    return poles - float(brentq(gap, 1e-300, poles * (1.0 - 1e-6), xtol=1e-300, rtol=1e-15))


def damping_factor(law: str, e: float) -> float:
    """a(e) in F = K delta^1.5 (1 + a delta' / v_0), from the laws' papers as chi v_0 / K."""
    return {
        "lankarani_nikravesh": lambda: 3.0 * (1.0 - e**2) / 4.0,
        "hunt_crossley": lambda: 3.0 * (1.0 - e) / 2.0,
        "herbert_mcwhannell": lambda: 6.0 * (1.0 - e) / ((2.0 * e - 1.0) ** 2 + 3.0),
        "lee_wang": lambda: 3.0 * (1.0 - e) / 4.0,
        "gonthier": lambda: (1.0 - e**2) / e,
        "zhiying_qishao": lambda: 3.0 * (1.0 - e**2) * math.exp(2.0 * (1.0 - e)) / 4.0,
        "flores": lambda: 8.0 * (1.0 - e) / (5.0 * e),
        "hu_guo": lambda: 3.0 * (1.0 - e) / (2.0 * e),
        "carvalho_martins": lambda: 1.5 * (1.0 - e) * (11.0 - e) / (1.0 + 9.0 * e),
        "exact": lambda: exact_damping(e),
    }[law]()


def monotone_slopes(points: tuple[tuple[float, float], ...]) -> np.ndarray:
    """Points (n, 3) of a table with the slope at each, after Fritsch and Butland (1984).

    A weighted harmonic mean of the slopes on both sides, 0 where these differ in sign; at an end
    the parabola's through three points, cut as Moler does.  At rest without a preload the curve
    goes on as its mirror image, whose slope there is the first one.
    """
    s, F = np.array(points).T
    w, d = np.diff(s), np.diff(F) / np.diff(s)
    slopes = np.zeros(s.size)

    def at_end(w0: float, w1: float, d0: float, d1: float) -> float:
        m = ((2.0 * w0 + w1) * d0 - w0 * d1) / (w0 + w1)
        if m * d0 <= 0.0:
            return 0.0
        return 3.0 * d0 if d0 * d1 <= 0.0 and abs(m) > 3.0 * abs(d0) else m

    for k in range(1, s.size - 1):
        if d[k - 1] * d[k] > 0.0:
            a, b = 2.0 * w[k] + w[k - 1], w[k] + 2.0 * w[k - 1]
            slopes[k] = (a + b) / (a / d[k - 1] + b / d[k])
    slopes[0] = d[0]
    if F[0] > 0.0 and s.size > 2:
        slopes[0] = at_end(w[0], w[1], d[0], d[1])
    slopes[-1] = d[-1]
    if s.size > 2:
        slopes[-1] = at_end(w[-1], w[-2], d[-1], d[-2])
    return np.column_stack([s, F - F[0], slopes])


@compiled
def tabulated(table: np.ndarray, inwards: float) -> float:
    """Force of a tabulated spring beyond its preload, N, by Hermite's polynomials."""
    s, last = abs(inwards), table.shape[0] - 1
    force = table[last, 1] + (s - table[last, 0]) * table[last, 2]
    for k in range(last):
        if s < table[k + 1, 0]:
            w = table[k + 1, 0] - table[k, 0]
            x = (s - table[k, 0]) / w
            force = (1.0 + 2.0 * x) * (1.0 - x) ** 2 * table[k, 1]
            force += x * x * (3.0 - 2.0 * x) * table[k + 1, 1]
            force += w * x * (1.0 - x) * ((1.0 - x) * table[k, 2] - x * table[k + 1, 2])
            break
    return math.copysign(force, inwards)


class Constants(NamedTuple):
    """A scene's numbers, SI units."""

    inverse_mass: np.ndarray  # (12,) of S, C, P, T in x, y and angle
    a: float  # chaser's centre of mass to the hinge
    half_cylinder: float  # cylinder's centre to the hinge
    tip_ahead: float  # probe's centre of mass to the tip's centre
    rear_behind: float  # probe's centre of mass to the rod's rear
    l_0: float  # length of D at rest
    k_A: float
    c_A: float
    k_T: float
    c_T: float
    k_A3: float
    c_A2: float
    c_A_rebound: float
    preload: float
    k_T3: float
    c_T2: float
    slide_friction: float
    table: np.ndarray  # (n, 3) stroke inwards, force of the spring beyond the preload, slope there
    R_t: float
    inner: np.ndarray  # (2, 2) target's frame: inner ends of the +y and the -y wall
    along: np.ndarray  # (2, 2) directions from there to the lip
    L_c: float
    K: float
    damping: float  # a(e)
    v_0_floor: float
    friction: int  # of FRICTION
    mu: float
    mu_s: float
    v_eps: float
    balls: np.ndarray  # (2, 3, 3) chaser's and target's: x, y in its frame, c_rr N
    v_eps_ball: float


def ball_limits(support: BallSupport, weight: float, ahead: float) -> np.ndarray:
    """Places of three balls and what each can resist, c_rr N, (3, 3).

    The loads hold up ``weight`` (N), which acts ``ahead`` (m) of the vehicle's origin, without
    a moment about any axis in the floor.
    """
    places = np.array(support.balls)
    equations = np.array([np.ones(3), places[:, 0] - ahead, places[:, 1]])
    load = np.linalg.solve(equations, np.array([weight, 0.0, 0.0]))
    return np.column_stack([places, support.c_rr * load])


def constants(scene: Scene) -> Constants:
    """Gather what the model needs from a scene."""
    m_P, behind, _ = probe_masses(scene)
    m_C, L_C = scene.cylinder.mass, scene.cylinder.length
    p, b, cone = scene.probe, scene.buffer, scene.cone
    h_0 = b.rest_length or p.length + p.tip_radius
    sides = np.array([1.0, -1.0])
    balls, v_eps_ball = np.zeros((2, 3, 3)), 1.0
    if scene.supports is not None:
        total = scene.chaser.mass + m_C + m_P
        ahead = (m_C * (b.hinge_offset - L_C / 2.0) + m_P * (b.hinge_offset + h_0 - behind)) / total
        balls[0] = ball_limits(scene.supports.chaser, total * scene.gravity, ahead)
        balls[1] = ball_limits(scene.supports.target, scene.target.mass * scene.gravity, 0.0)
        v_eps_ball = scene.supports.rolling_regularization_speed
    sigma = sum((1.0 - m.nu**2) / m.E for m in (scene.contact.tip, scene.contact.wall))
    return Constants(
        inverse_mass=1.0 / body_masses(scene),
        a=b.hinge_offset,
        half_cylinder=L_C / 2.0,
        tip_ahead=behind,
        rear_behind=p.tip_radius + p.length - behind,
        l_0=h_0 - p.tip_radius - p.length + L_C,
        k_A=b.k_A,
        c_A=b.c_A,
        k_T=b.k_T,
        c_T=b.c_T,
        k_A3=b.k_A3,
        c_A2=b.c_A2,
        c_A_rebound=b.c_A if b.c_A_rebound is None else b.c_A_rebound,
        preload=b.preload if b.force_table is None else b.force_table[0][1],
        k_T3=b.k_T3,
        c_T2=b.c_T2,
        slide_friction=b.friction,
        table=np.zeros((0, 3)) if b.force_table is None else monotone_slopes(b.force_table),
        R_t=p.tip_radius,
        inner=np.column_stack([np.full(2, -cone.L_T), sides * cone.R_c]),
        along=np.column_stack(
            [np.full(2, -math.cos(cone.half_angle)), sides * math.sin(cone.half_angle)]
        ),
        L_c=cone.L_c,
        K=4.0 * math.sqrt(p.tip_radius) / (3.0 * sigma),
        damping=damping_factor(scene.contact.law, scene.contact.restitution)
        if scene.contact.hysteresis_factor is None
        else scene.contact.hysteresis_factor,
        v_0_floor=scene.contact.min_approach_speed,
        friction=FRICTION[scene.friction.law],
        mu=scene.friction.mu,
        mu_s=scene.friction.mu if scene.friction.mu_s is None else scene.friction.mu_s,
        v_eps=scene.friction.slip_regularization_speed,
        balls=balls,
        v_eps_ball=v_eps_ball,
    )


@compiled
def wall_contact(
    z: np.ndarray, c: Constants, wall: int
) -> tuple[float, float, float, float, float, float]:
    """Where the tip is against a wall: the nearest point of a segment, and how it moves.

    Returns gap (m, negative is penetration), its rate (m/s), the normal from the wall to
    the tip's centre and the point on the wall, both in the world.
    """
    cP, sP = math.cos(z[8]), math.sin(z[8])
    cT, sT = math.cos(z[11]), math.sin(z[11])
    ax, ay = z[6] + c.tip_ahead * cP, z[7] + c.tip_ahead * sP
    bx = z[9] + cT * c.inner[wall, 0] - sT * c.inner[wall, 1]
    by = z[10] + sT * c.inner[wall, 0] + cT * c.inner[wall, 1]
    ex = cT * c.along[wall, 0] - sT * c.along[wall, 1]
    ey = sT * c.along[wall, 0] + cT * c.along[wall, 1]
    s = min(max((ax - bx) * ex + (ay - by) * ey, 0.0), c.L_c)
    px, py = bx + s * ex, by + s * ey
    distance = math.hypot(ax - px, ay - py)
    nx, ny = (ax - px) / distance, (ay - py) / distance
    # the tip's centre against the target's material under it
    ux = z[18] - z[20] * c.tip_ahead * sP - z[21] + z[23] * (ay - z[10])
    uy = z[19] + z[20] * c.tip_ahead * cP - z[22] - z[23] * (ax - z[9])
    return distance - c.R_t, ux * nx + uy * ny, nx, ny, px, py


@compiled
def slip(z: np.ndarray, c: Constants, wall: int) -> float:
    """Slip of the tip's material on the wall's at the point of contact along (-n_y, n_x), m/s."""
    _, _, nx, ny, px, py = wall_contact(z, c, wall)
    ux = z[18] - z[20] * (py - z[7]) - z[21] + z[23] * (py - z[10])
    uy = z[19] + z[20] * (px - z[6]) - z[22] - z[23] * (px - z[9])
    return uy * nx - ux * ny


@compiled
def contact_force(
    z: np.ndarray, c: Constants, wall: int, chi: float, sliding: float
) -> tuple[float, float]:
    """Normal force, eq. (1), and friction along (-n_y, n_x), N; zero out of contact.

    ``sliding`` is the sign of the slip for Coulomb's law, 0 where the tip sticks.
    """
    gap, rate, _, _, _, _ = wall_contact(z, c, wall)
    if gap >= 0.0:
        return 0.0, 0.0
    normal = max((-gap) ** 1.5 * (c.K - chi * rate), 0.0)
    if c.friction == 0:
        return normal, 0.0
    if c.friction == 4:
        return normal, -c.mu * normal * sliding
    x = slip(z, c, wall) / c.v_eps
    if c.friction == 1:
        share = c.mu * math.tanh(x)
    elif c.friction == 2:
        share = c.mu * min(max(x, -1.0), 1.0)
    else:
        share = c.mu * math.tanh(4.0 * x) + (c.mu_s - c.mu) * x / (x**2 / 4.0 + 3.0 / 4.0) ** 2
    return normal, -share * normal


@compiled
def along_a_step(
    states: np.ndarray, c: Constants, wall: int, chi: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Gap, its rate, normal force and slip of a wall at several states (26, n)."""
    n = states.shape[1]
    gaps, rates, forces, slips = np.zeros(n), np.zeros(n), np.zeros(n), np.zeros(n)
    for k in range(n):
        z = states[:, k].copy()
        gaps[k], rates[k] = wall_contact(z, c, wall)[:2]
        forces[k] = contact_force(z, c, wall, chi, 0.0)[0]
        slips[k] = slip(z, c, wall)
    return gaps, rates, forces, slips


@compiled
def solve(M: np.ndarray, b: np.ndarray, n: int) -> None:
    """Gauss elimination of a positive definite system of n, in place; the result is in b."""
    for k in range(n):
        for i in range(k + 1, n):
            f = M[i, k] / M[k, k]
            for j in range(k, n):
                M[i, j] -= f * M[k, j]
            b[i] -= f * b[k]
    for k in range(n - 1, -1, -1):
        for j in range(k + 1, n):
            b[k] -= M[k, j] * b[j]
        b[k] /= M[k, k]


@compiled
def constraints(
    z: np.ndarray, c: Constants, phi: np.ndarray, bias: np.ndarray, J: np.ndarray
) -> None:
    """Eq. (6), theta_C = theta_P and eq. (7): values, J' v and Jacobian J, in four rows."""
    cS, sS = math.cos(z[2]), math.sin(z[2])
    cC, sC = math.cos(z[5]), math.sin(z[5])
    half, spin = c.half_cylinder, z[17]
    dx, dy = z[6] - z[3], z[7] - z[4]
    ux, uy = z[18] - z[15], z[19] - z[16]
    phi[0] = z[0] + c.a * cS - z[3] - half * cC
    J[0, 0], J[0, 2], J[0, 3], J[0, 5] = 1.0, -c.a * sS, -1.0, half * sC
    bias[0] = -c.a * z[14] ** 2 * cS + half * spin**2 * cC
    phi[1] = z[1] + c.a * sS - z[4] - half * sC
    J[1, 1], J[1, 2], J[1, 4], J[1, 5] = 1.0, c.a * cS, -1.0, -half * cC
    bias[1] = -c.a * z[14] ** 2 * sS + half * spin**2 * sC
    phi[2] = z[5] - z[8]
    J[2, 5], J[2, 8] = 1.0, -1.0
    phi[3] = cC * dy - sC * dx
    J[3, 3], J[3, 4], J[3, 6], J[3, 7] = sC, -cC, -sC, cC
    J[3, 5] = -(cC * dx + sC * dy)
    bias[3] = -2.0 * spin * (cC * ux + sC * uy) - spin**2 * phi[3]


@compiled
def no_slip(z: np.ndarray, c: Constants, wall: int, J: np.ndarray) -> float:
    """Jacobian (12,) of the slip on a wall; returns J' v, by a difference along the motion."""
    _, _, nx, ny, px, py = wall_contact(z, c, wall)
    J[6], J[7], J[8] = -ny, nx, nx * (px - z[6]) + ny * (py - z[7])
    J[9], J[10], J[11] = ny, -nx, -nx * (px - z[9]) - ny * (py - z[10])
    ahead, behind = z.copy(), z.copy()
    for j in range(12):  # Numba compiles slices of arrays ten times as long
        ahead[j] += SMALL_TIME * z[12 + j]
        behind[j] -= SMALL_TIME * z[12 + j]
    return (slip(ahead, c, wall) - slip(behind, c, wall)) / (2.0 * SMALL_TIME)


@compiled
def spring_vector(z: np.ndarray, c: Constants) -> tuple[float, float, float, float, float]:
    """Length and direction of D of eq. (8), and its rate in x and y."""
    cS, sS = math.cos(z[2]), math.sin(z[2])
    cC, sC = math.cos(z[5]), math.sin(z[5])
    cP, sP = math.cos(z[8]), math.sin(z[8])
    L, r = 2.0 * c.half_cylinder, c.rear_behind
    Dx = z[6] - r * cP - (z[0] + c.a * cS - L * cC)
    Dy = z[7] - r * sP - (z[1] + c.a * sS - L * sC)
    rate_x = z[18] + r * sP * z[20] - (z[12] - c.a * sS * z[14] + L * sC * z[17])
    rate_y = z[19] - r * cP * z[20] - (z[13] + c.a * cS * z[14] - L * cC * z[17])
    length = math.hypot(Dx, Dy)
    return length, Dx / length, Dy / length, rate_x, rate_y


@compiled
def held(z: np.ndarray, c: Constants, length_held: float, J: np.ndarray) -> tuple[float, float]:
    """A probe at rest in its slide: value, and J' v, of the constraint of D's length."""
    length, ex, ey, rate_x, rate_y = spring_vector(z, c)
    cS, sS = math.cos(z[2]), math.sin(z[2])
    cC, sC = math.cos(z[5]), math.sin(z[5])
    cP, sP = math.cos(z[8]), math.sin(z[8])
    L, r = 2.0 * c.half_cylinder, c.rear_behind
    J[0], J[1], J[2] = -ex, -ey, c.a * (sS * ex - cS * ey)
    J[5] = L * (cC * ey - sC * ex)
    J[6], J[7], J[8] = ex, ey, r * (sP * ex - cP * ey)
    turning = (ex * rate_y - ey * rate_x) ** 2 / length
    turning += r * z[20] ** 2 * (ex * cP + ey * sP) + c.a * z[14] ** 2 * (ex * cS + ey * sS)
    return length - length_held, turning - L * z[17] ** 2 * (ex * cC + ey * sC)


@compiled
def strike(z: np.ndarray, c: Constants) -> np.ndarray:
    """The rates (12,) after an impulse that brings the probe to rest in its slide."""
    n, W = 5, c.inverse_mass
    b, J, M = np.zeros(n), np.zeros((n, 12)), np.zeros((n, n))
    constraints(z, c, np.zeros(n), np.zeros(n), J)
    held(z, c, c.l_0, J[4])
    for k in range(n):
        for j in range(12):
            b[k] += J[k, j] * z[12 + j]
            for i in range(n):
                M[k, i] += J[k, j] * W[j] * J[i, j]
    solve(M, b, n)
    rates = z[12:24].copy()
    for j in range(12):
        for k in range(n):
            rates[j] -= W[j] * J[k, j] * b[k]
    return rates


@compiled
def applied(
    z: np.ndarray, c: Constants, touching: np.ndarray, chi: np.ndarray, sliding: np.ndarray
) -> np.ndarray:
    """Forces and moments (12,) of the buffer and of the walls.

    The third of ``sliding`` is the sign of the probe's rate in its slide.
    """
    Q = np.zeros(12)
    cS, sS = math.cos(z[2]), math.sin(z[2])
    cC, sC = math.cos(z[5]), math.sin(z[5])
    cP, sP = math.cos(z[8]), math.sin(z[8])
    # axial spring and damper act along D
    L, r = 2.0 * c.half_cylinder, c.rear_behind
    length, ex, ey, rate_x, rate_y = spring_vector(z, c)
    longer, lengthening = length - c.l_0, ex * rate_x + ey * rate_y
    damping = (c.c_A_rebound if lengthening > 0.0 else c.c_A) + c.c_A2 * abs(lengthening)
    pull = (c.k_A + c.k_A3 * longer**2) * longer + damping * lengthening - c.preload
    pull += c.slide_friction * sliding[2]
    if c.table.shape[0] > 0:
        pull -= tabulated(c.table, -longer)
    turned, turning = z[5] - z[2], z[17] - z[14]
    torque = (c.k_T + c.k_T3 * turned**2) * turned + (c.c_T + c.c_T2 * abs(turning)) * turning
    Q[0], Q[1] = pull * ex, pull * ey
    Q[2] = pull * c.a * (cS * ey - sS * ex) + torque
    Q[5] = -pull * L * (cC * ey - sC * ex) - torque
    Q[6], Q[7] = -pull * ex, -pull * ey
    Q[8] = pull * r * (cP * ey - sP * ex)
    for wall in range(2):
        if touching[wall]:
            _, _, nx, ny, px, py = wall_contact(z, c, wall)
            normal, rub = contact_force(z, c, wall, chi[wall], sliding[wall])
            fx, fy = normal * nx - rub * ny, normal * ny + rub * nx
            Q[6] += fx
            Q[7] += fy
            Q[8] += (px - z[6]) * fy - (py - z[7]) * fx
            Q[9] -= fx
            Q[10] -= fy
            Q[11] -= (px - z[9]) * fy - (py - z[10]) * fx
    return Q


@compiled
def accelerations(
    z: np.ndarray,
    c: Constants,
    touching: np.ndarray,
    chi: np.ndarray,
    sliding: np.ndarray,
    resting: np.ndarray,
    length_held: float,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, float]:
    """Accelerations (12,) of the four bodies, and what holds them.

    That is the wrench on either vehicle without its supports, (2, 3), the force that holds a
    sticking tip on either wall, (2,), and that which holds the probe in its slide, inwards, N.  A
    resting vehicle is one of infinite mass; the third of ``resting`` is the held probe, with the
    length of D.
    """
    Q, W = applied(z, c, touching, chi, sliding), c.inverse_mass.copy()
    wrenches = np.zeros((2, 3))
    for j in range(3):
        wrenches[0, j], wrenches[1, j] = Q[j], Q[9 + j]
    for which in range(2):
        k = 9 * which
        if resting[which]:
            for j in range(3):
                W[k + j] = 0.0
            continue
        ct, st = math.cos(z[k + 2]), math.sin(z[k + 2])
        for i in range(3):
            x, y, limit = c.balls[which, i]
            rx, ry = ct * x - st * y, st * x + ct * y
            ux, uy = z[12 + k] - z[14 + k] * ry, z[13 + k] + z[14 + k] * rx
            g = limit / math.sqrt(ux * ux + uy * uy + c.v_eps_ball**2)
            Q[k] -= g * ux
            Q[k + 1] -= g * uy
            Q[k + 2] -= g * (rx * uy - ry * ux)
    phi, b, J, M = np.zeros(7), np.zeros(7), np.zeros((7, 12)), np.zeros((7, 7))
    constraints(z, c, phi, b, J)
    n, sticking = 4, [0, 0]
    for wall in range(2):
        if touching[wall] and c.friction == 4 and sliding[wall] == 0.0:
            b[n] = no_slip(z, c, wall, J[n])
            sticking[wall] = n
            n += 1
    seated = n
    if resting[2]:
        phi[n], b[n] = held(z, c, length_held, J[n])
        n += 1
    for k in range(n):
        rate = 0.0
        for j in range(12):
            rate += J[k, j] * z[12 + j]
        b[k] += 2.0 * BAUMGARTE * rate + BAUMGARTE**2 * phi[k]
        for j in range(12):
            b[k] += J[k, j] * W[j] * Q[j]
        for i in range(n):
            for j in range(12):
                M[k, i] += J[k, j] * W[j] * J[i, j]
    solve(M, b, n)  # b becomes the multipliers
    acc, friction = np.zeros(12), np.zeros(2)
    for j in range(12):
        force = 0.0
        for k in range(n):
            force += J[k, j] * b[k]
        acc[j] = W[j] * (Q[j] - force)
        if j < 3:
            wrenches[0, j] -= force
        elif j >= 9:
            wrenches[1, j - 9] -= force
    for wall in range(2):
        if sticking[wall]:
            friction[wall] = -b[sticking[wall]]
    return acc, wrenches, friction, b[seated]


@compiled
def motion(
    z: np.ndarray,
    c: Constants,
    touching: np.ndarray,
    chi: np.ndarray,
    sliding: np.ndarray,
    resting: np.ndarray,
    length_held: float,
) -> np.ndarray:
    """Rate of change of the state: 12 coordinates, 12 velocities, normal impulse of each wall."""
    rate = np.zeros(26)
    acc = accelerations(z, c, touching, chi, sliding, resting, length_held)[0]
    for j in range(12):
        rate[j], rate[12 + j] = z[12 + j], acc[j]
    for wall in range(2):
        if touching[wall]:
            rate[24 + wall] = contact_force(z, c, wall, chi[wall], sliding[wall])[0]
    return rate


def limit_used(wrench: np.ndarray, balls: np.ndarray, heading: float) -> float:
    """Which share of what its balls can hold a vehicle at rest asks for.

    The largest ratio, over all motions, of the wrench's power to the power that the balls
    could take (Goyal, Ruina and Papadopoulos 1991): the least of a convex function
    of the two motions that are left free by a power of one.
    """
    c, s = math.cos(heading), math.sin(heading)
    x, y = c * balls[:, 0] - s * balls[:, 1], s * balls[:, 0] + c * balls[:, 1]
    arm = np.hypot(x, y).max()
    w = np.array([wrench[0], wrench[1], wrench[2] / arm])
    size = np.linalg.norm(w)
    if size == 0.0:
        return 0.0
    basis = np.linalg.svd((w / size)[None, :])[2]  # rows: along the wrench, then across

    def taken(free: np.ndarray) -> float:
        m = w / size + free @ basis[1:]
        return float(balls[:, 2] @ np.hypot(m[0] - m[2] * y / arm, m[1] + m[2] * x / arm))

    best = minimize(
        taken, np.zeros(2), method="Nelder-Mead", options={"xatol": 1e-11, "fatol": 1e-15}
    )
    return float(size / best.fun)


@dataclass
class Touch:
    """A touch of wall ``side`` (+1 or -1): times (s), approach speed (m/s), peak (N)."""

    side: int
    start: float
    speed: float
    end: float = math.inf
    peak: float = 0.0
    peak_time: float = 0.0


@dataclass
class MaximalRun:
    """What a run gave: touches, minimal coordinates at the times asked for, drift."""

    touches: list[Touch] = field(default_factory=list)
    moving: list[float] = field(default_factory=list)  # when the target left its rest
    seat: list[float] = field(default_factory=list)  # when the probe left its seat, came back, ...
    slide: list[float] = field(default_factory=list)  # when it began or ceased to slide
    q: list[np.ndarray] = field(default_factory=list)
    v: list[np.ndarray] = field(default_factory=list)
    impulse: list[np.ndarray] = field(default_factory=list)
    drift: float = 0.0  # largest constraint violation after any step, m or rad


def gather(c: Constants, z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Minimal coordinates q and rates v of a state; h by eq. (11)."""
    e, f = np.array([math.cos(z[8]), math.sin(z[8])]), np.array([-math.sin(z[8]), math.cos(z[8])])
    hinge = z[:2] + c.a * np.array([math.cos(z[2]), math.sin(z[2])])
    hinge_rate = z[12:14] + c.a * z[14] * np.array([-math.sin(z[2]), math.cos(z[2])])
    tip = z[6:8] + c.tip_ahead * e
    tip_rate = z[18:20] + c.tip_ahead * z[20] * f
    h = float((tip - hinge) @ e)
    rate = float((tip_rate - hinge_rate) @ e)
    q = np.array([z[0], z[1], z[2], z[8], h, z[9], z[10], z[11]])
    v = np.array([z[12], z[13], z[14], z[20], rate, z[21], z[22], z[23]])
    return q, v


class DenseWhenAsked:
    """Dense output of a solver's last step, prepared where it is asked for."""

    def __init__(self, solver: DOP853) -> None:
        self.solver = solver
        self.dense: DenseOutput | None = None

    def __call__(self, t: float | np.ndarray) -> np.ndarray:
        if self.dense is None:
            self.dense = self.solver.dense_output()
        return np.asarray(self.dense(t))


class MaximalBench:
    """Steps the four bodies with SciPy's DOP853 from one located event to the next.

    ``solve_ivp`` itself looks for a change of sign between step ends only: it starts after
    an event with a gap of +-1e-18 m and then misses a touch that follows within the step.
    So each step is looked at in eighths by value and slope, never at its very start.

    Parameters
    ----------
    scene
        No latch closes in the run.
    t, q, v
        Start, in minimal coordinates; the target rests there if the scene has supports.
    rtol, atol
        As in SciPy.
    """

    def __init__(
        self,
        scene: Scene,
        t: float,
        q: np.ndarray,
        v: np.ndarray,
        rtol: float = 1e-13,
        atol: float = 1e-15,
    ) -> None:
        self.c = constants(scene)
        self.rtol, self.atol = rtol, atol
        self.t = t
        self.z = np.concatenate([*spread(scene, np.asarray(q), np.asarray(v)), np.zeros(2)])
        self.touching = np.zeros(2, dtype=bool)
        self.chi = np.zeros(2)
        # Coulomb's law: sign of the slip, 0 where the tip sticks; and of the probe in its slide
        self.sliding = np.array([1.0, 1.0, 0.0])
        # chaser, target, and the probe that its seat or friction holds
        at_rest = scene.supports is not None and not np.any(v[5:])
        is_held = self.c.preload > 0.0 or self.c.slide_friction > 0.0
        self.resting = np.array([False, at_rest, is_held])
        self.on_seat = self.c.preload > 0.0
        self.length_held = self.c.l_0
        self.open: list[Touch | None] = [None, None]
        self.seat_length = self.c.l_0  # of the spring when the probe left its seat, m
        self.wanted: list[float] = []
        self.ends = np.zeros((26, 2))  # states at both ends of the present step
        self.run = MaximalRun()

    def _rate(self, t: float, z: np.ndarray) -> np.ndarray:
        return motion(z, self.c, *self._state())

    def _state(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, float]:
        return self.touching, self.chi, self.sliding, self.resting, self.length_held

    def _reactions(self, z: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
        """Wrenches that hold the vehicles (2, 3), friction on the tip (2,), force of the seat."""
        return accelerations(z, self.c, *self._state())[1:]

    def _load(self, z: np.ndarray) -> float:
        """Share of the supports' limit that the resting target uses."""
        return limit_used(self._reactions(z)[0][1], self.c.balls[1], z[11])

    def _friction_margin(self, z: np.ndarray, wall: int) -> float:
        """Slip in its direction, m/s; for a sticking tip the friction that is left, N."""
        if self.sliding[wall] != 0.0:
            return slip(z, self.c, wall) * float(self.sliding[wall])
        normal, _ = contact_force(z, self.c, wall, self.chi[wall], 0.0)
        return self.c.mu_s * normal - abs(float(self._reactions(z)[1][wall]))

    def _hold_margin(self, z: np.ndarray) -> float:
        """What is left of the force that can hold the probe in its slide, N."""
        force, friction = self._reactions(z)[2], self.c.slide_friction
        return force + friction if self.on_seat else friction - abs(force)

    def _seat_margin(self, z: np.ndarray) -> float:
        """Distance to the seat, m."""
        return self.seat_length - spring_vector(z, self.c)[0]

    def _slide_margin(self, z: np.ndarray) -> float:
        """Rate of a sliding probe in its direction, m/s."""
        _, ex, ey, rate_x, rate_y = spring_vector(z, self.c)
        return float(self.sliding[2]) * (ex * rate_x + ey * rate_y)

    def _margins(self) -> list[tuple[Callable[[np.ndarray], float], float]]:
        """What ends the probe's present way of moving as it falls below a rounding."""
        if self.resting[2]:
            return [(self._hold_margin, 0.0)]
        found: list[tuple[Callable[[np.ndarray], float], float]] = []
        if self.c.preload > 0.0:
            found.append((self._seat_margin, SEAT_ROUNDING))
        if self.c.slide_friction > 0.0:
            found.append((self._slide_margin, 0.0))
        return found

    def _buffer_change(
        self, dense: DenseWhenAsked, t_a: float, t_b: float
    ) -> tuple[float, int] | None:
        """First time in a step when the probe's way of moving ends, and which of the margins."""
        times = t_a + PLACES * (t_b - t_a)
        states, first = dense(times).T, None
        for which, (margin, rounding) in enumerate(self._margins()):
            margins = [margin(z) for z in states]
            for k in range(1, times.size):
                if margins[k] < -rounding:
                    at = self._root(dense, margin, margins[k - 1], times[k - 1], times[k])
                    if first is None or at < first[0]:
                        first = at, which
                    break
        return first

    def _root(
        self,
        dense: DenseWhenAsked,
        margin: Callable[[np.ndarray], float],
        before: float,
        low: float,
        high: float,
    ) -> float:
        if before <= 0.0:
            # it has just changed: look for where it has gone the new way at all
            inside = low + (high - low) * np.logspace(-9, 0, 40)
            ahead = [t for t in inside if margin(dense(t)) > 0.0]
            if not ahead:
                return float(low)
            low = ahead[-1]
        return float(brentq(lambda t: margin(dense(t)), low, high, xtol=1e-17, rtol=1e-15))

    def _change_buffer(self, which: int) -> None:
        """Let the probe slide, hold it by friction, or let it strike its seat."""
        if self.resting[2]:
            self._let_slide()
        elif which == 0 and self.c.preload > 0.0:
            self._strike_seat()
        else:
            self._hold_by_friction()

    def _let_slide(self) -> None:
        """A held probe slides to the side to which its load exceeds what holds it."""
        (self.run.seat if self.on_seat else self.run.slide).append(self.t)
        inwards = self.on_seat or self._reactions(self.z)[2] < 0.0
        self.resting[2] = self.on_seat = False
        if self.c.slide_friction > 0.0:
            self.sliding[2] = -1.0 if inwards else 1.0
        # not l_0: what the constraint has drifted would be a distance
        if inwards and self.length_held == self.c.l_0:
            self.seat_length = spring_vector(self.z, self.c)[0]

    def _hold_by_friction(self) -> None:
        self.length_held = spring_vector(self.z, self.c)[0]
        self.sliding[2] = 0.0
        self.resting[2] = True
        self.run.slide.append(self.t)
        if self._hold_margin(self.z) < 0.0:
            self.run.slide.pop()
            self._let_slide()

    def _strike_seat(self) -> None:
        """An impact on the seat; a tip may slide the other way then."""
        self.run.seat.append(self.t)
        self.resting[2] = self.on_seat = True
        self.length_held, self.sliding[2] = self.c.l_0, 0.0
        self.z[12:24] = strike(self.z, self.c)
        for wall in range(2):
            moving = slip(self.z, self.c, wall)
            if self.touching[wall] and self.c.friction == FRICTION["coulomb"] and moving != 0.0:
                self.sliding[wall] = math.copysign(1.0, moving)
        if self._hold_margin(self.z) <= 0.0:
            self._let_slide()

    def _friction_change(
        self, dense: DenseWhenAsked, t_a: float, t_b: float, wall: int
    ) -> float | None:
        """First time in a step when the tip stops sliding, or sticking, on a wall."""
        times = t_a + PLACES * (t_b - t_a)
        if self.sliding[wall] == 0.0:
            margins = [self._friction_margin(z, wall) for z in dense(times).T]
        else:
            _, _, _, slips = along_a_step(dense(times), self.c, wall, 0.0)
            margins = list(slips * self.sliding[wall])
        for k in range(1, times.size):
            if margins[k] >= 0.0:
                continue
            low, high = times[k - 1], times[k]
            if margins[k - 1] <= 0.0:
                # it has just changed: look for where it has gone the new way at all
                inside = low + (high - low) * np.logspace(-9, 0, 40)
                ahead = [t for t in inside if self._friction_margin(dense(t), wall) > 0.0]
                if not ahead:
                    return float(low)
                low = ahead[-1]
            return float(
                brentq(
                    lambda t: self._friction_margin(dense(t), wall),
                    low,
                    high,
                    xtol=1e-17,
                    rtol=1e-15,
                )
            )
        return None

    def _change_friction(self, wall: int) -> None:
        """Stick where friction can hold the tip, else slide the way that it cannot prevent."""
        was = self.sliding[wall]
        self.sliding[wall] = 0.0
        needed = float(self._reactions(self.z)[1][wall])
        normal, _ = contact_force(self.z, self.c, wall, self.chi[wall], 0.0)
        if was == 0.0 or abs(needed) >= self.c.mu_s * normal:
            self.sliding[wall] = 1.0 if needed < 0.0 else -1.0

    def _crossing(self, dense: DenseWhenAsked, t_a: float, t_b: float, wall: int) -> float | None:
        """First time in a step when the gap (or, touching, the depth) goes below zero."""
        sign = -1.0 if self.touching[wall] else 1.0

        def value(t: float) -> float:
            return sign * wall_contact(dense(t), self.c, wall)[0]

        def slope(t: float) -> float:
            return sign * wall_contact(dense(t), self.c, wall)[1]

        gaps, rates, _, _ = along_a_step(self.ends, self.c, wall, 0.0)
        if (sign * gaps).min() > 2.0 * (t_b - t_a) * np.abs(rates).sum():
            return None  # too far off
        times = t_a + PLACES * (t_b - t_a)
        gaps, rates, _, _ = along_a_step(dense(times), self.c, wall, 0.0)
        gaps, rates = sign * gaps, sign * rates
        for k in range(1, times.size):
            low, high = times[k - 1], times[k]
            if gaps[k] >= 0.0:
                if not (rates[k - 1] < 0.0 < rates[k]):
                    continue
                dip = brentq(slope, low, high, xtol=1e-16)
                if value(dip) >= 0.0:
                    continue
                high = dip
            if k == 1:
                # the start may be on the wall to rounding: begin where the gap is widest
                if rates[0] <= 0.0 and gaps[0] <= 1e-16:
                    return float(low)
                if rates[0] > 0.0:
                    low = brentq(slope, low, high, xtol=1e-16)
            return float(brentq(value, low, high, xtol=1e-17, rtol=1e-15))
        return None

    def _watch_peak(self, dense: DenseWhenAsked, t_a: float, t_b: float) -> None:
        times = t_a + PLACES * (t_b - t_a)
        for wall, touch in enumerate(self.open):
            if touch is None:
                continue
            chi = self.chi[wall]
            _, _, forces, _ = along_a_step(self.ends, self.c, wall, chi)
            if forces.max() < 0.5 * touch.peak:
                continue  # steps are a small part of the contact's period
            _, _, forces, _ = along_a_step(dense(times), self.c, wall, chi)
            best = int(np.argmax(forces))
            if forces[best] < 0.99 * touch.peak:
                continue

            def pull(t: float, wall: int = wall, chi: float = chi) -> float:
                return -contact_force(dense(t), self.c, wall, chi, 0.0)[0]

            bounds = (times[max(best - 1, 0)], times[min(best + 1, times.size - 1)])
            top = minimize_scalar(pull, bounds=bounds, method="bounded", options={"xatol": 1e-12})
            if -top.fun > touch.peak:
                touch.peak, touch.peak_time = float(-top.fun), float(top.x)

    def _begin(self, wall: int) -> None:
        speed = max(-wall_contact(self.z, self.c, wall)[1], 0.0)
        self.touching[wall] = True
        self.sliding[wall] = 1.0 if slip(self.z, self.c, wall) >= 0.0 else -1.0
        self.chi[wall] = self.c.damping * self.c.K / max(speed, self.c.v_0_floor)
        touch = Touch(1 - 2 * wall, self.t, speed)
        self.open[wall] = touch
        self.run.touches.append(touch)

    def _end(self, wall: int) -> None:
        touch = self.open[wall]
        assert touch is not None
        touch.end = self.t
        self.open[wall] = None
        self.touching[wall] = False

    def _step(self, solver: DOP853) -> bool:
        """Take one step up to the first event in it; tells whether there was one."""
        solver.step()
        if solver.status == "failed":
            raise RuntimeError(f"SciPy gave up at t = {self.t}")
        dense = DenseWhenAsked(solver)
        self.ends = np.column_stack([self.z, solver.y])
        t_a, t_b = self.t, solver.t
        first, happening = t_b, None
        for wall in range(2):
            at = self._crossing(dense, t_a, t_b, wall)
            if at is not None and (at < first or happening is None):
                first, happening = at, wall
            if self.c.friction == FRICTION["coulomb"] and self.touching[wall]:
                at = self._friction_change(dense, t_a, t_b, wall)
                if at is not None and (at < first or happening is None):
                    first, happening = at, 3 + wall
        if self._margins():
            change = self._buffer_change(dense, t_a, t_b)
            if change is not None and (change[0] < first or happening is None):
                first, happening = change[0], 5 + change[1]
        if self.resting[1] and self.touching.any() and self._load(dense(first)) > 1.0:
            first = brentq(lambda t: self._load(dense(t)) - 1.0, t_a, first, xtol=1e-16)
            happening = 2
        while self.wanted and self.wanted[0] <= first:
            z = dense(self.wanted.pop(0))
            q, v = gather(self.c, z)
            self.run.q.append(q)
            self.run.v.append(v)
            self.run.impulse.append(z[24:].copy())
        self._watch_peak(dense, t_a, first)
        self.z = dense(first) if happening is not None else solver.y.copy()
        self.t = first
        phi = np.zeros(4)
        constraints(self.z, self.c, phi, np.zeros(4), np.zeros((4, 12)))
        self.run.drift = max(self.run.drift, float(np.abs(phi).max()))
        if happening is None:
            return False
        if happening == 2:
            self.resting[1] = False
            self.run.moving.append(self.t)
        elif happening >= 5:
            self._change_buffer(happening - 5)
        elif happening >= 3:
            self._change_friction(happening - 3)
        elif self.touching[happening]:
            self._end(happening)
        else:
            self._begin(happening)
        return True

    def advance(self, times: list[float]) -> MaximalRun:
        """Run to the last of ``times`` (s), all of them ahead."""
        self.wanted = list(times)
        while self.wanted:
            solver = DOP853(
                self._rate,
                self.t,
                self.z,
                times[-1],
                max_step=LONGEST_STEP,
                rtol=self.rtol,
                atol=self.atol,
                first_step=min(1e-7, times[-1] - self.t),
            )
            while solver.status == "running" and not self._step(solver):
                pass
        return self.run
