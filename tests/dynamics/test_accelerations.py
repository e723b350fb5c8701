"""Second derivatives of gap and slip against differences along a motion."""

import numpy as np
import pytest

from capture_sim import load_scene
from capture_sim.base.compiled.kernels import entry_kernel
from capture_sim.dynamics.model.equations import (
    gap_acceleration,
    gap_and_rate,
    make_system,
    slip_acceleration,
    slip_of,
    tip_in_cone,
)
from capture_sim.dynamics.model.parameters import pack


@entry_kernel
def accelerations(systems, y, f, i):
    par = systems[0].par
    return gap_acceleration(y, f, par, i), slip_acceleration(y, f, par, i)


@entry_kernel
def rates(systems, y, i):
    par = systems[0].par
    px, py, wx, wy = tip_in_cone(y, par)
    gap, rate, _, _ = gap_and_rate(px, py, wx, wy, 1.0 - 2.0 * i, par)
    return gap, rate, slip_of(y, par, i)


@pytest.mark.parametrize("wall", [0, 1])
@pytest.mark.parametrize("u", [-0.01, 0.02, 0.08])  # behind the inner edge, on the face, at the lip
def test_second_derivatives_are_those_of_the_motion(wall, u):
    scene = load_scene("paper_designed")
    system = make_system(pack(scene, 0.0, 0.0))
    rng = np.random.default_rng(4)
    side = 1.0 - 2.0 * wall
    for _ in range(20):
        q, _ = scene.initial_coordinates()
        q[[2, 3, 7]] = rng.uniform(-0.3, 0.3, 3)
        # the target where the tip is at (u, Y) of the wall
        tip = q[:2] + scene.buffer.hinge_offset * np.array([np.cos(q[2]), np.sin(q[2])])
        tip += q[4] * np.array([np.cos(q[3]), np.sin(q[3])])
        local = np.array([-(u + scene.cone.L_T), side * rng.uniform(0.0, 0.03)])
        c, s = np.cos(q[7]), np.sin(q[7])
        q[5:7] = tip - np.array([c * local[0] - s * local[1], s * local[0] + c * local[1]])
        v, a = rng.normal(size=8), rng.normal(size=8) * 10.0

        def moved(t, q=q, v=v, a=a):
            return np.concatenate([q + t * v + 0.5 * t * t * a, v + t * a, np.zeros(10)])

        f = np.concatenate([v, a, np.zeros(10)])
        gap_2, slip_1 = accelerations(system, moved(0.0), f, wall)
        t = 1e-6
        (_, rate_a, slip_a), (_, rate_b, slip_b) = (rates(system, moved(x), wall) for x in (-t, t))
        assert gap_2 == pytest.approx((rate_b - rate_a) / (2.0 * t), rel=1e-5, abs=1e-4)
        assert slip_1 == pytest.approx((slip_b - slip_a) / (2.0 * t), rel=1e-5, abs=1e-4)
