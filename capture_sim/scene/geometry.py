"""Geometry of the tip and the cone: where the tip is, and its distance to the walls.

In the target's frame BE, the inner edge of the cone, lies at x = -L_T.  Each wall is described in
coordinates (u, Y) of its own: u is the distance ahead of BE, towards the chaser; Y is the offset
from the axis towards this wall, which is +y for the wall at +y and -y for the wall at -y.  A wall
is a thin plate that begins at (0, R_c), R_c being the half-width of BE, and has the length L_c at
the half-angle beta to the axis.  The tip may meet its face, its inner edge and its outer lip.
"""

from __future__ import annotations

import math
from typing import Any

from capture_sim.base.compiled.kernels import inline_kernel


@inline_kernel
def tip_motion(
    y: Any, a: float, sS: Any, cS: Any, sP: Any, cP: Any, sT: Any, cT: Any
) -> tuple[Any, Any, Any, Any]:
    """Return the position (x, y), m, and velocity (x, y), m/s, of the tip in the target's frame.

    The velocity is that seen from the target, which may rotate.  ``y`` (16,) has the coordinates
    x_S, y_S, theta_S, theta_P, h, x_T, y_T, theta_T (chaser, probe, target; m and rad), then their
    rates.  ``a`` is the hinge's distance from the chaser's centre of mass, m.  sS to cT are the
    sines and cosines of theta_S, theta_P and theta_T.
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
    """Return the distance of the tip's centre to a wall, and the unit normal towards the tip.

    The result is (distance, n_u, n_Y); the distance (m) is never negative.  (u, Y) is the tip's
    centre, m, as the module describes it; R_c and L_c are in m; cos_b and sin_b are those of the
    half-angle.  A centre on the wall itself gets the normal of the face.
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
    """Return the curvature of a wall's distance function across the normal, 1/m.

    It is 0 where the face is nearest to the tip's centre (u, Y), and 1/distance where an end of
    the wall is nearest, but 0 at a distance of 0.  ``distance`` (m) is that of
    :func:`nearest_on_wall`, which also describes the arguments.
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
    """Return how far a tip moves along a straight line until it touches a wall, m.

    The result is ``inf`` if the tip misses the wall.  The tip's radius is ``reach`` (m); its centre
    starts at (u, Y), m, clear of the wall, and moves in the unit direction (du, dY).  R_c and L_c
    are in m, ``beta`` is the half-angle, rad.  Closed form: where the tip touches, its centre is on
    one of two lines parallel to the wall, or on a circle about one end of the wall.
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
