"""Fronts of several objectives, all to be minimised: layers, knee, rows of a table.

Points are arrays (n, objectives): of loads the logarithms, see
:meth:`capture_sim.studies.limits.Measure.cost`.  Distances are measured in shares of the front's
own ranges.
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
    """Return the indices of the front, of the front without that, and so on."""
    from pymoo.util.nds.non_dominated_sorting import NonDominatedSorting

    if not len(points):
        return []
    # two points that are equal do not dominate each other: one of them is enough
    _, first = np.unique(points, axis=0, return_index=True)
    first.sort()
    return [first[layer] for layer in NonDominatedSorting().do(points[first])]


def knee(points: np.ndarray) -> int:
    """Return the index of a front's point with the least sum of objectives.

    Of two objectives, this is the point farthest below the straight line between both ends.  Of a
    force and a stroke that line is, by the logarithms, one of about the same absorbed energy.
    """
    return int(_scaled(points).sum(axis=1).argmin())


def spread_points(points: np.ndarray, most: int, marked: Sequence[int] = ()) -> list[int]:
    """Return the indices of at most ``most`` points spread over a front.

    The selection takes the ends and the marked points, and then repeatedly the point farthest from
    all selected points.  The indices are in the order of the first objective.
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
