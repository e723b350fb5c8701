"""The loop on a rig of the real kind: restitution as predicted, touches, laws, limits, reports."""

import math
import re
from dataclasses import replace

import numpy as np
import pytest
from cases import cases
from plate import (
    MASS,
    SCENE,
    WIDE,
    close,
    close_often,
    ideal_rig,
    plate_law,
    plate_mass,
    predicted_restitution,
    recorded_poses,
    response_of,
    restitution_on,
    vehicles_restitution,
)

from capture_sim import load_scene
from capture_sim.errors import CaptureSimError
from capture_sim.hardware.answers import Answer
from capture_sim.hardware.guard import LoopLimits
from capture_sim.hardware.law import NO_LAW, WallLaw, Wrench
from capture_sim.hardware.loop import Loop, run_in_process
from capture_sim.hardware.rig import IDEAL, Cell, Rig, Servo, Transport
from capture_sim.hardware.stage import LoopStage

FAST, SLOW = Servo(100.0, 0.001), Servo()
WIDE_CELL = Cell(force_range=1e5)


def first_touch(method, rig, duration):
    loop, why = close(SCENE, rig, method, t_end=0.3 + 4.0 * duration)
    assert not why
    return loop, loop.episodes[0].restitution


# closed forms


@pytest.mark.parametrize("delay", [0.0, 0.001, 0.003, 0.01, 0.02])
def test_a_delay_raises_the_restitution_of_an_elastic_touch_as_predicted(delay):
    """That of the root; the next term of its series after the page's is -(7 pi^4 / 48) r^3."""
    duration = 0.2
    rig = ideal_rig(SCENE, plate_law(MASS, duration), delay)
    loop, got = first_touch("none", rig, duration)
    ratio = (delay + 0.5e-3) / duration
    expected = predicted_restitution(duration, response_of(rig, loop.lags.latency))
    assert got == pytest.approx(expected, rel=0.01)
    logarithm = 0.5 * math.pi**2 * ratio - 7.0 / 48.0 * math.pi**4 * ratio**3
    assert math.log(expected) == pytest.approx(logarithm, abs=2e-3)


@pytest.mark.parametrize(
    "servo, duration",
    cases(
        few=[(SLOW, 0.25), (FAST, 0.03)],
        all=[(SLOW, 0.25), (SLOW, 0.3), (FAST, 0.1), (FAST, 0.03)],
    ),
)
def test_restitution_through_the_real_rig_is_predicted(servo, duration):
    rig = Rig(SCENE, plate_law(MASS, duration), servo, Cell(200.0), Transport())
    loop, got = first_touch("none", rig, duration)
    expected = predicted_restitution(duration, response_of(rig, loop.lags.latency))
    assert expected > 1.15
    assert got == pytest.approx(expected, rel=0.04)


@pytest.mark.parametrize("delay", [0.005, 0.01, 0.02, 0.03])
def test_prediction_is_of_third_order_in_the_delay(delay):
    """exp((pi^4 / 2) (tau / T)^3): within 5 % up to a tenth of the touch."""
    duration = 0.2
    rig = ideal_rig(SCENE, plate_law(MASS, duration), delay)
    _, got = first_touch("prediction", rig, duration)
    ratio = (delay + 0.5e-3) / duration
    assert got == pytest.approx(math.exp(0.5 * math.pi**4 * ratio**3), rel=0.04)


def test_prediction_knows_the_servos_lag_from_the_measured_tip():
    """The stamps show 1 ms of 14: with loop/rig_tip the rest is known before the first touch."""
    duration = 0.3
    errors = {}
    for sends_tip in (True, False):
        rig = Rig(SCENE, plate_law(MASS, duration), Servo(20.0, 0.002), sends_tip=sends_tip)
        loop, _ = close(SCENE, rig, "prediction", t_end=0.9)
        errors[sends_tip] = abs(loop.episodes[0].restitution - 1.0)
        if sends_tip:
            assert loop.lags.servo == pytest.approx(rig.servo.lag, abs=1e-3)
        else:
            assert any("later than its stamps and tips show" in note for note in loop.notes)
    assert errors[True] < 0.03
    assert errors[False] > 3.0 * errors[True]


