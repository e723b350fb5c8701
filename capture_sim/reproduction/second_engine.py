"""Figures 10 and 11: velocities beside those of an independent engine.

The paper set its own model beside one in SimMechanics; this sets ours beside one in Exudyn (see
:mod:`capture_sim.reproduction.exudyn_engine`).  Exudyn knows friction clamped at v_eps only, so
both are run with that law; what the law itself changes is told apart.
"""

from __future__ import annotations

import importlib
from dataclasses import dataclass, replace

import numpy as np

from capture_sim.reproduction import exudyn_engine
from capture_sim.results import first_cluster
from capture_sim.scene.files import load_scene
from capture_sim.scene.parts import Scene
from capture_sim.simulation import Result, simulate

SCENE = "paper_designed"
_T_END = 1.3  # s: the whole of the figure
_STEP = 1e-3  # s between values
_RTOL = 1e-9


@dataclass(frozen=True)
class Comparison:
    """Two engines on one scene.

    Attributes
    ----------
    ours : Result
        At the other engine's times, friction clamped.
    t : ndarray (n,)
        s.
    q, v : ndarray (n, 8)
        The other engine's coordinates and rates; m, rad and per second.
    contact_end : float
        Of the first contact, s.
    law_effect : ndarray (8,)
        Largest difference that the friction law alone makes to our rates until then.
    """

    ours: Result
    t: np.ndarray
    q: np.ndarray
    v: np.ndarray
    contact_end: float
    law_effect: np.ndarray

    def largest_difference(self) -> np.ndarray:
        """Return the largest difference (8,) of each rate to the end of the first contact."""
        until = self.t <= self.contact_end
        return np.asarray(np.abs(self.ours.v[until] - self.v[until]).max(axis=0))


def missing() -> str:
    """Return why there is no second engine; empty if there is."""
    try:
        importlib.import_module(exudyn_engine.MODULE)
    except ImportError as error:
        return f"{exudyn_engine.NAME} is not installed ({error}): requirements/benchmark.txt"
    return ""


def compare(t_end: float = _T_END) -> Comparison:
    """Run the designed case in both engines and set them beside each other.

    Raises
    ------
    ImportError
        The second engine is not installed.
    """
    scene = load_scene(SCENE, ["friction.law=clamp"])
    t, q, v = run_exudyn(scene, t_end)
    ours = simulate(scene, t_end=t_end, t_eval=t, rtol=1e-10)
    smooth = simulate(load_scene(SCENE), t_end=t_end, t_eval=t, rtol=1e-10)
    end = float(first_cluster(ours.touches)["end"].max())
    until = t <= end
    law = np.abs(ours.v[until] - smooth.v[until]).max(axis=0)
    return Comparison(ours, t, q, v, end, law)


def run_exudyn(scene: Scene, t_end: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Run a scene in Exudyn; return times (n,), coordinates and rates (n, 8)."""
    exu = importlib.import_module(exudyn_engine.MODULE)
    items = importlib.import_module(f"{exudyn_engine.MODULE}.itemInterface")
    scene = replace(scene, run=replace(scene.run, t_end=t_end))
    system, tree, target = exudyn_engine.build(scene, scene.friction.mu)
    kinds = (exu.OutputVariableType.Coordinates, exu.OutputVariableType.Coordinates_t)
    sensors = [
        system.AddSensor(
            items.SensorNode(nodeNumber=node, storeInternal=True, outputVariableType=kind)
        )
        for kind in kinds
        for node in (tree, target)
    ]
    system.Assemble()
    settings = exudyn_engine.solver_settings(exu, t_end, _RTOL, _STEP)
    settings.solution.sensors.writePeriod = _STEP
    if not system.SolveDynamic(settings, solverType=exu.DynamicSolverType.DOPRI5):
        raise RuntimeError("Exudyn's solver gave up")
    values = [np.asarray(system.GetSensorStoredData(sensor)) for sensor in sensors]
    t = np.minimum(values[0][:, 0], t_end)
    q, v = (
        np.column_stack([chain[:, 1:4], chain[:, 3] + chain[:, 4], chain[:, 5], body[:, 1:4]])
        for chain, body in (values[:2], values[2:])
    )
    return t, q, v
