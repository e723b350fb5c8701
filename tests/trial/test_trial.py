"""A trial on a simulated clock: nothing is released blind, nothing that touches is aborted."""

import math
import random

import pytest
from cases import cases

from capture_sim import load_scene
from capture_sim.detection.measurements import Source
from capture_sim.errors import CaptureSimError
from capture_sim.launcher.state_machine import Launcher, LauncherPhase
from capture_sim.trial.interlocks import Interlocks, SourceMonitor, TrialLimits
from capture_sim.trial.trial import CANCELLED, Trial, TrialGoal, TrialPhase, TrialStep

SCENE = load_scene("tilt_0")
TARGET, STOP, SPEED, DROP = 0.66, 0.2125, 0.105, 0.1  # m and m/s: as of the example's bench
TOPICS = {
    Source.CHASER: ("motion_capture/chaser", "chaser/odom"),
    Source.TARGET: ("motion_capture/target", "target/odom"),
    Source.BUFFER: ("joint_states", "bench/buffer"),
}
TICK = 0.01  # s
NEVER = (math.inf, math.inf)
#: Time of the contact, s after the release.
CONTACT = 2.0 * DROP / SPEED + (STOP - DROP) / SPEED


def travel_at(t):
    ramp = min(max(t, 0.0), 2.0 * DROP / SPEED)
    sinking = 2.0 * DROP / SPEED
    return min(0.5 * SPEED * ramp * ramp / sinking + SPEED * max(t - sinking, 0.0), STOP)


class Rig:
    """A trial on a bench whose sources fall silent; t counts from the release of a good launch.

    ``rest``: for how long the bench was measured at rest before the goal, s.
    """

    def __init__(
        self, *, has_actuator=True, limits=None, travel=travel_at, others=True, rest=2.0, **goal
    ):
        self.limits = limits or TrialLimits()
        self.interlocks = Interlocks(self.limits, TOPICS)
        self.interlocks.readers.note(["/driver"], {}, -1.0)
        self.trial = None
        self.now, self.steps, self.held = -rest, [], []
        self.travel, self.others = travel, others
        self.silent = {}  # source: (begin, end), s of the rig's clock
        self.offset, self.frozen, self.lost_as = 0.0, NEVER, "silence"
        while self.now < -1e-9:
            self.now += TICK
            self._measure()
        self.trial = Trial(
            TrialGoal("c3", **goal),
            SCENE,
            Launcher(SCENE),
            self.interlocks,
            has_actuator=has_actuator,
            now=0.0,
        )

    def run(self, duration, rate=100.0):
        """Go on for some time, s; return the trial."""
        end = self.now + duration
        while self.now < end - 1e-9:
            self.now += 1.0 / rate
            self._measure()
            if self.others:
                closing = self.trial.phase is TrialPhase.CLOSING
                self.trial.set_others(ready=True, done=closing, pending="")
            self.steps += self.trial.advance(self.now)
            self.held.append((self.now, self.trial.holds))
        return self.trial

    def _measure(self):
        released = self.trial.released if self.trial and self.trial.is_released else math.inf
        at = self.now if not self.frozen[0] <= self.now < self.frozen[1] else self.frozen[0]
        x = self.travel(at - released)
        values = {
            Source.CHASER: (x, 0.005, 0.0),
            Source.TARGET: (TARGET, 0.0, 0.0),
            Source.BUFFER: (-0.003 * (x >= STOP), 0.0),
        }
        stamp = round((self.now + self.offset + 1.2e9) * 1e9)
        for source, measured in values.items():
            begin, end = self.silent.get(source, NEVER)
            if begin <= self.now < end:
                if self.lost_as == "silence":
                    continue
                measured = (math.nan,) * len(measured)
            topic = TOPICS[source][0]
            self.interlocks.add(topic, stamp, measured, self.now)
            if self.trial is None:
                continue
            if source is Source.BUFFER:
                self.trial.add_buffer(topic, *measured)
            else:
                self.trial.add_pose(source, topic, stamp, measured, self.now)


