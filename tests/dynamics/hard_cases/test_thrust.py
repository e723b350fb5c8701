"""Wrenches that are held on the vehicles: motion and work in closed form, switches, refusals."""

import math

import numpy as np
import pytest
from four_bodies import momentum
from random_scenes import random_scenes
from set_ups import ON_THE_FLOOR, altered, in_a_row

from capture_sim import Bench, SceneError, load_scene
from capture_sim.dynamics.drive import Control, drive
from capture_sim.dynamics.samples import SAMPLE, columns_of, unit_of_column
from capture_sim.dynamics.thrust import NO_THRUST, HeldWrench
from capture_sim.hardware.law import Wrench
from capture_sim.hardware.stage import LoopStage
from capture_sim.scene.parts import Thruster, Thrusters

#: Chaser and target far from each other, at rest.
ALONE = {"initial.chaser.vx": 0.0, "initial.target.x": 3.0, "initial.target.y": 0.0}
FREE = Thrusters(Thruster(5.0, 1.0), Thruster(5.0, 1.0))


def held(bench, pieces):
    """Samples of a run in pieces: wrenches on chaser and target, and until when."""
    parts, begin = [], 0.0
    for chaser, target, until in pieces:
        bench.thrust(chaser, target, until)
        parts.append(bench.advance(np.linspace(begin, until, 41)[1:]))
        begin = until
    return np.concatenate(parts)


def alone(**changes):
    return altered(
        load_scene("paper_designed"), ALONE | {"run.t_end": 20.0, "run.rtol": 1e-11} | changes
    )


# closed forms


def test_a_held_force_and_moment_from_rest_in_free_flight():
    """Exact: a constant acceleration, a constant angular one, and their work."""
    scene = alone()
    m, I = scene.target.mass, scene.target.inertia
    pushed = held(Bench(scene), [(NO_THRUST, (2.0, -0.5, 0.0), 3.0)])
    t = pushed["t"]
    assert pushed["q"][:, 5] - 3.0 == pytest.approx(t**2 / m, abs=1e-12)
    assert pushed["q"][:, 6] == pytest.approx(-0.25 * t**2 / m, abs=1e-12)
    assert pushed["work_thrust"] == pytest.approx(0.5 * (2.0**2 + 0.5**2) * t**2 / m, rel=1e-12)
    spun = held(Bench(scene), [(NO_THRUST, (0.0, 0.0, 0.03), 3.0)])
    turn = spun["q"][:, 7] - scene.initial.target.theta
    assert turn == pytest.approx(0.015 * t**2 / I, abs=1e-12)
    assert spun["work_thrust"] == pytest.approx(0.5 * 0.03**2 * t**2 / I, rel=1e-12)


@pytest.mark.parametrize("omega", [0.02, 0.7, -3.0])
def test_a_held_force_turns_with_its_vehicle(omega):
    """Exact: velocity and place of a body that spins at a constant rate; work is its energy."""
    scene = alone(**{"initial.target.omega": omega, "initial.target.theta": 0.4})
    m, (fx, fy) = scene.target.mass, (1.5, 0.4)
    found = held(Bench(scene), [(NO_THRUST, (fx, fy, 0.0), 2.0), (NO_THRUST, NO_THRUST, 3.0)])
    t = np.minimum(found["t"], 2.0)
    s, c = math.sin(0.4), math.cos(0.4)
    s_t, c_t = np.sin(0.4 + omega * t), np.cos(0.4 + omega * t)
    vx = (fx * (s_t - s) + fy * (c_t - c)) / (m * omega)
    vy = (fx * (c - c_t) + fy * (s_t - s)) / (m * omega)
    assert found["v"][:, 5] == pytest.approx(vx, abs=1e-11)
    assert found["v"][:, 6] == pytest.approx(vy, abs=1e-11)
    assert found["work_thrust"] == pytest.approx(0.5 * m * (vx**2 + vy**2), abs=1e-11)
    assert np.abs(found["energy_residual"]).max() < 1e-11


