"""The launch by the hanging mass against its closed form, and the vehicles' supports."""

import math

import numpy as np
import pytest
from maximal_model import limit_used

from capture_sim import SceneError, load_scene, simulate
from capture_sim.base.compiled.kernels import plain
from capture_sim.dynamics.model.supports import ball_rows, is_held, load_factor, rolling_wrench
from capture_sim.launcher.state_machine import (
    Launcher,
    LauncherPhase,
    LaunchObservation,
)
from capture_sim.scene.ball_loads import ball_loads
from capture_sim.scene.launch_plan import expected_speed, plan_launch


def seen(speed, is_slack, has_touched, *, t=math.nan, travel=math.nan):
    return LaunchObservation(t, speed, travel, is_slack, has_touched)


def event(result, label):
    return next(e for e in result.events if e.kind.label == label)


@pytest.mark.parametrize("inertia", [0.0, 2e-4])
def test_launch_agrees_with_its_closed_form(inertia):
    scene = load_scene("tilt_0", [f"string.pulley_inertia={inertia}"])
    result = simulate(scene)
    g, c = scene.gravity, scene.supports.chaser.c_rr
    m = scene.chaser.mass + scene.cylinder.mass + scene.probe.mass
    mh, H = result.plan.hanging_mass, scene.string.drop_height
    a = (mh * g - c * m * g) / (m + mh + inertia / scene.string.pulley_radius**2)
    landed = event(result, "landed")
    assert landed.t == pytest.approx(math.sqrt(2 * H / a), rel=1e-9)
    assert landed.v[0] == pytest.approx(math.sqrt(2 * a * H), rel=1e-9)
    pulled = result.t <= landed.t
    assert result.q[pulled, 0] == pytest.approx(0.5 * a * result.t[pulled] ** 2, abs=1e-9)
    assert result.v[pulled, 0] == pytest.approx(a * result.t[pulled], abs=1e-9)
    left = event(result, "rail_end")
    coasting = (result.t > landed.t) & (result.t <= left.t)
    tau = result.t[coasting] - landed.t
    assert result.q[coasting, 0] == pytest.approx(
        H + landed.v[0] * tau - 0.5 * c * g * tau**2, abs=1e-9
    )
    assert left.q[0] == pytest.approx(scene.rail.length, rel=1e-12)


@pytest.mark.parametrize("name", ["tilt_0", "tilt_p10", "tilt_m10"])
def test_impact_speed_by_the_hanging_mass(name):
    result = simulate(load_scene(name))
    landed = event(result, "landed")
    after = result.samples[result.t > landed.t]
    assert np.all(after["string_tension"] == 0.0)
    assert np.all(result.samples["string_tension"][result.t < landed.t] > 0.0)
    assert result.summary["impact_speed"] == pytest.approx(0.1, rel=0.01)
    assert result.summary["impact_speed"] == pytest.approx(result.plan.impact_speed, rel=1e-4)
    touch = event(result, "touch")
    assert touch.t == pytest.approx(result.plan.contact_time, abs=2e-4)
    assert touch.q[0] == pytest.approx(result.plan.travel, abs=2e-5)


def test_mass_height_and_speed_follow_from_each_other():
    by_speed = plan_launch(load_scene("tilt_0"))
    mass, height = by_speed.hanging_mass, by_speed.drop_height
    by_mass = plan_launch(
        load_scene("tilt_0", [f"string.hanging_mass={mass!r}", "string.drop_height=null"])
    )
    assert by_mass.drop_height == pytest.approx(height, rel=1e-12)
    forward = plan_launch(
        load_scene("tilt_0", [f"string.hanging_mass={mass!r}", "string.impact_speed=null"])
    )
    assert forward.impact_speed == pytest.approx(0.1, rel=1e-12)
    with pytest.raises(SceneError, match=r"string.hanging_mass = 0.01 kg: must be > 0.023"):
        load_scene("tilt_0", ["string.hanging_mass=0.01", "string.drop_height=null"])


def test_a_measured_travel_may_be_negative():
    """Noise of a camera, before the release: with and without a string."""
    for name, speed in (("tilt_0", 0.0), ("paper_designed", 0.1)):
        scene = load_scene(name, ["string=null", "rail=null"] if speed else [])
        plan = plan_launch(scene)
        assert expected_speed(scene, plan, -1e-4) == pytest.approx(
            plan.landing_speed if speed else 0.0, rel=1e-3
        )