def test_a_good_trial_goes_through_its_phases():
    rig = Rig(expected="captured")
    trial = rig.run(1.0)
    assert rig.steps == [TrialStep.ANNOUNCE, TrialStep.RELEASE]
    assert (trial.phase, trial.holds) == (TrialPhase.APPROACH, False)
    rig.run(CONTACT + 0.2 - (rig.now - trial.released))
    assert trial.phase is TrialPhase.CONTACT
    assert trial.launcher.status.state is LauncherPhase.DELIVERED
    assert trial.launcher.status.measured_speed == pytest.approx(SPEED, rel=0.01)
    trial.add_verdict("captured", "within 5 mm", is_final=True)
    rig.run(0.02)
    assert trial.phase is TrialPhase.DECIDED
    assert not trial.holds
    rig.run(rig.limits.after_verdict + 0.1)
    assert trial.phase is TrialPhase.OVER
    assert trial.holds
    assert rig.steps[2:] == [TrialStep.CLOSE]
    assert (trial.failure, trial.verdict) == ("", "captured")
    assert trial.loads.max_stroke == pytest.approx(0.003)
    assert trial.gap <= 0.005


@pytest.mark.parametrize("source", Source)
@pytest.mark.parametrize("lost_as", ["silence", "NaN"])
@pytest.mark.parametrize("from_the_start", [True, False])
def test_nothing_is_released_blind(source, lost_as, from_the_start):
    rig = Rig(others=False, rest=0.0 if from_the_start else 2.0)
    rig.lost_as = lost_as
    if from_the_start:
        rig.silent = {source: (0.0, math.inf)}
        others = {t: ["/rig"] for s, names in TOPICS.items() if s is not source for t in names[:1]}
        rig.interlocks.note_publishers(others, {})
    rig.run(0.5)
    rig.silent = {source: (0.0, math.inf)}
    rig.run(0.4)
    rig.others = True  # too late: the source has fallen silent while the other nodes joined
    trial = rig.run(rig.limits.start_timeout + 0.5)
    assert TrialStep.RELEASE not in rig.steps
    assert all(is_held for _, is_held in rig.held)
    assert trial.phase is TrialPhase.OVER
    assert trial.failure.startswith(f"not released after 10 s: {TOPICS[source][0]}")
    if from_the_start:
        assert "no publisher" in trial.failure
    else:
        assert "s old: must be at most 0.3" in trial.failure
        assert TrialStep.ABORT in rig.steps


def test_a_trial_without_need_of_a_buffer_is_released():
    rig = Rig(limits=TrialLimits(max_buffer_age=0.0))
    rig.silent = {Source.BUFFER: (0.0, math.inf)}
    assert rig.run(0.5).is_released


def test_a_refusal_names_age_and_qos():
    interlocks = Interlocks(TrialLimits(), TOPICS)
    assert interlocks.refusal(0.0).startswith(
        "motion_capture/chaser or chaser/odom: no measurement"
    )
    interlocks.add("chaser/odom", 10, (0.0, 0.0, 0.0), 1.0)
    mismatches = {"motion_capture/target": "best effort offered, reliable requested"}
    interlocks.note_publishers({"chaser/odom": ["/a"]}, mismatches)
    chaser, target, buffer, hold = interlocks.refusal(3.5).split("; ")
    assert chaser == "chaser/odom: last measurement 2.5 s old: must be at most 0.3"
    assert "motion_capture/target: best effort offered, reliable requested" in target
    assert buffer == "joint_states or bench/buffer: no measurement, no publisher"
    assert hold == "launcher/hold: no reader"


def test_nothing_is_released_without_a_driver():
    rig = Rig()
    rig.interlocks.readers.note(["/_ros2cli_1"], {}, 0.0)
    trial = rig.run(rig.limits.start_timeout + 0.5)
    assert trial.failure == "not released after 10 s: launcher/hold: no reader"
    assert not trial.is_released


