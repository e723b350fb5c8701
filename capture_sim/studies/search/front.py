"""Fronts of several objectives to minimise: layers, knee, and rows of a table.

Points are arrays (n, objectives) of costs, which are logarithms for loads; see
:meth:`capture_sim.studies.evaluate.limits.Measure.cost`.  Before distances are computed, each
objective is divided by its range over the front.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from capture_sim.errors import MissingPackageError, import_failure


def require_pymoo() -> None:
    """Raise MissingPackageError if pymoo is not installed."""
    try:
        import pymoo  # noqa: F401
    except ImportError as error:
        text = import_failure("design needs pymoo", error, "study")
        raise MissingPackageError(text) from None


def layers(points: np.ndarray) -> list[np.ndarray]:
    """Return the indices of the points in each layer.

    The first layer is the non-dominated front.  Each further layer is the front of the points that
    are not in the layers before.  Only the first of several equal points is included.
    """
    from pymoo.util.nds.non_dominated_sorting import NonDominatedSorting

    if not len(points):
        return []
    # equal points do not dominate each other, and one of them is enough
    _, first = np.unique(points, axis=0, return_index=True)
    first.sort()
    return [first[layer] for layer in NonDominatedSorting().do(points[first])]


def knee(points: np.ndarray) -> int:
    """Return the index of the point of a front with the least sum of scaled objectives.

    With two objectives, it is the point farthest below the straight line between both ends.  For a
    force and a stroke, whose costs are logarithms, the absorbed energy is about constant on this
    line.
    """
    return int(_scaled(points).sum(axis=1).argmin())


def spread_points(points: np.ndarray, most: int, marked: Sequence[int] = ()) -> list[int]:
    """Return the indices of at most ``most`` points spread over a front.

    The marked points and the ends of the front come first.  Then the point farthest from all chosen
    points is added repeatedly.  The indices are returned in the order of the first objective.
    """
    scaled = _scaled(points)
    chosen = list(dict.fromkeys([*marked, *scaled.argmin(axis=0).tolist()]))[:most]
    while len(chosen) < min(most, len(points)):
        distance = np.linalg.norm(scaled[:, None] - scaled[chosen], axis=2).min(axis=1)
        if distance.max() <= 0.0:
            break
        chosen.append(int(distance.argmax()))
    return sorted(chosen, key=lambda k: tuple(points[k]))


def _scaled(points: np.ndarray) -> np.ndarray:
    low, width = points.min(axis=0), np.ptp(points, axis=0)
    return np.asarray((points - low) / np.where(width > 0.0, width, 1.0))
