"""Hardware in the loop: vehicles and buffer are simulated, the contact is not.

What acts on the tip is measured elsewhere and comes in as a wrench, late by some delay.
It is held over each step.  What is too old, or cannot be, stops the stage safely.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from capture_sim.engine.held_wrench import (
    IMPULSE_SIZE,
    LAW,
    MOVED,
    N_LOOP,
    TRACE_COLUMNS,
    step_with_wrench,
    stored_energy,
    tip_state,
)
from capture_sim.errors import CaptureSimError, SceneError
from capture_sim.hardware.walls import NOTHING, TipState, WallLaw, Wrench
from capture_sim.interrupts import in_worker
from capture_sim.kernels import records
from capture_sim.messages.topics import Rate, Topic
from capture_sim.model.equations import AXIAL, LATCH, STOP, TORSION, make_system
from capture_sim.model.parameters import pack
from capture_sim.samples import EventKind
from capture_sim.scene.parts import Scene
from capture_sim.simulation import simulate

CONTACT_RIG = "contact_rig"
LOOP_SIMULATOR = "loop_simulator"

#: Where the tip is in the cone, for what measures or makes the contact.
TIP = Topic("loop/tip", "nav_msgs/msg/Odometry", (LOOP_SIMULATOR,), Rate.STATE)
#: What acts on the tip; stamped with the stamp of the tip's place that it answers.
TIP_WRENCH = Topic("loop/wrench", "geometry_msgs/msg/WrenchStamped", (CONTACT_RIG,), Rate.STATE)


class SafeStopError(CaptureSimError):
    """The loop had to be opened; the message says when and why."""


class StageState(NamedTuple):
    """All that a stage may be set back to: state vector, number of steps, mode."""

    y: np.ndarray
    steps: int
    mode: np.ndarray


def behind_the_rail(scene: Scene) -> tuple[np.ndarray, np.ndarray]:
    """Return coordinates (8,) and rates (8,) with which the chaser leaves its rail.

    A scene's rail ends before the first touch and after the hanging mass has landed.

    Raises
    ------
    SceneError
        The chaser does not get that far.
    """
    for event in simulate(scene).events:
        if event.kind == EventKind.RAIL_END:
            return event.q, event.v
    raise SceneError("rail: must end before the contact for hardware in the loop")


class LoopStage:
    """Vehicles, buffer, stroke stops and latch, floating free, with the tip's wrench from outside.

    Parameters
    ----------
    scene
        Without supports.  With a rail the stage begins where the chaser leaves it.  Once
        latched, the wrench acts no more.
    step
        s, over which a wrench is held.
    substeps
        Runge-Kutta steps in each.

    Raises
    ------
    SceneError
        The scene has a part that cannot be in a loop.
    """

    def __init__(self, scene: Scene, step: float = 1e-3, substeps: int = 10) -> None:
        if scene.supports is not None:
            raise SceneError("supports: must be null for hardware in the loop")
        self.scene = scene
        self.step, self.substeps = step, substeps
        self._system = make_system(pack(scene, 0.0, 0.0))
        self._mode = self._system["mode"]
        q, v = behind_the_rail(scene) if scene.rail is not None else scene.initial_coordinates()
        self._y = np.concatenate([q, v, np.zeros(N_LOOP - 16)])
        self._stages = np.zeros((6, N_LOOP))
        self._laws = records(np.zeros(1, LAW))
        self._trace = np.zeros((substeps, TRACE_COLUMNS))
        self._count = 0
        # the kernels are loaded, or compiled, now: within the loop each would cost a wrench
        in_worker(lambda: (self.effective_mass(1.0, 0.0), self.tip, self.energy))

    @property
    def t(self) -> float:
        """Time, s."""
        return self._count * self.step

    @property
    def q(self) -> np.ndarray:
        """Coordinates (8,), m and rad."""
        return self._y[:8].copy()

    @property
    def v(self) -> np.ndarray:
        """Rates (8,)."""
        return self._y[8:16].copy()

    @property
    def tip(self) -> TipState:
        """Where the tip is now."""
        return self.tip_at(tip_state(self._system, self._y))

    def tip_at(self, row: np.ndarray | tuple[float, ...]) -> TipState:
        """Return the tip of a row of :attr:`trace`, as of now."""
        x, y, theta, vx, vy, omega = map(float, row[:6])
        return TipState(self.t, x + self.scene.cone.L_T, y, theta, vx, vy, omega)

    @property
    def energy(self) -> float:
        """Kinetic energy and that of all springs, with what the buffer's dampers have taken, J.

        Nothing but the wrench can raise it, and a damper or friction of the law lower it.
        """
        y = self._y
        lost = y[AXIAL] + y[TORSION] + y[LATCH] + y[STOP]
        return float(stored_energy(self._system, self._laws, y) + lost)

    @property
    def impulse(self) -> float:
        """Integral of the size of the force on the tip so far, N s."""
        return float(self._y[IMPULSE_SIZE])

    @property
    def latched(self) -> bool:
        """Whether the latch has closed."""
        return bool(self._mode["latched"][0])

    @property
    def trace(self) -> np.ndarray:
        """Tip (pose, rates) and force of the last step, (substeps, 8), each at its begin."""
        return self._trace

    def take_law(self, law: WallLaw, *, gated: bool) -> None:
        """Put walls of this law into the vehicles' own steps.

        With ``gated`` the wrench from outside acts only while they are touched: it corrects them.
        """
        self._laws[0] = (*law, gated)

    def effective_mass(self, nx: float, ny: float) -> float:
        """Return the mass that a contact with this normal (target's axes) feels, kg.

        What a blow of 1e-3 N s within 1e-9 s meets.
        """
        kept, laws, trace = self.saved(), np.zeros_like(self._laws), np.zeros((1, TRACE_COLUMNS))
        speeds = []
        for force in (0.0, 1e6):
            self.restore(kept)
            push = (force * nx, force * ny, 0.0)
            step_with_wrench(self._system, laws, self._y, self._stages, trace, 1e-9, *push)
            speeds.append(self.tip.vx * nx + self.tip.vy * ny)
        self.restore(kept)
        return 1e-3 / (speeds[1] - speeds[0])

    def saved(self) -> StageState:
        """Return the state, for :meth:`restore`."""
        return StageState(self._y.copy(), self._count, self._mode.copy())

    def restore(self, state: StageState) -> None:
        """Go back to a saved state."""
        self._y[:], self._count = state.y, state.steps
        self._mode[:] = state.mode

    def go(self, fx: float, fy: float, torque: float) -> np.ndarray:
        """Go one step with the wrench held; return how the tip moved under it (m, m, rad)."""
        before = self._y[MOVED:].copy()
        step = (self._y, self._stages, self._trace, self.step / self.substeps)
        step_with_wrench(self._system, self._laws, *step, fx, fy, torque)
        self._count += 1
        return np.asarray(self._y[MOVED:] - before)

    def advance(self, wrench: Wrench) -> TipState:
        """Go one step with the wrench held; return where the tip is then.

        Raises
        ------
        SafeStopError
            See :meth:`arrived`.
        """
        self.go(*wrench)
        return self.arrived()

    def arrived(self) -> TipState:
        """Return where the tip is after a step.

        Raises
        ------
        SafeStopError
            The probe is pushed in up to its tip, or the state is not finite any more.
        """
        if not np.isfinite(self._y).all() or self._y[4] < self.scene.probe.tip_radius:
            raise SafeStopError(
                f"stopped at t = {self.t:.6g} s: the probe is pushed in up to its tip"
            )
        return self.tip


class WrenchHold:
    """The latest wrench from outside, as long as it may be trusted.

    Parameters
    ----------
    timeout
        s of age up to which a wrench is held.
    force_limit
        N, beyond which it is taken for a fault.
    """

    def __init__(self, timeout: float, force_limit: float) -> None:
        self._timeout, self._force_limit = timeout, force_limit
        self._stamp = -math.inf
        self._wrench = NOTHING
        self._fault = ""
        self.ages: list[float] = []  # s, of every wrench when it was used
        self.refused = 0

    @property
    def received(self) -> bool:
        """Whether there is one."""
        return self._stamp > -math.inf

    def offer(self, stamp: float, now: float, wrench: Wrench) -> str:
        """Take in a wrench; return why it was refused, or nothing.

        Parameters
        ----------
        stamp
            s, of the tip's place that it answers.
        now
            s, the loop's time.
        wrench
            See :data:`Wrench`.
        """
        reason = ""
        if not all(math.isfinite(value) for value in wrench):
            reason = "is not finite"
        elif stamp > now + 1e-9:
            reason = f"is stamped {stamp - now:.3g} s ahead of the loop"
        elif stamp <= self._stamp:
            reason = "is not newer than the one before"
        if reason:
            self.refused += 1
            return f"the wrench stamped {stamp:.6g} s {reason}"
        self._stamp, self._wrench = stamp, wrench
        force = math.hypot(wrench[0], wrench[1])
        if force > self._force_limit:
            self._fault = f"a force of {force:.4g} N came: must be <= {self._force_limit:g}"
        return ""

    def at(self, now: float) -> tuple[float, Wrench]:
        """Return stamp (s) and wrench that are held now.

        Raises
        ------
        SafeStopError
            It is too old or too large.
        """
        if self._fault:
            raise SafeStopError(f"stopped at t = {now:.6g} s: {self._fault}")
        age = now - self._stamp
        if age > self._timeout + 1e-9:
            raise SafeStopError(
                f"stopped at t = {now:.6g} s: the last wrench is {age:.3g} s old: must be "
                f"<= {self._timeout:g}"
            )
        self.ages.append(age)
        return self._stamp, self._wrench
