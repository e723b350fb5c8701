"""Python's memory in a node that goes through many runs.

A run leaves cycles (YAML, tracebacks), and CPython keeps up to 2000 freed tuples of each length
for later.  Either is given back by a full collection only, which would come by itself when
a quarter of all that was ever imported has piled up, and in the middle of a run.
"""

from __future__ import annotations

import gc


def set_memory_aside() -> None:
    """Leave what is there now out of all later sweeps: over it one takes longer than a tick."""
    gc.collect()
    gc.freeze()


def sweep_memory() -> None:
    """Give back what the last run has left, between two runs."""
    gc.collect()
