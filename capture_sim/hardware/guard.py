"""The guard of the loop: it checks all positions, wrenches and steps.

The loop sends positions only through :meth:`Guard.send`.  It uses wrenches only after
:meth:`Guard.check_wrench` and :meth:`Guard.check_answer`, and moves the vehicles only with
:meth:`Guard.take_guarded_step`.  Each raises SafeStopError beyond a limit.
"""

from __future__ import annotations

import itertools
import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, replace

from capture_sim.hardware.law import NO_LAW, NO_WRENCH, Penetration, TipState, WallLaw, Wrench
from capture_sim.hardware.stage import LoopStage, SafeStopError, StageState
from capture_sim.scene.quantities import Range, quantity

#: Number of stored states of the stage, one before each of its latest steps.
HISTORY = 128
#: Largest number of trial steps to find the share of a wrench that the energy limit permits.
_TRIALS = 3
#: Share of the energy limit that is reserved for round-off.
_MARGIN = 1e-3
#: A load cell has failed if a row of identical readings is longer than the first number and longer
#: than the second number times the longest such row at rest.
_FROZEN_READINGS, _FROZEN_ROWS = 10, 3
#: Stiffness of the softest expected wall if no law is known, N/m.
_MIN_STIFFNESS = 500.0
#: Stiffness of the softest expected wall, as a share of its law's stiffness.
_MIN_STIFFNESS_SHARE = 0.05


@dataclass(frozen=True)
class LoopLimits:
    """Limits beyond which the loop stops."""

    energy: float = quantity(
        "J", Range(0.0, 1e6), default=0.02, doc="energy that the loop may add to the vehicles"
    )
    force: float = quantity("N", Range(0.0, 1e9), default=300.0, doc="force on the rig")
    torque: float = quantity("N m", Range(0.0, 1e9), default=30.0, doc="torque on the rig")
    speed: float = quantity(
        "m/s", Range(0.0, 1e3), default=0.5, doc="speed of the commanded position"
    )
    acceleration: float = quantity(
        "m/s^2", Range(0.0, 1e6), default=100.0, doc="acceleration of the commanded position"
    )
    latency: float = quantity(
        "s", Range(0.001, 10.0), default=0.05, doc="time from a position to the use of its wrench"
    )
    angular_speed: float = quantity(
        "rad/s", Range(0.0, 1e3), default=3.0, doc="angular speed of the commanded position"
    )
    bias: float = quantity("N", Range(0.0, 1e9), default=10.0, doc="bias of the load cell at rest")
    depth: float = quantity(
        "m", Range(0.0, 1e3), default=1e-3, doc="depth of the tip in the scene's wall without force"
    )


def _check(name: str, value: float, unit: str, limit: float, hint: str = "") -> None:
    """Raise SafeStopError if a value is above its limit or NaN."""
    if not value <= limit:
        raise SafeStopError(f"{name} = {value:.4g} {unit}: must be <= {limit:g}{hint}")


