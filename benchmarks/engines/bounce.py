"""The first bounce of a scene: what a foreign contact model is fitted to."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from benchmarks.engines.own import with_run
from capture_sim.bench import Bench
from capture_sim.samples import EventKind
from capture_sim.scene.parts import Scene


class Bounce(NamedTuple):
    """A scene's first touch, by our own engine at a tight tolerance."""

    start: float  # s
    duration: float  # s
    target_speed: np.ndarray  # (2,) the target's velocity after it, m/s


def first_bounce(scene: Scene) -> Bounce:
    """Return the first touch of a scene that has one within 50 ms."""
    bench = Bench(with_run(scene, t_end=0.05, rtol=1e-10))
    bench.advance(np.zeros(0))
    end = next(event for event in bench.events if event.kind is EventKind.LIFT_OFF)
    touch = bench.touches[0]
    return Bounce(float(touch["start"]), float(touch["end"] - touch["start"]), end.v[5:7])


def fit(
    scene: Scene,
    guess: tuple[float, float],
    bounce_of: Callable[[float, float], tuple[float, np.ndarray]],
) -> tuple[float, float]:
    """Fit stiffness and damping of a contact so that the first bounce comes out right.

    Parameters
    ----------
    scene
        To take the bounce from.
    guess
        Stiffness and damping to start from, in the foreign engine's units.
    bounce_of
        Returns duration (s) and the target's velocity after it (2,) for a stiffness and a
        damping.

    Returns
    -------
    (stiffness, damping)
        That give the bounce's duration and the momentum it has passed on, as nearly as a
        linear contact can.
    """
    from scipy.optimize import least_squares

    wanted = first_bounce(scene)
    speed = float(np.hypot(*wanted.target_speed))

    def misses(logarithms: np.ndarray) -> np.ndarray:
        stiffness, damping = np.exp(logarithms)
        duration, velocity = bounce_of(float(stiffness), float(damping))
        return np.array(
            [
                duration / wanted.duration - 1.0,
                np.dot(velocity, wanted.target_speed) / speed**2 - 1.0,
            ]
        )

    found = least_squares(misses, np.log(guess), diff_step=1e-2, max_nfev=40)
    stiffness, damping = np.exp(found.x)
    return float(stiffness), float(damping)