@pytest.mark.parametrize("at_the_cone", [True, False])
def test_a_driver_that_leaves_aborts_an_approach(at_the_cone):
    rig = Rig()
    rig.run(CONTACT + 0.3 if at_the_cone else 1.0)
    rig.interlocks.readers.note([], {}, rig.now)
    trial = rig.run(0.1)
    assert trial.failure == ("" if at_the_cone else "launcher/hold: no reader")
    assert trial.holds is not at_the_cone


OTHERS = "launcher/hold: published by /launcher and by /lab2: must be one node"


@pytest.mark.parametrize("when", [0.1, 1.0, CONTACT + 0.3])
def test_another_hand_on_the_hold_lets_nothing_go(when):
    """Before the release, in the approach, and in the contact."""
    rig = Rig(others=when > 0.5)
    rig.run(when)
    rig.interlocks.publishers.note(["/lab2", "/launcher"], 0, rig.now)
    if when > 0.5:
        assert rig.trial.holds  # at once
    rig.others = True
    trial = rig.run(rig.limits.start_timeout + 0.5)
    assert OTHERS in trial.failure
    assert trial.is_released is (when > 0.5)
    assert trial.phase is TrialPhase.OVER


def test_another_hand_that_has_left_refuses_no_later_release():
    rig = Rig()
    rig.interlocks.publishers.note(["/lab2", "/launcher"], 0, rig.now)
    rig.run(1.0)
    rig.interlocks.publishers.note(["/launcher"], 0, rig.now)
    trial = rig.run(1.0)
    assert trial.is_released
    assert not trial.holds


def test_another_hand_after_the_verdict_is_a_problem():
    rig = Rig()
    rig.run(CONTACT + 0.5)
    rig.trial.add_verdict("captured", "", is_final=True)
    rig.run(0.1)
    rig.interlocks.publishers.note(["/lab2", "/launcher"], 0, rig.now)
    trial = rig.run(0.1)
    assert trial.phase is TrialPhase.OVER
    assert trial.outcome[0] == "captured"
    assert OTHERS in trial.problems[0]


@pytest.mark.parametrize("role", ["recorder", "capture_detector"])
def test_required_nodes_that_are_absent_or_lost(role):
    rig = Rig(others=False)
    rig.trial.set_others(ready=False, done=False, pending="", absent=f"no {role} takes part")
    trial = rig.run(rig.limits.start_timeout + 0.5)
    assert trial.failure == f"not released after 10 s: no {role} takes part"
    assert rig.steps == [TrialStep.CLOSE] or TrialStep.ANNOUNCE not in rig.steps
    for when in (1.0, CONTACT + 0.3):
        rig = Rig()
        rig.run(when)
        rig.others = False
        lost = {role: f"{role}: gone"}
        rig.trial.set_others(ready=True, done=False, pending="", lost=lost)
        trial = rig.run(0.1)
        goes_on = when > CONTACT and role == "recorder"
        assert trial.holds is not goes_on
        assert f"{role}: gone" in trial.failure or goes_on
        assert trial.is_released


@pytest.mark.parametrize("is_started_again", [True, False])
def test_a_node_that_goes_before_the_release_is_waited_for_once_more(is_started_again):
    """A recorder that was killed is in the graph until its lease ends, beside the new one."""
    rig = Rig(others=False)
    joins = {"ready": False, "done": False, "pending": "waiting for /recorder to join the run"}
    rig.trial.set_others(**joins)
    rig.run(1.0)
    assert rig.steps == [TrialStep.ANNOUNCE]
    rig.trial.set_others(**joins, lost={"recorder": "recorder: gone"})
    trial = rig.run(0.1)
    assert rig.steps == [TrialStep.ANNOUNCE, TrialStep.WITHDRAW]
    assert (trial.phase, trial.waiting_for(rig.now)) == (TrialPhase.PREPARING, "recorder: gone")
    if is_started_again:  # as a free node of the roll
        trial.set_others(ready=False, done=False, pending="")
        rig.run(0.1)
        assert rig.steps[2:] == [TrialStep.ANNOUNCE]
        rig.others = True
        rig.run(0.1)
        assert rig.steps[3:] == [TrialStep.RELEASE]
    else:
        trial.set_others(ready=False, done=False, pending="", absent="no recorder takes part")
        rig.run(rig.limits.start_timeout)
        assert trial.failure == "not released after 10 s: no recorder takes part"
        assert rig.steps[2:] == []
        assert trial.holds


