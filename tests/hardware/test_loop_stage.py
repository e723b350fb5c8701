"""Vehicles and buffer under a wrench from outside: mechanics, stops, latch, rail."""

import math

import numpy as np
import pytest
from elastic_loop import advanced
from four_bodies import bias, buffer_forces, kinetic, mass_matrix, momentum, tip

from capture_sim import SceneError, load_scene, simulate
from capture_sim.engine.held_wrench import N_LOOP
from capture_sim.hardware.law import NO_LAW, WallLaw, Walls
from capture_sim.hardware.stage import LoopStage
from capture_sim.samples import EventKind

# mechanics


def at(stage, q, v):
    """Put the stage into a state."""
    stage._y[:] = np.concatenate([q, v, np.zeros(N_LOOP - 16)])


def random_state(scene, rng):
    q, _ = scene.initial_coordinates()
    q = q + rng.normal(size=8) * [1, 1, 2, 0, 0.02, 1, 1, 2]
    q[3] = q[2] + 0.5 * rng.normal()
    return q, rng.normal(size=8) * [1, 1, 3, 3, 1, 1, 1, 3]


def test_a_wrench_moves_four_bodies_summed_one_by_one():
    """Against the independent mass matrix; generalised force by differences of the tip."""
    scene = load_scene("paper_designed")
    rng = np.random.default_rng(1)
    stage = LoopStage(scene, 1e-9, 1)
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

        at(stage, q, v)
        stage.advance(fx, fy, torque)
        found = (stage.v - v) / stage.step
        assert found == pytest.approx(expected, rel=1e-5, abs=1e-5 * np.abs(expected).max())


def test_momentum_is_kept_and_the_energy_is_the_work_of_the_wrench():
    """Work: the wrench times the way of the tip in the target's frame, which turns little."""
    scene = load_scene("paper_designed", ["buffer.c_T=0.3"])
    stage = LoopStage(scene, 1e-4, 4)
    rng = np.random.default_rng(2)
    before, energy, work = momentum(scene, stage.q, stage.v), stage.energy, 0.0
    for _ in range(200):
        wrench = rng.normal(size=3) * [3, 3, 0.1]
        start = np.array(stage.tip[4:])
        end = np.array(stage.advance(*wrench)[4:])
        work += wrench @ (0.5 * (start + end)) * stage.step
    assert momentum(scene, stage.q, stage.v) == pytest.approx(before, abs=1e-9)
    assert abs(work) > 1e-4
    assert stage.energy - energy == pytest.approx(work, rel=1e-3)


def test_the_peak_within_a_step_counts():
    """A tip at rest that a force lets ring once on its buffer within a step."""
    scene = load_scene("_loop")
    period = 2 * math.pi * math.sqrt(LoopStage(scene).effective_mass(1.0, 0.0) / scene.buffer.k_A)
    stage = LoopStage(scene, period, 200)
    at(stage, stage.q, np.zeros(8))
    stage.advance(-200.0, 0.0, 0.0)
    assert stage.peak_energy > 3.0 * stage.energy > 0.0


def test_a_law_without_losses_keeps_the_energy():
    """Its spring counts; friction and damping can only lower it."""
    scene = load_scene("paper_designed")
    K = scene.contact_stiffness
    for law, lost in ((WallLaw(K, 1.5), 0.0), (WallLaw(K, 1.5, K, friction=0.1), 1e-5)):
        stage = LoopStage(scene, 1e-3, 1000)
        stage.set_law(law)
        energies = [stage.energy]
        for _ in range(100):
            stage.advance(0.0, 0.0, 0.0)
            energies.append(stage.energy)
        assert max(energies) - energies[0] <= 1e-9
        assert lost <= energies[0] - energies[-1] <= max(1e4 * lost, 1e-8)


def test_energy_is_that_of_the_bodies():
    scene = load_scene("paper_undamped")
    stage = LoopStage(scene)
    q, v = random_state(scene, np.random.default_rng(3))
    at(stage, q, v)
    b = scene.buffer
    springs = 0.5 * b.k_A * (q[4] - scene.rest_length) ** 2 + 0.5 * b.k_T * (q[3] - q[2]) ** 2
    assert stage.energy == pytest.approx(kinetic(scene, q, v) + springs, rel=1e-12)


def test_effective_mass_is_what_an_impulse_meets():
    scene = load_scene("paper_designed")
    stage = LoopStage(scene, 1e-9, 1)
    q, _ = random_state(scene, np.random.default_rng(4))
    for angle in (0.0, 0.8, 2.0):
        n = (math.cos(angle), math.sin(angle))
        at(stage, q, np.zeros(8))
        mass = stage.effective_mass(*n)
        stage.advance(0.0, 0.0, 0.0)
        rest = stage.tip
        at(stage, q, np.zeros(8))
        stage.advance(*n, 0.0)
        pushed = stage.tip
        gained = (pushed.vx - rest.vx) * n[0] + (pushed.vy - rest.vy) * n[1]
        assert gained == pytest.approx(stage.step / mass, rel=1e-6)


