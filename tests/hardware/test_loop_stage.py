"""Vehicles and buffer under a wrench from outside: mechanics, stops, latch, rail."""

import math

import numpy as np
import pytest
from elastic_loop import advanced
from four_bodies import bias, buffer_forces, kinetic, mass_matrix, momentum, tip

from capture_sim import load_scene, simulate
from capture_sim.dynamics.samples import EventKind
from capture_sim.hardware.law import NO_LAW, WallLaw, Walls, Wrench
from capture_sim.hardware.stage import LoopStage, SafeStopError

# mechanics


def random_state(scene, rng):
    q, _ = scene.initial_coordinates()
    q = q + rng.normal(size=8) * [1, 1, 2, 0, 0.02, 1, 1, 2]
    q[3] = q[2] + 0.5 * rng.normal()
    return q, rng.normal(size=8) * [1, 1, 3, 3, 1, 1, 1, 3]


def test_a_wrench_moves_four_bodies_summed_one_by_one():
    """Against the independent mass matrix; generalised force by differences of the tip."""
    scene = load_scene("paper_designed")
    rng = np.random.default_rng(1)
    for _ in range(30):
        q, v = random_state(scene, rng)
        fx, fy, torque = rng.normal(size=3) * [50, 50, 2]
        c, s = math.cos(q[7]), math.sin(q[7])
        force = np.array([c * fx - s * fy, s * fx + c * fy])

        generalised = buffer_forces(scene, q, v) - bias(scene, q, v)
        for i in range(8):
            dq = np.zeros(8)
            dq[i] = 1e-6
            moved = (tip(scene, q + dq) - tip(scene, q - dq)) / 2e-6
            # the target's material at the tip's place
            arm = tip(scene, q) - q[5:7]
            carried = {5: (1, 0), 6: (0, 1), 7: (-arm[1], arm[0])}.get(i, (0, 0))
            generalised[i] += force @ (moved - carried)
        generalised[3] += torque
        generalised[7] -= torque
        expected = np.linalg.solve(mass_matrix(scene, q), generalised)

        stage = LoopStage(scene, 1e-7, (q, v))
        stage.take_step(Wrench(fx, fy, tz=torque))
        found = (stage.v - v) / stage.step
        assert found == pytest.approx(expected, rel=1e-5, abs=1e-5 * np.abs(expected).max())


def test_momentum_is_kept_and_the_energy_is_the_work_of_the_wrench():
    """Work: the wrench times the way of the tip in the target's frame, which turns little."""
    scene = load_scene("paper_designed", ["buffer.c_T=0.3"])
    stage = LoopStage(scene, 1e-4)
    rng = np.random.default_rng(2)
    before, work = momentum(scene, stage.q, stage.v), 0.0
    for _ in range(200):
        wrench = rng.normal(size=3) * [3, 3, 0.1]
        start = np.array(stage.tip[4:])
        stage.take_step(Wrench(*wrench[:2], tz=wrench[2]))
        end = np.array(stage.tip[4:])
        work += wrench @ (0.5 * (start + end)) * stage.step
    assert momentum(scene, stage.q, stage.v) == pytest.approx(before, abs=1e-9)
    assert abs(work) > 1e-4
    assert stage.energy == pytest.approx(work, rel=1e-3)


def test_the_peak_within_a_step_counts():
    """A tip at rest that a force lets ring once on its buffer within a step."""
    scene = load_scene("_loop", ["buffer.c_A=0"])
    yields = 1.0 / scene.probe.mass + 1.0 / (scene.chaser_total_mass - scene.probe.mass)
    period = 2 * math.pi / math.sqrt(scene.buffer.k_A * yields)
    stage = LoopStage(scene, period, (scene.initial_coordinates()[0], np.zeros(8)))
    stage.take_step(Wrench(-200.0))
    assert stage.peak_energy > 3.0 * stage.energy > 0.0


