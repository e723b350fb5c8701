"""Settings of a launch that can change while the launcher runs."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass
class LaunchSettings:
    """Parameters of the launcher that each launch uses.

    ``tolerance`` and ``aborts``: see :class:`capture_sim.launch.watch.Launcher`.
    """

    tolerance: float
    aborts: bool
