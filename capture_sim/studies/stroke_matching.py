"""Springs for wanted strokes: steps 1 to 5 of the paper's design flow.

The unknowns are log k_A and log k_T, what is to vanish is the log of the strokes' ratio to the
wish: in these, a spring's energy balance (stroke ~ k^-1/2 along the probe, ~ k^-1 across it) is
a straight line, and Broyden's method, started from it, needs few runs.  The strokes have corners,
though, where a touch more or less falls into the first contact.  Where the method does not come
through, it starts again from the best places of a coarse grid of springs, and last a simplex
search goes on from the best that was found.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import minimize

from capture_sim.scene.parts import Scene
from capture_sim.studies.first_contact import FirstContact, run_first_contact

#: Springs that are tried, N/m and N m/rad.
AXIAL_RANGE = (1.0, 1e6)
TORSION_RANGE = (0.1, 1e6)

#: To this part of the wish the search goes on.
CLOSE = 5e-4

#: To this part of the wish strokes count as met.
ACCEPTED = 0.01

_MOST_BROYDEN = 24
_AXIAL_GRID = np.geomspace(20.0, 2e4, 7)
_TORSION_GRID = np.geomspace(5.0, 2e4, 7)
_RESTARTS = 4
_MOST_SIMPLEX = 120
_LONGEST_MOVE = 1.5  # of a logarithm, in one step


@dataclass(frozen=True)
class Match:
    """What the search for springs found.

    Attributes
    ----------
    k_A, k_T : float
        N/m and N m/rad.
    contact : FirstContact
        With these springs.
    miss : float
        Largest relative difference of a stroke from the wish.
    runs : int
        That it took.
    """

    k_A: float
    k_T: float
    contact: FirstContact
    miss: float
    runs: int

    @property
    def met(self) -> bool:
        """Whether both strokes are those wished for."""
        return self.miss <= ACCEPTED


def with_buffer(scene: Scene, k_A: float, k_T: float, c_A: float) -> Scene:
    """Return a scene with another buffer."""
    return replace(scene, buffer=replace(scene.buffer, k_A=k_A, k_T=k_T, c_A=c_A))


def guess(scene: Scene, axial_stroke: float, torsion: float, speed: float) -> tuple[float, float]:
    """Return springs (N/m, N m/rad) that would take up the approach's energy at the wished strokes.

    The reduced mass of both vehicles, brought to rest along the axis by the axial spring; the
    torsional spring bears, at the tip, the lateral part of that force on a wall at the cone's
    angle with its friction.
    """
    chaser, target = scene.chaser_total_mass, scene.target.mass
    k_A = chaser * target / (chaser + target) * (speed / axial_stroke) ** 2
    mu = scene.friction.mu if scene.friction.law != "none" else 0.0
    tangent = math.tan(scene.cone.beta)
    lateral = max(1.0 - mu * tangent, 0.1) / (tangent + mu)
    return k_A, k_A * axial_stroke * lateral * scene.rest_length / torsion


def match_strokes(
    scene: Scene,
    axial_stroke: float,
    torsion: float,
    c_A: float,
    start: tuple[float, float],
    thorough: bool = True,
    tell: Callable[[float, float, float, FirstContact], None] | None = None,
) -> Match:
    """Find the springs with which the first contact has the wished strokes.

    Parameters
    ----------
    scene
        Its springs count nothing.
    axial_stroke, torsion
        m and rad, both positive.
    c_A
        Axial damping while it is tried, N s/m; the paper's flow has none in this step.
    start
        k_A and k_T to start from.
    thorough
        Search on where Broyden's method from there does not come through.
    tell
        Hears of every run: k_A, k_T, c_A and what came of it.

    Returns
    -------
    Match
        The best that was found; ``met`` tells whether it is good enough.
    """
    low = np.log([AXIAL_RANGE[0], TORSION_RANGE[0]])
    high = np.log([AXIAL_RANGE[1], TORSION_RANGE[1]])
    seen: list[tuple[float, np.ndarray, FirstContact]] = []

    def residual(x: np.ndarray) -> np.ndarray:
        k_A, k_T = np.exp(x).tolist()
        contact = run_first_contact(with_buffer(scene, k_A, k_T, c_A))
        if tell is not None:
            tell(k_A, k_T, c_A, contact)
        # a stroke of nothing is as far off as the range of springs allows
        strokes = np.maximum([contact.axial_stroke, contact.torsion], 1e-12)
        r = np.log(strokes / [axial_stroke, torsion])
        if contact.failure:
            r[0] = max(r[0], 1.0)  # the probe went in up to its tip: far too soft
        seen.append((float(np.abs(np.expm1(r)).max()), x.copy(), contact))
        return r

    def best() -> tuple[float, np.ndarray, FirstContact]:
        return min(seen, key=lambda one: one[0])

    _broyden(residual, np.clip(np.log(start), low, high), low, high)
    if best()[0] > CLOSE and thorough:
        grid = [np.log([k_A, k_T]) for k_A in _AXIAL_GRID for k_T in _TORSION_GRID]
        tried = len(seen)
        for x in grid:
            residual(x)
        for _, x, _ in sorted(seen[tried:], key=lambda one: one[0])[:_RESTARTS]:
            if best()[0] > CLOSE:
                _broyden(residual, x, low, high)
    if CLOSE < best()[0] < 0.5 and thorough:
        _simplex(residual, best()[1], best()[0], low, high)
    miss, x, contact = best()
    k_A, k_T = np.exp(x).tolist()
    return Match(k_A, k_T, contact, miss, len(seen))


def _broyden(
    residual: Callable[[np.ndarray], np.ndarray], x: np.ndarray, low: np.ndarray, high: np.ndarray
) -> None:
    """Go from ``x`` towards residual zero, for as long as that seems worth it."""
    r = residual(x)
    # slope of the residual: a spring's energy along, its balance of moments across
    slope = np.diag([-0.5, -1.0])
    for _ in range(_MOST_BROYDEN):
        if np.abs(np.expm1(r)).max() <= CLOSE:
            return
        move = -np.linalg.solve(slope, r)
        move *= min(1.0, _LONGEST_MOVE / np.abs(move).max())
        moved = np.clip(x + move, low, high) - x
        if np.abs(moved).max() < 1e-9:
            return  # pressed against the end of the range
        x = x + moved
        before, r = r, residual(x)
        slope = slope + np.outer(r - before - slope @ moved, moved) / (moved @ moved)
        if not abs(np.linalg.det(slope)) > 0.02:
            slope = np.diag([-0.5, -1.0])


class _FoundError(Exception):
    """The simplex has come close enough."""


def _simplex(
    residual: Callable[[np.ndarray], np.ndarray],
    x: np.ndarray,
    miss: float,
    low: np.ndarray,
    high: np.ndarray,
) -> None:
    """Search round the best place that Broyden's method has come to."""

    def size(place: np.ndarray) -> float:
        r = residual(place)
        if np.abs(np.expm1(r)).max() <= CLOSE:
            raise _FoundError
        return float(r @ r)

    width = max(2.0 * miss, 0.02)
    corners = np.clip(x + width * np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]]), low, high)
    options = {"initial_simplex": corners, "maxfev": _MOST_SIMPLEX, "xatol": 1e-6, "fatol": 1e-12}
    try:
        minimize(
            size, x, method="Nelder-Mead", bounds=list(zip(low, high, strict=True)), options=options
        )
    except _FoundError:
        return
