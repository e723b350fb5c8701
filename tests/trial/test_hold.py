"""launcher/hold on a simulated clock: it never pauses, and its silence lets nothing go."""

import itertools
import random

import pytest

from capture_sim import load_scene
from capture_sim.detection.measurements import Source
from capture_sim.launcher.state_machine import Launcher
from capture_sim.trial.hold import (
    HOLD_PERIOD,
    HOLD_TIMEOUT,
    HoldListener,
    HoldOutput,
    HoldPublishers,
    HoldReaders,
)
from capture_sim.trial.interlocks import Interlocks, TrialLimits
from capture_sim.trial.trial import Trial, TrialGoal, TrialPhase, TrialStep

SCENE = load_scene("tilt_0")
MAX_SILENCE = TrialLimits.max_hold_silence  # s
TARGET = (0.66, 0.0, 0.0)  # m, m, rad
TOPICS = {Source.CHASER: ["chaser"], Source.TARGET: ["target"], Source.BUFFER: ["buffer"]}


class Driver:
    """A driver as docs/your_rig.md asks for: what it does with its chaser."""

    def __init__(self):
        self.last, self.is_armed, self.is_held, self.releases = -1e9, False, True, []

    def receive(self, hold, now):
        self.look(now)
        self.last = now
        self.is_armed = self.is_armed or hold
        self.set(hold or not self.is_armed, now)

    def look(self, now):
        if now - self.last > HOLD_TIMEOUT:
            self.is_armed = False
            self.set(True, now)

    def set(self, hold, now):
        if self.is_held and not hold:
            self.releases.append(now)
        self.is_held = hold


class Bench:
    """A trial whose chaser stays at its start, a launcher that may stall, and a driver."""

    def __init__(self, **options):
        self.now, self.sent, self.driver, self.steps = 0.0, [], Driver(), []
        self.served = -1.0
        self.output = HoldOutput(self.send)
        self.interlocks = Interlocks(TrialLimits(max_pose_age=5.0, max_buffer_age=5.0), TOPICS)
        self.interlocks.readers.note(["/driver"], {}, -1.0)
        launcher = Launcher(SCENE, aborts=False)
        goal = TrialGoal("c3")
        options = {"has_actuator": True, "now": 0.0, **options}
        self.trial = Trial(goal, SCENE, launcher, self.interlocks, **options)
        self.trial.set_others(ready=True, done=False, pending="")
        self.output.update(True, 0.0)  # as from the launcher's start on

    def send(self, hold):
        self.sent.append(self.now)
        self.driver.receive(hold, self.now)

    def serve(self):
        """Do what a callback of the launcher does."""
        stamps = [self.now - 0.005 * k for k in range(40) if self.now - 0.005 * k > self.served]
        for stamp in reversed(stamps):  # those that have waited for this callback arrive together
            for source, (topic,) in TOPICS.items():
                pose = TARGET if source is Source.TARGET else (0.0, 0.005, 0.0)
                self.interlocks.add(topic, int(stamp * 1e9), pose, self.now)
        self.served = self.now
        self.trial.note_silence(self.output.silence(self.now), self.now)
        self.steps += self.trial.advance(self.now)
        self.output.update(self.trial.holds, self.now)
        self.driver.look(self.now)

    def run(self, duration, longest=0.02):
        """Serve for some time, with callbacks of up to ``longest`` s each."""
        end = self.now + duration
        rng = random.Random(1)
        while self.now < end:
            self.serve()
            self.now += longest * rng.uniform(0.5, 1.0)
        return self.trial


@pytest.mark.parametrize("longest", [0.001, 0.02, 0.1, 0.2])
def test_hold_is_late_by_one_callback_at_most(longest):
    bench = Bench()
    bench.run(5.0, longest)
    gaps = [b - a for a, b in itertools.pairwise(bench.sent)]
    assert max(gaps) <= HOLD_PERIOD + longest
    assert len(bench.driver.releases) == 1
    assert not bench.driver.is_held
    # and it does not flood the driver: 10 Hz and the changes
    assert len(gaps) <= 5.0 / HOLD_PERIOD + 2


