"""Bouncing under a constant pull: to rest, and ten thousand times.

The floor slows the target, the probe slides freely in the chaser: the wall comes towards
the tip with a constant acceleration, as the floor towards a ball that is dropped.
"""

import math

import numpy as np
import pytest
from row_model import Row
from scipy.integrate import quad
from scipy.optimize import brentq
from set_ups import ON_THE_FLOOR, anvil, residual, run, slowed

PULL, GAP, SPEED = 0.1, 1e-4, 0.01  # m/s^2, m, m/s towards the wall at the release


def dropped(e, changes, stiffer=1.0, speed=SPEED, gap=GAP, pull=PULL, rolling=1.0):
    """The tip above the wall; ``stiffer``: Young's modulus in that of aluminium."""
    E = 71.7e9 * stiffer
    ball = {
        "buffer.k_A": 0.0,
        "buffer.c_A": 0.0,
        "friction.law": "none",
        "contact.law": "exact",
        "contact.restitution": e,
        "contact.tip.E": E,
        "contact.wall.E": E,
        "contact.min_approach_speed": 1e-9,
        "initial.chaser.vx": speed,
        "run.state_rate": 1.0,
        "run.rate": 1.0,
    }
    return slowed(anvil(gap, ON_THE_FLOOR | ball | changes, base="tilt_0"), pull, rolling)


def in_a_row_model(scene, t_end):
    """The same as three points, seen from a frame that moves with the target's first speed."""
    body = scene.supports.chaser.c_rr * scene.chaser_total_mass * scene.gravity
    slowing = (body, 0.0, scene.target.mass * PULL)
    return Row(scene, GAP, (SPEED, SPEED, 0.0), slowing).run(t_end)


def reduced_mass(scene):
    return scene.probe.mass * scene.target.mass / (scene.probe.mass + scene.target.mass)


@pytest.mark.parametrize(
    "e, method",
    [(0.3, "dop853"), (0.3, "dopri5"), (0.5, "rk4"), (0.8, "dop853"), (0.8, "dopri5")],
)
def test_bouncing_to_rest_is_that_of_three_points_in_a_row(e, method):
    """Exact: every touch of it, and the rest at its end, by an independent model.

    At rest the normal force is the weight, reduced mass x pull, and no touch follows.
    """
    rtol = 1e-11 if method != "rk4" else 1e-8
    scene = dropped(e, {"run.method": method, "run.rtol": rtol, "run.step": 2e-6, "run.t_end": 1.0})
    result = run(scene)
    assert result.failure == ""
    row = in_a_row_model(scene, 1.0)
    touches = result.touches
    assert touches.size == row.times("touch").size
    assert touches["start"] == pytest.approx(row.times("touch"), abs=1e-7)
    assert touches["end"][:-1] == pytest.approx(row.times("lift_off"), abs=1e-7)
    assert touches["end"][-1] == 1.0
    weight = reduced_mass(scene) * PULL
    assert result.samples["normal_force"][-1, 0] == pytest.approx(weight, rel=1e-6)
    assert residual(result) < 1e-9 * result.samples["kinetic"][0]


@pytest.mark.parametrize(
    "e, stiffer, short", [(0.8, 1.0, 0.02), (0.8, 1e3, 2e-3), (0.5, 1e4, 1e-3)]
)
def test_bouncing_ends_when_the_geometric_series_of_its_flights_ends(e, stiffer, short):
    """Zeno: infinitely many flights of 2 e^k v / pull in a finite time.

    Nearly exact: the series leaves out how long a touch lasts and that the weight works
    during it, both of the order (touch's duration) / (flight), which grows from bounce to
    bounce: an elastic ball comes to rest after finitely many.  It may fall short of the
    series by ``short`` of the whole, less the harder the contact.
    """
    landing = math.sqrt(SPEED**2 + 2 * PULL * GAP)
    start = (landing - SPEED) / PULL
    total = start + 2 * landing * e / ((1 - e) * PULL)
    scene = dropped(e, {"run.t_end": 1.05 * total}, stiffer)
    touches = run(scene).touches
    assert touches["start"][0] == pytest.approx(start, rel=1e-9)
    assert touches["approach_speed"][0] == pytest.approx(landing, rel=1e-9)
    assert touches["start"][-1] == pytest.approx(total, rel=short)
    assert touches.size > 6
    # each touch returns e of its approach speed, but for the pull during the touch
    v = touches["approach_speed"][:-1]
    weight = PULL * (touches["end"] - touches["start"])[:-1] / v
    assert np.all(np.abs(touches["approach_speed"][1:] / v - e) < weight)


def test_ten_thousand_touches_in_one_run():
    """Elastic bouncing goes on for ever.

    Exact: approach speed and period of every bounce; the period by one integral over the
    touch under the weight, from the energy.  Each touch may err by the tolerance, and
    after 400 m of way by rounding (6e-14 m of a depth of 1e-7 m): ten thousand may add up
    to a thousandth of the speed.
    """
    speed, gap, pull, drift = 1e-3, 1e-8, 1.0, 1e-3
    how = {"run.t_end": 29.0, "run.max_steps": 2_000_000}
    scene = dropped(1.0, how, 1.0, speed, gap, pull, rolling=30.0)
    result = run(scene)
    assert result.failure == ""
    touches = result.touches
    assert touches.size > 10_000
    landing = math.sqrt(speed**2 + 2 * pull * gap)
    assert touches["approach_speed"][:-1] == pytest.approx(landing, rel=drift)
    m, K = reduced_mass(scene), scene.contact_stiffness

    def square(depth):
        return landing**2 + 2 * pull * depth - 0.8 * K / m * depth**2.5

    deepest = brentq(square, 1e-9, 1e-5, xtol=1e-20)
    # depth = deepest (1 - x^2): takes the root's pole out
    touch = (
        2
        * quad(
            lambda x: 2 * x * deepest / math.sqrt(square(deepest * (1 - x * x))), 0, 1, epsrel=1e-10
        )[0]
    )
    period = np.diff(touches["start"])
    assert period[0] == pytest.approx(touch + 2 * landing / pull, rel=1e-5)
    assert period == pytest.approx(touch + 2 * landing / pull, rel=drift)
    assert residual(result) < 1e-12 * result.samples["kinetic"][0]
