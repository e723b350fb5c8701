"""The paper's scene in Exudyn, an independent multibody code, whose friction is clamped.

A kinematic tree (chaser, cylinder, probe), a planar rigid body (target) and two contacts of a
sphere with a triangle.  Exudyn's Hunt-Crossley factor 3/2 (1 - e) is made that of our law by
its restitution; its friction is mu F_n clamp(v / v_eps), so it is compared with a reference of
that law.  Touches are not located: the impact speed is that at a step's end.

    .venv/bin/python -m benchmarks.engines.exudyn

writes the run that `make reproduction` compares the paper's Figures 10 and 11 with.
"""

from __future__ import annotations

import functools
import importlib.metadata
import math
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import exudyn as exu
import numpy as np
from exudyn import itemInterface as items  # noqa: N813

from benchmarks.trial import Outcome, Trial
from capture_sim.base.resources import config_dir
from capture_sim.scene.loading import load_scene
from capture_sim.scene.parts import Scene

REFERENCE = "_clamp"  # what the reference's name ends with, friction by clamp
NOTE = (
    "KinematicTree, RigidBody2D and ContactSphereTriangle, DOPRI5; same contact law, friction "
    "clamped on both sides"
)
_HALF_WIDTH = 0.1  # m, of the wall across the plane of motion
_DOPRI5 = exu.DynamicSolverType.DOPRI5
_KINDS = (exu.OutputVariableType.Coordinates, exu.OutputVariableType.Coordinates_t)


def trials(scene: Scene, truth: Outcome, quick: bool) -> Iterator[Trial]:
    """Yield the settings to try."""
    for rtol in (1e-6,) if quick else (1e-3, 1e-4, 1e-5, 1e-6, 1e-7, 1e-8, 1e-9, 1e-10):
        job = functools.partial(prepare, scene, rtol)
        yield Trial("Exudyn", f"rtol {rtol:.0e}", job, "engine", truth)


def prepare(
    scene: Scene, rtol: float, mu: float | None = None
) -> tuple[Callable[[], bool], Callable[[bool], Outcome]]:
    """Build the system; return what runs it and what reads the outcome.

    ``mu`` takes the place of the scene's coefficient of friction.
    """
    system, *nodes = build(scene, scene.friction.mu if mu is None else mu)
    settings = solver_settings(scene.run.t_end, rtol)

    def read(done: bool) -> Outcome:
        if not done:
            return Outcome.failed("solver gave up")
        values = [np.atleast_2d(system.GetNodeOutput(node, _KINDS[0])) for node in nodes]
        return Outcome(coordinates(*values)[0], 0)

    return lambda: system.SolveDynamic(settings, solverType=_DOPRI5), read


def coordinates(chain: np.ndarray, body: np.ndarray) -> np.ndarray:
    """Return q (n, 8), or its rate, of the tree's coordinates (n, 5) and the target's."""
    return np.column_stack([chain[:, :3], chain[:, 2] + chain[:, 3], chain[:, 4], body[:, :3]])


