"""Three ball supports of a vehicle: rolling resistance, and the limit of the load at rest.

The resistance of each ball is c_rr N, opposite to its velocity.  At rest, the forces of the three
balls balance the applied wrench as long as no force needs to exceed c_rr N.  The wrenches that can
be balanced form a convex set (the friction limit surface of Goyal, Ruina and Papadopoulos, 1991).
:func:`load_factor` returns the share of this limit that an applied wrench uses.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any

import numpy as np

from capture_sim.base.compiled.kernels import inline_kernel, kernel
from capture_sim.base.compiled.vectors import vectorized

#: Share of the squared limit below which a squared force is certainly held, despite round-off.
_EASILY = 0.98
#: Shape of the balls of a vehicle for the kernels: rows are x and y in the vehicle's frame (m) and
#: the limit c_rr N (N) of three balls.  A fourth, empty column fills a vector register.
BALLS = (3, 4)


def ball_rows(places: Iterable[tuple[float, float]], limits: Iterable[float]) -> list[list[float]]:
    """Return the rows of shape BALLS for three balls at ``places`` (m) with limits c_rr N (N)."""
    xs, ys = zip(*places, strict=True)
    return [[*xs, 0.0], [*ys, 0.0], [*limits, 0.0]]


@inline_kernel
def rolling_wrench(
    vx: float, vy: float, omega: float, c: float, s: float, balls: np.ndarray, v_eps: float
) -> tuple[float, float, float, float]:
    """Return rolling resistance on a vehicle: force x, y (N), torque (N m), dissipated power (W).

    Force and velocity are in the world's axes.  ``balls`` are of the shape BALLS; ``c`` and ``s``
    are cosine and sine of the vehicle's heading.  Below ``v_eps`` (m/s) the resistance decreases
    smoothly to 0.
    """
    # in the vehicle's frame
    along, across, torque = resistance(c * vx + s * vy, c * vy - s * vx, omega, balls, v_eps)
    fx = s * across - c * along
    fy = -s * along - c * across
    return fx, fy, -torque, torque * omega - fx * vx - fy * vy


@inline_kernel
def resistance_of_each(ux, uy, omega, balls, v_eps):
    """Return the force x, y (N) and torque (N m) that the balls exert on the floor.

    Velocity and force are in the vehicle's frame.  The resistance on the vehicle is the opposite.
    """
    fx = 0.0
    fy = 0.0
    torque = 0.0
    for i in range(3):
        bx = ux - omega * balls[1, i]
        by = uy + omega * balls[0, i]
        g = balls[2, i] / math.sqrt(v_eps * v_eps + bx * bx + by * by)
        fx += g * bx
        fy += g * by
        torque += balls[0, i] * (g * by) - balls[1, i] * (g * bx)
    return fx, fy, torque


@vectorized(resistance_of_each, results=3)
def resistance(code: Any, ux: Any, uy: Any, omega: Any, balls: Any, v_eps: Any) -> list[Any]:
    """Write vector code for :func:`resistance_of_each`, with the three balls in one register.

    A square root and a division need the same time for four numbers as for one number.
    """
    x, y, limit = (code.load(balls, 4 * row, 4) for row in range(3))
    ux, uy, omega, v_eps = (code.broadcast(value, 4) for value in (ux, uy, omega, v_eps))
    bx = code.multiply_add(code.negative(omega), y, ux, 4)
    by = code.multiply_add(omega, x, uy, 4)
    square = code.multiply_add(bx, bx, code.multiply(v_eps, v_eps), 4)
    square = code.multiply_add(by, by, square, 4)
    g = code.divide(limit, code.root(square, 4))
    fx, fy = code.multiply(g, bx), code.multiply(g, by)
    torque = code.multiply_add(code.negative(y), fx, code.multiply(x, fy), 4)
    totals = []
    for values in (fx, fy, torque):
        total = code.lane(values, 0, 4)
        for k in (1, 2):
            total = code.add(total, code.lane(values, k, 4))
        totals.append(total)
    return totals


@kernel
def fastest_ball(
    vx: float, vy: float, omega: float, c: float, s: float, balls: np.ndarray
) -> float:
    """Return the speed over the floor of the fastest of a vehicle's three balls, m/s.

    ``c`` and ``s`` are cosine and sine of the vehicle's heading.
    """
    fastest = 0.0
    for i in range(3):
        rx = c * balls[0, i] - s * balls[1, i]
        ry = s * balls[0, i] + c * balls[1, i]
        ux = vx - omega * ry
        uy = vy + omega * rx
        fastest = max(fastest, ux * ux + uy * uy)
    return math.sqrt(fastest)


@kernel
def is_held(
    fx: float, fy: float, torque: float, c: float, s: float, balls: np.ndarray, share: float
) -> bool:
    """Return True if the supports can balance a wrench with at most ``share`` of their limit.

    The force (N) is in the world's axes; ``c`` and ``s`` are cosine and sine of the heading.
    """
    if is_easily_held(fx, fy, torque, c, s, balls, share):
        return True
    return load_factor(fx, fy, torque, c, s, balls, share) <= share


@inline_kernel
def is_easily_held(fx, fy, torque, c, s, balls, share):
    """Return True if the supports certainly hold a wrench with less than ``share`` of their limit.

    The test is cheap and sufficient.  It checks one possible distribution: the force is shared in
    proportion to the limits, and the torque is balanced by forces around their centre.  If the
    result is False, the wrench may still be held.
    """
    limit = balls[2, 0] + balls[2, 1] + balls[2, 2]
    if limit <= 0.0:
        return False
    x = (balls[0, 0] * balls[2, 0] + balls[0, 1] * balls[2, 1] + balls[0, 2] * balls[2, 2]) / limit
    y = (balls[1, 0] * balls[2, 0] + balls[1, 1] * balls[2, 1] + balls[1, 2] * balls[2, 2]) / limit
    along, across = (c * fx + s * fy) / limit, (c * fy - s * fx) / limit
    spread = 0.0
    for i in range(3):
        dx, dy = balls[0, i] - x, balls[1, i] - y
        spread += balls[2, i] * (dx * dx + dy * dy)
    moment = torque - limit * (x * across - y * along)
    turning = moment / spread if spread > 0.0 else 0.0
    if spread == 0.0 and moment != 0.0:
        return False
    for i in range(3):
        if balls[2, i] > 0.0:
            force_x = along - turning * (balls[1, i] - y)
            force_y = across + turning * (balls[0, i] - x)
            if force_x * force_x + force_y * force_y > _EASILY * share * share:
                return False
    return True


@kernel
def load_factor(
    fx: float,
    fy: float,
    torque: float,
    c: float,
    s: float,
    balls: np.ndarray,
    enough: float = math.inf,
) -> float:
    """Return the share of the supports' limit that a wrench uses; above 1 the vehicle moves.

    If the share exceeds ``enough``, the search may end early.  The result is then a lower limit
    that also exceeds ``enough``.

    The share is the maximum of (power of the wrench) / (power that the balls dissipate) over all
    motions of the body.  For a rotation about one of the balls, where this ratio is not smooth,
    there is a closed form.  All other motions are searched by iteratively reweighted least squares.
    """
    limit = balls[2, 0] + balls[2, 1] + balls[2, 2]
    if limit <= 0.0:
        return math.inf
    if fx == 0.0 and fy == 0.0 and torque == 0.0:
        return 0.0
    # in the vehicle's frame; the unit of length is the distance of the farthest ball
    arm = 0.0
    for i in range(3):
        arm = max(arm, math.hypot(balls[0, i], balls[1, i]))
    if arm == 0.0:
        arm = 1.0
    w0, w1, w2 = c * fx + s * fy, c * fy - s * fx, torque / arm
    share = 0.0
    for i in range(3):
        ratio, held = share_by_turn(w0, w1, w2, balls, i, arm)
        if held:
            return ratio
        share = max(share, ratio)
    if share > enough:
        return share
    return max(share, share_by_search(w0, w1, w2, balls, arm, enough))


@kernel
def share_by_turn(w0, w1, w2, balls, i, arm):
    """Return the share of the limit for a rotation about ball ``i``, and True if it is the maximum.

    It is the maximum over all motions if ball ``i``, which does not move, can balance the rest of
    the wrench.
    """
    resisted = f0 = f1 = 0.0
    for j in range(3):
        dx, dy = (balls[0, j] - balls[0, i]) / arm, (balls[1, j] - balls[1, i]) / arm
        distance = math.sqrt(dx * dx + dy * dy)
        if distance > 0.0:
            resisted += balls[2, j] * distance
            f0 -= balls[2, j] * dy / distance
            f1 += balls[2, j] * dx / distance
    moment = w2 - (balls[0, i] * w1 - balls[1, i] * w0) / arm
    if resisted <= 0.0:
        return 0.0, False
    ratio = abs(moment) / resisted
    turned = math.copysign(ratio, moment)
    return ratio, math.hypot(w0 - turned * f0, w1 - turned * f1) <= ratio * balls[2, i]


@kernel
def share_by_search(w0, w1, w2, balls, arm, enough):
    """Return the share of the supports' limit that a wrench uses, see :func:`load_factor`.

    It is the largest ratio of power to dissipation over all planar motions of the vehicle, found by
    an iteration from below, which ends early above ``enough``.  ``w0``, ``w1`` are the force in the
    vehicle's frame (N); ``w2`` is the torque divided by ``arm`` (m), the unit of length.
    """
    norm = math.sqrt(w0 * w0 + w1 * w1 + w2 * w2)
    w0, w1, w2 = w0 / norm, w1 / norm, w2 / norm
    best = math.inf
    g0 = balls[2, 0]
    g1 = balls[2, 1]
    g2 = balls[2, 2]
    floor = 1e-12
    for _ in range(200):
        axx = ayy = att = axt = ayt = 0.0
        for i in range(3):
            g = g0 if i == 0 else (g1 if i == 1 else g2)
            rx = balls[0, i] / arm
            ry = balls[1, i] / arm
            axx += g
            axt -= g * ry
            ayt += g * rx
            att += g * (rx * rx + ry * ry)
        ayy = axx
        # A xi = w by elimination; A is symmetric and positive definite
        schur = att - axt * axt / axx - ayt * ayt / ayy
        if schur <= 1e-14 * axx:
            schur = 1e-14 * axx
        t = (w2 - axt / axx * w0 - ayt / ayy * w1) / schur
        x = (w0 - axt * t) / axx
        y = (w1 - ayt * t) / ayy
        power = w0 * x + w1 * y + w2 * t
        x, y, t = x / power, y / power, t / power
        resisted = 0.0
        for i in range(3):
            ux, uy = x - t * balls[1, i] / arm, y + t * balls[0, i] / arm
            speed = math.sqrt(ux * ux + uy * uy)  # a third of the time of hypot
            resisted += balls[2, i] * speed
            g = balls[2, i] / max(speed, floor)
            if i == 0:
                g0 = g
            elif i == 1:
                g1 = g
            else:
                g2 = g
        done = resisted >= best * (1.0 - 1e-13)
        best = min(best, resisted)
        if done or norm > enough * best:
            break
    return norm / best
