"""Loads of the ball supports: how each vehicle's weight rests on its three balls."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from capture_sim.scene.parts import Scene


def ball_loads(balls: np.ndarray, weight: float, x_com: float, y_com: float) -> np.ndarray:
    """Return the normal load of each of three balls by static equilibrium, (3,), N.

    A negative load means that the vehicle would tip over.  ``balls`` (3, 2) and the centre of mass
    (``x_com``, ``y_com``) are in the vehicle's frame, m; ``weight`` is in N.
    numpy.linalg.LinAlgError if the balls are exactly in one line.
    """
    matrix = np.vstack([np.ones(3), balls[:, 0], balls[:, 1]])
    loads: np.ndarray = np.linalg.solve(matrix, weight * np.array([1.0, x_com, y_com]))
    return loads


def chaser_com_offset(scene: Scene) -> float:
    """Return how far forward of its main body's centre of mass the chaser's centre of mass is, m.

    The chaser includes cylinder and probe, with the buffer at rest.
    """
    cylinder = scene.buffer.hinge_offset - scene.cylinder.length / 2.0
    probe = scene.buffer.hinge_offset + scene.rest_length - scene.probe.com_offset
    moment = scene.cylinder.mass * cylinder + scene.probe.mass * probe
    return moment / scene.chaser_total_mass


#: Fields that the loads of the balls depend on.
LOADS = (
    *("chaser.mass", "cylinder", "probe", "buffer.hinge_offset", "buffer.rest_length"),
    *("target.mass", "gravity"),
)


def loads(scene: Scene, vehicle: str) -> np.ndarray:
    """Return the loads of the three balls under ``vehicle``, (3,), N; the array is read-only.

    ``vehicle`` is ``"chaser"`` or ``"target"``; the scene must have supports.  The loads are those
    with the buffer at rest, and a run keeps them, because the stroke changes them little.
    """
    assert scene.supports is not None
    if vehicle == "chaser":
        support, mass, com_offset = (
            scene.supports.chaser,
            scene.chaser_total_mass,
            chaser_com_offset(scene),
        )
    else:
        support, mass, com_offset = scene.supports.target, scene.target.mass, 0.0
    return _cached_loads(support.balls, mass * scene.gravity, com_offset)


@lru_cache(maxsize=8)
def _cached_loads(
    balls: tuple[tuple[float, float], ...], weight: float, com_offset: float
) -> np.ndarray:
    # needed twice per scene, and equal in most runs of a study
    load = ball_loads(np.array(balls), weight, com_offset, 0.0)
    load.flags.writeable = False
    return load
