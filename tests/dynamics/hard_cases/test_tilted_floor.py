"""A tilted floor: gravity pulls both vehicles along it; rail and string as on a level one."""

import math

import numpy as np
import pytest

from capture_sim import SceneError, load_scene, simulate
from capture_sim.dynamics.samples import EventKind
from capture_sim.scene.launch_plan import plan_launch
from capture_sim.scene.loading import change_scene

TILT = ["floor.tilt_x=0.5 mrad", "floor.tilt_y=-0.3 mrad"]
FREE = ["supports=null", "run.t_end=2", "run.rtol=1e-11"]
BENCHES = {
    "cone": [],
    "latch": ["latch={radius: 0.006, stiffness: 3000, damping: 30}"],
    "seat": ["buffer.preload=2", "buffer.friction=0.4"],
    "stops": ["stops={compression: 0.003, extension: 0.003, stiffness: 2e5, damping: 50}"],
}


@pytest.mark.parametrize("bench", BENCHES)
def test_free_vehicles_move_as_on_a_level_floor_that_falls(bench):
    """Uniform gravity gives all bodies one acceleration (Galileo): nothing inside changes."""
    level = load_scene("tilt_p10", ["approach.speed=0.1", *FREE, *BENCHES[bench]])
    tilted = change_scene(level, TILT)
    one, other = simulate(level), simulate(tilted)
    t = one.samples["t"]
    fallen = other.samples["q"] - one.samples["q"]
    for pull, indices in zip(tilted.pull, ([0, 5], [1, 6]), strict=True):
        fallen[:, indices] -= 0.5 * pull * t[:, None] ** 2
    assert len(one.touches) > 3
    assert np.abs(fallen).max() < 2e-8
    assert other.loads["max_axial_stroke_in"] == pytest.approx(
        one.loads["max_axial_stroke_in"], rel=1e-6
    )
    assert np.abs(other.samples["energy_residual"]).max() < 1e-9
    assert abs(other.samples["work_floor"][-1]) > 1e-3


@pytest.mark.parametrize("tilt", [-0.4e-3, 0.05e-3, 0.4e-3])
def test_the_launch_is_planned_for_the_tilt(tilt):
    """The impact has the speed asked for, at the planned time; the free phase coasts with it."""
    scene = load_scene("tilt_0", [f"floor.tilt_x={tilt}", "run.t_end=3.2"])
    plan, run = plan_launch(scene), simulate(scene)
    level = plan_launch(load_scene("tilt_0"))
    assert (plan.hanging_mass < level.hanging_mass) == (tilt > 0.0)
    assert run.touches["start"][0] == pytest.approx(plan.contact_time, abs=1e-4)
    assert np.abs(run.samples["energy_residual"]).max() < 1e-9
    before = run.samples[run.samples["t"] < run.touches["start"][0]]
    assert before["v"][-1, 0] == pytest.approx(scene.string.impact_speed, rel=1e-3)


def test_a_vehicle_stands_up_to_its_rolling_resistance():
    """c_rr of the target is the tangent of the steepest floor on which it stands."""
    c_rr = load_scene("tilt_0").supports.target.c_rr
    for share, moves in ((0.99, False), (1.1, True)):
        tilt = math.asin(share * c_rr)
        far = ["initial.target.y=0.5", "rail=null", "string=null", f"floor.tilt_y={tilt}"]
        run = simulate(load_scene("tilt_0", [*far, "run.t_end=1"]))
        moved = run.samples["q"][-1, 6] - 0.5
        expected = 0.5 * (share - 1.0) * c_rr * 9.80665 if moves else 0.0
        assert moved == pytest.approx(expected, rel=1e-2, abs=1e-15)
        kinds = [event.kind for event in run.events]
        assert (EventKind.MOVING in kinds) == moves


@pytest.mark.parametrize("tilt", [1.01, -1.01])
def test_a_chaser_that_would_roll_along_the_rail_by_itself_is_refused(tilt):
    c_rr = load_scene("tilt_0").supports.chaser.c_rr
    with pytest.raises(SceneError, match=r"floor\.tilt_x, tilt_y = .* rolls by itself"):
        load_scene("tilt_0", [f"floor.tilt_x={tilt * c_rr}"])
    load_scene("tilt_0", [f"floor.tilt_x={0.99 * math.copysign(c_rr, tilt)}"])


def test_a_level_floor_costs_nothing_in_results():
    """The scene's default: bit for bit as before there was a floor."""
    scene = load_scene("tilt_p10", ["floor.tilt_x=0"])
    one, other = simulate(scene), simulate(load_scene("tilt_p10"))
    assert np.array_equal(one.samples["q"], other.samples["q"])
    assert not one.samples["work_floor"].any()