def test_a_law_can_only_take_energy():
    """Its spring counts; friction and damping lower the energy."""
    scene = load_scene("paper_designed")
    K = scene.contact_stiffness
    for law, lost in ((WallLaw(K, 1.5), 0.0), (WallLaw(K, 1.5, K, friction=0.1), 1e-5)):
        stage = LoopStage(scene)
        stage.set_law(law)
        energies = [0.0]
        for _ in range(100):
            stage.take_step()
            energies.append(stage.energy)
        assert max(energies) <= 1e-9
        assert lost <= -energies[-1] <= max(1e4 * lost, 1e-8)


def test_energy_is_that_of_the_bodies():
    scene = load_scene("paper_undamped")
    q, v = random_state(scene, np.random.default_rng(3))
    stage, b = LoopStage(scene, state=(q, v)), scene.buffer

    def energy(q, v):
        springs = b.k_A * (q[4] - scene.rest_length) ** 2 + b.k_T * (q[3] - q[2]) ** 2
        return kinetic(scene, q, v) + 0.5 * springs

    stage.take_step(Wrench(10.0, 30.0, tz=1.0))
    assert stage.energy == pytest.approx(energy(stage.q, stage.v) - energy(q, v), rel=1e-6)


def test_closing_speed_and_mass_are_those_of_the_rigid_vehicles():
    """An impulse on the tip of a clamped buffer changes one by its share of the other."""
    scene = load_scene("_loop", ["buffer.k_A=1e9", "buffer.k_T=1e8", "buffer.c_A=0"])
    rng = np.random.default_rng(4)
    q, _ = scene.initial_coordinates()
    q[2] = q[3] = 0.4
    q[7] = -0.2
    v = rng.normal(size=8) * [1, 1, 1, 0, 0, 1, 1, 1]
    v[3] = v[2]
    stage = LoopStage(scene, 1e-4, (q, v))
    for angle in (0.0, 0.8, 2.0):
        n = (math.cos(angle), math.sin(angle))
        speed = -(stage.tip.vx * n[0] + stage.tip.vy * n[1])
        assert stage.closing_speed(*n) == pytest.approx(speed, rel=1e-12)
        pushed, free = (LoopStage(scene, 1e-4, (q, v)) for _ in range(2))
        pushed.take_step(Wrench(1e3 * n[0], 1e3 * n[1]))
        free.take_step()
        gained = free.closing_speed(*n) - pushed.closing_speed(*n)
        assert gained == pytest.approx(0.1 / stage.contact_mass(*n), rel=1e-3)


def test_a_buffer_that_rings_does_not_change_the_closing_speed():
    scene = load_scene("_loop")
    q, v = scene.initial_coordinates()
    v[4] = 0.05
    stage, speeds = LoopStage(scene, 2e-4, (q, v)), []
    for _ in range(50):
        speeds.append(stage.closing_speed(-1.0, 0.0))
        stage.take_step()
    assert np.ptp(speeds) < 1e-9


def test_a_stage_goes_back_to_a_saved_state():
    """State, law and wrench: the same steps again give the same bits."""
    scene = load_scene("paper_designed")
    stage = LoopStage(scene)
    stage.set_law(WallLaw(scene.contact_stiffness, 1.5))
    for _ in range(30):
        stage.take_step()
    saved, found = stage.saved(), []
    for _ in range(2):
        stage.restore(saved)
        for k in range(50):
            stage.take_step(Wrench(0.1 * k))
        found.append((stage.t, *stage.q, *stage.v, stage.energy))
        stage.set_law(NO_LAW)
    assert found[0] == found[1]


def test_a_bench_that_cannot_go_on_says_why():
    """A state that is not finite is not blamed on the stroke."""
    stage = LoopStage(load_scene("_loop"))
    with pytest.raises(SafeStopError, match="no longer finite"):
        stage.take_step(Wrench(math.nan))
    soft = LoopStage(load_scene("_loop", ["buffer.k_A=1.0", "buffer.c_A=0"]))
    with pytest.raises(SafeStopError, match="pushed in up to its tip"):
        for _ in range(1000):
            soft.take_step(Wrench(-100.0))


