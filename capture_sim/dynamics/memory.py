"""Reusable memory of a run: the engine's workspace, and an array for the samples of each call."""

from __future__ import annotations

import functools
from collections.abc import Sequence

import numpy as np

from capture_sim.dynamics.engine.state import WORKSPACE
from capture_sim.dynamics.samples import (
    SAMPLE,
)
from capture_sim.dynamics.solver.pairs import PAIRS
from capture_sim.dynamics.solver.runge_kutta import set_pair

_FIRST_STEP = 1e-6  # s; the step control adjusts it
_FIRST_ERROR = 1e-4  # for the step control, as there is no earlier step

#: Size of the workspace's fields before the log, bytes.  Each call begins the log again.
STATE_BYTES = WORKSPACE.fields["log"][1]  # type: ignore[index]


class Memory:
    """The memory of one run; later runs can reuse it, which saves the time of allocating.

    ``samples`` (n,) of dtype SAMPLE is an array for the samples of a call; the next call overwrites
    it.  The runs of a study are integrated one after the other, so they can share one array.  With
    None each call allocates a new array.
    """

    def __init__(self, samples: np.ndarray | None = None) -> None:
        self.workspace = np.zeros(1, WORKSPACE)
        self._samples = np.empty(0, SAMPLE) if samples is None else samples

    def samples(self, count: int) -> np.ndarray:
        """Return an uninitialised array (count,) of dtype SAMPLE.

        It is the beginning of the shared array if that is long enough, otherwise a new array.
        """
        return self._samples[:count] if count <= self._samples.size else np.empty(count, SAMPLE)


@functools.lru_cache(maxsize=len(PAIRS))
def first_state(method: str) -> np.ndarray:
    """Return the initial bytes of a workspace up to its log, for runs with an integration method.

    ``method`` is a value of ``run.method``, a key of PAIRS.
    """
    workspace = np.zeros(1, WORKSPACE)
    set_pair(workspace[0]["stepper"], PAIRS[method]())
    step = workspace[0]["step"]
    step["h_next"], step["error"] = _FIRST_STEP, _FIRST_ERROR
    step["equations_changed"] = 1
    return workspace.view(np.uint8)[:STATE_BYTES]


def joined(parts: Sequence[np.ndarray]) -> np.ndarray:
    """Return a new array with the records of all parts in order; the parts have the same dtype."""
    # as bytes: field by field, NumPy needs eight times as long
    raw = [np.ascontiguousarray(part).view(f"V{part.itemsize}") for part in parts]
    return np.concatenate(raw).view(parts[0].dtype)
