"""Drag of the vehicles, and constant forces of their cables: on the rail and in contact."""

import math

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from benchmarks.foreign_plant import Besides, motion_of
from capture_sim import SceneError, load_scene, simulate
from capture_sim.base.compiled.kernels import plain
from capture_sim.scene import launch_motion
from capture_sim.scene.launch_plan import expected_speed, expected_time, plan_launch

distance_at, speed_at = plain(launch_motion.distance_at), plain(launch_motion.speed_at)
time_after, speed_after = plain(launch_motion.time_after), plain(launch_motion.speed_after)

BESIDES = {"chaser.drag": 0.3, "chaser.cable_x": -0.02, "chaser.cable_y": 0.004}
BESIDES |= {"target.drag": 0.2, "target.cable_x": 0.01, "target.cable_y": -0.02}


def test_a_free_body_moves_as_its_equation_says():
    """M dv/dt = F - c v, solved by hand; nothing else acts on the target."""
    force, drag = np.array([0.02, -0.01]), 5.0
    scene = load_scene(
        "tilt_0",
        {
            **dict.fromkeys(("rail", "string", "supports")),
            "initial.target.y": 0.5,
            **{"target.cable_x": force[0], "target.cable_y": force[1], "target.drag": drag},
            **{"run.t_end": 2.0, "run.rtol": 1e-11},
        },
    )
    run = simulate(scene)
    k, t = drag / scene.target.mass, run.samples["t"][:, None]
    moved = force / drag * (t - (1.0 - np.exp(-k * t)) / k)
    assert np.abs(run.samples["q"][:, 5:7] - moved - [scene.initial.target.x, 0.5]).max() < 1e-12
    assert np.abs(run.samples["energy_residual"]).max() < 1e-12
    assert run.samples["dissipated_rolling"][-1] > 1e-6


@pytest.mark.parametrize("string", ["mass", "height"])
def test_the_launch_is_planned_for_drag_and_cable(string):
    """The wanted impact speed at the planned time, whichever of mass and height is asked for."""
    asked = {"string.drop_height": None, "string.hanging_mass": 0.3} if string == "height" else {}
    scene = load_scene("tilt_0", {**BESIDES, **asked, "run.t_end": 3.2})
    plan, run = plan_launch(scene), simulate(scene)
    assert plan.impact_speed == pytest.approx(scene.string.impact_speed, rel=1e-12)
    assert run.touches["start"][0] == pytest.approx(plan.contact_time, abs=5e-4)
    before = run.samples[run.samples["t"] < run.touches["start"][0]]
    assert before["v"][-1, 0] == pytest.approx(scene.string.impact_speed, rel=2e-3)
    assert np.abs(run.samples["energy_residual"]).max() < 1e-9
    for t, x, v in zip(before["t"], before["q"][:, 0], before["v"][:, 0], strict=True):
        if x < scene.rail.length:
            assert expected_speed(scene, plan, x) == pytest.approx(v, abs=1e-12)
            assert expected_time(scene, plan, x) == pytest.approx(t, abs=1e-9)


@pytest.mark.long
def test_the_bench_of_another_model_agrees():
    """benchmarks/foreign_plant.py has the same drag and cables in other equations."""
    scene = load_scene("tilt_p10", {**BESIDES, "run.t_end": 4.0})
    plan = plan_launch(scene)
    given = {"string.hanging_mass": plan.hanging_mass, "string.drop_height": plan.drop_height}
    scene = load_scene("tilt_p10", {**BESIDES, **given, "string.impact_speed": None})
    times = np.linspace(0.0, 4.0, 401)
    pull = [BESIDES[f"{body}.cable_{axis}"] for body in ("chaser", "target") for axis in "xy"]
    besides = Besides(drag=(0.3, 0.2), cable=tuple(pull))
    other, first = motion_of(scene, besides, times)
    run = simulate(scene)
    assert run.touches["start"][0] == pytest.approx(first, abs=1e-4)
    own = np.array([np.interp(times, run.samples["t"], q) for q in run.samples["q"].T])
    assert np.abs(own.T - other).max() < 1e-5
    undisturbed, _ = motion_of(scene, Besides(), times)
    assert np.abs(undisturbed - other).max() > 5e-3


@pytest.mark.parametrize("acceleration", [-0.02, 0.0, 0.05])
@pytest.mark.parametrize("damping", [1e-9, 1e-4, 0.3, 3.0])
def test_the_motion_on_the_rail_is_that_of_its_equation(acceleration, damping):
    speed, t = 0.1, 0.5
    exact = solve_ivp(
        lambda _, z: [z[1], acceleration - damping * z[1]],
        *((0.0, t), [0.0, speed]),
        method="DOP853",
        rtol=1e-13,
        atol=1e-16,
    ).y[:, -1]
    assert distance_at(speed, acceleration, damping, t) == pytest.approx(exact[0], rel=1e-12)
    assert speed_at(speed, acceleration, damping, t) == pytest.approx(exact[1], rel=1e-12)
    assert time_after(speed, acceleration, damping, exact[0]) == pytest.approx(t, rel=1e-11)
    assert speed_after(speed, acceleration, damping, exact[0]) == pytest.approx(exact[1], rel=1e-11)
    back = time_after(exact[1], acceleration, damping, -exact[0])
    assert back == pytest.approx(-t, rel=1e-11)


def test_a_motion_that_ends_before_does_not_arrive():
    assert time_after(0.1, 0.0, 2.0, 0.0499) == pytest.approx(-math.log(0.002) / 2.0)
    for distance in (0.05, 0.06):
        assert time_after(0.1, 0.0, 2.0, distance) == math.inf
        assert speed_after(0.1, 0.0, 2.0, distance) == 0.0
    assert time_after(0.1, -0.02, 0.3, 0.3) == math.inf


def test_what_no_launch_can_do_is_refused():
    with pytest.raises(SceneError, match=r"cable_x, cable_y = 1\.0, 0\.0 N: .* rolls by itself"):
        load_scene("tilt_0", {"chaser.cable_x": 1.0})
    with pytest.raises(SceneError, match=r"chaser.drag = -0\.1 N s/m"):
        load_scene("tilt_0", {"chaser.drag": -0.1})
    heavy = {"chaser.drag": 5.0, "string.drop_height": None, "string.hanging_mass": 0.15}
    with pytest.raises(SceneError, match=r"impact_speed = 0\.1 m/s: must be <= 0\.0[0-9]"):
        load_scene("tilt_0", heavy)
    with pytest.raises(SceneError, match=r"drop_height = 0\.1 m: must be > .* in free fall"):
        load_scene("tilt_0", {"chaser.drag": 1e4})


def test_no_drag_and_no_cable_cost_nothing_in_results():
    one = simulate(load_scene("tilt_p10", dict.fromkeys(BESIDES, 0.0)))
    other = simulate(load_scene("tilt_p10"))
    assert np.array_equal(one.samples["q"], other.samples["q"])