def test_two_nodes_that_publish_one_sensor_are_named():
    """A simulator in the domain of a bench: which of the two poses would be used is chance."""
    rig = Rig()
    nodes = {"motion_capture/chaser": ["/rig"], "chaser/odom": ["/simulator"]}
    rig.interlocks.note_publishers(nodes, {})
    trial = rig.run(rig.limits.start_timeout + 0.5)
    assert "published by /rig and /simulator: must be one node for the chaser" in trial.failure
    assert not trial.is_released
    driver = {"motion_capture/chaser": ["/rig"], "chaser/odom": ["/rig"]}
    rig = Rig()
    rig.interlocks.note_publishers(driver, {})
    assert rig.run(1.0).is_released


def test_poses_of_two_publishers_on_one_topic_abort_an_approach():
    rig = Rig()
    rig.run(1.0)
    for k in range(10):
        rig.interlocks.add("motion_capture/chaser", 10**9 + k, (0.3, 0.1, 0.01 * k), rig.now)
        trial = rig.run(0.01)
    assert trial.failure == "motion_capture/chaser: stamps of two clocks: two nodes publish it"
    assert trial.holds


def test_a_simulator_that_starts_in_the_approach_touches_nothing():
    """Its odometry is no pose of this trial, and hides no camera that dies."""
    rig = Rig()
    rig.run(1.0)
    nodes = {"motion_capture/chaser": ["/rig"], "chaser/odom": ["/simulator"]}
    rig.interlocks.note_publishers(nodes, {})
    for k in range(100):
        rig.interlocks.add("chaser/odom", k, (0.3, 0.1, 0.01 * k), rig.now)
        rig.trial.add_pose(Source.CHASER, "chaser/odom", k, (0.3, 0.1, 0.0), rig.now)
        trial = rig.run(0.01)
    assert (trial.phase, trial.failure) == (TrialPhase.APPROACH, "")
    rig.silent = {Source.CHASER: (rig.now, math.inf)}
    for k in range(100, 150):
        rig.interlocks.add("chaser/odom", k, (0.3, 0.1, 0.01 * k), rig.now)
        trial = rig.run(0.01)
    assert trial.failure.startswith("motion_capture/chaser: last measurement 0.3")


def test_a_verdict_of_another_run_is_ignored():
    rig = Rig(others=False)
    rig.run(0.5)
    stamp = round((1.2e9 + rig.now) * 1e9)
    rig.trial.add_verdict("stuck", "of an earlier trial", is_final=True, stamp=stamp)
    rig.others = True
    rig.run(CONTACT + 0.5)
    assert rig.trial.phase is TrialPhase.CONTACT
    rig.trial.add_verdict("missed", "of a replay", is_final=True, stamp=3_000_000_000)
    assert rig.trial.verdict == ""
    stamp = round((1.2e9 + rig.now - 0.1) * 1e9)
    rig.trial.add_verdict("captured", "", is_final=True, stamp=stamp)
    assert rig.trial.verdict == "captured"


@pytest.mark.parametrize("silence", [0.29, 0.31])
@pytest.mark.parametrize("source", [Source.CHASER, Source.TARGET])
@pytest.mark.parametrize("lost_as", ["silence", "NaN"])
def test_a_blind_approach_is_aborted_at_its_limit(silence, source, lost_as):
    rig = Rig()
    rig.run(1.5)
    rig.lost_as = lost_as
    rig.silent = {source: (rig.now + 1e-6, rig.now + silence)}
    trial = rig.run(0.5, rate=1000.0)
    if silence < rig.limits.max_pose_age:
        assert (trial.phase, trial.failure) == (TrialPhase.APPROACH, "")
        return
    assert trial.failure
    assert trial.is_released
    assert trial.holds
    assert trial.failure.startswith(TOPICS[source][0])
    assert rig.steps[2:] == [TrialStep.ABORT, TrialStep.CLOSE]
    assert trial.launcher.status.state is LauncherPhase.ABORTED
    first_held = next(t for t, is_held in rig.held if is_held and t > trial.released)
    assert first_held == pytest.approx(rig.silent[source][0] + 0.3, abs=0.003)