def solver_settings(t_end: float, rtol: float, output_step: float = 1e-3) -> Any:
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
    b, cone, contact = scene.buffer, scene.cone, scene.contact
    compliance = sum((1.0 - part.nu**2) / part.E for part in (contact.tip, contact.wall))
    stiffness = 4.0 * math.sqrt(scene.probe.tip_radius) / (3.0 * compliance)  # Hertz
    damping = 0.75 * (1.0 - contact.restitution**2)
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
    slide_x, slide_y, turn = (
        exu.JointType.PrismaticX,
        exu.JointType.PrismaticY,
        exu.JointType.RevoluteZ,
    )
    inertias = [0.0, 0.0, scene.chaser.inertia, scene.cylinder.inertia, scene.probe.inertia]
    middles = [0.0, 0.0, 0.0, -scene.cylinder.length / 2.0, -scene.probe.com_offset]
    tree = system.AddObject(
        items.ObjectKinematicTree(
            nodeNumber=tree_node,
            jointTypes=[slide_x, slide_y, turn, turn, slide_x],
            linkParents=[-1, 0, 1, 2, 3],
            jointTransformations=exu.Matrix3DList([np.eye(3)] * 5),
            jointOffsets=exu.Vector3DList(
                [[x, 0.0, 0.0] for x in (0.0, 0.0, 0.0, b.hinge_offset, 0.0)]
            ),
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
    walls = system.AddMarker(items.MarkerBodyRigid(bodyNumber=target, localPosition=[0.0] * 3))
    for side in (1.0, -1.0):
        x, y = -cone.L_T, side * cone.R_c  # the wall's inner end, in the target's frame
        lip_x = x - cone.L_c * math.cos(cone.half_angle)
        lip = [lip_x, y + side * cone.L_c * math.sin(cone.half_angle), 0.0]
        data = items.NodeGenericData(
            initialCoordinates=[0.1, 0.0, 0.0, 0.0], numberOfDataCoordinates=4
        )
        system.AddObject(
            items.ObjectContactSphereTriangle(
                markerNumbers=[tip, walls],
                nodeNumber=system.AddNode(data),
                sphereRadius=scene.probe.tip_radius,
                trianglePoints=exu.Vector3DList([[x, y, -_HALF_WIDTH], [x, y, _HALF_WIDTH], lip]),
                includeEdges=7,
                dynamicFriction=mu,
                frictionProportionalZone=scene.friction.slip_regularization_speed,
                contactStiffness=stiffness,
                contactStiffnessExponent=1.5,
                # 3/2 (1 - e) is to be our factor
                restitutionCoefficient=1.0 - damping / 1.5,
                minimumImpactVelocity=contact.min_approach_speed,
                impactModel=1,
            )
        )
    system.Assemble()
    return system, tree_node, target_node


def run_trace(scene: Scene, rtol: float = 1e-9, step: float = 1e-3) -> tuple[np.ndarray, ...]:
    """Return times (n,), s, at least ``step`` apart, coordinates and rates (n, 8) of a run."""
    system, *nodes = build(scene, scene.friction.mu)
    sensors = [
        system.AddSensor(
            items.SensorNode(nodeNumber=node, storeInternal=True, outputVariableType=kind)
        )
        for kind in _KINDS
        for node in nodes
    ]
    system.Assemble()
    settings = solver_settings(scene.run.t_end, rtol, step)
    settings.solution.sensors.writePeriod = step
    if not system.SolveDynamic(settings, solverType=_DOPRI5):
        raise RuntimeError("Exudyn's solver gave up")
    values = [np.asarray(system.GetSensorStoredData(sensor)) for sensor in sensors]
    q, v = (coordinates(*(value[:, 1:] for value in pair)) for pair in (values[:2], values[2:]))
    return np.minimum(values[0][:, 0], scene.run.t_end), q, v


def main() -> None:
    """Write the designed case's velocities: every ms of the first contact, then every 5 ms."""
    scene = load_scene("paper_designed", ["friction.law=clamp"])
    t, q, v = run_trace(replace(scene, run=replace(scene.run, t_end=1.3)))
    kept = (t <= 0.3) | (np.arange(t.size) % 5 == 0)
    path = config_dir() / "reference" / "paper_designed_exudyn.csv"
    version = importlib.metadata.version("exudyn")
    head = (
        f"Exudyn {version} (ObjectKinematicTree, RigidBody2D, ContactSphereTriangle; DOPRI5, "
        "rtol 1e-9)\n"
        "scene paper_designed with friction.law=clamp, the friction that Exudyn has\n"
        "made by .venv/bin/python -m benchmarks.engines.exudyn\n"
        "t s, rates of x_S m/s, y_S m/s, theta_S rad/s, theta_P rad/s, h m/s, x_T m/s, y_T m/s, "
        "theta_T rad/s, h m"
    )
    table = np.column_stack([t, v, q[:, 4]])[kept]
    np.savetxt(path, table, fmt="%.11g", delimiter=",", header=head)
    print(f"{len(table)} rows in {path}")


if __name__ == "__main__":
    main()