def test_a_force_on_the_supports_begins_to_move_beyond_their_limit():
    """Exact: below c W nothing; above it the acceleration (F - c W) / m, and the loss c W x."""
    scene = altered(load_scene("tilt_0", ["run.t_end=10"]), ON_THE_FLOOR | {"run.rtol": 1e-10})
    bench = Bench(altered(scene, {"initial.chaser.x": 0.0, "initial.target.x": 3.0}))
    mass, limit = scene.target.mass, scene.supports.target.c_rr * scene.target.mass * scene.gravity
    turned = {"initial.target.theta": 0.0}
    bench = Bench(altered(bench.scene, turned))
    below, above = 0.95 * limit, 3.0 * limit
    found = held(bench, [(NO_THRUST, (below, 0, 0), 1.0), (NO_THRUST, (above, 0, 0), 2.0)])
    rest, moving = found[found["t"] <= 1.0], found[found["t"] > 1.0]
    assert not rest["v"].any()
    assert rest["work_thrust"][-1] == 0.0
    t = moving["t"] - 1.0
    # the resistance is smoothed below 1e-6 m/s
    assert moving["v"][:, 5] == pytest.approx((above - limit) / mass * t, abs=2e-6)
    way = moving["q"][:, 5] - 3.0
    assert moving["work_thrust"] == pytest.approx(above * way, rel=1e-9)
    assert moving["dissipated_rolling"] == pytest.approx(limit * way, rel=1e-3, abs=1e-9)
    assert np.abs(found["energy_residual"]).max() < 1e-10
    kinds = [(e.kind.label, e.t, e.detail) for e in bench.events[1:]]
    assert kinds == [("thrust_on", 0.0, "target"), ("moving", 1.0, "target")]


def test_a_force_in_sustained_contact_pushes_both_vehicles():
    """Exact: the momentum F t, and in the end one acceleration for all in a row."""
    how = {"contact.stiffness": 1e5, "contact.exponent": 1.0, "buffer.c_A": 60.0}
    scene = in_a_row(1e-4, how | {"initial.chaser.vx": 0.0, "run.t_end": 10.0})
    force = 0.8
    found = held(Bench(scene), [((force, 0.0, 0.0), NO_THRUST, 8.0)])
    p = np.array([momentum(scene, q, v)[0] for q, v in zip(found["q"], found["v"], strict=True)])
    assert p == pytest.approx(force * found["t"], abs=1e-8)
    total = scene.chaser_total_mass + scene.target.mass
    at_tip = force * scene.target.mass / total
    end = found[-1]
    assert end["normal_force"].max() == pytest.approx(at_tip, rel=1e-6)
    on_probe = at_tip + force * scene.probe.mass / total
    assert end["axial_stroke"] == pytest.approx(-on_probe / scene.buffer.k_A, rel=1e-6)
    assert np.abs(found["energy_residual"]).max() < 1e-9


# the ledger


def pushed_at_random(scene, seed):
    """The largest residual and the work of a run with wrenches that change every 20 to 200 ms.

    At rtol 1e-11: the residual is the integration's error, at 1e-9 up to 1.3e-8 J in these scenes.
    """
    rng = np.random.default_rng(seed)
    bench, begin, largest = Bench(altered(scene, {"run.rtol": 1e-11, "run.t_end": 1.5})), 0.0, 0.0
    while not bench.done:
        until = begin + rng.uniform(0.02, 0.2)
        bench.thrust(rng.normal(0, (1, 1, 0.05)), rng.normal(0, (1, 1, 0.05)), until)
        samples = bench.advance(np.linspace(begin, until, 21)[1:])
        largest = max(largest, np.abs(samples["energy_residual"]).max(initial=0.0))
        begin = until
    return largest, samples["work_thrust"][-1] if samples.size else math.nan


def with_own_contact(scene, k):
    """Every second scene with a lining."""
    table = ((0.0, 0.0), (2e-4, 4.0), (2e-4, 4.0), (2e-3, 400.0))
    return altered(scene, {"contact.force_table": table}) if k % 2 else scene


@pytest.mark.parametrize("k", range(6))
def test_the_ledger_closes_with_thrust_and_an_own_contact(k):
    scene = with_own_contact(random_scenes(8, seed=59)[k], k)
    largest, work = pushed_at_random(scene, k)
    assert abs(work) > 1e-6
    assert largest < 1e-9


