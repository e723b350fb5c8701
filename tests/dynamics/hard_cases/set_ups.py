"""Benches for the hard cases, arranged so that something about them is known exactly."""

from __future__ import annotations

import functools
import math
from typing import Any

import numpy as np
import pytest
from four_bodies import momentum
from random_accuracy import first_touch
from random_scenes import wide_scenes

from capture_sim import load_scene, simulate
from capture_sim.hardware.law import Wrench
from capture_sim.hardware.stage import LoopStage
from capture_sim.run.run import Run
from capture_sim.run.simulation import RunError
from capture_sim.scene.parts import Scene
from capture_sim.scene.paths import changed

ADAPTIVE = ("dop853", "dopri5")
METHODS = (*ADAPTIVE, "rk4")


@functools.cache
def _loaded(name: str) -> Scene:
    return load_scene(name)


def altered(scene: Scene, changes: dict[str, Any]) -> Scene:
    """The scene with values changed by their dotted names, one by one; like load_scene's."""
    return functools.reduce(lambda scene, item: changed(scene, *item), changes.items(), scene)


def turned(angle: float, x: float, y: float) -> np.ndarray:
    c, s = math.cos(angle), math.sin(angle)
    return np.array([c * x - s * y, s * x + c * y])


def outer_lip(scene: Scene, side: float = 1.0) -> tuple[float, float]:
    """The outer end of a wall in the target's frame, m."""
    cone = scene.cone
    x = -cone.L_T - cone.L_c * math.cos(cone.half_angle)
    return x, side * (cone.R_c + cone.L_c * math.sin(cone.half_angle))


def in_a_row(gap: float, changes: dict[str, Any], base: str = "paper_designed") -> Scene:
    """Chaser, probe, outer lip and the target's centre of mass on the x axis.

    Everything stays on the axis: a collision of three bodies in a row, see row_model.
    """
    scene = _loaded(base)
    x, y = outer_lip(scene)
    ahead = (
        scene.buffer.hinge_offset
        + scene.rest_length
        + scene.probe.tip_radius
        + math.hypot(x, y)
        + gap
    )
    at = {
        "initial.chaser.x": 0.0,
        "initial.chaser.y": 0.0,
        "initial.target.x": ahead,
        "initial.target.y": 0.0,
        "initial.target.theta": math.pi - math.atan2(y, x),
    }
    return altered(scene, at | changes)


def free_impact(gap: float, speed: float, e: float, changes: dict[str, Any]) -> Scene:
    """The probe alone against the target, both free: no axial spring, exact law."""
    free = {
        "buffer.k_A": 0.0,
        "buffer.c_A": 0.0,
        "contact.law": "exact",
        "contact.restitution": e,
        "initial.chaser.vx": speed,
        "run.rate": 1.0,
        "run.state_rate": 1.0,
    }
    return in_a_row(gap, free | changes)


def anvil(
    gap: float, changes: dict[str, Any], slope: float = 0.0, base: str = "paper_designed"
) -> Scene:
    """The tip ``gap`` (m) before the face of the +y wall, of a target that can not turn.

    The wall's normal towards the tip is -x turned by ``slope`` (rad); the point that will
    be touched is 45 mm from the inner edge.
    """
    scene = _loaded(base)
    cone = scene.cone
    facing = math.atan2(-math.cos(cone.half_angle), -math.sin(cone.half_angle))
    theta = math.remainder(math.pi + slope - facing, 2.0 * math.pi)
    b = 0.045
    wall = turned(
        theta, -cone.L_T - b * math.cos(cone.half_angle), cone.R_c + b * math.sin(cone.half_angle)
    )
    off = (scene.probe.tip_radius + gap) * turned(slope, 1.0, 0.0)
    at = np.array([scene.buffer.hinge_offset + scene.rest_length, 0.0]) + off - wall
    there = {
        "target.inertia": 1e12,
        "initial.chaser.x": 0.0,
        "initial.chaser.y": 0.0,
        "initial.chaser.vx": 0.0,
        "initial.target.x": float(at[0]),
        "initial.target.y": float(at[1]),
        "initial.target.theta": theta,
    }
    return altered(scene, there | changes)


#: On supports, without what launches and what holds.
ON_THE_FLOOR = {"rail": None, "string": None, "latch": None}


def slowed(scene: Scene, pull: float, speed: float, rigid: bool = False) -> Scene:
    """Both vehicles at ``speed`` (m/s) over a floor that slows them.

    The rolling resistance of the target is constant as long as it rolls one way, so it
    presses the tip on the wall like a weight: the wall comes towards the tip with ``pull``
    (m/s^2) while they are apart.  Without axial spring the weight is the probe's, and the
    chaser is slowed so as to keep its distance; ``rigid``: the weight is the whole
    chaser's, which rolls freely.
    """
    g = scene.gravity
    c_target = pull / g
    c_chaser = 0.0
    if not rigid:
        m_T, m_P = scene.target.mass, scene.probe.mass
        together = pull * m_T / (m_T + m_P)
        body = scene.chaser.mass + scene.cylinder.mass
        c_chaser = together * body / ((body + m_P) * g)
    return altered(
        scene,
        {
            "supports.target.c_rr": c_target,
            "supports.chaser.c_rr": c_chaser,
            "initial.target.vx": scene.initial.target.vx + speed,
            "initial.chaser.vx": scene.initial.chaser.vx + speed,
        },
    )