def test_a_pose_that_repeats_under_way_is_no_pose():
    rig = Rig()
    rig.run(2.0)
    rig.frozen = (rig.now, math.inf)
    trial = rig.run(0.5)
    assert "motion_capture/chaser: the same pose for 0.3" in trial.failure


def test_stamps_that_do_not_advance_are_no_measurements():
    source = SourceMonitor()
    for k in range(10):
        source.add(7, (float(k),), 0.1 * k)
    assert source.age(0.9) == pytest.approx(0.9)
    source.add(7 - 10**9, (0.0,), 1.0)  # the clock was set back
    source.add(8 - 10**9, (0.0,), 1.1)
    assert source.age(1.1) == 0.0


BEGINS = [CONTACT - 0.05, CONTACT, CONTACT - 0.25, CONTACT + 1.0]  # s, of a loss


@pytest.mark.parametrize("begin", cases(few=BEGINS[:2], all=BEGINS))
@pytest.mark.parametrize("lost_as", ["silence", "NaN", "frozen"])
def test_a_vehicle_that_may_touch_is_never_aborted(begin, lost_as):
    """Cameras that lose both vehicles before, at and after the contact, for ever or for 2 s."""
    for length in (2.0, math.inf):
        rig = Rig()
        rig.run(1.0)
        window = (rig.trial.released + begin, rig.trial.released + begin + length)
        rig.lost_as = lost_as
        if lost_as == "frozen":
            rig.frozen = window
        else:
            rig.silent = {Source.CHASER: window, Source.TARGET: window}
        trial = rig.run(10.0)
        assert (trial.failure, trial.holds) == ("", False), (begin, length)
        trial.add_verdict("captured", "", is_final=True)
        assert rig.run(2.0).phase is TrialPhase.OVER


@pytest.mark.parametrize("late", [0.2, 1.0, 3.0, 3.5, 10.0])
@pytest.mark.parametrize("rebound", [False, True])
def test_poses_that_begin_late_abort_no_launch_to_the_cone(late, rebound):
    """S3: let go by hand or by the output, a captured vehicle is never 'without contact'."""

    def travel(t):
        return travel_at(t) - (0.4 * SPEED * max(t - CONTACT, 0.0) if rebound else 0.0)

    rig = Rig(travel=travel, others=False)
    rig.run(0.5)
    rig.others = True
    rig.run(0.01)
    # released with fresh poses of a driver that dies at once, and the watch has seen none of them
    watch = rig.trial._watch
    rig.trial.add_pose = lambda source, topic, stamp, pose, now: (
        None
        if now < rig.trial.released + late
        else watch.add_target(pose, now)
        if source is Source.TARGET
        else watch.add_chaser(stamp * 1e-9, pose, now)
    )
    watch.__init__(rig.trial.launcher, SCENE)
    watch.release(rig.trial.released)
    trial = rig.run(late + 6.0)
    assert trial.failure == ""
    if not rebound:
        status = trial.launcher.status
        assert status.state is LauncherPhase.DELIVERED
        if late > CONTACT:
            assert math.isnan(status.measured_speed)
            assert status.reason.startswith("impact speed not measured: poses begin ")


def test_a_chaser_that_never_moves_is_aborted_for_its_time():
    rig = Rig(travel=lambda t: 0.0)
    trial = rig.run(6.0)
    assert trial.failure.startswith("no contact after ")
    assert trial.holds


def test_by_hand_nothing_is_refused_and_nothing_aborted():
    rig = Rig(has_actuator=False)
    rig.silent = dict.fromkeys(Source, (0.0, 3.0))
    trial = rig.run(10.0)
    assert rig.steps == [TrialStep.ANNOUNCE]
    assert all(is_held for _, is_held in rig.held)  # it has nothing to let go
    assert trial.failure == ""
    trial.cancel()
    rig.run(0.1)
    assert (trial.phase, trial.failure) == (TrialPhase.OVER, CANCELLED)