@pytest.mark.long
@pytest.mark.parametrize("k", range(6, 100))
def test_the_ledger_closes_in_a_hundred_random_scenes(k):
    scene = with_own_contact(random_scenes(k + 1, seed=59)[k], k)
    assert pushed_at_random(scene, k)[0] < 1e-9


def test_no_thrust_is_the_run_without_it():
    """To the bit between pauses that lie on the way of no step."""
    scene = load_scene("paper_designed", ["run.t_end=0.3"])
    plain = Bench(scene)
    plain.advance(np.zeros(0))
    bench = Bench(scene)
    bench.thrust(NO_THRUST, NO_THRUST, 0.3)
    bench.advance(np.zeros(0))
    assert np.array_equal(bench.touches, plain.touches)


def test_the_wrench_on_a_tip_does_work_in_the_ledger():
    bench = Bench(load_scene("paper_designed", ["run.rtol=1e-10"]))
    for k in range(20):
        bench.drive_tip((0.5, 0.2 * math.sin(k), 0.01), 0.05 * (k + 1))
        samples = bench.advance(np.linspace(0.05 * k, 0.05 * (k + 1), 6)[1:])
    assert abs(samples["work_thrust"][-1]) > 1e-3
    assert np.abs(samples["energy_residual"]).max() < 1e-10


def test_a_stage_on_supports_moves_when_the_wrench_passes_their_limit():
    scene = altered(load_scene("tilt_0"), ON_THE_FLOOR | {"initial.chaser.x": 0.0})
    stage = LoopStage(scene, 1e-2)
    for _ in range(20):
        stage.take_step(Wrench(-0.05, 0.0))
    assert not stage.v[[0, 1, 2, 5, 6, 7]].any()
    for _ in range(50):
        stage.take_step(Wrench(-8.0, 0.0))
    assert stage.v[5] > 1e-3
    assert abs(float(stage.sample["energy_residual"][0])) < 1e-9


# what acts of a command


def applied(thruster, commands, until, timeout=10.0):
    """Times and wrenches in effect: each change of the commands' (time, force along x)."""
    wrench, found = HeldWrench(thruster, timeout), []
    for t, force in [*commands, (until, None)]:
        while wrench.next_change() <= t:
            now = wrench.next_change()
            wrench.go_to(now)
            found.append((round(now, 9), wrench.applied[0]))
        if force is not None:
            wrench.command(t, (force, 0.0, 0.0))
    return found


def test_commands_are_cut_delayed_held_and_time_out():
    assert applied(Thruster(2.0, 1.0), [(0.0, 3.0), (1.0, -5.0)], 2.0) == [(0.0, 2.0), (1.0, -2.0)]
    late = Thruster(2.0, 1.0, delay=0.25)
    assert applied(late, [(0.0, 1.0), (1.0, 0.5)], 2.0) == [(0.25, 1.0), (1.25, 0.5)]
    # the last command that waited for the end of a pulse counts
    pulsed = Thruster(2.0, 1.0, min_hold=0.5)
    commands = [(0.0, 1.0), (0.1, 0.2), (0.2, 0.3), (0.9, 0.4)]
    assert applied(pulsed, commands, 2.0) == [(0.0, 1.0), (0.5, 0.3), (1.0, 0.4)]
    timed = applied(Thruster(2.0, 1.0), [(0.0, 1.0), (0.4, 1.0)], 3.0, timeout=0.5)
    assert timed == [(0.0, 1.0), (0.4, 1.0), (0.9, 0.0)]


@pytest.mark.parametrize("rate", [10.0, 100.0])
def test_a_controller_brakes_and_its_silence_is_named(rate):
    thrusters = Thrusters(Thruster(5.0, 1.0, delay=0.013), timeout=0.4)
    scene = altered(alone(), {"thrusters": thrusters, "run.t_end": 2.0, "initial.chaser.vx": 0.1})

    def command(sample):
        if sample["t"] > 1.0:
            return None, None
        return (-60.0 * (sample["v"][0] - 0.05), 0.0, 0.0), None

    bench = Bench(scene)
    samples = np.concatenate([p.samples for p in drive(bench, control=Control(command, rate))])
    assert np.array_equal(samples["t"], bench.times(0, 3000))
    assert samples["v"][-1, 0] == pytest.approx(0.05, abs=0.015)
    assert np.abs(samples["energy_residual"]).max() < 1e-10
    events = [(e.kind.label, round(e.t, 9), e.detail) for e in bench.events[1:-1]]
    assert events[0] == ("thrust_on", 0.013, "chaser")
    assert events[-1] == ("thrust_off", 1.413, "chaser, no command for 0.4 s")