def run(scene: Scene, **options: Any) -> Run:
    """Simulate; a run that had to stop gives what it has until there, with ``failure`` set."""
    try:
        return simulate(scene, **options)
    except RunError as error:
        return error.result


def times(result: Run, label: str) -> np.ndarray:
    """When something happened, s."""
    return np.array([e.t for e in result.events if e.kind.label == label])


def first(result: Run, label: str) -> Any:
    """The first event of a kind."""
    return next(e for e in result.events if e.kind.label == label)


def residual(result: Run) -> float:
    """Largest residual of the energy ledger, J."""
    return float(np.abs(result.samples["energy_residual"]).max(initial=0.0))


def assert_conserved(result: Run, allowed: float) -> None:
    """Momentum of all four bodies to ``allowed``, energy to 1e-9 of that at the start."""
    before, after = (momentum(result.scene, result.q[k], result.v[k]) for k in (0, -1))
    assert np.abs(after - before).max() <= allowed
    assert residual(result) < 1e-9 * result.samples["kinetic"][0]


def pushed(force: float, changes: dict[str, Any], steps: int) -> tuple[LoopStage, np.ndarray]:
    """A stage under a constant force (N) on the tip, inwards along the probe; strokes every ms."""
    scene = in_a_row(0.5, {"buffer.c_A": 0.0, "initial.chaser.vx": 0.0} | changes)
    stage = LoopStage(scene)
    heading = scene.initial.target.theta
    inwards = Wrench(-force * math.cos(heading), force * math.sin(heading))
    strokes = []
    for _ in range(steps):
        stage.take_step(inwards)
        strokes.append(stage.q[4] - scene.rest_length)
    return stage, np.array(strokes)


#: Speed of the heavy chaser, m/s, and the share of its mass that the probe's own may change.
SPEED, LIGHT = 0.1, 1e-3
ELASTIC = {"contact.law": "exact", "contact.restitution": 1.0}


def heavy_run(changes: dict[str, Any], **options: Any) -> Run:
    """A chaser of 10 t runs against a wall that does not move: one mass on the buffer.

    The buffer has neither spring nor damper unless ``changes`` give them.
    """
    heavy = {
        "chaser.mass": 1e4,
        "chaser.inertia": 1e9,  # pushed from the front, it would turn away
        "target.mass": 1e12,
        "initial.chaser.vx": SPEED,
        "friction.law": "none",
        "buffer.k_A": 0.0,
        "buffer.c_A": 0.0,
        "buffer.k_T": 1e5,
        "run.t_end": 1.6,
        "run.rtol": 1e-10,
        "run.state_rate": 1000.0,
        "run.rate": 1.0,
    }
    # the chaser stands still there
    return run(altered(anvil(1e-6, {}), heavy | changes), **options)


#: Contacts that are hard on a buffer.
HARD = {
    "dead contact": ["contact.law=exact", "contact.restitution=0.001"],
    "sticking tip": ["friction.law=coulomb", "friction.mu=1.5"],
    "elastic": ["contact.law=exact", "contact.restitution=1", "buffer.c_A=0"],
    "latch": [
        "latch={radius: 0.02, stiffness: 2.0e+4, damping: 80.0}",
        "initial.chaser.vx=0.3",
    ],
}


def runs_of_all_methods(changes: list[str], step: float = 2e-6) -> list[Run]:
    """Runs of the paper's bench to 40 ms; every method closes the ledger, and the ends agree."""
    base, results = load_scene("paper_designed", changes), []
    for method in METHODS:
        settings = {"run.method": method, "run.step": step, "run.rtol": 1e-11}
        result = run(altered(base, settings), t_end=0.04)
        assert result.failure == ""
        allowed = 1e-5 if method == "rk4" else 1e-9
        assert residual(result) < allowed * result.samples["kinetic"][0]
        results.append(result)
    for result, allowed in zip(results[1:], (1e-8, 1e-5), strict=True):
        assert result.q[-1] == pytest.approx(results[0].q[-1], abs=allowed)
    return results


#: Random benches that touch, by their number.
RANDOM = (0, 1, 3, 4, 5, 7, 9, 10, 11, 12)


def random_run(number: int, changes: dict[str, Any]) -> Run:
    """The run of a random bench to 0.1 s after its first touch; its ledger closes."""
    scene = altered(wide_scenes(number + 1)[number], changes)
    result = run(scene, t_end=first_touch(scene) + 0.1)
    assert result.failure == ""
    assert result.touches.size > 0
    assert residual(result) < 1e-6 * result.samples["kinetic"][0]
    return result