# touches under noise and bias


@pytest.mark.parametrize("noise", cases(few=[0.1], all=[0.0, 1e-3, 0.1, 0.5]))
@pytest.mark.parametrize("bias", cases(few=[0.0, 5.0], all=[0.0, 0.5, 5.0]))
def test_noise_and_bias_do_not_decide(noise, bias):
    """A dissipative plate, one touch."""
    duration = 0.1
    law = plate_law(MASS, duration, 0.6)
    quiet = ideal_rig(SCENE, law, 0.001)
    cell = Cell(noise=noise, bias=bias, resolution=0.0)
    rig = Rig(SCENE, law, *IDEAL[:1], cell, Transport(0.001, 0.0, 0.0, 0.0))
    expected, _ = close(SCENE, quiet, t_end=0.6)
    got, _ = close(SCENE, rig, t_end=0.6)
    assert len(got.episodes) == 1
    assert got.answers.noise == pytest.approx(noise, rel=0.3)
    assert got.contact.threshold == pytest.approx(max(6.0 * got.answers.noise, 0.01))
    assert got.episodes[0].restitution == pytest.approx(expected.episodes[0].restitution, rel=0.01)
    assert got.episodes[0].rig.restitution == pytest.approx(0.6, rel=0.01)


# model


@pytest.mark.parametrize(
    "true, offset", cases(few=[(0.6, 2e-5)], all=[(1.0, -2e-5), (0.6, 2e-5), (0.3, -2e-5)])
)
@pytest.mark.parametrize(
    "servo, duration, factor",
    cases(
        few=[(FAST, 0.0037, 0.5), (SLOW, 0.033, 2.0)],
        all=[
            (FAST, 0.0037, 0.5),
            (FAST, 0.01, 0.5),
            (FAST, 0.01, 2.0),
            (FAST, 0.1, 0.5),
            (SLOW, 0.033, 0.5),
            (SLOW, 0.033, 2.0),
            (SLOW, 0.2, 0.5),
        ],
    ),
)
def test_the_model_holds_the_restitution_from_the_second_touch_on(
    servo, duration, factor, true, offset
):
    """Lag up to one touch, noise 0.1 N, bias 0.5 N; from a stiffness wrong by two."""
    assert servo.lag <= duration
    law = plate_law(MASS, duration, true, offset)

    def rig(seed):
        return Rig(SCENE, law, servo, WIDE_CELL, Transport(), seed=seed)

    guess = WallLaw(factor * law.stiffness)
    t_end = 0.35 + 2.0 * duration
    (first, _), (second, why) = close_often(2, guess, rig, t_end)
    assert not why
    (touch,) = second.episodes
    expected = restitution_on(law, t_end)
    assert vehicles_restitution(second.stage) == pytest.approx(expected, rel=0.05)
    # the target turns meanwhile
    assert touch.restitution == pytest.approx(vehicles_restitution(second.stage), rel=0.03)
    assert touch.rig_restitution == pytest.approx(expected, rel=0.02)
    assert touch.is_held
    if abs(first.episodes[0].restitution / expected - 1.0) > 0.07:
        assert first.episodes[0].is_held is False
        assert any("not held within 5%" in note for note in first.notes)


def test_a_model_needs_a_stiffness():
    with pytest.raises(CaptureSimError, match=r"stiffness = 0 N/m\^exponent: must be > 0"):
        Loop(LoopStage(SCENE), "model")


def test_a_rig_that_is_not_reached_is_reported_and_the_law_softened():
    """A wall 2 mm farther than thought: three touches of the law alone, then a stop."""
    law = plate_law(MASS, 0.02, offset=-2e-3)
    guess = WallLaw(law.stiffness)
    loop, _ = close(SCENE, Rig(SCENE, law, FAST), "model", guess, t_end=0.4)
    assert loop.episodes[0].rig is None
    assert "the law was in contact, the rig was not" in loop.notes[0]
    assert "mm before the law's wall" in loop.notes[0] or "lowered" in loop.notes[0]
    assert loop.estimate.law.stiffness == pytest.approx(0.25 * law.stiffness)


