"""Times at which a run is sampled, s since the release: checks, and continuation to the end."""

from __future__ import annotations

import math
import sys

import numpy as np
from numpy.typing import ArrayLike

from capture_sim.errors import SceneError


def to_the_end(times: np.ndarray) -> np.ndarray:
    """Return sample times (n,) with infinity appended, (n + 1,), so that a run goes on to its end.

    No run reaches the last time, so it gives no sample.
    """
    return np.append(times, np.inf)


def check_times(
    times: ArrayLike, after: float = -math.inf, t_end: float = sys.float_info.max
) -> np.ndarray:
    """Return sample times, s since the release, as an array (n,).

    Raise SceneError unless they are finite, ascending, not negative, greater than ``after`` and at
    most ``t_end``.
    """
    try:
        t = np.ascontiguousarray(times, dtype=float)
    except (TypeError, ValueError, OverflowError):
        raise SceneError("sample times: must be numbers, s") from None
    if t.ndim != 1:
        raise SceneError(f"sample times of shape {t.shape}: must be (n,)")
    if t.size and not (after < t[0] >= 0.0 and t[-1] <= t_end and (t[1:] > t[:-1]).all()):
        before = np.concatenate([[after], t[:-1]])
        k = int(np.argmin((t > before) & (t >= 0.0) & (t <= t_end)))
        lower_text = f"> {before[k]:.9g}" if before[k] >= 0.0 else ">= 0"
        upper_text = "" if t_end == sys.float_info.max else f" and <= {t_end:.9g}"
        raise SceneError(
            f"sample time number {k} = {t[k]:.9g} s: must be {lower_text}{upper_text}, finite and "
            "ascending"
        )
    return t
