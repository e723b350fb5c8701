"""The paper's scene in Drake, as near as its contact can be brought.

Drake's point contact is linear in penetration with Hunt-Crossley damping, and its friction a
regularised Stribeck law; stiffness and dissipation are fitted to duration and momentum of the
reference's first bounce, which flatters it.  The walls are boxes with their faces where the
cone's are; time is continuous, with an error-controlled integrator.
"""

from __future__ import annotations

import functools
import importlib
import math
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import numpy as np

from benchmarks.engines import bounce
from benchmarks.engines.own import with_run
from benchmarks.trial import Outcome, Trial
from capture_sim.scene.parts import Scene

NAME = "Drake"
MODULE = "pydrake"
PACKAGE = "drake"
REFERENCE = ""
NOTE = (
    "MultibodyPlant, RK3 with error control; contact linear in penetration, "
    "fitted to the first bounce"
)
_THICKNESS = 0.01  # m, half that of a wall, behind its face


def trials(scene: Scene, quick: bool) -> Iterator[Trial]:
    """Yield the settings to try."""
    contact = functools.cache(functools.partial(fitted_contact, scene))
    for accuracy in (1e-4,) if quick else (1e-2, 1e-3, 1e-4, 1e-5, 1e-6):
        job = functools.partial(prepare, scene, accuracy, contact)
        yield Trial(f"{NAME}, fitted", f"accuracy {accuracy:.0e}", job, "engine")


def prepare(
    scene: Scene, accuracy: float, contact: Callable[[], tuple[float, float]]
) -> Callable[[], Callable[[], Outcome]]:
    """Build the system; return what runs it and returns what reads the outcome."""
    simulator, plant, context = build(scene, accuracy, *contact())
    simulator.Initialize()

    def run() -> Callable[[], Outcome]:
        try:
            simulator.AdvanceTo(scene.run.t_end)
        except RuntimeError as error:
            failure = f"stopped: {str(error).splitlines()[0][:60]}"
            return lambda: Outcome(np.full(8, np.nan), 0, failure=failure)

        def read() -> Outcome:
            p = plant.GetPositions(context)
            q = [p[0], p[1], p[2], p[2] + p[3], p[4] + scene.rest_length, *p[5:8]]
            evaluations = simulator.get_integrator().get_num_derivative_evaluations()
            return Outcome(np.array(q), int(evaluations))

        return read

    return run


def build(
    scene: Scene, accuracy: float, stiffness: float, dissipation: float
) -> tuple[Any, Any, Any]:
    """Return simulator, plant and the plant's context, at the release.

    ``stiffness`` N/m; ``dissipation`` s/m.
    """
    framework = importlib.import_module("pydrake.systems.framework")
    analysis = importlib.import_module("pydrake.systems.analysis")
    multibody = importlib.import_module("pydrake.multibody.plant")
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
    q, v = scene.initial_coordinates()
    plant.SetPositions(context, [q[0], q[1], q[2], q[3] - q[2], q[4] - scene.rest_length, *q[5:]])
    plant.SetVelocities(context, [v[0], v[1], v[2], v[3] - v[2], v[4], *v[5:]])
    return simulator, plant, context


