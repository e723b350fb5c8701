"""The limits of the loop: of the rig's load, of what it is sent, and of the energy it adds."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from capture_sim.hardware.law import TipState, Wrench
from capture_sim.hardware.stage import LoopStage, SafeStopError

#: Halvings that find the share of a wrench that the energy limit leaves.
_HALVINGS = 8


class Limits(NamedTuple):
    """What stops the loop; :data:`LIMITS` describes all but the latency."""

    energy: float = 0.02
    force: float = 300.0
    torque: float = 30.0
    speed: float = 0.5
    acceleration: float = 100.0
    latency: float = 0.05  # s, from a position to the use of its wrench
    angular_speed: float = 3.0
    bias: float = 10.0


#: By field of :class:`Limits`: what it bounds, with its unit, and its largest value.
LIMITS = {
    "energy": ("energy that the loop may add to the vehicles, J", 1e6),
    "force": ("force on the rig, N", 1e9),
    "torque": ("torque on the rig, N m", 1e9),
    "speed": ("speed of the commanded position, m/s", 1e3),
    "acceleration": ("acceleration of the commanded position, m/s^2", 1e6),
    "angular_speed": ("angular speed of the commanded position, rad/s", 1e3),
    "bias": ("bias of the load cell at rest, N", 1e9),
}


def check_limit(name: str, value: float, unit: str, limit: float) -> None:
    """Raise SafeStopError if a value is beyond its limit."""
    if value > limit:
        raise SafeStopError(f"{name} = {value:.4g} {unit}: must be <= {limit:g}")


def check_motion(
    limits: Limits, step: float, pose: TipState, last: TipState, before: TipState | None
) -> None:
    """Raise SafeStopError if the commanded position moves too fast or too abruptly.

    ``last`` and ``before`` are the positions one and two steps (s) earlier.
    """
    moved = np.array([pose.x - last.x, pose.y - last.y])
    check_limit("commanded speed", float(np.hypot(*moved)) / step, "m/s", limits.speed)
    turned = abs(math.remainder(pose.theta - last.theta, 2.0 * math.pi))
    check_limit("commanded angular speed", turned / step, "rad/s", limits.angular_speed)
    if before is not None:
        bent = moved - np.array([last.x - before.x, last.y - before.y])
        acceleration = float(np.hypot(*bent)) / step**2
        check_limit("commanded acceleration", acceleration, "m/s^2", limits.acceleration)


class EnergyLimit:
    """Keeps the energy that the loop adds to vehicles, buffer and law below its limit.

    ``excess`` (J): the most that they have been above their energy before the touch; ``withheld``
    (J): what scaled wrenches would have added.
    """

    def __init__(self, stage: LoopStage, limit: float) -> None:
        self._stage, self._limit = stage, limit
        self._reference = stage.energy  # J, the least before the touch
        self.excess = self.withheld = 0.0

    def note_free_motion(self) -> None:
        """Note the energy before a step outside of a touch."""
        self._reference = min(self._reference, self._stage.energy)

    def go(self, wrench: Wrench | None) -> None:
        """Go a step under a wrench, or a law; a wrench that would add too much is scaled down.

        SafeStopError if a law adds more than the limit, or as much again was withheld from a
        wrench.
        """
        stage, saved, energy = self._stage, self._stage.saved(), self._stage.energy
        limit = self._reference + self._limit
        planar = (0.0, 0.0, 0.0) if wrench is None else (wrench.fx, wrench.fy, wrench.tz)
        stage.go(*planar)
        if not stage.peak_energy <= limit:
            demanded, excess = stage.energy - energy, stage.peak_energy - self._reference
            if wrench is None or not math.isfinite(demanded):
                stage.restore(saved)
                raise SafeStopError(
                    f"energy added to the vehicles = {excess:.3g} J: must be <= "
                    f"{self._limit:g} (energy_limit)"
                )
            low, high = 0.0, 1.0
            for _ in range(_HALVINGS):
                share = 0.5 * (low + high)
                stage.restore(saved)
                stage.go(*(share * component for component in planar))
                low, high = (share, high) if stage.peak_energy <= limit else (low, share)
            stage.restore(saved)
            stage.go(*(low * component for component in planar))
            self.withheld += max(demanded - (stage.energy - energy), 0.0)
            if self.withheld > self._limit:
                raise SafeStopError(
                    f"energy withheld from the vehicles = {self.withheld:.3g} J, after "
                    f"{self._limit:g} J added: must be <= {self._limit:g} (energy_limit)"
                )
        self.excess = max(self.excess, stage.peak_energy - self._reference)
