"""Engines whose contact is linear: walls as boxes, and a contact fitted to the first bounce.

That flatters them: stiffness and damping are those that give the duration of the reference's first
touch and the momentum that it passes on.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import numpy as np
from scipy.optimize import least_squares

from benchmarks.engines.own import with_run
from capture_sim.dynamics.bench import Bench
from capture_sim.dynamics.samples import EventKind
from capture_sim.scene.parts import Scene

THICKNESS = 0.01  # m, half that of a wall, behind its face

#: Duration (s) and the target's velocity after it (2,) for a stiffness and a damping.
BounceOf = Callable[[float, float], tuple[float, np.ndarray]]


class Wall(NamedTuple):
    """A box whose face is a wall of the cone, in the target's frame."""

    name: str
    x: float  # m, its centre
    y: float
    angle: float  # rad


def walls(scene: Scene) -> Iterator[Wall]:
    """Yield the walls on +y and -y."""
    cone = scene.cone
    sin, cos = math.sin(cone.half_angle), math.cos(cone.half_angle)
    for name, side in (("plus", 1.0), ("minus", -1.0)):
        x = -cone.L_T - 0.5 * cone.L_c * cos + THICKNESS * sin
        y = side * (cone.R_c + 0.5 * cone.L_c * sin + THICKNESS * cos)
        yield Wall(name, x, y, -side * cone.half_angle)


def joints(scene: Scene) -> tuple[list[float], list[float]]:
    """Return place and rate of x, y, theta_S, theta_P - theta_S, h - h_0, x_T, y_T, theta_T."""
    q, v = scene.initial_coordinates()
    return (
        [q[0], q[1], q[2], q[3] - q[2], q[4] - scene.rest_length, *q[5:]],
        [v[0], v[1], v[2], v[3] - v[2], v[4], *v[5:]],
    )


def coordinates(scene: Scene, p: Any) -> np.ndarray:
    """Return q (8,) of the joints' places."""
    return np.array([p[0], p[1], p[2], p[2] + p[3], p[4] + scene.rest_length, *p[5:8]])


def fit(scene: Scene, guess: tuple[float, float], bouncing: Callable[[Scene], BounceOf]):
    """Return stiffness and damping, in the engine's units, with which the first bounce is right.

    Parameters
    ----------
    scene
        To take the bounce from, without its friction.
    guess
        To start from.
    bouncing
        Makes what tries a contact on a scene that ends soon after the bounce.
    """
    scene = dataclasses.replace(scene, friction=dataclasses.replace(scene.friction, law="none"))
    bench = Bench(with_run(scene, t_end=0.05, rtol=1e-10))
    bench.advance(np.zeros(0))
    touch = bench.touches[0]
    lift_off = next(event for event in bench.events if event.kind is EventKind.LIFT_OFF)
    duration, wanted = touch["end"] - touch["start"], lift_off.v[5:7]
    bounce_of = bouncing(with_run(scene, t_end=float(touch["start"]) + 2e-3))

    def misses(logarithms: np.ndarray) -> list[float]:
        took, velocity = bounce_of(*np.exp(logarithms).tolist())
        return [took / duration - 1.0, velocity @ wanted / (wanted @ wanted) - 1.0]

    found = least_squares(misses, np.log(guess), diff_step=1e-2, max_nfev=40)
    return tuple(np.exp(found.x).tolist())