def test_launcher_follows_the_launch():
    launcher = Launcher(load_scene("tilt_0"))
    assert launcher.status.state is LauncherPhase.ARMED
    assert launcher.observe(seen(0.0, False, False)).state is LauncherPhase.ARMED
    assert launcher.release().state is LauncherPhase.RELEASED
    assert launcher.observe(seen(0.05, False, False)).state is LauncherPhase.RELEASED
    assert launcher.observe(seen(0.105, True, False)).state is LauncherPhase.LANDED
    launcher.observe(seen(0.101, True, False))
    done = launcher.observe(seen(0.06, True, True))
    assert (done.state, done.measured_speed) == (LauncherPhase.DELIVERED, 0.101)
    assert launcher.abort("late").state is LauncherPhase.DELIVERED


@pytest.mark.parametrize("name", ["tilt_0", "tilt_p10", "paper_designed"])
def test_speed_that_belongs_to_a_travel(name):
    """By energy, against the motion as it is integrated in time."""
    scene = load_scene(name)
    result = simulate(scene)
    launcher = Launcher(scene)
    launcher.release()
    before = result.samples[result.samples["touches"] == 0]
    for sample in before[::7]:
        travel = launcher.travelled(*sample["q"][:2])
        assert expected_speed(scene, launcher.plan, travel) == pytest.approx(
            sample["v"][0], abs=2e-6
        )
        status = launcher.observe(
            LaunchObservation(
                t=float(sample["t"]),
                speed=float(sample["v"][0]),
                travel=travel,
                is_slack=sample["string_tension"] == 0.0,
                has_touched=False,
            )
        )
        assert status.state is not LauncherPhase.ABORTED


def released(**options):
    launcher = Launcher(load_scene("tilt_0"), **options)
    launcher.release()
    return launcher


def test_launch_is_aborted_outside_its_window_and_only_there():
    plan = released().plan
    half = 0.5 * plan.drop_height
    wanted = plan.landing_speed * math.sqrt(0.5)
    for off, state in ((0.0099, "RELEASED"), (-0.0099, "RELEASED"), (0.0101, "ABORTED")):
        launcher = released(tolerance=0.1)
        status = launcher.observe(seen(wanted + off, False, False, t=1.0, travel=half))
        assert status.state is LauncherPhase[state]
    assert "0.06" in status.reason
    assert "must be" in status.reason
    # latched: nothing that comes later mends it
    assert launcher.observe(seen(wanted, False, True, t=1.1, travel=half)) == status
    assert launcher.abort("later").reason == status.reason


def test_launch_that_does_not_arrive_is_aborted():
    launcher = released(tolerance=0.2)
    late = 1.2 * launcher.plan.contact_time + 0.5
    wanted = launcher.plan.landing_speed
    height = launcher.plan.drop_height
    assert launcher.observe(seen(wanted, True, False, t=late - 0.01, travel=height)).reason == ""
    assert (
        "no contact"
        in launcher.observe(seen(wanted, True, False, t=late + 0.01, travel=height)).reason
    )
    stuck = released()
    assert stuck.observe(seen(0.0, False, False, t=late + 0.01, travel=0.0)).state == 5


def test_chaser_coasts_to_rest_and_stays_there():
    """Rolling resistance stops a free vehicle at v^2 / (2 c g), and holds it."""
    scene = load_scene(
        "tilt_0",
        ["rail=null", "string=null", "initial.chaser.vx=0.03", "run.t_end=50"],
    )
    result = simulate(scene)
    g, c = scene.gravity, scene.supports.chaser.c_rr
    stop = event(result, "at_rest")
    assert stop.t == pytest.approx(0.03 / (c * g), rel=2e-3)
    assert stop.q[0] == pytest.approx(0.03**2 / (2 * c * g), rel=1e-4)
    after = result.samples[result.t > stop.t]
    assert np.all(after["q"][:, :3] == after["q"][0, :3])
    assert np.all(after["v"][:, :3] == 0.0)
    assert result.samples["dissipated_rolling"][-1] == pytest.approx(
        0.5 * scene.chaser_total_mass * 0.03**2, rel=1e-3
    )
    # nothing has touched the target: it has not moved by a bit
    assert np.all(result.q[:, 5:] == result.q[0, 5:])
    assert result.verdict in ("missed", "stuck")


