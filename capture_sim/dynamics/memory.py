"""Memory of runs: the engine's record, and room for samples."""

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
    """Memory of one run at a time; a later run can have it again, as new memory costs time.

    ``samples`` (n,) of dtype SAMPLE is room for the samples of a call, which the next call
    overwrites: runs of a study that are integrated one after the other share it.  None for new room
    in each call.
    """

    def __init__(self, samples: np.ndarray | None = None) -> None:
        self.workspace = np.zeros(1, WORKSPACE)
        self._samples = np.empty(0, SAMPLE) if samples is None else samples

    def samples(self, count: int) -> np.ndarray:
        """Return room for samples, (count,) of dtype SAMPLE."""
        return self._samples[:count] if count <= self._samples.size else np.empty(count, SAMPLE)


@functools.lru_cache(maxsize=len(PAIRS))
def first_state(method: str) -> np.ndarray:
    """Return the bytes of a workspace up to its log, with what all runs of a method begin with."""
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
