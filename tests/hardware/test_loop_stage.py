"""The contact from outside: mechanics, the rules of the hold, and what a delay does."""

import math

import numpy as np
import pytest
from four_bodies import bias, buffer_forces, kinetic, mass_matrix, momentum, tip
from plate import first_touch, plate_mass

from capture_sim import SceneError, load_scene, simulate
from capture_sim.engine.held_wrench import N_LOOP
from capture_sim.errors import CaptureSimError
from capture_sim.hardware.compensation import gain_rate
from capture_sim.hardware.in_the_loop import LoopStage, SafeStopError, WrenchHold
from capture_sim.hardware.loop_messages import tip_message, tip_of, wrench_message, wrench_of
from capture_sim.hardware.walls import NOTHING, TipState, WallLaw
from capture_sim.messages.convert import CONE_FRAME, Messages
from capture_sim.messages.definitions import typestore
from capture_sim.samples import EventKind

PLATE = 2000.0  # N/m


@pytest.fixture(scope="module")
def plate():
    return load_scene("_loop")


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
        stage.advance((fx, fy, torque))
        found = (stage.v - v) / stage.step
        assert found == pytest.approx(expected, rel=1e-5, abs=1e-5 * np.abs(expected).max())


def test_momentum_is_kept_and_work_is_energy():
    scene = load_scene("paper_designed", ["buffer.c_T=0.3"])
    stage = LoopStage(scene, 1e-3, 20)
    rng = np.random.default_rng(2)
    before, energy, work = momentum(scene, stage.q, stage.v), stage.energy, 0.0
    for _ in range(200):
        wrench = rng.normal(size=3) * [3, 3, 0.1]
        work += wrench @ stage.go(*wrench)
    assert momentum(scene, stage.q, stage.v) == pytest.approx(before, abs=1e-9)
    assert abs(work) > 1e-4
    assert stage.energy - energy == pytest.approx(work, rel=1e-7)


def test_a_law_without_losses_keeps_the_energy():
    """Its spring counts; friction and damping can only lower it."""
    scene = load_scene("paper_designed")
    K = scene.contact_stiffness
    for law, lost in ((WallLaw(K, 1.5), 0.0), (WallLaw(K, 1.5, K, friction=0.1), 1e-5)):
        stage = LoopStage(scene, 1e-3, 1000)
        stage.take_law(law, gated=False)
        energies = [stage.energy]
        for _ in range(100):
            stage.advance(NOTHING)
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
        stage.advance(NOTHING)
        rest = stage.tip
        at(stage, q, np.zeros(8))
        stage.advance((*n, 0.0))
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
        stage.advance(NOTHING)
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
    stage = LoopStage(scene, 1e-3, 1000)
    stage.take_law(WallLaw(scene.contact_stiffness, 1.5), gated=False)
    energy = stage.energy
    for _ in range(round(until / 1e-3)):
        stage.advance(NOTHING)
    assert stage.q == pytest.approx(run.q[-1], abs=2e-6)
    assert stage.v == pytest.approx(run.v[-1], abs=2e-4)
    assert stage.energy - energy == pytest.approx(0.0, abs=1e-7)
    assert stage.latched == any(event.kind == EventKind.LATCHED for event in run.events)
    met = {event.kind for event in run.events}
    assert EventKind.STOP_HIT in met
    assert (EventKind.LATCHED in met) == (until > 0.17)


# what a delay does


def test_an_elastic_contact_without_delay_makes_no_energy(plate):
    law, mass = WallLaw(PLATE), plate_mass(plate)
    gains = []
    for step in (2e-3, 1e-3, 5e-4):
        gains.append(first_touch(plate, law, 0, step, 1.0, 80, mass).restitution - 1.0)
    # only the hold is left, and it goes with the step
    assert gains[0] / gains[1] == pytest.approx(2.0, rel=0.05)
    assert gains[1] / gains[2] == pytest.approx(2.0, rel=0.05)


