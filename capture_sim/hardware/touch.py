"""What is known of one touch."""

from __future__ import annotations

import math
from dataclasses import dataclass

from capture_sim.hardware.fit import LawEstimate


@dataclass
class Touch:
    """One touch, from its first force to its last; what chatters is one touch.

    Attributes
    ----------
    begin
        s.
    approach_speed
        m/s, along the force.
    energy
        J, of that motion before: half the effective mass times its square.
    duration
        s, under force.
    work
        J, of the wrench or the law on the vehicles.
    peak_force
        N, on the vehicles.
    rig_peak_force
        N, that the load cell has read.
    impulse
        N s, on the vehicles.
    law_restitution
        With ``model``, of the law that acted; else NaN.
    rig
        The law fitted to what the rig measured; None if it was not touched.
    is_held
        True if the restitution was within 5 % of the rig's, None if that is not known.
    """

    begin: float
    approach_speed: float
    energy: float
    duration: float = 0.0
    work: float = 0.0
    peak_force: float = 0.0
    rig_peak_force: float = 0.0
    impulse: float = 0.0
    law_restitution: float = math.nan
    rig: LawEstimate | None = None
    is_held: bool | None = None

    @property
    def restitution(self) -> float:
        """Speed after over speed before: of the law that acted, else from the energy."""
        if math.isnan(self.law_restitution):
            return math.sqrt(max(1.0 + self.work / self.energy, 0.0))
        return self.law_restitution