@pytest.mark.parametrize(
    "silence, goes_on", [(MAX_SILENCE - 1e-6, True), (MAX_SILENCE + 1e-6, False)]
)
def test_an_approach_with_a_silent_hold_is_aborted(silence, goes_on):
    bench = Bench()
    trial = bench.run(2.5)
    assert trial.phase is TrialPhase.APPROACH
    bench.now = bench.sent[-1] + silence
    bench.serve()
    assert trial.holds is not goes_on
    assert (trial.phase is TrialPhase.APPROACH) is goes_on
    if not goes_on:
        assert trial.failure.startswith("launcher/hold: silent for 0.4 s: must be at most 0.4")
        assert TrialStep.ABORT in bench.steps
    assert len(bench.driver.releases) == 1


def test_a_contact_with_a_silent_hold_is_held_and_undecided():
    bench = Bench()
    trial = bench.run(2.5)
    trial.add_verdict("contact", "", is_final=False)
    bench.run(0.1)
    assert trial.phase is TrialPhase.CONTACT
    bench.now += 2.0
    bench.run(1.0)
    trial.add_verdict("rebound", "of a braked chaser", is_final=True)
    assert trial.outcome == ("undecided", trial.failure)
    assert trial.failure.startswith("launcher/hold: silent for 2.")
    assert bench.driver.is_held
    assert len(bench.driver.releases) == 1


def test_nothing_is_let_go_soon_after_a_silence():
    """A driver that has held must have heard a true before the false."""
    bench = Bench()
    bench.trial.set_others(ready=False, done=False, pending="recorder")
    bench.run(2.5)
    bench.now += 0.45
    bench.trial.set_others(ready=True, done=False, pending="")
    bench.run(HOLD_TIMEOUT - 0.05)
    assert "launcher/hold: was silent less than 0.5 s ago" in bench.trial.waiting_for(bench.now)
    assert TrialStep.RELEASE not in bench.steps
    bench.run(2.5)
    assert bench.steps == [TrialStep.ANNOUNCE, TrialStep.RELEASE]
    assert len(bench.driver.releases) == 1


@pytest.mark.parametrize("stall", [0.45, 0.6, 3.0])
def test_a_driver_that_has_held_lets_nothing_go_at_a_late_false(stall):
    """Also of a launcher that goes on: a false after a silence counts only after a true."""
    driver = Driver()
    for k in range(20):
        driver.receive(k < 10, 0.1 * k)
    driver.receive(False, 1.9 + stall)
    assert driver.is_held is (stall > HOLD_TIMEOUT)
    assert len(driver.releases) == 1


# the client


def test_no_release_before_the_client_asks_for_the_result():
    bench = Bench(needs_client=True)
    trial = bench.run(2.0)
    assert trial.phase is TrialPhase.PREPARING
    assert trial.waiting_for(bench.now).startswith("client: has not asked for the result")
    assert bench.steps == []  # nothing is announced either
    trial.note_result_request()
    bench.serve()
    assert bench.steps == [TrialStep.ANNOUNCE, TrialStep.RELEASE]
    assert not bench.driver.is_held


def test_a_client_that_never_asks_is_refused():
    bench = Bench(needs_client=True)
    trial = bench.run(10.5)
    assert trial.phase is TrialPhase.OVER
    assert trial.failure.startswith("not released after 10 s: client: has not asked")
    assert bench.driver.releases == []


def test_by_hand_no_client_is_needed():
    trial = Bench(needs_client=True, has_actuator=False).run(0.5)
    assert trial.is_released


