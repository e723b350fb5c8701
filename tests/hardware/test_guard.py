"""Nothing passes the guard: the first positions, dead cells, wrong units, energy, pace."""

import contextlib
import itertools
import math
from dataclasses import replace

import pytest
from plate import MASS, SCENE, WIDE, close, ideal_rig, plate_law

from capture_sim.hardware.guard import Guard, LoopLimits
from capture_sim.hardware.law import TipState, Wrench
from capture_sim.hardware.loop import METHODS, Loop, run_in_process
from capture_sim.hardware.pacing import MIN_INTERVAL, LoopPacer, request_priority
from capture_sim.hardware.rig import IDEAL, Cell, Rig, Servo, Transport
from capture_sim.hardware.stage import LoopStage, SafeStopError

STEP = 1e-3
NO_TRANSPORT = Transport(0.0, 0.0, 0.0, 0.0)
WALL = plate_law(MASS, 0.05)


class Recorded:
    """A channel that keeps what is sent through it, and may change the readings."""

    def __init__(self, rig, change=lambda t, wrench: wrench):
        self.rig, self.change, self.poses, self.peak = rig, change, [], 0.0

    def answer(self, pose):
        self.poses.append(pose)
        answers = self.rig.answer(pose)
        self.peak = self.rig.peak_force
        return [a._replace(wrench=Wrench(*self.change(a.stamp, a.wrench))) for a in answers]


def largest_acceleration(poses):
    """Of what a rig at rest was sent, m/s^2."""
    places = [(p.x, p.y) for p in poses]
    bends = zip(places, places[1:], places[2:], strict=False)
    return max(math.hypot(*(a - 2 * b + c for a, b, c in zip(*p, strict=True))) for p in bends) / (
        STEP**2
    )


# what is sent


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("delay", [0.0, 0.004])
def test_no_position_is_sent_beyond_the_acceleration_limit(method, delay):
    """Also by a rig that answers within the step, whose answers leave no older position."""
    stops = []
    for limit in (0.5, 2.0, 5.0, 1e6):
        rig = Recorded(ideal_rig(SCENE, WALL, delay))
        limits = replace(WIDE, acceleration=limit)
        _, why = close(SCENE, rig, method, WALL, limits, t_end=0.4)
        assert largest_acceleration(rig.poses) <= limit * (1.0 + 1e-6)
        stops.append("commanded acceleration = " in why)
    assert stops == [True, True, True, False]


def test_without_a_run_up_the_first_motion_from_rest_is_a_blow():
    loop = Loop(LoopStage(SCENE), limits=LoopLimits(acceleration=99.0), run_up=0.0)
    why = run_in_process(loop, ideal_rig(SCENE, WALL), 0.1)
    assert "commanded acceleration = 100 m/s^2: must be <= 99" in why


def test_the_run_up_ends_in_the_first_position_at_its_speed():
    rig = Recorded(ideal_rig(SCENE, WALL))
    _, why = close(SCENE, rig, t_end=0.01)
    assert not why
    first = LoopStage(SCENE).tip
    at_start = next(pose for pose in rig.poses if abs(pose.t) < 1e-9)
    assert at_start[1:] == pytest.approx(first[1:], abs=1e-12)
    assert rig.poses[0][4:] == (0.0, 0.0, 0.0)
    assert largest_acceleration(rig.poses) == pytest.approx(1.5 * 0.1 / 0.2, rel=0.01)
    for before, after in zip(rig.poses[99:], rig.poses[100:], strict=False):
        mean = 0.5 * (before.vx + after.vx)
        assert (after.x - before.x) / STEP == pytest.approx(mean, abs=1e-4)


@pytest.mark.parametrize("field", ["x", "y", "theta"])
def test_a_position_that_is_no_number_is_not_sent(field):
    guard = Guard(LoopStage(SCENE), LoopLimits())
    pose = guard.send(TipState(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0))
    with pytest.raises(SafeStopError, match="commanded"):
        guard.send(pose._replace(**{field: math.nan}))


def test_prediction_moves_without_jumps_while_the_lag_changes():
    """Jumps of the latency and a slow servo, at the default limits, before any contact."""
    for jitter in (0.0, 2e-3):
        rig = Recorded(Rig(SCENE, WALL, Servo(10.0, 0.01), Cell(), Transport(0.004, jitter)))
        _, why = close(SCENE, rig, "prediction", limits=LoopLimits(), t_end=0.15)
        assert not why
        assert largest_acceleration(rig.poses) < 10.0


# what comes back


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("start", [0.02, 0.21])
def test_a_cell_that_repeats_its_last_value_is_noticed(method, start):
    """From before the contact, or within it: the wall does not bear what the vehicles can give."""
    wall, kept = plate_law(MASS, 0.02), []

    def frozen(t, wrench):
        if t < start or not kept:
            kept[:] = wrench
        return kept

    rig = Recorded(Rig(SCENE, wall, Servo(0.0, 0.0), Cell(force_range=1e6), NO_TRANSPORT), frozen)
    _, why = close(SCENE, rig, method, wall, t_end=0.6)
    assert "identical readings of the load cell in a row = 11: must be <= 10" in why
    assert rig.peak < 300.0


def test_a_cell_slower_than_the_loop_is_no_dead_cell():
    """Each reading comes five times, also at rest."""
    kept = [0, None]

    def slow(t, wrench):
        kept[0] += 1
        if kept[0] % 5 == 1:
            kept[1] = wrench
        return kept[1]

    loop, why = close(SCENE, Recorded(Rig(SCENE, WALL, *IDEAL[:1]), slow), t_end=0.5)
    assert not why
    assert loop.contact.peak_force > 0.0


