"""Clocks, rates and standstill before a release, and sensors that fail after it, without DDS."""

import math
import re

import pytest
from test_trial import CONTACT, SCENE, TARGET, TOPICS, Rig, Trial, TrialGoal, TrialPhase

from capture_sim.detection.measurements import Source
from capture_sim.launcher.state_machine import Launcher
from capture_sim.trial.interlocks import RULES, Interlocks, SourceMonitor, TrialLimits

NAMES = {source: topics[0] for source, topics in TOPICS.items()}


def refusal(
    *,
    rate=None,
    speed=0.0,
    x=0.0,
    turn=0.0,
    stroke=0.0,
    target_speed=0.0,
    machine=math.nan,
    first_pose=0.0,
    waived=(),
    **limits,
):
    """Return why a bench is not released after 2 s of its measurements.

    ``rate``: Hz, by source; ``speed``: of the chaser, m/s; ``x`` and ``turn``: of the chaser from
    its start, m and rad; ``stroke``: m; ``machine``: this machine's clock, s; ``first_pose``: when
    its camera begins, s.
    """
    interlocks = Interlocks(TrialLimits(**limits), TOPICS, waived=waived)
    interlocks.readers.note(["/driver"], {}, -1.0)
    interlocks.machine_clock = machine
    interlocks.begin(SCENE)
    for k in range(2000):
        t = 1e-3 * k
        for source, topic in NAMES.items():
            period = round(1000.0 / (rate or {}).get(source, 100.0))
            if k % period == 0 and (source is not Source.CHASER or t >= first_pose):
                values = {
                    Source.CHASER: (x + speed * t, 0.005, turn),
                    Source.TARGET: (TARGET, target_speed * t, 0.0),
                    Source.BUFFER: (stroke, 0.0),
                }
                interlocks.add(topic, round((t + 1.2e9) * 1e9), values[source], t)
    return interlocks.refusal(2.0)


def test_a_bench_in_order_is_released():
    assert refusal() == ""
    assert refusal(machine=1.2e9 + 0.5) == ""


def test_a_steady_clock_of_all_sources_refuses():
    text = refusal(machine=1.7e9)
    assert "behind this machine's: must be within 1 s" in text
    assert "[rule machine_clock]" in text
    assert refusal(machine=1.7e9, waived=["machine_clock"]) == ""


def test_a_source_that_sends_too_seldom_refuses():
    text = refusal(rate={Source.BUFFER: 5.0})
    assert text.startswith("joint_states: 5")
    assert "must be at least 10" in text
    slow = {"rate": {Source.BUFFER: 5.0}}
    assert refusal(**slow, waived=["rates", "buffer_rest"]) == ""
    assert refusal(**slow, min_rate=2.0, waived=["buffer_rest"]) == ""
    assert "too few measurements to tell whether it is at rest" in refusal(**slow, min_rate=2.0)


def test_a_chaser_that_moves_refuses():
    text = refusal(speed=0.05, waived=["start"])
    assert text.startswith("the chaser moves by 47.2 mm within 1 s, at 50 mm/s: it must be at rest")
    assert refusal(speed=0.05, waived=["start", "standstill"]) == ""


def test_a_chaser_with_too_few_poses_to_tell_whether_it_stands_refuses():
    """Of cameras that have just been started no rate is known yet, either."""
    few = "too few measurements to tell whether it is at rest: must be 8 in 1 s"
    for first, words in ((1.3, few), (0.9, "at rest for 0.3 s: must be 0.5"), (0.6, "")):
        text = refusal(first_pose=first)
        assert words in text
        assert bool(text) is bool(words)
        assert refusal(first_pose=first, waived=["standstill"]) == ""
    assert few in refusal(rate={Source.CHASER: 7.0}, min_rate=5.0)


@pytest.mark.parametrize("where", [{"x": 0.06}, {"x": -0.06}, {"turn": 0.2}, {"x": 212.5}])
def test_a_chaser_away_from_its_start_refuses(where):
    text = refusal(**where)
    assert text.startswith("motion_capture/chaser: target ")
    assert "in the scene 0.660 m ahead, -0.005 m left, turned 0.0 deg: must be within" in text
    assert text.endswith("[rule start]")
    assert refusal(**where, waived=["start"]) == ""
    assert refusal(x=0.02, turn=0.03) == ""


def test_a_buffer_that_is_not_at_rest_refuses():
    text = refusal(stroke=-0.2)
    assert text.startswith("joint_states: stroke -0.2 m, torsion 0 rad: must be within 0.003 m")
    assert refusal(stroke=-0.2, waived=["buffer_rest"]) == ""
    assert refusal(stroke=0.002) == ""


def test_broken_rules_of_plausibility_refuse():
    rig = Rig(others=False)
    rig.interlocks.implausible = ("motion_capture/chaser: refused (tilted): w first",)
    rig.others = True
    trial = rig.run(rig.limits.start_timeout + 0.5)
    assert trial.failure.endswith("refused (tilted): w first")
    assert not trial.is_released


