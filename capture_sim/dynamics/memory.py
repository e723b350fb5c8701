"""Reusable memory of a run: the engine's workspace, and arrays for the samples of a call."""

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

#: The workspace up to the log, which each call begins again.
STATE_BYTES = WORKSPACE.fields["log"][1]  # type: ignore[index]


class Memory:
    """The memory of one run at a time.

    A later run can use it again, because allocating memory takes time.

    ``samples`` (n,) of dtype SAMPLE holds the samples of a call, and the next call overwrites it.
    The runs of a study are integrated one after the other, so they share one such array.  With None
    each call allocates a new array.
    """

    def __init__(self, samples: np.ndarray | None = None) -> None:
        self.workspace = np.zeros(1, WORKSPACE)
        self._samples = np.empty(0, SAMPLE) if samples is None else samples

    def samples(self, count: int) -> np.ndarray:
        """Return room for samples, (count,) of dtype SAMPLE."""
        return self._samples[:count] if count <= self._samples.size else np.empty(count, SAMPLE)


@functools.lru_cache(maxsize=len(PAIRS))
def first_state(method: str) -> np.ndarray:
    """Return the bytes of a workspace up to its log, as every run of a method starts with."""
    workspace = np.zeros(1, WORKSPACE)
    set_pair(workspace[0]["stepper"], PAIRS[method]())
    step = workspace[0]["step"]
    step["h_next"], step["error"] = _FIRST_STEP, _FIRST_ERROR
    step["equations_changed"] = 1
    return workspace.view(np.uint8)[:STATE_BYTES]


def joined(parts: Sequence[np.ndarray]) -> np.ndarray:
    """Return a copy of arrays of records of one type, one after the other."""
    # as bytes: field by field, NumPy needs eight times as long
    raw = [np.ascontiguousarray(part).view(f"V{part.itemsize}") for part in parts]
    return np.concatenate(raw).view(parts[0].dtype)
