"""Geometry of the tip and the cone: where the tip is, and its distance to the walls.

In the target's frame the line BE lies at x = -L_T.  Both walls are described in
(u, Y): u is the distance ahead of BE, towards the chaser; Y the offset from the axis
towards the wall in question (+y for the one, -y for the other).  A wall runs from
(0, R_c) over the generatrix L_c at the half-angle beta, and is a thin plate: the tip may
meet its face, its inner edge and its outer lip.
"""

from __future__ import annotations

import math
from typing import Any

from capture_sim.base.compiled.kernels import inline_kernel


@inline_kernel
def tip_motion(
    y: Any, a: float, sS: Any, cS: Any, sP: Any, cP: Any, sT: Any, cT: Any
) -> tuple[Any, Any, Any, Any]:
    """Return the tip's position (m) and velocity (m/s) in the target's frame.

    ``y`` has coordinates and rates, (16,); ``a`` is the hinge's offset, m; sS to cT are the sines
    and cosines of theta_S, theta_P and theta_T.
    """
    h, swing, spin = y[4], a * y[10], y[4] * y[11]
    rx = y[0] + a * cS + h * cP - y[5]
    ry = y[1] + a * sS + h * sP - y[6]
    ux = y[8] - swing * sS + y[12] * cP - spin * sP - y[13]
    uy = y[9] + swing * cS + y[12] * sP + spin * cP - y[14]
    px = cT * rx + sT * ry
    py = cT * ry - sT * rx
    wx = cT * ux + sT * uy + y[15] * py
    wy = cT * uy - sT * ux - y[15] * px
    return px, py, wx, wy


@inline_kernel
def nearest_on_wall(
    u: float, Y: float, R_c: float, L_c: float, cos_b: float, sin_b: float
) -> tuple[float, float, float]:
    """Return the tip's distance to a wall and the unit normal (n_u, n_Y) towards the tip.

    Lengths in m; the distance is to the tip's centre and never negative.
    """
    along = u * cos_b + (Y - R_c) * sin_b
    if along <= 0.0:
        du, dY = u, Y - R_c
    elif along >= L_c:
        du, dY = u - L_c * cos_b, Y - R_c - L_c * sin_b
    else:
        across = u * sin_b - (Y - R_c) * cos_b
        if across >= 0.0:
            return across, sin_b, -cos_b
        return -across, -sin_b, cos_b
    distance = math.sqrt(du * du + dY * dY)
    if distance == 0.0:
        # the centre is exactly on the edge: every normal is valid; use that of the face
        return 0.0, sin_b, -cos_b
    return distance, du / distance, dY / distance


@inline_kernel
def wall_curvature(
    u: float, Y: float, distance: float, R_c: float, L_c: float, cos_b: float, sin_b: float
) -> float:
    """Return the curvature of a wall's distance function across the normal, 1/m; 0 over its face.

    ``distance`` (m) is the distance of the tip's centre, see :func:`nearest_on_wall`.
    """
    along = u * cos_b + (Y - R_c) * sin_b
    if 0.0 < along < L_c or distance == 0.0:
        return 0.0
    return 1.0 / distance


def travel_to_wall(
    u: float,
    Y: float,
    du: float,
    dY: float,
    reach: float,
    R_c: float,
    L_c: float,
    beta: float,
) -> float:
    """Return the travel of a tip of radius ``reach`` (m) along a line to its touch of a wall, m.

    Its centre starts at (u, Y), m, in the unit direction (du, dY); ``inf`` if it misses the wall.
    Closed form: the centres that touch are two lines parallel to the wall, joined by circles about
    its ends.
    """
    cos_b, sin_b = math.cos(beta), math.sin(beta)
    hits = [math.inf]
    # the face's offset line: across = reach, on the side where the tip starts
    across = u * sin_b - (Y - R_c) * cos_b
    rate = du * sin_b - dY * cos_b
    if rate != 0.0:
        travel = (math.copysign(reach, across) - across) / rate
        along = (u + travel * du) * cos_b + (Y + travel * dY - R_c) * sin_b
        if travel >= 0.0 and 0.0 <= along <= L_c:
            hits.append(travel)
    for end_u, end_Y in ((0.0, R_c), (L_c * cos_b, R_c + L_c * sin_b)):
        pu, pY = u - end_u, Y - end_Y
        half = pu * du + pY * dY
        root = half * half - (pu * pu + pY * pY - reach * reach)
        if root >= 0.0 and -half - math.sqrt(root) >= 0.0:
            hits.append(-half - math.sqrt(root))
    return min(hits)