def test_by_hand_no_deviation_aborts():
    """Neither a chaser that is pushed twice as fast as planned nor one that is never let go."""
    for travel in (lambda t: travel_at(2.0 * t), lambda t: 0.0):
        rig = Rig(has_actuator=False, travel=travel)
        rig.run(1.0)
        rig.trial.set_launch(0.1, aborts=True)  # a parameter that is changed meanwhile
        trial = rig.run(9.0)
        assert trial.failure == ""
        assert trial.launcher.status.state is not LauncherPhase.ABORTED


@pytest.mark.parametrize("when", [0.5, 1.0, CONTACT + 0.5])
def test_a_cancel_holds_at_once(when):
    rig = Rig()
    rig.others = when > 0.5
    rig.run(when)
    rig.trial.cancel()
    steps = rig.trial.advance(rig.now)
    assert steps[-1] is TrialStep.CLOSE
    assert rig.trial.holds
    assert rig.trial.failure == CANCELLED


def test_time_limits_end_what_nobody_ends():
    rig = Rig(limits=TrialLimits(time_limit=5.0, closing_timeout=2.0))
    rig.run(1.0)
    rig.others = False
    rig.trial.set_others(ready=True, done=False, pending="")
    trial = rig.run(5.0)
    assert (trial.phase, trial.failure) == (TrialPhase.CLOSING, "")
    trial.set_others(ready=True, done=False, pending="recorder")
    rig.run(2.1)
    assert trial.phase is TrialPhase.OVER
    assert trial.problems == ["after 2 s: recorder"]


def test_others_that_do_not_join_are_named():
    rig = Rig(others=False)
    rig.run(1.0)
    rig.trial.set_others(ready=False, done=False, pending="waiting for /recorder")
    assert rig.trial.waiting_for(rig.now) == "waiting for /recorder"
    trial = rig.run(rig.limits.start_timeout)
    assert trial.failure == "not released after 10 s: waiting for /recorder"
    assert not trial.is_released


def test_force_counts_from_its_offset():
    rig = Rig()
    loads = rig.trial.loads
    for _ in range(10):
        rig.trial.add_force(2.0, 0.0, 1.0)
    rig.run(0.5)
    rig.trial.add_force(2.0, 30.0, 41.0)
    rig.trial.add_force(math.nan, 0.0, 0.0)
    assert loads.max_force == pytest.approx(50.0)


@pytest.mark.parametrize(
    "goal", [{"name": "a\nb"}, {"name": "x" * 201}, {"name": "a", "expected": "good"}]
)
def test_goals_are_checked(goal):
    with pytest.raises(CaptureSimError, match="must be"):
        TrialGoal(**goal)


def test_any_order_of_what_comes_holds_before_the_release_and_after_the_end():
    """Random gaps, cancels and reports: held in PREPARING, CLOSING and OVER, whatever comes."""
    for seed in range(cases(few=20, all=60)):
        rng = random.Random(seed)
        rig = Rig(others=rng.random() < 0.8)
        for _ in range(12):
            begin = rig.now + rng.uniform(0.0, 2.0)
            rig.silent = {rng.choice(list(Source)): (begin, begin + rng.uniform(0.0, 1.0))}
            if rng.random() < 0.05:
                rig.trial.cancel()
            if rng.random() < 0.1:
                state = rng.choice(["contact", "captured", "missed"])
                rig.trial.add_verdict(state, "", is_final=state != "contact")
            rig.run(rng.uniform(0.1, 1.0))
        for now, is_held in rig.held:
            is_before = not now >= rig.trial.released
            assert is_held or not is_before
        if rig.trial.phase in (TrialPhase.CLOSING, TrialPhase.OVER):
            assert rig.trial.holds
        assert rig.steps.count(TrialStep.RELEASE) <= 1