@pytest.mark.parametrize("lag", [0, 1, 2, 5])
def test_a_delayed_spring_gains_what_negative_damping_says(plate, lag):
    mass = plate_mass(plate)
    w, tau = math.sqrt(PLATE / mass), (lag + 0.5) * 1e-3
    got = first_touch(plate, WallLaw(PLATE), lag, 1e-3, 1.0, 40, mass)
    assert got.duration == pytest.approx(math.pi / w, rel=0.01)
    assert got.restitution == pytest.approx(math.exp(math.pi * w * tau / 2), rel=2e-3)
    first_order = 0.5 * math.pi * PLATE * tau * got.approach_speed**2 / w
    assert got.work == pytest.approx(first_order, rel=2.0 * w * tau)


def test_the_rate_of_gain_is_that_of_small_delays():
    assert gain_rate(1.0) == pytest.approx(math.pi**2 / 2, rel=1e-12)
    scene = load_scene("paper_designed")
    law = WallLaw(scene.contact_stiffness, 1.5)
    duration = first_touch(scene, law, 0, 1e-7, 0.005, 1).duration
    slow, fast = (
        math.log(first_touch(scene, law, lag, 1e-6, 0.005, 1).restitution) for lag in (2, 6)
    )
    slope = (fast - slow) / (4e-6 / duration)
    assert slope == pytest.approx(gain_rate(1.5), rel=0.03)


def test_a_contact_shorter_than_the_delay_cannot_be_in_the_loop():
    scene = load_scene("paper_designed")
    law = WallLaw(scene.contact_stiffness, 1.5)
    assert first_touch(scene, law, 0, 1e-3, 0.02, 1000).restitution > 100.0


# the hold


def test_what_is_not_usable_is_refused_with_a_reason():
    hold = WrenchHold(timeout=0.01, force_limit=100.0)
    assert not hold.received
    assert hold.offer(0.0, 0.0, (1.0, 2.0, 0.0)) == ""
    assert hold.received
    assert "is not finite" in hold.offer(0.001, 0.002, (math.nan, 0.0, 0.0))
    assert "0.003 s ahead of the loop" in hold.offer(0.005, 0.002, (1.0, 0.0, 0.0))
    assert hold.offer(0.002, 0.002, (3.0, 0.0, 0.0)) == ""
    assert "not newer" in hold.offer(0.001, 0.003, (9.0, 0.0, 0.0))
    assert "not newer" in hold.offer(0.002, 0.003, (9.0, 0.0, 0.0))
    assert hold.refused == 4
    assert hold.at(0.003) == (0.002, (3.0, 0.0, 0.0))
    assert hold.ages == pytest.approx([0.001])


def test_a_wrench_is_held_up_to_the_timeout_and_no_longer():
    hold = WrenchHold(timeout=0.01, force_limit=100.0)
    with pytest.raises(SafeStopError):
        hold.at(0.0)
    hold.offer(0.0, 0.0, (1.0, 0.0, 0.0))
    assert hold.at(0.010) == (0.0, (1.0, 0.0, 0.0))
    with pytest.raises(SafeStopError, match=r"0\.011 s old: must be <= 0\.01"):
        hold.at(0.011)


def test_a_force_beyond_the_limit_stops_for_good():
    hold = WrenchHold(timeout=1.0, force_limit=100.0)
    hold.offer(0.0, 0.0, (80.0, -80.0, 0.0))
    hold.offer(0.001, 0.001, (1.0, 0.0, 0.0))
    with pytest.raises(SafeStopError, match=r"a force of 113\.1 N came: must be <= 100"):
        hold.at(0.001)


def test_messages_say_what_was_put_in():
    make = Messages()
    tip_state = TipState(0.125, -0.02, 0.004, 0.3, 0.1, -0.05, 0.7)
    read = typestore().deserialize_cdr
    got = tip_of(read(tip_message(make, tip_state), "nav_msgs/msg/Odometry"))
    assert got == pytest.approx(tip_state, rel=1e-14)
    data = wrench_message(make, 0.125, (1.0, -2.0, 0.3))
    message = read(data, "geometry_msgs/msg/WrenchStamped")
    assert wrench_of(message) == (1.0, -2.0, 0.3)
    message.header.frame_id = "world"
    with pytest.raises(CaptureSimError, match=f"'world': must be {CONE_FRAME}"):
        wrench_of(message)
