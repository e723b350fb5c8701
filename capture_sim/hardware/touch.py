"""What is known of one touch."""

from __future__ import annotations

import math
from dataclasses import dataclass

from capture_sim.hardware.fit import LawEstimate


@dataclass
class Touch:
    """One touch, from its first force to its last; what chatters is one touch."""

    begin: float  # s
    approach_speed: float  # m/s, along the force
    energy: float  # J, of that motion before: half the effective mass times its square
    duration: float = 0.0  # s, under force
    work: float = 0.0  # J, of the wrench or the law on the vehicles
    peak_force: float = 0.0  # N, on the vehicles
    rig_peak_force: float = 0.0  # N, that the load cell has read
    impulse: float = 0.0  # N s, on the vehicles
    law_restitution: float = math.nan  # with ``model``, of the law that acted; else NaN
    # the law fitted to what the rig measured; None if it was not touched
    rig: LawEstimate | None = None
    # True if the restitution was within 5 % of the rig's, None if that is not known
    is_held: bool | None = None

    @property
    def restitution(self) -> float:
        """Speed after over speed before: of the law that acted, else from the energy.

        NaN if only the rig was in contact, or only the law.
        """
        if not (self.peak_force and self.rig_peak_force):
            return math.nan
        if math.isnan(self.law_restitution):
            return math.sqrt(max(1.0 + self.work / self.energy, 0.0))
        return self.law_restitution