class Guard:
    """Applies the limits of a loop to positions, wrenches and steps.

    ``law``: the expected contact law.  ``excess`` (J): largest rise of the vehicles' energy above
    its minimum before the touch.  ``withheld`` (J): energy that the limit has withheld by scaling
    wrenches down.  ``history``: states of the stage before its latest steps, newest last.
    """

    def __init__(self, stage: LoopStage, limits: LoopLimits, law: WallLaw = NO_LAW) -> None:
        self._stage, self._limits = stage, limits
        self._expected = WallLaw(_MIN_STIFFNESS, offset=law.offset)
        if law.stiffness > 0.0:
            self._expected = replace(
                law, stiffness=_MIN_STIFFNESS_SHARE * law.stiffness, damping=0.0
            )
        self._reference = stage.energy  # J, minimum before the touch
        self._sent: deque[TipState] = deque(maxlen=2)
        self._max_row = math.inf  # identical readings in a row
        self._row, self._reading = 1, NO_WRENCH
        self.excess = self.withheld = 0.0
        self.history: deque[StageState] = deque(maxlen=HISTORY)

    # to the rig

    def send(self, pose: TipState) -> TipState:
        """Return a position unchanged if its speed and acceleration are within the limits.

        Otherwise raise SafeStopError.  Speed and acceleration follow from the two positions that
        were sent before; the first position is assumed to be at rest.
        """
        limits, step = self._limits, self._stage.step
        if not self._sent:
            self._sent.extend((pose, pose))
        before, last = self._sent
        dx, dy = pose.x - last.x, pose.y - last.y
        _check("commanded speed", math.hypot(dx, dy) / step, "m/s", limits.speed)
        turned = abs(_turn(pose.theta - last.theta)) / step
        _check("commanded angular speed", turned, "rad/s", limits.angular_speed)
        bent = math.hypot(dx - (last.x - before.x), dy - (last.y - before.y)) / step**2
        _check("commanded acceleration", bent, "m/s^2", limits.acceleration)
        self._sent.append(pose)
        return pose

    # from the rig

    def check_rest(self, readings: Sequence[Wrench], bias: Wrench) -> None:
        """Check the readings at rest; set the longest row of identical readings without a fault."""
        hint = " (bias_limit); the tip is in contact, or the load cell must be tared"
        _check("force at rest", bias.force, "N", self._limits.bias, hint)
        rows = [len(list(row)) for _, row in itertools.groupby(readings)]
        if len(rows) > 1:  # otherwise there is no noise to compare with
            self._max_row = max(_FROZEN_READINGS, _FROZEN_ROWS * max(rows))

    def check_wrench(self, wrench: Wrench) -> None:
        """Check force and torque of a wrench without bias, even if it is too late to be used."""
        _check("force on the rig", wrench.force, "N", self._limits.force)
        _check("torque on the rig", wrench.torque, "N m", self._limits.torque)

    def check_answer(self, reading: Wrench, push: float, wall: Penetration, lag: float) -> None:
        """Check a raw reading and its push off the wall (N) against the tip's penetration.

        ``lag``: largest time by which the actual tip may be behind that penetration, s.
        """
        self._row = self._row + 1 if reading == self._reading else 1
        self._reading = reading
        if self._row > self._max_row:
            raise SafeStopError(
                f"identical readings of the load cell in a row = {self._row}: must be <= "
                f"{self._max_row}; there was noise at rest"
            )
        expected, limit = self._expected, self._limits.depth
        depth = wall.depth + expected.offset - max(wall.rate, 0.0) * lag
        if depth > limit and push < expected.stiffness * (depth - limit) ** expected.exponent:
            raise SafeStopError(
                f"depth of the tip in the scene's wall = {depth:.3g} m at a push of {push:.3g} "
                f"N: must be <= {limit:g} (depth_limit); load cell, its sign or the wall's "
                "position is wrong"
            )

    def check_latency(self, latency: float, hint: str) -> None:
        """Check the age (s) of the wrench in use."""
        limit = self._limits.latency
        if not latency <= limit + 1e-9:
            _check("latency of the wrench", latency, "s", limit, f" (timeout){hint}")

    # to the vehicles

    def note_free_motion(self) -> None:
        """Note the energy before a step outside of a touch."""
        self._reference = min(self._reference, self._stage.energy)

    def take_guarded_step(self, wrench: Wrench, *, is_correction: bool = False) -> None:
        """Advance the vehicles one step; scale the wrench down if it would add too much energy.

        A correction of a law may add no energy.  SafeStopError if the added energy exceeds the
        limit, or if the energy withheld from other wrenches exceeds it.
        """
        stage, limit = self._stage, self._limits.energy
        before, energy = stage.saved(), stage.energy
        self.history.append(before)
        stage.take_step(wrench)
        allowed = (_MARGIN if is_correction else 1.0) * limit
        if not stage.peak_energy <= self._reference + allowed:
            demanded = stage.energy - energy
            self._repeat_step_within(self._reference + allowed - _MARGIN * limit, wrench, before)
            self.withheld += max(demanded - (stage.energy - energy), 0.0)
        self.excess = max(self.excess, stage.peak_energy - self._reference)
        _check("energy added to the vehicles", self.excess, "J", limit, " (energy_limit)")
        if self.withheld > limit and not is_correction:
            raise SafeStopError(
                f"energy withheld from the vehicles = {self.withheld:.3g} J, after "
                f"{self.excess:.3g} J added: must be <= {limit:g} (energy_limit)"
            )

    def _repeat_step_within(self, limit: float, wrench: Wrench, before: StageState) -> None:
        """Repeat a step with a share of the wrench that keeps the energy below a limit, J.

        The peak energy is a convex function of the share, as in a linear system.  So the chord
        through a share that is small enough and a share that is too large gives a further share
        that is small enough.
        """
        stage, high, share = self._stage, self._stage.peak_energy, 0.0
        stage.restore(before)
        stage.take_step(NO_WRENCH)
        within, low = stage.saved(), stage.peak_energy
        for _ in range(_TRIALS if high > limit > low else 0):
            trial = share + (1.0 - share) * (limit - low) / (high - low)
            stage.restore(before)
            stage.take_step(Wrench(trial * wrench.fx, trial * wrench.fy, tz=trial * wrench.tz))
            if not stage.peak_energy <= limit:
                break
            within, low, share = stage.saved(), stage.peak_energy, trial
        stage.restore(within)


def _turn(angle: float) -> float:
    return math.remainder(angle, 2.0 * math.pi) if math.isfinite(angle) else math.nan