def test_a_wall_much_nearer_than_thought_stops_at_the_force_limit():
    law = plate_law(MASS, 0.02, offset=5e-3)
    limits = replace(WIDE, force=300.0)
    guess = WallLaw(law.stiffness)
    loop, why = close(SCENE, Rig(SCENE, law, FAST), "model", guess, limits, 0.4)
    assert "force on the rig = " in why
    assert "must be <= 300" in why
    assert loop.energy_excess <= 1e-6


def test_a_contact_that_no_law_describes_is_reported():
    """A wall that yields at 15 N, of the 35 that it would bear."""
    law = plate_law(MASS, 0.1)
    yielding = Rig(SCENE, law, FAST, Cell(bias=0.0, force_range=15.0))
    loop, _ = close(SCENE, yielding, "model", law, t_end=0.6)
    assert any("the fitted law misses the rig's force by" in note for note in loop.notes)
    assert loop.episodes[0].is_held is None
    assert loop.law == law  # what does not describe the contact is not taken over


@pytest.mark.parametrize("method", ["none", "model"])
@pytest.mark.parametrize("true", [1.0, 0.6])
def test_a_hidden_lag_is_reported(method, true):
    law = plate_law(MASS, 0.1, true)
    rig = Rig(SCENE, law, FAST, hidden_lag=0.008)
    loop, _ = close(SCENE, rig, method, WallLaw(0.5 * law.stiffness), t_end=0.7)
    assert loop.episodes[0].rig.lag == pytest.approx(0.008, abs=0.3e-3)
    assert loop.episodes[0].rig.restitution == pytest.approx(true, rel=0.02)
    assert any("ms later than its stamps and tips show" in note for note in loop.notes)


@pytest.mark.parametrize(
    "t_end, text", [(0.3, "within a contact"), (0.35, "before the contact was compared")]
)
def test_a_run_that_ends_before_the_fit_says_what_is_not_known(t_end, text):
    law = plate_law(MASS, 0.1)
    loop, why = close(SCENE, Rig(SCENE, law, FAST), "model", WallLaw(law.stiffness), t_end=t_end)
    assert not why
    assert [touch.is_held for touch in loop.episodes] == [None] * len(loop.episodes)
    assert text in loop.notes[-1]


# limits


def test_the_commanded_motion_is_limited():
    law = plate_law(MASS, 0.05)
    for limits, text in (
        (replace(WIDE, speed=0.05), r"commanded speed = 0.05\d* m/s: must be <= 0.05"),
        (
            replace(WIDE, angular_speed=1e-4),
            r"commanded angular speed = \S+ rad/s: must be <= 0.0001",
        ),
        (replace(WIDE, acceleration=1.0), r"commanded acceleration = \S+ m/s\^2: must be <= 1"),
    ):
        _, why = close(SCENE, ideal_rig(SCENE, law, 0.002), "none", limits=limits, t_end=0.5)
        assert why.startswith("stopped at t = ")
        assert re.search(text, why)


def test_the_energy_limit_scales_the_wrench_down_before_it_stops():
    """Answers 20 ms late: without the limit this touch would give 0.09 J."""
    law = plate_law(MASS, 0.15)
    results = {}
    for limit in (0.2, 0.06):
        limits = replace(WIDE, energy=limit)
        loop, why = close(SCENE, ideal_rig(SCENE, law, 0.02), "none", limits=limits, t_end=0.7)
        results[limit] = loop, why
    free, bound = results[0.2][0], results[0.06][0]
    assert not results[0.2][1]
    assert free.energy_withheld == 0.0
    assert free.energy_excess > 0.06
    assert bound.energy_excess <= 0.06 * (1 + 1e-9)
    assert bound.energy_withheld > 0.0
    assert any("wrench scaled down" in note for note in bound.notes)


