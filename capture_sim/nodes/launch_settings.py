"""Settings of a launch that can change while the launcher runs."""

from __future__ import annotations

from dataclasses import dataclass

from capture_sim.scene.quantities import Range, quantity


@dataclass
class LaunchSettings:
    """Parameters of the launcher that each launch uses; see :class:`..launch.watch.Launcher`."""

    tolerance: float = quantity(
        "1",
        Range(0.01, 10.0),
        default=0.2,
        doc="share of the planned impact speed by which the chaser's speed may deviate",
    )
    aborts: bool = quantity(
        "",
        default=True,
        doc="abort a launch that differs from its plan: speed beyond speed_tolerance by 5 "
        "standard deviations, or contact too late; false only warns",
    )
