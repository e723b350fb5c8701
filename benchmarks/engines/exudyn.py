"""The paper's scene in Exudyn, whose friction is clamped: compared with a reference of that law."""

from __future__ import annotations

import functools
import importlib
from collections.abc import Callable, Iterator

import numpy as np

from benchmarks.trial import Outcome, Trial
from capture_sim.reproduction.exudyn_engine import MODULE, NAME, build, solver_settings
from capture_sim.scene.parts import Scene

PACKAGE = "exudyn"
REFERENCE = "_clamp"  # what the reference's name ends with, friction by clamp
NOTE = (
    "KinematicTree, RigidBody2D and ContactSphereTriangle, DOPRI5; same contact law, friction "
    "clamped on both sides"
)


def trials(scene: Scene, quick: bool) -> Iterator[Trial]:
    """Yield the settings to try."""
    for rtol in (1e-6,) if quick else (1e-3, 1e-4, 1e-5, 1e-6, 1e-7, 1e-8, 1e-9, 1e-10):
        yield Trial(NAME, f"rtol {rtol:.0e}", functools.partial(prepare, scene, rtol), "engine")


def prepare(
    scene: Scene, rtol: float, mu: float | None = None
) -> Callable[[], Callable[[], Outcome]]:
    """Build the system; return what runs it and returns what reads the outcome.

    ``mu`` takes the place of the scene's coefficient of friction.
    """
    exu = importlib.import_module(MODULE)
    system, tree_node, target_node = build(scene, scene.friction.mu if mu is None else mu)
    settings = solver_settings(exu, scene.run.t_end, rtol)

    def run() -> Callable[[], Outcome]:
        done = system.SolveDynamic(settings, solverType=exu.DynamicSolverType.DOPRI5)

        def read() -> Outcome:
            if not done:
                return Outcome(np.full(8, np.nan), 0, failure="solver gave up")
            kind = exu.OutputVariableType.Coordinates
            c = system.GetNodeOutput(tree_node, kind)
            t = system.GetNodeOutput(target_node, kind)
            return Outcome(np.array([c[0], c[1], c[2], c[2] + c[3], c[4], *t[:3]]), 0)

        return read

    return run