@pytest.mark.parametrize(
    "driver, node, counts",
    [
        ("", "/lab/driver", True),
        ("", "/_ros2cli_4711", False),
        ("", "/lab/rosbag2_recorder", False),
        ("driver", "/lab/driver", True),
        ("/lab/driver", "/lab/driver", True),
        ("/driver", "/lab/driver", False),
        ("driver", "/lab/monitor", False),
    ],
)
def test_which_reader_can_be_the_driver(driver, node, counts):
    readers = HoldReaders(driver)
    readers.note([node], {}, 0.0)
    assert (readers.absence() == "") is counts
    if not counts:
        expected = f"launcher/hold: not read by {driver}" if driver else "launcher/hold: no reader"
        assert readers.refusal(10.0) == expected


def test_a_driver_is_known_for_a_while_before_a_release():
    """By then it has received a true; what it was sent before it was found does not count."""
    readers = HoldReaders()
    readers.note(["/a"], {}, 1.0)
    readers.note(["/a"], {}, 1.3)
    just = 1.0 + HOLD_TIMEOUT
    assert readers.refusal(just - 1e-6) == "launcher/hold: /a found less than 0.5 s ago"
    assert readers.refusal(just) == ""
    readers.note(["/a", "/b"], {}, 2.0)  # a second one, then the first again
    assert "/b found" in readers.refusal(2.1)
    readers.note(["/b"], {}, 2.4)
    readers.note(["/a", "/b"], {}, 2.6)
    assert readers.refusal(2.7) == "launcher/hold: /a found less than 0.5 s ago"


def test_a_driver_that_no_message_reaches_is_named():
    readers = HoldReaders()
    readers.note([], {"/rig": "reads std_msgs/msg/Int8", "/_ros2cli_1": "reads a/msg/B"}, 0.0)
    assert readers.refusal(9.0) == "launcher/hold: no reader (/rig reads std_msgs/msg/Int8)"


def test_a_true_that_is_not_the_launchers_own_is_another_hand():
    """Echoes of its own messages come late, and in order."""
    for foreign in (False, True):
        publishers = HoldPublishers("/launcher", -10.0)
        publishers.begin()
        sent = [True, True, False, False, False, False]
        heard = [None, True, True, False, False, foreign]
        for k, (own, echo) in enumerate(zip(sent, heard, strict=True)):
            if echo is not None:
                publishers.hear(echo, not own, 0.1 * k)
        assert publishers.is_disputed is foreign
        assert publishers.conflict(0.6) == ""  # its name may come
        text = "launcher/hold: published by /launcher and by a node without a name"
        assert publishers.conflict(2.0).startswith(text) is foreign
        publishers.note(["/launcher"], 0, 2.0)
        assert publishers.refusal(2.0) == ""  # it has left
        publishers.note(["/launcher", "/b"], 0, 0.6)
        assert "published by /launcher and by /b: must be one node" in publishers.conflict(0.6)


def test_publishers_of_the_hold_are_named():
    publishers = HoldPublishers("/launcher", 0.0)
    assert publishers.refusal(0.5) == "/launcher: started less than 1 s ago"
    publishers.note(["/launcher"], 0, 1.0)
    assert publishers.refusal(2.0) == ""
    publishers.note(["/launcher"], 1, 2.0)
    assert publishers.refusal(2.0) == "launcher/hold: published by a node that is not known yet"
    publishers.note(["/launcher", "/launcher"], 0, 2.1)
    assert "by /launcher and by /launcher: must be one node" in publishers.refusal(2.1)


def test_a_listener_tells_a_hold_from_a_silence():
    listener = HoldListener()
    listener.note(is_held=True, now=0.0)
    assert not listener.may_be_held(100.0)  # it was not let go yet
    listener.note(is_held=False, now=100.0)
    assert not listener.may_be_held(100.0 + HOLD_TIMEOUT)
    assert listener.may_be_held(100.1 + HOLD_TIMEOUT)
    listener.note(is_held=False, now=102.0)  # the launcher only stood still
    assert not listener.may_be_held(102.1)
    listener.note(is_held=True, now=103.0)
    listener.note(is_held=False, now=103.1)
    assert listener.is_held  # what comes after a hold decides nothing
    assert listener.may_be_held(103.1)