def test_on_the_rail_a_controller_pushes_from_its_end():
    scene = load_scene("tilt_0", {"thrusters": {"chaser": {"force": 1, "torque": 1}}})
    bench = Bench(scene)
    control = Control(lambda sample: ((0.3, 0.0, 0.0), None))
    samples = np.concatenate([p.samples for p in drive(bench, control=control)])
    off = bench.times_of(next(e.kind for e in bench.events if e.kind.label == "rail_end"))[0]
    on = samples["t"][samples["thrust"].any(axis=1)]
    assert off < on.min() < off + 1.0 / scene.run.rate + 1e-3
    assert np.abs(samples["energy_residual"]).max() < 1e-8


def test_columns_have_names_and_units():
    columns = columns_of(np.zeros(2, SAMPLE))
    assert {"thrust.chaser_x", "thrust.target_z", "work_thrust"} <= set(columns)
    assert unit_of_column("thrust.chaser_x") == "N"
    assert unit_of_column("thrust.target_z") == "N m"
    assert unit_of_column("work_thrust") == "J"


# what is refused


@pytest.mark.parametrize(
    "chaser, until, says",
    [
        ((math.nan, 0, 0), 1.0, r"thrust = nan, 0\b.*: must be three finite numbers each"),
        ((1.0, 0.0), 1.0, r"thrust = 1\.0, 0\.0, 0\.0, .*: must be three finite numbers each"),
        ((1.0, 0, 0), 0.0, r"until = 0\.0 s: must be > 0, the present time"),
        ((1.0, 0, 0), math.nan, r"until = nan s: must be finite and > 0"),
    ],
)
def test_bad_wrenches_are_refused_in_one_line(chaser, until, says):
    with pytest.raises(SceneError, match=says) as refused:
        Bench(alone()).thrust(chaser, NO_THRUST, until)
    assert "\n" not in str(refused.value)


def test_thrust_needs_a_pause_and_no_rail():
    bench = Bench(alone())
    bench.advance(np.array([0.5]))
    with pytest.raises(SceneError, match="must begin at the release, or at a pause"):
        bench.thrust(NO_THRUST, NO_THRUST, 1.0)
    with pytest.raises(SceneError, match="must begin where the chaser has left its rail"):
        Bench(load_scene("tilt_0")).thrust((1, 0, 0), NO_THRUST, 1.0)


@pytest.mark.parametrize(
    "thrusters, says",
    [
        ({}, "thrusters: must be on the chaser or the target, or null"),
        ({"chaser": {"force": 0, "torque": 1}}, r"force = 0 N: must be > 0"),
        ({"chaser": {"force": 1, "torque": 1, "delay": -1}}, r"delay = -1 s: must be >= 0"),
        ({"target": {"force": 1}}, "torque"),
        ({"chaser": {"force": 1, "torque": 1}, "timeout": 0}, r"timeout = 0 s: must be > 0"),
    ],
)
def test_bad_thrusters_are_refused_in_one_line(thrusters, says):
    with pytest.raises(SceneError, match=says) as refused:
        load_scene("paper_designed", {"thrusters": thrusters})
    assert "\n" not in str(refused.value)


def test_a_controller_needs_thrusters_and_a_rate_of_the_samples():
    control = Control(lambda sample: (None, None), 300.0)
    with pytest.raises(SceneError, match="thrusters: must be in the scene for a controller"):
        next(drive(Bench(alone()), control=control))
    scene = altered(alone(), {"thrusters": FREE})
    with pytest.raises(SceneError, match=r"rate of the controller = 300\.0 Hz: must be run.state"):
        next(drive(Bench(scene), control=control))
