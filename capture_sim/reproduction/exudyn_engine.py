"""A scene's two vehicles, buffer and cone in Exudyn: an independent multibody code.

A kinematic tree (chaser, cylinder, probe), a planar rigid body (target) and two contacts of a
sphere with a triangle.  Exudyn's Hunt-Crossley factor 3/2 (1 - e) is made that of our law by
its restitution; its friction is mu F_n clamp(v / v_eps).  Touches are not located: the impact
speed is that at a step's end.
"""

from __future__ import annotations

import importlib
import math
from typing import Any

import numpy as np

from capture_sim.scene.parts import Scene

NAME = "Exudyn"
MODULE = "exudyn"
_HALF_WIDTH = 0.1  # m, of the wall across the plane of motion


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
    walls = system.AddMarker(items.MarkerBodyRigid(bodyNumber=target, localPosition=[0.0] * 3))
    for side in (1.0, -1.0):
        x, y = -cone.L_T, side * cone.R_c  # the wall's inner end, in the target's frame
        lip_x = x - cone.L_c * math.cos(cone.beta)
        lip = [lip_x, y + side * cone.L_c * math.sin(cone.beta), 0.0]
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
                frictionProportionalZone=scene.friction.v_eps,
                contactStiffness=stiffness,
                contactStiffnessExponent=1.5,
                # 3/2 (1 - e) is to be our factor
                restitutionCoefficient=1.0 - damping / 1.5,
                minimumImpactVelocity=contact.v_0_floor,
                impactModel=1,
            )
        )
    system.Assemble()
    return system, tree_node, target_node
