"""Vehicles held by their supports, and the launch's instants where they fall together."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from set_ups import METHODS, ON_THE_FLOOR, altered, anvil, first, in_a_row, residual, run, times

from capture_sim import SceneError, load_scene


@pytest.mark.parametrize("method", METHODS)
def test_vehicle_at_rest_stays_for_a_thousand_seconds(method):
    """Exact: nothing moves, not by a bit; and it costs a handful of steps (rk4: its own)."""
    changes = ON_THE_FLOOR | {
        "run.method": method,
        "run.step": 1e-2,
        "run.t_end": 1000.0,
        "run.state_rate": 1.0,
        "run.rate": 1.0,
    }
    result = run(altered(load_scene("tilt_0"), changes))
    assert [e.kind.label for e in result.events] == ["release", "end"]
    assert result.t.size == 1001
    assert np.all(result.q == result.q[0])
    assert np.all(result.v == 0.0)
    assert np.all(result.samples["at_rest"] == 3)
    assert result.statistics.evaluations < (500 if method != "rk4" else 500_000)


def test_vehicles_loaded_below_the_limit_do_not_move():
    """The chaser has run against the target and stands with the spring compressed.

    Exact: once both rest, neither moves by a bit for as long as it lasts, while the probe
    between them rings down; then spring and contact force are equal.  The contact keeps
    the steps at 1 ms.
    """
    changes = ON_THE_FLOOR | {
        "supports.chaser.c_rr": 0.05,
        "supports.target.c_rr": 0.5,
        "initial.chaser.vx": 0.05,
        "run.t_end": 100.0,
        "run.state_rate": 10.0,
        "run.rate": 10.0,
    }
    result = run(in_a_row(1e-3, changes, base="tilt_0"))
    rest = times(result, "at_rest")
    assert rest.size == 1  # the chaser; the target has never moved
    assert times(result, "moving").size == 0
    vehicles = result.q[:, [0, 1, 2, 5, 6, 7]]
    after = result.t > rest[0]
    assert np.all(vehicles[after] == vehicles[-1])
    assert np.all(result.q[:, 5:] == result.q[0, 5:])
    assert result.statistics.steps < 300_000
    assert result.samples["axial_force"][-1] > 0.5
    assert result.samples["normal_force"][-1, 0] == pytest.approx(
        result.samples["axial_force"][-1], rel=1e-8
    )


@pytest.mark.parametrize("method", ["dop853", "dopri5"])
@pytest.mark.parametrize("c_rr", [0.005, 0.01])
def test_vehicle_moves_off_when_its_limit_is_reached(c_rr, method):
    """A heavy chaser comes on slowly and presses on the target through the spring.

    Exact: the instant, k_A x + c_A v = c_rr N with the contact's depth taken off x; then
    the linear motion that follows.  Up to there the target has not moved by a bit, and it
    moves off once.
    """
    speed, gap = 1e-3, 1e-4
    changes = ON_THE_FLOOR | {
        "supports.chaser.c_rr": 0.0,
        "supports.target.c_rr": c_rr,
        "supports.rolling_regularization_speed": 1e-9,
        "chaser.mass": 1e9,
        "chaser.inertia": 1e12,
        "initial.chaser.vx": speed,
        "run.method": method,
        "run.t_end": 5.5,
        "run.state_rate": 100.0,
        "run.rate": 100.0,
    }
    scene = in_a_row(gap, changes, base="tilt_0")
    result = run(scene)
    assert result.failure == ""
    k, c = scene.buffer.k_A, scene.buffer.c_A
    limit = c_rr * scene.target.mass * scene.gravity
    depth = (limit / scene.contact_stiffness) ** (2 / 3)
    instant = (gap + (limit - c * speed) / k + depth) / speed
    moved = times(result, "moving")
    assert moved == pytest.approx([instant], rel=1e-5)
    assert np.all(result.q[result.t < moved[0], 5:] == result.q[0, 5:])
    mass = scene.target.mass + scene.probe.mass
    follows = solve_ivp(
        lambda t, y: [y[1], (k * (speed * t - y[0]) - c * y[1]) / mass],
        (0.0, 5.5),
        [0.0, 0.0],
        method="DOP853",
        rtol=1e-10,
        atol=1e-14,
        dense_output=True,
    ).sol
    later = result.t > moved[0]
    expected = follows(result.t[later] - moved[0])
    assert result.q[later, 5] - result.q[0, 5] == pytest.approx(expected[0], abs=2e-7)
    assert result.v[later, 5] == pytest.approx(expected[1], abs=2e-6)


def test_landing_and_rail_end_at_the_same_instant():
    """Exact: both events, in this order, at one time and state; the coast has no length."""
    scene = load_scene("tilt_0", ["string.drop_height=0.15"])
    assert scene.string.drop_height == scene.rail.length
    result = run(scene)
    landed, free = first(result, "landed"), first(result, "rail_end")
    assert landed.t == free.t
    assert np.array_equal(landed.q, free.q)
    assert np.array_equal(landed.v, free.v)
    kinds = [e.kind.label for e in result.events]
    assert kinds.index("rail_end") == kinds.index("landed") + 1
    assert 2 not in result.samples["phase"]  # never coasting on the rail
    assert landed.t == pytest.approx(result.plan.landing_time, rel=1e-12)
    beside = run(altered(scene, {"rail.length": 0.15 + 1e-12}))
    assert beside.q[-1] == pytest.approx(result.q[-1], abs=1e-7)
    assert residual(result) < 1e-8


@pytest.mark.parametrize("mass", [0.024, 0.03, 1.0, 1e2, 1e5])
@pytest.mark.parametrize("inertia", [0.0, 2e-4])
def test_string_is_never_slack_before_the_landing(mass, inertia):
    """From rest the string can not go slack: chaser and mass are one freedom, and the mass
    sinks by less than g.

    Exact: the tension, m_h (g - a) - I a / r^2 > 0, from the least mass that moves the
    chaser to one it hardly holds back.
    """
    changes = [
        f"string.hanging_mass={mass!r}",
        f"string.pulley_inertia={inertia!r}",
        "string.impact_speed=null",
    ]
    result = run(load_scene("tilt_0", changes), t_end=20.0)
    scene, g = result.scene, result.scene.gravity
    m, spin = scene.chaser_total_mass, inertia / scene.string.pulley_radius**2
    resist = scene.supports.chaser.c_rr * m * g
    a = (mass * g - resist) / (m + mass + spin)
    taut = result.samples[result.samples["phase"] == 1]
    assert taut.size > 10
    assert taut["string_tension"] == pytest.approx(mass * (g - a) - spin * a, rel=1e-9)
    assert taut["string_tension"].min() > 0.0
    assert taut["string_tension"] == pytest.approx(m * a + resist, rel=1e-8)
    assert 0.0 < a < g


@pytest.mark.parametrize("given", ["impact_speed", "hanging_mass"])
def test_chaser_that_runs_ahead_of_its_string_is_refused(given):
    """A chaser that moves when the mass is let go would leave the string slack.

    The one freedom of chaser and mass can not represent that: the scene is refused.
    """
    other = {
        "impact_speed": [],
        "hanging_mass": ["string.impact_speed=null", "string.hanging_mass=0.05"],
    }[given]
    with pytest.raises(SceneError, match=r"initial.chaser.vx, vy: speed 0.05 m/s: must be 0"):
        load_scene("tilt_0", ["initial.chaser.vx=0.05", *other])


@pytest.mark.parametrize("c_rr", [1e-4, 1e-3])
def test_touch_beyond_the_limit_sets_the_target_moving_within_the_touch(c_rr):
    """Exact: it moves off when the contact force has risen to its limit, c_rr N."""
    changes = ON_THE_FLOOR | {
        "supports.chaser.c_rr": 0.02,
        "supports.target.c_rr": c_rr,
        "initial.chaser.vx": 0.05,
        "run.t_end": 2.0,
    }
    scene = in_a_row(1e-3, changes, base="tilt_0")
    result = run(scene)
    touch, moved = result.touches[0], times(result, "moving")[0]
    assert touch["start"] < moved < touch["end"]
    limit = c_rr * scene.target.mass * scene.gravity
    there = run(scene, t_eval=[moved]).samples[0]
    assert there["normal_force"][0] == pytest.approx(limit, rel=1e-6)
    assert residual(result) < 1e-8


@pytest.mark.parametrize("speed", [1e-6, 4e-6, 1e-5])
def test_supports_without_resistance_let_a_slow_vehicle_roll(speed):
    """Exact: uniform motion, however slow; and nothing is ever put at rest."""
    changes = ON_THE_FLOOR | {
        "supports.chaser.c_rr": 0.0,
        "supports.target.c_rr": 0.0,
        "initial.target.vx": speed,
        "run.t_end": 10.0,
    }
    result = run(altered(load_scene("tilt_0"), changes))
    assert [e.kind.label for e in result.events] == ["release", "end"]
    assert np.all(result.v[:, 5] == speed)
    assert result.q[-1, 5] - result.q[0, 5] == pytest.approx(10 * speed, rel=1e-9)


def test_latch_closes_at_once_where_the_tip_starts_in_its_zone():
    """Exact: caught at the release, where it is, moving or not; the tip starts at a wall."""
    for speed in (0.0, 0.1, -0.1):
        changes = {
            "initial.target.x": 0.3515 + 0.096 - 1e-3,
            "initial.target.y": 0.0,
            "initial.chaser.vx": speed,
            "run.t_end": 0.1,
        }
        scene = altered(load_scene("paper_designed"), changes)
        latch = load_scene("tilt_0").latch
        result = run(altered(scene, {"latch": latch}))
        assert times(result, "latched").tolist() == [0.0]
        assert residual(result) < 1e-9


def test_wall_does_not_move_a_vehicle_that_its_supports_hold():
    """A target on the anvil, hit below its limit: not one bit of it moves.

    Exact: the impact's peak is that of a Hertz impact of the probe on a fixed wall.
    """
    changes = ON_THE_FLOOR | {
        "supports.chaser.c_rr": 0.0,
        "supports.target.c_rr": 1.0,
        "buffer.k_A": 0.0,
        "buffer.c_A": 0.0,
        "contact.restitution": 1.0,
        "initial.chaser.vx": 0.01,
        "run.t_end": 0.1,
        "run.rtol": 1e-10,
    }
    result = run(anvil(1e-4, changes, base="tilt_0"))
    assert np.all(result.q[:, 5:] == result.q[0, 5:])
    K, m = result.scene.contact_stiffness, result.scene.probe.mass
    depth = (5 * m * 0.01**2 / (4 * K)) ** 0.4
    assert result.touches["peak_force"] == pytest.approx([K * depth**1.5], rel=1e-8)
    assert result.touches["impulse"] == pytest.approx([2 * m * 0.01], rel=1e-8)