def test_supports_are_rejected():
    with pytest.raises(SceneError, match="supports: must be null for hardware in the loop"):
        LoopStage(load_scene("tilt_0"))


def test_the_loop_begins_behind_the_rail():
    scene = load_scene("tilt_0", ["supports=null"])
    run = simulate(scene)
    (end,) = (event for event in run.events if event.kind == EventKind.RAIL_END)
    touch = next(event for event in run.events if event.kind == EventKind.TOUCH)
    assert end.t < touch.t
    stage = LoopStage(scene, 1e-3, 10)
    assert stage.t == 0.0
    assert stage.v == pytest.approx(end.v)
    steps = math.floor((touch.t - end.t) / 1e-3)
    for _ in range(steps):
        stage.advance(0.0, 0.0, 0.0)
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
    assert stage.q == pytest.approx(run.q[-1], abs=2e-6)
    assert stage.v == pytest.approx(run.v[-1], abs=2e-4)
    assert energy_change == pytest.approx(0.0, abs=1e-7)
    assert stage.latched == any(event.kind == EventKind.LATCHED for event in run.events)
    met = {event.kind for event in run.events}
    assert EventKind.STOP_HIT in met
    assert (EventKind.LATCHED in met) == (until > 0.17)


@pytest.mark.parametrize("past", [1e-9, 1e-6, 1e-4])
@pytest.mark.parametrize(
    "changes, side",
    [
        (["stops={compression: 0.004, extension: 0.002, stiffness: 5.0e+4, damping: 0}"], 1),
        (["stops={compression: 0.004, extension: 0.002, stiffness: 5.0e+4, damping: 0}"], -1),
        (["buffer.preload=5"], 1),
    ],
)
def test_a_stop_or_seat_that_is_already_passed_acts_in_the_next_step(changes, side, past):
    """A step locates eight events; the probe may be past the next one at its end."""
    scene = load_scene("paper_designed", [*changes, "buffer.c_A=0"])
    stage = LoopStage(scene, 1e-5, 10)
    q, v = scene.initial_coordinates()
    end = {1: scene.outward_stroke, -1: -0.004}[side]
    q[4] += end + side * past
    v[:] = 0.0
    v[4] = side * 0.05
    at(stage, q, v)
    stage._system["mode"]["seated"] = 0
    energy = stage.energy
    beyond = 0.0
    for _ in range(2000):
        stage.advance(0.0, 0.0, 0.0)
        beyond = max(beyond, side * (stage.q[4] - scene.rest_length - end))
    # half m v^2 in a stop is 0.1 mm
    assert beyond < past + (3e-4 if scene.stops is not None else 0.0)
    pushed_in = 0.5 * 5e4 * past**2 if scene.stops is not None else 0.0
    assert stage.energy - energy == pytest.approx(pushed_in, rel=1e-3, abs=1e-9)


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
    stage = LoopStage(scene, 1e-5, 10)
    stage.advance(0.0, 0.0, 0.0)
    assert stage.latched


def test_the_law_in_the_vehicles_steps_is_the_law():
    """Compiled, and as a wrench held over a step so short that nothing changes."""
    scene = load_scene("paper_designed")
    K = scene.contact_stiffness
    law, walls = WallLaw(K, 1.5, 8.0 * K, 2e-5, friction=0.3), Walls(scene)
    stage = LoopStage(scene, 1e-11, 1)
    rng = np.random.default_rng(5)
    q, v, rest, begin = stage.q, stage.v, np.zeros(N_LOOP - 16), stage.saved()
    for _ in range(20):
        push = [2e-4 + 1e-4 * rng.random(), 0, 0, 0, 0, 0, 0, 0]  # the wall is 0.1 mm away
        moved = np.concatenate([q + push, v + 0.05 * rng.normal(size=8), rest])
        stage.restore(begin._replace(y=moved))
        state, tip = stage.saved(), stage.tip
        held = walls.wrench(law, tip)
        assert held.force > 0.0
        found = []
        for inside, wrench in ((law, (0.0, 0.0, 0.0)), (NO_LAW, (held.fx, held.fy, held.tz))):
            stage.restore(state)
            stage.set_law(inside)
            stage.advance(*wrench)
            found.append(stage.v - state.y[8:16])
        assert found[0] == pytest.approx(found[1], rel=1e-5, abs=1e-12)
