"""Vehicles and buffer, simulated in steps of fixed length under a wrench from outside."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from capture_sim.engine.held_wrench import (
    ENERGY,
    IMPULSE_SIZE,
    LAW,
    N_LOOP,
    TRACE_COLUMNS,
    step_with_wrench,
    stored_energy,
    tip_state,
)
from capture_sim.errors import CaptureSimError, SceneError
from capture_sim.hardware.law import TipState, WallLaw
from capture_sim.interrupts import in_worker
from capture_sim.kernels import records
from capture_sim.model.equations import make_system
from capture_sim.model.parameters import pack
from capture_sim.samples import EventKind
from capture_sim.scene.parts import Scene
from capture_sim.simulation import simulate


class SafeStopError(CaptureSimError):
    """The loop must be opened; the message says why."""


class StageState(NamedTuple):
    """All that a stage may be set back to: state vector, number of steps, mode."""

    y: np.ndarray
    steps: int
    mode: np.ndarray


def state_after_rail(scene: Scene) -> tuple[np.ndarray, np.ndarray]:
    """Return coordinates (8,) and rates (8,) with which the chaser leaves its rail.

    A scene's rail ends before the first touch and after the hanging mass has landed; SceneError if
    the chaser does not get that far.
    """
    for event in simulate(scene).events:
        if event.kind == EventKind.RAIL_END:
            return event.q, event.v
    raise SceneError("rail: must end before the contact for hardware in the loop")


class LoopStage:
    """Vehicles, buffer, stroke stops and latch, floating free, with the tip's wrench from outside.

    The wrench is held over each ``step`` (s), of ``substeps`` Runge-Kutta steps.  With a rail the
    stage begins where the chaser leaves it.  Once latched, the wrench acts no more.  SceneError for
    a scene with supports.
    """

    def __init__(self, scene: Scene, step: float = 1e-3, substeps: int = 10) -> None:
        if scene.supports is not None:
            raise SceneError("supports: must be null for hardware in the loop")
        self.scene = scene
        self.step, self.substeps = step, substeps
        self._system = make_system(pack(scene, 0.0, 0.0))
        self._mode = self._system["mode"]
        q, v = state_after_rail(scene) if scene.rail is not None else scene.initial_coordinates()
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
        """Kinetic energy, that of all springs, and what the buffer's dampers have dissipated, J.

        Only the wrench can raise it; damping and friction of the law lower it.
        """
        return float(stored_energy(self._system, self._laws, self._y))

    @property
    def peak_energy(self) -> float:
        """The largest energy (J) at the end of any Runge-Kutta step of the last step."""
        return float(self._trace[:, ENERGY].max())  # NaN where one is

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
        """Tip (pose, rates), force, energy of the last step's Runge-Kutta steps, (substeps, 9)."""
        return self._trace

    def set_law(self, law: WallLaw) -> None:
        """Put walls of this law into the vehicles' own steps; none for a stiffness of 0."""
        self._laws[0] = law

    def effective_mass(self, nx: float, ny: float) -> float:
        """Return the mass that a contact with this normal (target's axes) feels, kg.

        What a blow of 1e-3 N s within 1e-9 s meets.
        """
        saved_state, laws, trace = (
            self.saved(),
            np.zeros_like(self._laws),
            np.zeros((1, TRACE_COLUMNS)),
        )
        par, speeds = self._system["par"], []
        has_latch = par["has_latch"].copy()
        par["has_latch"] = 0  # a tip in its zone would be caught
        for force in (0.0, 1e6):
            self.restore(saved_state)
            self._mode["latched"] = 0
            push = (force * nx, force * ny, 0.0)
            step_with_wrench(self._system, laws, self._y, self._stages, trace, 1e-9, *push)
            speeds.append(self.tip.vx * nx + self.tip.vy * ny)
        self.restore(saved_state)
        par["has_latch"] = has_latch
        return 1e-3 / (speeds[1] - speeds[0])

    def saved(self) -> StageState:
        """Return the state, for :meth:`restore`."""
        return StageState(self._y.copy(), self._count, self._mode.copy())

    def restore(self, state: StageState) -> None:
        """Go back to a saved state."""
        self._y[:], self._count = state.y, state.steps
        self._mode[:] = state.mode

    def go(self, force_x: float, force_y: float, torque: float) -> None:
        """Go one step with this wrench held (N, N, N m)."""
        step = (self._y, self._stages, self._trace, self.step / self.substeps)
        step_with_wrench(self._system, self._laws, *step, force_x, force_y, torque)
        self._count += 1

    def advance(self, force_x: float, force_y: float, torque: float) -> TipState:
        """Go one step with this wrench held; return where the tip is then.  See :meth:`check`."""
        self.go(force_x, force_y, torque)
        self.check()
        return self.tip

    def check(self) -> None:
        """Raise SafeStopError if the probe is pushed in up to its tip or the state not finite."""
        if not np.isfinite(self._y).all() or self._y[4] < self.scene.probe.tip_radius:
            radius = self.scene.probe.tip_radius
            raise SafeStopError(
                f"h = {self._y[4]:.4g} m: must be >= {radius:g}; the probe is pushed in up to its "
                "tip"
            )
