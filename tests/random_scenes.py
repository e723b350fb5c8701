"""Random benches for tests of accuracy: the same ones for the same seed, on any machine."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache

import numpy as np

from capture_sim.errors import SceneError
from capture_sim.launch.plan import travel_to_touch
from capture_sim.launch.scenes import load_scene
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


def random_scene(rng: np.random.Generator, with_supports: bool) -> Scene:
    """A bench with random offset, angles, speed and buffer, shortly before its first touch.

    Offset of the tip's path from the target's centre of mass within +-65 mm, target turned
    by up to 15 degrees, chaser by up to 5, speeds from 0.02 to 0.3 m/s, k_A from 100 to
    3000 N/m, k_T from 50 to 2000 N m/rad, c_A from 0 to 30 N s/m; with supports c_rr up to
    0.003.  The rest is the paper's Table 2.
    """
    base = bench(with_supports)
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
        a=base.buffer.a,
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