def test_the_loop_begins_behind_the_rail():
    scene = load_scene("tilt_0", ["supports=null"])
    run = simulate(scene)
    (end,) = (event for event in run.events if event.kind == EventKind.RAIL_END)
    touch = next(event for event in run.events if event.kind == EventKind.TOUCH)
    assert end.t < touch.t
    stage = LoopStage(scene)
    assert stage.t == 0.0
    assert stage.v == pytest.approx(end.v)
    steps = math.floor((touch.t - end.t) / 1e-3)
    for _ in range(steps):
        stage.take_step()
    (there,) = simulate(scene, t_end=end.t + steps * 1e-3).q[-1:]
    assert stage.q == pytest.approx(there, abs=1e-7)


# stops and latch


CAUGHT = [
    "latch={radius: 0.01, stiffness: 2.0e+4, damping: 80.0}",
    "stops={compression: 0.004, extension: 0.002, stiffness: 5.0e+4, damping: 20.0}",
    "contact.restitution=1.0",
    "friction.law=none",
]


@pytest.mark.parametrize("until", [0.05, 0.1, 0.2, 0.4])
def test_stops_and_latch_are_met_as_by_the_offline_bench(until):
    """The elastic law of the walls in the loop's steps, against the bench's located events."""
    scene = load_scene("paper_designed", [*CAUGHT, "buffer.c_A=60", "initial.chaser.vx=0.3"])
    run = simulate(scene, t_end=until)
    stage, energy_change = advanced(scene, until)
    assert stage.q == pytest.approx(run.q[-1], abs=1e-7)
    assert stage.v == pytest.approx(run.v[-1], abs=2e-5)
    assert energy_change == pytest.approx(0.0, abs=1e-7)
    assert stage.latched == any(event.kind == EventKind.LATCHED for event in run.events)
    met = {event.kind for event in run.events}
    assert EventKind.STOP_HIT in met
    assert (EventKind.LATCHED in met) == (until > 0.17)


def test_a_tip_in_the_zone_of_the_latch_is_caught_in_the_first_step():
    """As by the offline bench, see test_floor_and_launch."""
    scene = load_scene(
        "paper_designed",
        [
            "latch={radius: 0.02, stiffness: 2.0e+4, damping: 80.0}",
            "initial.target.x=0.4465",
            "initial.target.y=0",
            "initial.target.theta=0",
        ],
    )
    (caught,) = [e for e in simulate(scene, t_end=0.01).events if e.kind is EventKind.LATCHED]
    assert caught.t == 0.0
    stage = LoopStage(scene, 1e-5)
    stage.take_step()
    assert stage.latched


def test_the_law_in_the_vehicles_steps_is_the_law():
    """As the engine's contact, and as a wrench held over a step so short that nothing changes."""
    scene = load_scene("paper_designed")
    K = scene.contact_stiffness
    walls, rng = Walls(scene), np.random.default_rng(5)
    q, v = scene.initial_coordinates()
    for exponent in (1.0, 1.5, 2.0):
        k = K * 1e-4 ** (1.5 - exponent)
        law = WallLaw(k, exponent, 8.0 * k, 2e-5, friction=0.3)
        for _ in range(14):
            push = [2e-4 + 1e-4 * rng.random(), 0, 0, 0, 0, 0, 0, 0]  # the wall is 0.1 mm away
            state = q + push, v + 0.05 * rng.normal(size=8)
            inside, outside = (LoopStage(scene, 1e-11, state) for _ in range(2))
            if walls.deepest(inside.tip).rate <= 0.01:
                continue  # a touch begins with a tip that moves in
            held = walls.wrench(law, inside.tip)
            assert held.force > 0.0
            inside.set_law(law)
            inside.take_step()
            outside.set_law(NO_LAW)
            outside.take_step(held)
            assert inside.v - state[1] == pytest.approx(outside.v - state[1], rel=1e-4, abs=1e-12)
