"""The same equations in the three forms that are handed to SciPy."""

from __future__ import annotations

from typing import Protocol

import numpy as np

from benchmarks.engines.numpy_model import NumpyModel
from benchmarks.engines.python_model import PythonModel
from capture_sim.engine import loop
from capture_sim.kernels import entry_kernel
from capture_sim.launch.plan import plan_launch
from capture_sim.model.equations import N_STATE, N_TOTAL, make_system, tip_in_cone, wall_gap
from capture_sim.model.parameters import pack
from capture_sim.scene.parts import Scene


@entry_kernel
def gap_of_wall(parameters, y, side):  # type: ignore[no-untyped-def]
    """Return the gap (m) and its rate (m/s) of the wall on ``side`` (+1: +y, -1: -y)."""
    par = parameters[0]
    px, py, wx, wy = tip_in_cone(y, par)
    gap, rate, _, _ = wall_gap(px, py, wx, wy, side, par)
    return gap, rate


class Problem(Protocol):
    """What an integrator needs to know of the bench."""

    evaluations: int

    def rate_of_change(self, t: float, y: np.ndarray) -> np.ndarray:
        """Return dy/dt (16,) at the time ``t`` (s)."""

    def gap(self, y: np.ndarray, wall: int) -> tuple[float, float]:
        """Return gap (m) and its rate (m/s) of a wall, 0: +y, 1: -y."""

    def latch(self, wall: int, approach: float) -> None:
        """Begin a touch at this approach speed, m/s."""

    def release(self, wall: int) -> None:
        """End a touch."""

    def normal_force(self, y: np.ndarray, wall: int) -> float:
        """Return F_n of a wall in touch, N."""


def packed(scene: Scene) -> np.ndarray:
    """Return the (1,) record of a scene's constants that the compiled kernels read."""
    plan = plan_launch(scene)
    return pack(scene, plan.hanging_mass, plan.drop_height, plan.impact_speed)


def into_wall(scene: Scene, penetration: float = 3e-6) -> float:
    """Return the x_S at which the tip is ``penetration`` (m) in the -y wall, all else as is."""
    q, v = scene.initial_coordinates()
    y = np.concatenate([q, v])
    parameters = packed(scene)
    for _ in range(20):
        gap, _ = gap_of_wall(parameters, y, -1.0)
        y[0] += (gap + penetration) / np.sin(scene.cone.half_angle)
    return float(y[0])


class CompiledProblem:
    """The engine's own right-hand side, :func:`capture_sim.engine.loop.evaluate`."""

    def __init__(self, scene: Scene) -> None:
        self.parameters = packed(scene)
        self.system = make_system(self.parameters)
        self.mode = self.system["mode"][0]
        self.touching, self.chi = self.mode["touching"], self.mode["chi"]
        par = self.parameters[0]
        self._damping = float(par["hysteresis"] * par["K"])
        self._floor = float(par["v_0_floor"])
        self._K = float(par["K"])
        self._f = np.zeros(N_TOTAL)
        self.evaluations = 0

    def rate_of_change(self, _: float, y: np.ndarray) -> np.ndarray:
        """Return dy/dt (16,)."""
        self.evaluations += 1
        loop.evaluate(self.system, y, self._f)
        return self._f[:N_STATE].copy()

    def gap(self, y: np.ndarray, wall: int) -> tuple[float, float]:
        """Return gap (m) and its rate (m/s)."""
        gap, rate = gap_of_wall(self.parameters, y, 1.0 - 2.0 * wall)
        return float(gap), float(rate)

    def latch(self, wall: int, approach: float) -> None:
        """Begin a touch."""
        self.touching[wall] = 1
        self.chi[wall] = self._damping / max(approach, self._floor)
        self.mode["sticking"][wall] = 0

    def release(self, wall: int) -> None:
        """End a touch."""
        self.touching[wall] = 0

    def normal_force(self, y: np.ndarray, wall: int) -> float:
        """Return F_n, N; eq. (1)."""
        gap, rate = self.gap(y, wall)
        penetration = max(-gap, 0.0)
        return float(max(penetration * penetration**0.5 * (self._K - self.chi[wall] * rate), 0.0))


class NumpyProblem:
    """The vector model, :class:`benchmarks.engines.numpy_model.NumpyModel`."""

    def __init__(self, scene: Scene) -> None:
        self._model = NumpyModel(scene)
        self.latch = self._model.latch
        self.release = self._model.release
        self.evaluations = 0

    def rate_of_change(self, _: float, y: np.ndarray) -> np.ndarray:
        """Return dy/dt (16,)."""
        self.evaluations += 1
        return self._model.rate_of_change(y)

    def gap(self, y: np.ndarray, wall: int) -> tuple[float, float]:
        """Return gap (m) and its rate (m/s)."""
        contact = self._model.contact(y[:8], y[8:], wall)
        return contact.gap, contact.rate

    def normal_force(self, y: np.ndarray, wall: int) -> float:
        """Return F_n, N."""
        return self._model.normal_force(self._model.contact(y[:8], y[8:], wall), wall)


class PythonProblem:
    """The same in plain numbers, :class:`benchmarks.engines.python_model.PythonModel`."""

    def __init__(self, scene: Scene) -> None:
        self._model = PythonModel(scene, friction=scene.friction.law)
        self.latch = self._model.latch
        self.release = self._model.release
        self.evaluations = 0

    def rate_of_change(self, _: float, y: np.ndarray) -> np.ndarray:
        """Return dy/dt (16,); NaN where a trial step has left all bounds."""
        self.evaluations += 1
        try:
            return self._model.rate_of_change(y)
        except (ArithmeticError, ValueError):
            # where NumPy's numbers become infinite, Python's raise
            return np.full(16, np.nan)

    def gap(self, y: np.ndarray, wall: int) -> tuple[float, float]:
        """Return gap (m) and its rate (m/s)."""
        contact = self._model.contact(y.tolist(), wall)
        return contact.gap, contact.rate

    def normal_force(self, y: np.ndarray, wall: int) -> float:
        """Return F_n, N."""
        return float(self._model.normal_force(self._model.contact(y.tolist(), wall), wall))
