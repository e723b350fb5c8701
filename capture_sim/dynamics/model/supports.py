"""Three ball-shaped supports: loads, rolling resistance, and the limit at rest.

The resistance of each ball is c_rr N against its velocity.  At rest, the three forces balance the
applied wrench as long as none exceeds c_rr N; the wrenches that can be balanced form a convex set
(the friction limit surface of Goyal, Ruina and Papadopoulos, 1991).  ``load_factor`` returns the
share of this limit that an applied wrench uses.
"""

from __future__ import annotations

import math

import numpy as np

from capture_sim.base.compiled.kernels import inline_kernel, kernel


@inline_kernel
def rolling_wrench(
    vx: float, vy: float, omega: float, c: float, s: float, balls: np.ndarray, v_eps: float
) -> tuple[float, float, float, float]:
    """Return rolling resistance on a vehicle: force x, y (N), torque (N m), power lost (W).

    ``balls`` (3, 3): x, y in the vehicle's frame (m) and limit c_rr N (N); ``c, s`` cosine
    and sine of its heading.  Below ``v_eps`` (m/s) the resistance falls off smoothly.
    """
    fx = 0.0
    fy = 0.0
    torque = 0.0
    power = 0.0
    for i in range(3):
        rx = c * balls[i, 0] - s * balls[i, 1]
        ry = s * balls[i, 0] + c * balls[i, 1]
        ux = vx - omega * ry
        uy = vy + omega * rx
        square = ux * ux + uy * uy
        g = balls[i, 2] / math.sqrt(square + v_eps * v_eps)
        fx -= g * ux
        fy -= g * uy
        torque -= g * (rx * uy - ry * ux)
        power += g * square
    return fx, fy, torque, power


@kernel
def fastest_ball(
    vx: float, vy: float, omega: float, c: float, s: float, balls: np.ndarray
) -> float:
    """Return the speed of the fastest ball, m/s."""
    fastest = 0.0
    for i in range(3):
        rx = c * balls[i, 0] - s * balls[i, 1]
        ry = s * balls[i, 0] + c * balls[i, 1]
        ux = vx - omega * ry
        uy = vy + omega * rx
        fastest = max(fastest, ux * ux + uy * uy)
    return math.sqrt(fastest)


@kernel
def load_factor(
    fx: float, fy: float, torque: float, c: float, s: float, balls: np.ndarray
) -> float:
    """Return the share of the supports' limit that a wrench uses; above 1 the vehicle moves.

    It is the maximum of (power of the wrench) / (power that the balls dissipate) over all motions
    of the body.  For a turn about one of the balls, where that ratio has a corner, there is a
    closed form; all other motions are searched by iteratively reweighted least squares.
    """
    limit = balls[0, 2] + balls[1, 2] + balls[2, 2]
    if limit <= 0.0:
        return math.inf
    if fx == 0.0 and fy == 0.0 and torque == 0.0:
        return 0.0
    # in the vehicle's frame, with the distance of the farthest ball as unit of length
    arm = 0.0
    for i in range(3):
        arm = max(arm, math.hypot(balls[i, 0], balls[i, 1]))
    if arm == 0.0:
        arm = 1.0
    w0, w1, w2 = c * fx + s * fy, c * fy - s * fx, torque / arm
    share = 0.0
    for i in range(3):
        ratio, held = share_by_turn(w0, w1, w2, balls, i, arm)
        if held:
            return ratio
        share = max(share, ratio)
    return max(share, share_by_search(w0, w1, w2, balls, arm))


@kernel
def share_by_turn(w0, w1, w2, balls, i, arm):
    """Return the share of the limit for a turn about ball ``i``, and whether it is the maximum.

    It is the maximum if ball ``i``, which does not move, can balance the rest of the wrench.
    """
    resisted = f0 = f1 = 0.0
    for j in range(3):
        dx, dy = (balls[j, 0] - balls[i, 0]) / arm, (balls[j, 1] - balls[i, 1]) / arm
        distance = math.sqrt(dx * dx + dy * dy)
        if distance > 0.0:
            resisted += balls[j, 2] * distance
            f0 -= balls[j, 2] * dy / distance
            f1 += balls[j, 2] * dx / distance
    moment = w2 - (balls[i, 0] * w1 - balls[i, 1] * w0) / arm
    if resisted <= 0.0:
        return 0.0, False
    ratio = abs(moment) / resisted
    turned = math.copysign(ratio, moment)
    return ratio, math.hypot(w0 - turned * f0, w1 - turned * f1) <= ratio * balls[i, 2]


@kernel
def share_by_search(w0, w1, w2, balls, arm):
    """Return the largest share of the limit over all motions, by an iteration from below."""
    norm = math.sqrt(w0 * w0 + w1 * w1 + w2 * w2)
    w0, w1, w2 = w0 / norm, w1 / norm, w2 / norm
    best = math.inf
    g0 = balls[0, 2]
    g1 = balls[1, 2]
    g2 = balls[2, 2]
    floor = 1e-12
    for _ in range(200):
        axx = ayy = att = axt = ayt = 0.0
        for i in range(3):
            g = g0 if i == 0 else (g1 if i == 1 else g2)
            rx = balls[i, 0] / arm
            ry = balls[i, 1] / arm
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
            speed = math.hypot(x - t * balls[i, 1] / arm, y + t * balls[i, 0] / arm)
            resisted += balls[i, 2] * speed
            g = balls[i, 2] / max(speed, floor)
            if i == 0:
                g0 = g
            elif i == 1:
                g1 = g
            else:
                g2 = g
        done = resisted >= best * (1.0 - 1e-13)
        best = min(best, resisted)
        if done:
            break
    return norm / best