@pytest.mark.parametrize("factor", [0.0, 1e-3, -1.0])
@pytest.mark.parametrize("method", METHODS)
def test_a_cell_in_kilonewtons_or_of_the_wrong_sign_is_noticed(factor, method):
    """Without noise, by the depth in the scene's wall; one elastic touch bears 175 N."""
    wall = plate_law(MASS, 0.02)
    rig = Recorded(
        ideal_rig(SCENE, wall, 0.001), lambda t, wrench: [factor * value for value in wrench]
    )
    limits = replace(WIDE, depth=2e-4)
    _, why = close(SCENE, rig, method, wall, limits, t_end=0.5)
    assert "must be <= 0.0002 (depth_limit); load cell, its sign or the wall's position" in why
    assert rig.peak < 300.0


@pytest.mark.parametrize("sends_tip", [True, False])
def test_a_wall_that_is_felt_is_no_fault(sends_tip):
    """A slow servo and a soft wall at the default limits, also without a measured tip."""
    wall = plate_law(MASS, 0.2)
    loop, why = close(
        SCENE, Rig(SCENE, wall, Servo(), sends_tip=sends_tip), "model", wall, LoopLimits(), 0.9
    )
    assert not why
    assert loop.contact.peak_force > 5.0


# energy


def test_a_stop_in_the_first_loaded_step_reports_what_was_added():
    """A spike that would give far more than the limit at once."""
    guard = Guard(LoopStage(SCENE), replace(WIDE, energy=1e-3))
    guard.note_free_motion()
    with pytest.raises(SafeStopError, match=r"after 0\.000\d+ J added: must be <= 0\.001"):
        guard.take_guarded_step(Wrench(700.0))
    assert 0.5e-3 < guard.excess <= 1e-3
    assert guard.withheld > 1e-3


@pytest.mark.parametrize("push", [10.0, 290.0, 3e3, 3e5])
@pytest.mark.parametrize("is_correction", [False, True])
def test_a_wrench_is_scaled_to_the_energy_that_is_left(push, is_correction):
    stage = LoopStage(SCENE)
    guard = Guard(stage, replace(WIDE, energy=0.02))
    guard.note_free_motion()
    with contextlib.suppress(SafeStopError):
        guard.take_guarded_step(Wrench(push), is_correction=is_correction)
    most = 2e-5 if is_correction else 0.02
    assert 0.0 <= stage.energy <= guard.excess <= most * (1.0 + 1e-9)
    assert (guard.withheld > 0.0) == (push > 10.0 or is_correction)
    if push == 290.0 and not is_correction:
        assert guard.excess > 0.9 * most


# the pace


class Clock:
    """A clock that the test moves."""

    def __init__(self):
        self.now = 100.0

    def __call__(self):
        return self.now


def paced(work_times, period=STEP, max_lateness=1.0, max_late_share=1.0):
    """Return when positions were sent, by the time of the work on each (s), and the pacer."""
    clock = Clock()
    pacer, sent = LoopPacer(period, max_lateness, max_late_share, clock), []
    for work in work_times:
        clock.now += pacer.time_to_work()
        clock.now += work
        pacer.work_done()
        clock.now += pacer.time_to_send()
        pacer.release()
        sent.append(clock.now)
    return sent, pacer


def test_positions_are_never_closer_than_the_page_says():
    """Work of any length: what is late is sent at once, and the next one not too soon."""
    work = [1e-4 + 1.3e-3 * (k * 0.6180339887 % 1.0) ** 4 for k in range(20_000)]
    sent, pacer = paced(work)
    intervals = [b - a for a, b in itertools.pairwise(sent)]
    assert min(intervals) >= MIN_INTERVAL * STEP * (1.0 - 1e-6)
    assert max(intervals) > 1.2 * STEP
    assert 0.0 < pacer.late_share < 0.5


def test_the_rate_is_kept_while_the_work_takes_less_than_half_of_a_step():
    sent, pacer = paced([4e-4] * 1000)
    assert sent[-1] - sent[0] == pytest.approx(0.999, rel=1e-3)
    assert pacer.rate == pytest.approx(1000.0, rel=1e-2)
    assert pacer.late_steps <= 2


def test_too_many_late_steps_stop_the_loop_and_a_single_one_that_is_too_late():
    with pytest.raises(SafeStopError, match=r"share of late steps = 1: .* 66. steps per second"):
        paced([1.5e-3] * 300, max_late_share=0.2)
    paced([2e-3, *[1e-4] * 9] * 100, max_late_share=0.2)  # a tenth
    with pytest.raises(SafeStopError, match=r"lateness of a step = 0.06\d* s: must be <= 0.05"):
        paced([1e-4] * 10 + [0.061], max_lateness=0.05)


def test_a_priority_that_is_not_granted_says_how_to_get_it(monkeypatch):
    def refuse(*_):
        raise PermissionError(1, "Operation not permitted")

    monkeypatch.setattr("os.sched_setscheduler", refuse)
    assert "SCHED_FIFO not granted: Operation not permitted; add '@realtime" in request_priority(50)
    asked = []
    monkeypatch.setattr("os.sched_setscheduler", lambda *call: asked.append(call))
    assert request_priority(50) == ""
    assert len(asked) >= 1


def test_lost_answers_leave_nothing_behind():
    """Every other answer is lost: what the loop keeps of its positions does not grow."""

    class Lossy:
        def answer(self, pose):
            k = round(pose.t / STEP)
            return rig.answer(pose) if k % 2 or k < 0 else []

    rig = ideal_rig(SCENE, WALL)
    loop = Loop(LoopStage(SCENE), limits=WIDE)
    assert not run_in_process(loop, Lossy(), 0.1)
    assert len(loop._sent) < 5
