"""Random benches for tests of accuracy: the same ones for the same seed, on any machine."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache

import numpy as np

from capture_sim.errors import SceneError
from capture_sim.scene.launch_plan import travel_to_touch
from capture_sim.scene.laws import CONTACT_LAWS
from capture_sim.scene.loading import load_scene
from capture_sim.scene.parts import Buffer, Initial, PlanarState, Scene

#: Way of the tip to the first touch, m.
RUN_UP = 2e-3


def log_uniform(rng: np.random.Generator, low: float, high: float) -> float:
    """A random number with as many in every decade."""
    return float(math.exp(rng.uniform(math.log(low), math.log(high))))


@cache
def bench(with_supports: bool) -> Scene:
    """What all random benches have in common."""
    if with_supports:
        return load_scene("tilt_0", ["rail=null", "string=null", "latch=null"])
    return load_scene("paper_designed")


def random_scene(rng: np.random.Generator, with_supports: bool, base: Scene | None = None) -> Scene:
    """A bench with random offset, angles, speed and buffer, shortly before its first touch.

    Offset of the tip's path from the target's centre of mass within +-65 mm, target turned
    by up to 15 degrees, chaser by up to 5, speeds from 0.02 to 0.3 m/s, k_A from 100 to
    3000 N/m, k_T from 50 to 2000 N m/rad, c_A from 0 to 30 N s/m; with supports c_rr up to
    0.003.  The rest is the paper's Table 2.
    """
    base = base or bench(with_supports)
    if base.supports is not None:
        c_rr = [float(rng.uniform(0.0, 3e-3)) for _ in range(2)]
        base = replace(
            base,
            supports=replace(
                base.supports,
                chaser=replace(base.supports.chaser, c_rr=c_rr[0]),
                target=replace(base.supports.target, c_rr=c_rr[1]),
            ),
        )
    buffer = Buffer(
        hinge_offset=base.buffer.hinge_offset,
        k_A=log_uniform(rng, 100.0, 3000.0),
        c_A=float(rng.uniform(0.0, 30.0)),
        k_T=log_uniform(rng, 50.0, 2000.0),
    )
    speed = log_uniform(rng, 0.02, 0.3)
    while True:
        heading = math.radians(rng.uniform(-5.0, 5.0))
        c, s = math.cos(heading), math.sin(heading)
        offset = float(rng.uniform(-0.065, 0.065))
        target = PlanarState(
            x=0.8 * c - offset * s,
            y=0.8 * s + offset * c,
            theta=heading + math.radians(rng.uniform(-15.0, 15.0)),
        )
        chaser = PlanarState(theta=heading, vx=speed * c, vy=speed * s)
        try:
            far = replace(base, buffer=buffer, initial=Initial(chaser, target))
            way = travel_to_touch(far) - RUN_UP
            if math.isfinite(way):
                near = replace(chaser, x=way * c, y=way * s)
                return replace(far, initial=Initial(near, target))
        except SceneError:
            continue


def random_scenes(count: int, seed: int = 20) -> list[Scene]:
    """``count`` random benches, every fourth of them on supports."""
    rng = np.random.default_rng(seed)
    return [random_scene(rng, with_supports=i % 4 == 3) for i in range(count)]


#: Laws of the wider benches; "coulomb" sticks by events, the others are smooth or nearly so.
_FRICTION = ("none", "tanh", "clamp", "brown_mcphee", "coulomb")


def wide_scene(rng: np.random.Generator) -> Scene:
    """A bench that differs from the paper's in more than its buffer.

    As :func:`random_scene` without supports, and: vehicles of 4 to 120 kg with inertias of a
    uniform disc of 0.1 to 0.4 m, both spinning by up to 0.3 rad/s, half-angles of 0.5 to 1.1 rad,
    every law of contact and of friction, restitutions from 0.2 to 1 and mu up to 0.6.
    """
    paper = bench(with_supports=False)
    vehicles = []
    for vehicle in (paper.chaser, paper.target):
        mass = log_uniform(rng, 4.0, 120.0)
        inertia = 0.5 * mass * float(rng.uniform(0.1, 0.4)) ** 2
        vehicles.append(replace(vehicle, mass=mass, inertia=inertia))
    mu = float(rng.uniform(0.05, 0.6))
    base = replace(
        paper,
        chaser=vehicles[0],
        target=vehicles[1],
        cone=replace(paper.cone, half_angle=float(rng.uniform(0.5, 1.1))),
        contact=replace(
            paper.contact,
            law=str(rng.choice(CONTACT_LAWS)),
            restitution=float(rng.uniform(0.2, 1.0)),
        ),
        friction=replace(paper.friction, law=str(rng.choice(_FRICTION)), mu=mu, mu_s=1.2 * mu),
    )
    scene = random_scene(rng, with_supports=False, base=base)
    states = (scene.initial.chaser, scene.initial.target)
    turning = [replace(state, omega=float(rng.uniform(-0.3, 0.3))) for state in states]
    return replace(scene, initial=Initial(*turning))


def wide_scenes(count: int, seed: int = 30) -> list[Scene]:
    """``count`` benches of :func:`wide_scene`."""
    rng = np.random.default_rng(seed)
    return [wide_scene(rng) for _ in range(count)]