def test_rules_of_plausibility_are_looked_at_in_the_moment_of_the_release():
    rig = Rig(others=False)
    requests = []
    rig.interlocks.request_check = lambda: requests.append(rig.now)
    rig.interlocks.note_check((), 0.0)
    rig.run(0.5)
    rig.others = True
    assert not rig.run(0.1).is_released  # the last check is of before all others were ready
    assert requests[0] > 0.5
    rig.interlocks.note_check(("load_cell/wrench: a hand",), requests[0])
    assert not rig.run(0.1).is_released
    assert rig.trial.waiting_for(rig.now) == "load_cell/wrench: a hand"
    del requests[:]
    rig.interlocks.note_check((), rig.now)
    assert not rig.run(0.1).is_released  # what has come since the hand is not checked
    rig.interlocks.note_check((), requests[-1])
    assert rig.run(0.02).is_released


def test_a_check_that_does_not_come_is_named_an_overload():
    rig = Rig(others=False)
    rig.interlocks.note_check((), 0.0)
    rig.run(3.5)
    assert rig.trial.waiting_for(rig.now) == (
        "rules of plausibility: last checked 3.5 s ago: this machine is overloaded: end other "
        "programs"
    )


def test_each_rule_can_be_waived_by_name():
    broken = {"rate": {Source.BUFFER: 9.0}, "speed": 0.1, "x": 0.1, "stroke": -0.01}
    broken["target_speed"] = 0.1
    text = refusal(**broken, machine=1.7e9)
    assert all(f"[rule {name}]" in text for name in RULES)
    assert refusal(**broken, machine=1.7e9, waived=RULES) == ""


# after the release


@pytest.mark.parametrize("step", [-5.0, -1.0, 2.0])
def test_a_clock_that_steps_aborts_an_approach(step):
    rig = Rig()
    rig.run(1.0)
    rig.offset = step
    trial = rig.run(0.2)
    assert trial.failure.startswith("motion_capture/chaser: clock stepped by")
    assert trial.holds


def test_a_driver_that_was_restarted_before_the_release_has_no_step():
    rig = Rig()
    rig.run(1.0)
    rig.trial.cancel()
    rig.run(0.1)
    rig.offset = -5.0  # its clock begins anew
    again = Rig()
    again.interlocks, again.offset, again.now = rig.interlocks, -5.0, rig.now
    for _ in range(200):  # it is put back
        again.now += 0.01
        again._measure()
    again.trial = Trial(
        TrialGoal("c4"), SCENE, Launcher(SCENE), rig.interlocks, has_actuator=True, now=rig.now
    )
    trial = again.run(1.0)
    assert (trial.failure, trial.is_released) == ("", True)


def test_one_wild_stamp_is_no_step():
    monitor = SourceMonitor()
    for k in range(400):
        if k == 200:
            monitor.mark()
        monitor.add(round(1e7 * k) + (3_600_000_000_000 if k == 300 else 0), (float(k),), 0.01 * k)
        assert monitor.clock_step() == 0.0


def test_late_messages_are_no_step():
    monitor = SourceMonitor()
    for k in range(400):
        if k == 200:
            monitor.mark()
        monitor.add(round(1e7 * k), (float(k),), 0.01 * k + (2.0 if k >= 300 else 0.0))
        assert monitor.clock_step() == 0.0


def test_a_bench_faster_than_time_has_no_step_where_its_clock_is_waived():
    for waived in ((), ("machine_clock",)):
        interlocks = Interlocks(TrialLimits(), TOPICS, waived=waived)
        for k in range(300):
            if k == 100:
                interlocks.mark()
            for topic in NAMES.values():
                interlocks.add(topic, round(5e7 * k), (0.1 * k, 0.0, 0.0), 0.01 * k)
        assert bool(interlocks.clock_steps()) is (not waived)


@pytest.mark.parametrize("begin", [1.0, CONTACT - 0.1, CONTACT + 0.2])
def test_encoders_that_die_are_a_problem_and_the_reason(begin):
    rig = Rig()
    rig.run(0.5)
    begin += rig.trial.released
    rig.silent = {Source.BUFFER: (begin, math.inf)}
    rig.run(CONTACT + 2.0)
    rig.trial.add_verdict("undecided", "ended before any contact", is_final=True)
    trial = rig.run(2.0)
    assert trial.phase is TrialPhase.OVER
    [problem] = trial.sensor_problems
    since = re.fullmatch(r"joint_states: stopped ([\d.]+) s after the release", problem)[1]
    assert float(since) == pytest.approx(begin - trial.released, abs=0.011)
    assert trial.outcome[0] == "undecided"
    assert trial.outcome[1].startswith(trial.sensor_problems[0])


def test_cameras_that_are_hidden_at_the_contact_are_no_problem_and_longer_ones_are():
    for length in (0.5, 1.5):
        rig = Rig()
        rig.run(0.5)
        window = (rig.trial.released + CONTACT, rig.trial.released + CONTACT + length)
        rig.silent = {Source.CHASER: window, Source.TARGET: window}
        rig.run(CONTACT + 2.5)
        rig.trial.add_verdict("captured", "", is_final=True)
        trial = rig.run(0.1)
        assert bool(trial.sensor_problems) is (length > 1.0)
        if trial.sensor_problems:
            assert "for 1." in trial.sensor_problems[0]