def test_loads_balance_weight_and_moment():
    balls = np.array([[0.12, 0.0], [-0.06, 0.104], [-0.06, -0.104]])
    loads = ball_loads(balls, 200.0, 0.01, -0.004)
    assert loads.sum() == pytest.approx(200.0)
    assert loads @ balls == pytest.approx([2.0, -0.8])


BALLS = np.array([[0.1, 0.0, 2.0], [-0.05, 0.0866025403784, 2.0], [-0.05, -0.0866025403784, 2.0]])


def rows_of(balls):
    """Balls given by place and limit, as the kernels have them."""
    return np.array(ball_rows(balls[:, :2], balls[:, 2]))


def test_limit_of_the_supports_against_an_optimiser():
    """That of the independent model: the least of a convex function, by Nelder and Mead."""
    rng = np.random.default_rng(3)
    balls = np.array([[0.12, 0.01, 1.0], [-0.06, 0.104, 2.5], [-0.05, -0.11, 0.7]])
    for _ in range(30):
        angle, w = rng.uniform(-3, 3), rng.normal(size=3) * np.array([3, 3, 0.3])
        found = plain(load_factor)(*w, math.cos(angle), math.sin(angle), rows_of(balls))
        limit = limit_used(w, balls, angle)
        assert (1 - 1e-6) * limit <= found <= (1 + 1e-9) * limit  # it comes from below


@pytest.mark.parametrize("still", range(3))
def test_limit_of_the_supports_for_a_turn_about_one_ball_has_a_closed_form(still):
    """The two other balls resist with all they have, the still one with less: exactly the limit."""
    rng = np.random.default_rng(still)
    for _ in range(100):
        balls = np.column_stack([rng.uniform(-0.3, 0.3, (3, 2)), rng.uniform(0.01, 1.0, 3)])
        wrench = np.zeros(3)
        for ball, (x, y, limit) in enumerate(balls):
            if ball == still:
                fx, fy = rng.uniform(-0.7, 0.7, 2) * limit
            else:
                dx, dy = (balls[ball] - balls[still])[:2]
                fx, fy = np.array([-dy, dx]) / math.hypot(dx, dy) * limit
            wrench += fx, fy, x * fy - y * fx
        angle = float(rng.uniform(-3.0, 3.0))
        c, s = math.cos(angle), math.sin(angle)
        turned = c * wrench[0] - s * wrench[1], s * wrench[0] + c * wrench[1], wrench[2]
        for share in (0.3, 1.0, 7.0):
            found = plain(load_factor)(*(share * np.array(turned)), c, s, rows_of(balls))
            assert found == pytest.approx(share, rel=1e-12)


@pytest.mark.parametrize("share", [0.98, 1.0])
def test_supports_hold_what_is_below_a_share_of_their_limit_and_nothing_above(share):
    """The cheap answer and the search that ends early, beside the exact share."""
    rng = np.random.default_rng(11)
    hold, answers = plain(is_held), []
    for _ in range(300):
        balls = np.column_stack([rng.uniform(-0.3, 0.3, (3, 2)), rng.uniform(0.0, 1.0, 3)])
        rows, angle = rows_of(balls), rng.uniform(-3.0, 3.0)
        heading = math.cos(angle), math.sin(angle)
        wrench = rng.normal(size=3) * (1.0, 1.0, 0.2)
        wrench /= plain(load_factor)(*wrench, *heading, rows)
        for factor in (0.2, 0.7, 1.0 - 1e-9, 1.0 + 1e-9, 1.5, 10.0):
            held = hold(*(share * factor * wrench), *heading, rows, share)
            assert held == (factor < 1.0)
            answers.append(held)
    assert 0 < sum(answers) < len(answers)


def test_rolling_resistance_opposes_each_ball():
    fx, fy, torque, power = plain(rolling_wrench)(0.1, 0.0, 0.0, 1.0, 0.0, rows_of(BALLS), 1e-9)
    assert (fx, fy, torque) == pytest.approx((-6.0, 0.0, 0.0), abs=1e-12)
    assert power == pytest.approx(0.6)
    fx, fy, torque, power = plain(rolling_wrench)(0.0, 0.0, 2.0, 1.0, 0.0, rows_of(BALLS), 1e-9)
    assert (fx, fy) == pytest.approx((0.0, 0.0), abs=1e-9)
    assert torque == pytest.approx(-0.6)
    assert power == pytest.approx(1.2)