def test_the_load_of_the_rig_is_the_cells_and_the_vehicles_share_is_apart():
    """Stopped by the energy limit, the rig has borne more than the vehicles were given."""
    law = plate_law(MASS, 0.15)
    rig = ideal_rig(SCENE, law, 0.02)
    loop, _ = close(SCENE, rig, "none", limits=replace(WIDE, energy=0.01), t_end=0.7)
    assert loop.energy_withheld > 0.01
    assert loop.contact.peak_force == pytest.approx(rig.peak_force, rel=0.1)
    whole, _ = close(SCENE, ideal_rig(SCENE, law, 0.02), "none", t_end=0.7)
    (touch,) = whole.episodes
    assert touch.rig_peak_force == whole.contact.peak_force
    assert touch.peak_force == pytest.approx(touch.rig_peak_force)  # nothing was scaled down


class Pulses:
    """A rig that pulls the tip on for 2 ms, again and again."""

    def answer(self, pose):
        pulls = pose.t > 0.02 and pose.t % 0.05 < 0.002
        return [Answer(pose.t, Wrench(60.0 if pulls else 0.0), pose)]


def test_energy_given_in_one_touch_is_not_given_again_in_the_next():
    limits = replace(WIDE, energy=0.02)
    loop = Loop(LoopStage(SCENE), "none", limits=limits)
    energy = loop.stage.energy
    why = run_in_process(loop, Pulses(), 0.5)
    assert len(loop.episodes) >= 1
    assert loop.stage.energy - energy <= 0.02 * (1.0 + 1e-9)
    assert "energy_limit" in why


def test_a_restitution_that_one_side_alone_has_is_not_known():
    """The wall is 5 mm farther on the rig than in the scene: only the law is in contact."""
    law = plate_law(MASS, 0.1)
    far = Rig(SCENE, replace(law, offset=-5e-3), SLOW)
    loop, _ = close(SCENE, far, "model", law, t_end=0.5)
    assert loop.episodes[0].peak_force > 1.0
    assert loop.episodes[0].rig_peak_force == 0.0
    assert math.isnan(loop.episodes[0].restitution)


@pytest.mark.parametrize("t_end", [0.0, 0.28])
def test_a_rig_that_a_loop_left_in_the_wall_serves_the_next_one(t_end):
    """Without an earlier loop, and with one that was in contact, the next loop is the same."""
    law = plate_law(MASS, 0.1)
    rig = Rig(SCENE, law, FAST, Cell(noise=0.0), Transport(jitter=0.0, drops=0.0, doubles=0.0))
    left, _ = close(SCENE, rig, t_end=t_end)
    assert (left.contact.peak_force > 1.0) == (t_end > 0.0)
    loop, why = close(SCENE, rig, t_end=0.5)
    assert not why
    assert loop.answers.bias.fx == pytest.approx(0.5, abs=0.01)
    assert loop.known_lag == pytest.approx(FAST.lag + 0.0015, abs=1e-3)
    (touch,) = loop.episodes
    fresh, _ = close(SCENE, replace(rig), t_end=0.5)
    assert touch.restitution == pytest.approx(fresh.episodes[0].restitution, rel=1e-3)


def test_answers_count_as_at_rest_only_at_the_first_position():
    loop = Loop(LoopStage(SCENE))
    start, away = loop.t, loop.pose._replace(x=loop.pose.x + 2e-3)
    assert start == -0.2
    loop.receive(start, Wrench(0.5), loop.pose)
    loop.receive(start, Wrench(-18.0), away)
    loop.receive(start, Wrench(-18.0))  # without a tip: where it was measured last
    assert loop.answers.n_at_rest == 0  # what came before the tip moved does not count either
    loop.receive(3.0, Wrench(-18.0), loop.pose)  # to a position of an earlier loop
    assert loop.answers.n_at_rest == 0
    assert loop.start_distance == pytest.approx(2e-3)
    loop.receive(start, Wrench(0.5), loop.pose)
    assert loop.answers.n_at_rest == 1


def test_a_tip_that_does_not_follow_gives_no_lag():
    class Stuck:
        def answer(self, pose):
            return [Answer(pose.t, Wrench(), first)]

    loop = Loop(LoopStage(SCENE))
    first = loop.pose
    assert not run_in_process(loop, Stuck(), 0.15)
    assert loop.lag > LoopLimits().latency
    assert loop.known_lag is None