def _add_bodies(scene: Scene, plant: Any, stiffness: float, dissipation: float) -> None:
    tree = importlib.import_module("pydrake.multibody.tree")
    geometry = importlib.import_module("pydrake.geometry")
    math_ = importlib.import_module("pydrake.math")
    b, cone, probe = scene.buffer, scene.cone, scene.probe
    instance = tree.default_model_instance()

    def body(name: str, mass: float, inertia: float, x: float = 0.0) -> Any:
        """Add a body whose centre of mass lies at ``x`` (m) on its own axis."""
        unit = tree.UnitInertia(inertia / mass, inertia / mass, inertia / mass)
        centre = np.array([x, 0.0, 0.0])
        about = unit.ShiftFromCenterOfMass(-centre)
        return plant.AddRigidBody(name, instance, tree.SpatialInertia(mass, centre, about))

    def frame(name: str, parent: Any, at: float) -> Any:
        """Return the parent's frame shifted by ``at`` (m) along its axis."""
        shift = math_.RigidTransform([at, 0.0, 0.0])
        return plant.AddFrame(tree.FixedOffsetFrame(f"{name}_at", parent.body_frame(), shift))

    def slide(
        name: str, parent: Any, child: Any, axis: list[int], at: float = 0.0, damping: float = 0.0
    ) -> Any:
        joint = tree.PrismaticJoint(
            name, frame(name, parent, at), child.body_frame(), axis, -math.inf, math.inf, damping
        )
        return plant.AddJoint(joint)

    def turn(name: str, parent: Any, child: Any, at: float = 0.0, damping: float = 0.0) -> Any:
        joint = tree.RevoluteJoint(
            name, frame(name, parent, at), child.body_frame(), [0, 0, 1], damping
        )
        return plant.AddJoint(joint)

    def planar(name: str, child: Any) -> None:
        nothing = tree.SpatialInertia(0.0, np.zeros(3), tree.UnitInertia(0.0, 0.0, 0.0))
        carriages = [plant.AddRigidBody(f"{name}_{axis}", instance, nothing) for axis in ("x", "y")]
        slide(f"{name}_slide_x", plant.world_body(), carriages[0], [1, 0, 0])
        slide(f"{name}_slide_y", carriages[0], carriages[1], [0, 1, 0])
        turn(f"{name}_turn", carriages[1], child)

    chaser = body("chaser", scene.chaser.mass, scene.chaser.inertia)
    half = 0.5 * scene.cylinder.length
    cylinder = body("cylinder", scene.cylinder.mass, scene.cylinder.inertia, -half)
    tip = body("probe", probe.mass, probe.inertia, -probe.com_offset)
    target = body("target", scene.target.mass, scene.target.inertia)
    planar("chaser", chaser)
    hinge = turn("hinge", chaser, cylinder, b.hinge_offset, b.c_T)
    stroke = slide("stroke", cylinder, tip, [1, 0, 0], scene.rest_length, b.c_A)
    planar("target", target)
    plant.AddForceElement(tree.RevoluteSpring(hinge, 0.0, b.k_T))
    plant.AddForceElement(tree.PrismaticSpring(stroke, 0.0, b.k_A))

    mu = scene.friction.mu if scene.friction.law != "none" else 0.0
    friction = importlib.import_module("pydrake.multibody.plant").CoulombFriction(mu, mu)
    soft, hard = geometry.ProximityProperties(), geometry.ProximityProperties()
    geometry.AddContactMaterial(dissipation, stiffness, friction, soft)
    # in series with the tip: so much stiffer that the tip's values are what counts
    geometry.AddContactMaterial(0.0, 1e9 * stiffness, friction, hard)
    plant.RegisterCollisionGeometry(
        tip, math_.RigidTransform(), geometry.Sphere(probe.tip_radius), "tip", soft
    )
    for name, side in (("plus", 1.0), ("minus", -1.0)):
        middle_x = -cone.L_T - 0.5 * cone.L_c * math.cos(cone.half_angle)
        middle_y = side * (cone.R_c + 0.5 * cone.L_c * math.sin(cone.half_angle))
        place = [
            middle_x + _THICKNESS * math.sin(cone.half_angle),
            middle_y + side * _THICKNESS * math.cos(cone.half_angle),
            0.0,
        ]
        turned = math_.RigidTransform(
            math_.RotationMatrix.MakeZRotation(-side * cone.half_angle), place
        )
        box = geometry.Box(cone.L_c, 2.0 * _THICKNESS, 0.2)
        plant.RegisterCollisionGeometry(target, turned, box, name, hard)


def fitted_contact(scene: Scene) -> tuple[float, float]:
    """Return stiffness and dissipation that make the first bounce come out right, frictionless."""
    scene = replace(scene, friction=replace(scene.friction, law="none"))
    wanted = bounce.first_bounce(scene)
    scene = with_run(scene, t_end=wanted.start + 2e-3)

    def bounce_of(stiffness: float, dissipation: float) -> tuple[float, np.ndarray]:
        simulator, plant, context = build(scene, 1e-7, stiffness, dissipation)
        simulator.Initialize()
        t, step, first, last = 0.0, 2e-6, math.nan, math.nan
        before = plant.GetVelocities(context)[5:7].copy()
        while t < scene.run.t_end:
            t += step
            simulator.AdvanceTo(t)
            now = plant.GetVelocities(context)[5:7].copy()
            if np.any(now != before):
                first = t - step if math.isnan(first) else first
                last = t
            elif not math.isnan(first):
                break
            before = now
        return last - first, before

    return bounce.fit(scene, (1e7, 5.0), bounce_of)
