"""Vehicles and buffer in the loop: the bench in steps of fixed length, with a wrench on its tip."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from capture_sim.base.compiled.kernels import plain
from capture_sim.base.interrupts import in_worker
from capture_sim.dynamics.bench import Bench, Checkpoint
from capture_sim.dynamics.samples import Event, EventKind
from capture_sim.errors import CaptureSimError, SceneError, SimulationError
from capture_sim.hardware.law import NO_LAW, NO_WRENCH, TipState, WallLaw, Wrench
from capture_sim.run.simulation import simulate
from capture_sim.scene.geometry import tip_motion
from capture_sim.scene.parts import Scene

#: Number of samples in a step; they give the forces and the energy within the step.
N_SAMPLES = 10

_tip_motion = plain(tip_motion)


class SafeStopError(CaptureSimError):
    """The loop must be opened; the message gives the reason."""


class StageState(NamedTuple):
    """A state of a stage, for :meth:`LoopStage.restore`."""

    bench: Checkpoint
    steps: int
    samples: np.ndarray  # of the last step, of dtype SAMPLE

    @property
    def energy(self) -> float:
        """See :attr:`LoopStage.energy`."""
        return float(_energies(self.samples)[-1])


def _energies(samples: np.ndarray) -> np.ndarray:
    lost = samples["dissipated_contact"] + samples["dissipated_friction"]
    return np.asarray(samples["work_thrust"] + samples["energy_residual"] - lost)


def state_after_rail(scene: Scene) -> tuple[np.ndarray, np.ndarray]:
    """Return coordinates (8,) and rates (8,) of the bench when the chaser leaves its rail.

    A scene's rail ends before the first touch and after the hanging mass has landed.  SceneError if
    the chaser does not reach the end of the rail.
    """
    for event in simulate(scene).events:
        if event.kind == EventKind.RAIL_END:
            return event.q, event.v
    raise SceneError("rail: must end before the contact for hardware in the loop")


class LoopStage:
    """Vehicles, buffer, supports, stroke stops and latch, with an external wrench on the tip.

    The wrench is constant over each ``step`` (s).  With a rail, the stage begins where the chaser
    leaves the rail.  After the latch has closed, the wrench has no effect.  The walls of the scene
    do not act; see :meth:`set_law`.  ``state``: initial coordinates (8,) and rates (8,); None for
    the initial state of the scene.
    """

    def __init__(
        self, scene: Scene, step: float = 1e-3, state: tuple[np.ndarray, np.ndarray] | None = None
    ) -> None:
        self.scene, self.step = scene, step
        self._bench = Bench(scene)
        if state is None:
            has_rail = scene.rail is not None
            state = state_after_rail(scene) if has_rail else scene.initial_coordinates()
        self._bench.start_at(*state)
        self._fractions = np.arange(1, N_SAMPLES + 1) / N_SAMPLES
        self._count = 0
        self.set_law(NO_LAW)
        self._bench.drive_tip((0.0, 0.0, 0.0), 0.0)
        # load or compile the kernels now: within the loop, each would delay a wrench
        self._samples = in_worker(lambda: self._bench.advance(np.zeros(1)))

    @property
    def t(self) -> float:
        """Time, s."""
        return self._count * self.step

    @property
    def q(self) -> np.ndarray:
        """Coordinates (8,), m and rad."""
        return np.array(self._samples["q"][-1])

    @property
    def v(self) -> np.ndarray:
        """Rates (8,)."""
        return np.array(self._samples["v"][-1])

    @property
    def tip(self) -> TipState:
        """Present pose and velocity of the tip."""
        q, v = self._samples["q"][-1].tolist(), self._samples["v"][-1].tolist()
        angles = [f(q[i]) for i in (2, 3, 7) for f in (math.sin, math.cos)]
        x, y, vx, vy = _tip_motion([*q, *v], self.scene.buffer.hinge_offset, *angles)
        return TipState(self.t, x + self.scene.cone.L_T, y, q[3] - q[7], vx, vy, v[3] - v[7])

    @property
    def energy(self) -> float:
        """Energy that vehicles, springs and law have gained since the start, J.

        It includes the energy that the dampers of buffer, stops and latch have dissipated.  So only
        the wrench can raise this energy; damping and friction of the law lower it.
        """
        return float(_energies(self._samples)[-1])

    @property
    def peak_energy(self) -> float:
        """Largest :attr:`energy` within the last step, J; NaN if the energy is not finite."""
        return float(_energies(self._samples).max())

    @property
    def forces(self) -> np.ndarray:
        """Magnitude of the force on the tip within the last step, (N_SAMPLES,), N."""
        force = self._samples["contact_force"]
        return np.hypot(force[:, 0], force[:, 1])

    @property
    def sample(self) -> np.ndarray:
        """The present state, a copy (1,) of dtype SAMPLE."""
        return self._samples[-1:].copy()

    @property
    def events(self) -> Sequence[Event]:
        """Events that the bench has located so far."""
        return self._bench.events

    @property
    def latched(self) -> bool:
        """True if the latch has closed."""
        return bool(self._samples["elastic_latch"][-1] > 0.0)

    def closing_speed(self, nx: float, ny: float, state: StageState | None = None) -> float:
        """Return the closing speed of the vehicles at the tip, along a normal (target's axes), m/s.

        Chaser and buffer count as one rigid body with their total momentum and angular momentum, so
        oscillations of the buffer do not change the speed.  ``state``: None for the present state.
        """
        samples = self._samples if state is None else state.samples
        chaser, target, tip, normal = self._contact(nx, ny, samples)
        speed = chaser.velocity_at(tip) - target.velocity_at(tip)
        return -float(normal @ speed)

    def contact_mass(self, nx: float, ny: float) -> float:
        """Return the effective mass, kg, of a contact with this normal if the buffer is rigid."""
        chaser, target, tip, normal = self._contact(nx, ny, self._samples)
        return 1.0 / (chaser.mobility(tip, normal) + target.mobility(tip, normal))

    def _contact(
        self, nx: float, ny: float, samples: np.ndarray
    ) -> tuple[RigidBody, RigidBody, np.ndarray, np.ndarray]:
        """Return chaser and target as rigid bodies, and tip and normal in the world's axes."""
        q, v, scene = samples["q"][-1], samples["v"][-1], self.scene
        c, s = math.cos(q[7]), math.sin(q[7])
        along, across = (
            np.array([math.cos(q[3]), math.sin(q[3])]),
            np.array([-math.sin(q[3]), math.cos(q[3])]),
        )
        offset = scene.buffer.hinge_offset
        hinge = q[:2] + offset * np.array([math.cos(q[2]), math.sin(q[2])])
        hinge_rate = v[:2] + offset * v[2] * np.array([-math.sin(q[2]), math.cos(q[2])])

        def on_probe(distance: float, rate: float) -> tuple[np.ndarray, np.ndarray, float]:
            velocity = hinge_rate + rate * along + distance * v[3] * across
            return hinge + distance * along, velocity, float(v[3])

        cylinder = on_probe(-0.5 * scene.cylinder.length, 0.0)
        probe = on_probe(q[4] - scene.probe.com_offset, v[4])
        chaser = joined_body(
            RigidBody(scene.chaser.mass, scene.chaser.inertia, q[:2], v[:2], float(v[2])),
            RigidBody(scene.cylinder.mass, scene.cylinder.inertia, *cylinder),
            RigidBody(scene.probe.mass, scene.probe.inertia, *probe),
        )
        target = RigidBody(scene.target.mass, scene.target.inertia, q[5:7], v[5:7], float(v[7]))
        normal = np.array([c * nx - s * ny, s * nx + c * ny])
        return chaser, target, hinge + q[4] * along, normal

    def set_law(self, law: WallLaw) -> None:
        """Set the law of the walls, with the tip outside them; NO_LAW removes the walls."""
        self._bench.set_contact(
            law.stiffness, law.exponent, law.damping, law.offset, law.friction, law.slip_speed
        )

    def saved(self) -> StageState:
        """Return the state, for :meth:`restore` of this stage or of another one of this scene."""
        return StageState(self._bench.saved(), self._count, self._samples)

    def restore(self, state: StageState) -> None:
        """Restore a saved state, including its law."""
        self._bench.restore(state.bench)
        self._count, self._samples = state.steps, state.samples

    def take_step(self, wrench: Wrench = NO_WRENCH) -> None:
        """Advance one step under a constant wrench; SafeStopError if the bench cannot continue."""
        times = (self._count + self._fractions) * self.step
        self._bench.drive_tip((wrench.fx, wrench.fy, wrench.tz), times[-1])
        try:
            self._samples = self._bench.advance(times)
        except SimulationError as error:
            raise SafeStopError(str(error)) from None
        self._count += 1


class RigidBody(NamedTuple):
    """A planar rigid body: kg, kg m2, centre of mass (2,), m, its velocity (2,), m/s, and rad/s."""

    mass: float
    inertia: float
    centre: np.ndarray
    velocity: np.ndarray
    spin: float

    def velocity_at(self, point: np.ndarray) -> np.ndarray:
        """Return the velocity (2,) of the body's material at a point."""
        x, y = point - self.centre
        return self.velocity + self.spin * np.array([-y, x])

    def mobility(self, point: np.ndarray, normal: np.ndarray) -> float:
        """Return the speed of a point along a normal after a unit impulse on it, 1/kg."""
        x, y = point - self.centre
        return float(1.0 / self.mass + (x * normal[1] - y * normal[0]) ** 2 / self.inertia)


def joined_body(*bodies: RigidBody) -> RigidBody:
    """Return the rigid body with the total mass, momentum and angular momentum of some bodies."""
    mass = sum(body.mass for body in bodies)
    centre = sum(body.mass * body.centre for body in bodies) / mass
    velocity = sum(body.mass * body.velocity for body in bodies) / mass
    inertia = spin = 0.0
    for body in bodies:
        (x, y), (vx, vy) = body.centre - centre, body.velocity - velocity
        inertia += body.inertia + body.mass * (x * x + y * y)
        spin += body.inertia * body.spin + body.mass * (x * vy - y * vx)
    return RigidBody(mass, inertia, np.asarray(centre), np.asarray(velocity), spin / inertia)