# what the robot is sent, and what its cell shows


@pytest.mark.parametrize("factor", [0.5, 1.0, 2.0])
def test_nothing_above_the_pages_acceleration_is_commanded(factor):
    """docs/hardware_methods.md: pi v / T in the touch; after it, the probe must not ring."""
    scene, stiffness = load_scene("_loop"), 2e4
    law = WallLaw(stiffness, damping=3.0 * stiffness)
    guess = WallLaw(factor * stiffness, damping=3.0 * factor * stiffness)
    loop = Loop(LoopStage(scene, 1e-3), "model", guess, WIDE)
    commanded = recorded_poses(loop)
    assert not run_in_process(loop, ideal_rig(scene, law, 0.008), 1.0)
    times, speeds = np.array([p.t for p in commanded]), np.array([[p.vx, p.vy] for p in commanded])
    accelerations = np.hypot(*np.diff(speeds, axis=0).T) / 1e-3
    duration = min(each.duration(plate_mass(scene), 0.1) for each in (law, guess))
    assert accelerations.max() < 1.3 * math.pi * 0.1 / duration
    last = loop.episodes[-1].duration + 0.05
    assert accelerations[times[1:] > 0.05 + last + 0.1].max() < 0.3


@pytest.mark.parametrize("method", ["none", "model"])
@pytest.mark.parametrize("step", [0.5, -3.0])
def test_a_bias_that_steps_is_named_and_the_contact_ends(method, step):
    law = plate_law(MASS, 0.03)
    rig = Rig(SCENE, law, *IDEAL[:1], Cell(), Transport(0.001, 0.0, 0.0, 0.0))
    answer = rig.answer

    def stepped(pose):
        drift = step if pose.t > 0.25 else 0.0  # in the contact, which begins at 0.2 s
        return [
            one._replace(wrench=one.wrench._replace(fx=one.wrench.fx + drift))
            for one in answer(pose)
        ]

    rig.answer = stepped
    loop, why = close(SCENE, rig, method, law if method == "model" else NO_LAW, t_end=1.5)
    assert not why
    assert not loop.contact.is_on
    [note] = [note for note in loop.notes if "drifted" in note]
    assert float(note.split("drifted by ")[1].split(" ")[0]) == pytest.approx(abs(step), rel=0.1)


@pytest.mark.parametrize("seed", cases(few=range(8), all=range(200)))
def test_a_drawn_rig_is_not_stopped_and_not_shaken(seed):
    """5 to 50 kN/m, damping to 3 s/m, 1 to 10 ms, a law wrong by up to two; the default limits."""
    rng, scene = np.random.default_rng([7, seed]), load_scene("_loop")
    stiffness, damping = 10.0 ** rng.uniform(3.7, 4.7), rng.uniform(0.0, 3.0)
    delay, factor = rng.uniform(0.001, 0.010), 2.0 ** rng.uniform(-1.0, 1.0)
    law = WallLaw(stiffness, damping=damping * stiffness)
    guess = WallLaw(factor * stiffness, damping=damping * factor * stiffness)
    limits = LoopLimits(force=1e4, torque=1e4)
    loop = Loop(LoopStage(scene, 1e-3), "model", guess, limits)
    commanded = recorded_poses(loop)
    assert not run_in_process(loop, ideal_rig(scene, law, delay), 1.0)
    times, speeds = np.array([p.t for p in commanded]), np.array([[p.vx, p.vy] for p in commanded])
    accelerations = np.hypot(*np.diff(speeds, axis=0).T) / 1e-3
    duration = min(each.duration(plate_mass(scene), 0.1) for each in (law, guess))
    assert accelerations.max() < 3.0 * math.pi * 0.1 / duration
    ended = 0.05 + loop.episodes[-1].duration + 0.12
    assert accelerations[times[1:] > ended].max() < 0.5
    assert loop.energy_excess < 0.01 * limits.energy
