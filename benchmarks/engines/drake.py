"""The paper's scene in Drake, as near as its contact can be brought.

Drake's point contact is linear in penetration with Hunt-Crossley damping, and its friction a
regularised Stribeck law; stiffness and dissipation are fitted to the first bounce.  Time is
continuous, with an error-controlled integrator.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pydrake.geometry as geometry
import pydrake.math as transforms
import pydrake.multibody.plant as multibody
import pydrake.multibody.tree as tree
import pydrake.systems.analysis as analysis
import pydrake.systems.framework as framework

from benchmarks.engines import fitted
from benchmarks.trial import Outcome, Trial
from capture_sim.scene.parts import Scene

REFERENCE = ""
NOTE = (
    "MultibodyPlant, RK3 with error control; contact linear in penetration, "
    "fitted to the first bounce"
)
_FIT_STEP = 2e-6  # s


def trials(scene: Scene, truth: Outcome, quick: bool) -> Iterator[Trial]:
    """Yield the settings to try."""
    contact = functools.cache(lambda: fitted.fit(scene, (1e7, 5.0), bouncing))
    for accuracy in (1e-4,) if quick else (1e-2, 1e-3, 1e-4, 1e-5, 1e-6):
        job = functools.partial(prepare, scene, accuracy, contact)
        yield Trial("Drake, fitted", f"accuracy {accuracy:.0e}", job, "engine", truth)


def prepare(
    scene: Scene, accuracy: float, contact: Callable[[], tuple[float, float]]
) -> tuple[Callable[[], Any], Callable[[Any], Outcome]]:
    """Build the system; return what runs it and what reads the outcome."""
    simulator, plant, context = build(scene, accuracy, *contact())

    def read(_: Any) -> Outcome:
        evaluations = simulator.get_integrator().get_num_derivative_evaluations()
        places = plant.GetPositions(context)
        return Outcome(fitted.coordinates(scene, places), int(evaluations))

    return lambda: simulator.AdvanceTo(scene.run.t_end), read


def build(scene: Scene, accuracy: float, stiffness: float, dissipation: float) -> tuple:
    """Return simulator, plant and the plant's context, at the release; N/m and s/m."""
    builder = framework.DiagramBuilder()
    plant, _ = multibody.AddMultibodyPlantSceneGraph(builder, time_step=0.0)
    plant.mutable_gravity_field().set_gravity_vector(np.zeros(3))
    _add_bodies(scene, plant, stiffness, dissipation)
    plant.set_contact_model(multibody.ContactModel.kPoint)
    plant.Finalize()
    plant.set_stiction_tolerance(scene.friction.slip_regularization_speed)
    simulator = analysis.Simulator(builder.Build())
    analysis.ResetIntegratorFromFlags(simulator, "runge_kutta3", 1e-3)
    integrator = simulator.get_mutable_integrator()
    integrator.set_target_accuracy(accuracy)
    integrator.request_initial_step_size_target(1e-6)
    simulator.get_mutable_context().SetTime(0.0)
    context = plant.GetMyMutableContextFromRoot(simulator.get_mutable_context())
    places, rates = fitted.joints(scene)
    plant.SetPositions(context, places)
    plant.SetVelocities(context, rates)
    simulator.Initialize()
    return simulator, plant, context


def _add_bodies(scene: Scene, plant: Any, stiffness: float, dissipation: float) -> None:
    b, probe, instance = scene.buffer, scene.probe, tree.default_model_instance()

    def body(name: str, mass: float, inertia: float, x: float = 0.0) -> Any:
        """Add a body whose centre of mass lies at ``x`` (m) on its own axis."""
        unit = tree.UnitInertia(*[inertia / mass if mass else 0.0] * 3)
        centre = np.array([x, 0.0, 0.0])
        about = unit.ShiftFromCenterOfMass(-centre)
        return plant.AddRigidBody(name, instance, tree.SpatialInertia(mass, centre, about))

    def joint(kind: Any, parent: Any, child: Any, axis: list[int], at: float, *more: float) -> Any:
        """Add a joint to a place ``at`` (m) on the parent's axis."""
        name = f"{parent.name()}_{child.name()}"
        shift = transforms.RigidTransform([at, 0.0, 0.0])
        frame = plant.AddFrame(tree.FixedOffsetFrame(f"{name}_at", parent.body_frame(), shift))
        return plant.AddJoint(kind(name, frame, child.body_frame(), axis, *more))

    def planar(child: Any) -> None:
        slides = [body(f"{child.name()}_{axis}", 0.0, 0.0) for axis in "xy"]
        for parent, slide, axis in zip(
            [plant.world_body(), slides[0]], slides, ([1, 0, 0], [0, 1, 0]), strict=True
        ):
            joint(tree.PrismaticJoint, parent, slide, axis, 0.0, -math.inf, math.inf, 0.0)
        joint(tree.RevoluteJoint, slides[1], child, [0, 0, 1], 0.0, 0.0)

    chaser = body("chaser", scene.chaser.mass, scene.chaser.inertia)
    half = 0.5 * scene.cylinder.length
    cylinder = body("cylinder", scene.cylinder.mass, scene.cylinder.inertia, -half)
    tip = body("probe", probe.mass, probe.inertia, -probe.com_offset)
    target = body("target", scene.target.mass, scene.target.inertia)
    planar(chaser)
    hinge = joint(tree.RevoluteJoint, chaser, cylinder, [0, 0, 1], b.hinge_offset, b.c_T)
    bounds = (-math.inf, math.inf, b.c_A)
    stroke = joint(tree.PrismaticJoint, cylinder, tip, [1, 0, 0], scene.rest_length, *bounds)
    planar(target)
    plant.AddForceElement(tree.RevoluteSpring(hinge, 0.0, b.k_T))
    plant.AddForceElement(tree.PrismaticSpring(stroke, 0.0, b.k_A))

    mu = scene.friction.mu if scene.friction.law != "none" else 0.0
    friction = multibody.CoulombFriction(mu, mu)
    soft, hard = geometry.ProximityProperties(), geometry.ProximityProperties()
    geometry.AddContactMaterial(dissipation, stiffness, friction, soft)
    # in series with the tip: so much stiffer that the tip's values are what counts
    geometry.AddContactMaterial(0.0, 1e9 * stiffness, friction, hard)
    ball = geometry.Sphere(probe.tip_radius)
    plant.RegisterCollisionGeometry(tip, transforms.RigidTransform(), ball, "tip", soft)
    for wall in fitted.walls(scene):
        turned = transforms.RotationMatrix.MakeZRotation(wall.angle)
        place = transforms.RigidTransform(turned, [wall.x, wall.y, 0.0])
        box = geometry.Box(scene.cone.L_c, 2.0 * fitted.THICKNESS, 0.2)
        plant.RegisterCollisionGeometry(target, place, box, wall.name, hard)


def bouncing(scene: Scene) -> fitted.BounceOf:
    """Return what tries a contact on the first bounce."""

    def bounce_of(stiffness: float, dissipation: float) -> tuple[float, np.ndarray]:
        simulator, plant, context = build(scene, 1e-7, stiffness, dissipation)
        t, touched = 0.0, 0.0
        before = plant.GetVelocities(context)[5:7].copy()
        while t < scene.run.t_end:
            t += _FIT_STEP
            simulator.AdvanceTo(t)
            now = plant.GetVelocities(context)[5:7].copy()
            if np.any(now != before):
                touched += _FIT_STEP
            elif touched:
                break
            before = now
        return touched, before

    return bounce_of
