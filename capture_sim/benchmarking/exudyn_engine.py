"""The paper's scene in Exudyn: an independent multibody code with a contact as ours.

A kinematic tree (chaser, cylinder, probe), a planar rigid body (target) and two contacts of a
sphere with a triangle.  Exudyn's Hunt-Crossley factor 3/2 (1 - e) is made that of our law by
its restitution, and its friction is mu F_n clamp(v / v_eps), so it is compared with a
reference of that law.  Touches are not located: the impact speed is that at a step's end.
"""

from __future__ import annotations

import functools
import importlib
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from capture_sim.benchmarking.outcome import Outcome
from capture_sim.benchmarking.python_model import PythonModel
from capture_sim.benchmarking.trial import Trial
from capture_sim.scene.parts import Scene

NAME = "Exudyn"
MODULE = "exudyn"
PACKAGE = "exudyn"
REFERENCE = "_clamp"  # what the reference's name ends with, friction by clamp
NOTE = (
    "KinematicTree, RigidBody2D and ContactSphereTriangle, DOPRI5; same contact law, friction "
    "clamped on both sides"
)
_HALF_WIDTH = 0.1  # m, of the wall across the plane of motion


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


def solver_settings(exu: Any, t_end: float, rtol: float, output_step: float = 1e-3) -> Any:
    """Return the settings of a run to ``t_end`` (s), in pieces of ``output_step`` (s)."""
    settings = exu.SimulationSettings()
    time = settings.timeIntegration
    time.endTime = t_end
    time.numberOfSteps = max(1, round(t_end / output_step))
    time.automaticStepSize = True
    time.absoluteTolerance = 1e-2 * rtol
    time.relativeTolerance = rtol
    time.initialStepSize = 1e-6
    time.minimumStepSize = 1e-12
    time.explicit.computeEndOfStepAccelerations = False
    time.verboseMode = 0
    settings.solution.file.write = False
    settings.solution.sensors.writePeriod = t_end
    return settings


def build(scene: Scene, mu: float) -> tuple[Any, int, int]:
    """Return the assembled system and the numbers of its two nodes."""
    exu = importlib.import_module(MODULE)
    items = importlib.import_module(f"{MODULE}.itemInterface")
    model, b = PythonModel(scene), scene.buffer
    system = exu.SystemContainer().AddSystem()
    q, v = scene.initial_coordinates()
    tree_node = system.AddNode(
        items.NodeGenericODE2(
            referenceCoordinates=[0.0] * 5,
            initialCoordinates=[q[0], q[1], q[2], q[3] - q[2], q[4]],
            initialCoordinates_t=[v[0], v[1], v[2], v[3] - v[2], v[4]],
            numberOfODE2Coordinates=5,
        )
    )
    joint = exu.JointType
    inertias = [0.0, 0.0, scene.chaser.inertia, scene.cylinder.inertia, scene.probe.inertia]
    middles = [0.0, 0.0, 0.0, -scene.cylinder.length / 2.0, -scene.probe.com_offset]
    tree = system.AddObject(
        items.ObjectKinematicTree(
            nodeNumber=tree_node,
            jointTypes=[
                joint.PrismaticX,
                joint.PrismaticY,
                joint.RevoluteZ,
                joint.RevoluteZ,
                joint.PrismaticX,
            ],
            linkParents=[-1, 0, 1, 2, 3],
            jointTransformations=exu.Matrix3DList([np.eye(3)] * 5),
            jointOffsets=exu.Vector3DList([[x, 0.0, 0.0] for x in (0.0, 0.0, 0.0, b.a, 0.0)]),
            linkInertiasCOM=exu.Matrix3DList([inertia * np.eye(3) for inertia in inertias]),
            linkCOMs=exu.Vector3DList([[x, 0.0, 0.0] for x in middles]),
            linkMasses=[0.0, 0.0, scene.chaser.mass, scene.cylinder.mass, scene.probe.mass],
            jointPControlVector=[0.0, 0.0, 0.0, b.k_T, b.k_A],
            jointDControlVector=[0.0, 0.0, 0.0, b.c_T, b.c_A],
            jointPositionOffsetVector=[0.0, 0.0, 0.0, 0.0, scene.rest_length],
            jointVelocityOffsetVector=[0.0] * 5,
        )
    )
    target_node = system.AddNode(
        items.NodeRigidBody2D(
            referenceCoordinates=[0.0] * 3, initialCoordinates=q[5:], initialVelocities=v[5:]
        )
    )
    target = system.AddObject(
        items.ObjectRigidBody2D(
            mass=scene.target.mass, inertia=scene.target.inertia, nodeNumber=target_node
        )
    )
    tip = system.AddMarker(
        items.MarkerKinematicTreeRigid(objectNumber=tree, linkNumber=4, localPosition=[0.0] * 3)
    )
    cone = system.AddMarker(items.MarkerBodyRigid(bodyNumber=target, localPosition=[0.0] * 3))
    for x, y, along_x, along_y in model.walls:
        lip = [x + along_x * model.L_c, y + along_y * model.L_c, 0.0]
        data = items.NodeGenericData(
            initialCoordinates=[0.1, 0.0, 0.0, 0.0], numberOfDataCoordinates=4
        )
        system.AddObject(
            items.ObjectContactSphereTriangle(
                markerNumbers=[tip, cone],
                nodeNumber=system.AddNode(data),
                sphereRadius=scene.probe.tip_radius,
                trianglePoints=exu.Vector3DList([[x, y, -_HALF_WIDTH], [x, y, _HALF_WIDTH], lip]),
                includeEdges=7,
                dynamicFriction=mu,
                frictionProportionalZone=scene.friction.v_eps,
                contactStiffness=model.K,
                contactStiffnessExponent=1.5,
                # 3/2 (1 - e) is to be our factor
                restitutionCoefficient=1.0 - model.damping / 1.5,
                minimumImpactVelocity=scene.contact.v_0_floor,
                impactModel=1,
            )
        )
    system.Assemble()
    return system, tree_node, target_node
