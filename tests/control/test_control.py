"""Pacing and control, without ROS."""

import itertools
import sys
import threading
import time

import pytest

from capture_sim.control.pacing import MAX_RECOVERED_DELAY, Pacer
from capture_sim.control.simulation import Code, RunCut, SimulationControl, State


class Clock:
    """A clock that only the test moves."""

    def __init__(self):
        self.now = 100.0

    def __call__(self):
        return self.now


def paced(factor):
    clock = Clock()
    return Pacer(factor, clock), clock


@pytest.mark.parametrize("factor", [0.5, 1.0, 10.0])
def test_ticks_are_due_from_one_origin_and_their_errors_do_not_add_up(factor):
    pacer, clock = paced(factor)
    pacer.tick(0.0)
    for k in range(1, 1001):
        clock.now += pacer.delay(k * 1e-3) + 5e-5  # waiting takes a little too long
        pacer.tick(k * 1e-3)
        assert clock.now - 100.0 == pytest.approx(k * 1e-3 / factor + 5e-5, abs=1e-9)
    assert pacer.lateness().max == pytest.approx(5e-5, abs=1e-9)
    assert pacer.lateness(1000).p50 == pytest.approx(5e-5, abs=1e-9)
    assert pacer.late_ticks(4e-5) == 1000
    assert pacer.late_ticks(6e-5) == 0
    assert pacer.ticks == 1001
    assert pacer.wall == pytest.approx(1.0 / factor + 5e-5)
    assert pacer.achieved == pytest.approx(factor, rel=1e-3)


def test_unpaced_is_always_due_and_never_late():
    pacer, clock = paced(0.0)
    assert pacer.delay(1e6) == 0.0
    pacer.tick(1e6)
    clock.now += 1.0
    pacer.tick(1e6 + 3.0)
    assert pacer.lateness() is None
    assert pacer.achieved == pytest.approx(3.0)


def test_delays_are_recovered_up_to_a_limit_and_skipped_beyond():
    pacer, clock = paced(1.0)
    pacer.tick(0.0)
    clock.now += 0.5  # some work took long
    assert pacer.delay(0.1) == pytest.approx(-0.4)
    pacer.tick(0.1)
    assert pacer.delay(1.0) == pytest.approx(0.5)  # recovered
    clock.now += 0.5 + 2.0 * MAX_RECOVERED_DELAY
    pacer.tick(1.1)
    assert pacer.skipped_delay == pytest.approx(2.0 * MAX_RECOVERED_DELAY - 0.1)
    assert pacer.delay(1.3) == pytest.approx(0.2)
    assert pacer.late_ticks(0.05) == 2


def test_the_factor_changes_without_a_jump():
    pacer, clock = paced(1.0)
    pacer.tick(0.0)
    clock.now += 0.5
    pacer.factor = 4.0
    assert pacer.delay(1.0) == pytest.approx(0.125)
    assert pacer.delay(4.5) == pytest.approx(1.0)


def test_time_stands_still_while_it_is_held():
    pacer, clock = paced(2.0)
    pacer.tick(0.0)
    clock.now += 0.5
    pacer.hold()
    clock.now += 60.0
    assert pacer.delay(3.0) == pytest.approx(1.0)  # two seconds of three are left, at 2 x
    assert pacer.wall == pytest.approx(0.5)
    pacer.hold()
    pacer.skip(3.0)  # a step
    assert pacer.delay(4.0) == pytest.approx(0.5)
    assert pacer.lateness(None).max == 0.0


# control


def stepping(control):
    """Step for ever in a thread; return what was passed, and how it was cut."""
    passed, cuts = [], []

    def work():
        try:
            for k in itertools.count():
                control.tick(k * 1e-3)
                passed.append(control.state)
        except RunCut as cut:
            cuts.append(cut)
            control.end()

    control.begin()
    thread = threading.Thread(target=work, daemon=True)
    thread.start()
    return passed, cuts, thread


def test_steps_are_counted_exactly():
    control = SimulationControl(State.PAUSED, Pacer(0.0))
    passed, cuts, thread = stepping(control)
    for count in (1, 5, 100):
        before = len(passed)
        assert control.step(count).result(5.0).code is Code.OK
        assert len(passed) == before + count
    assert control.set_state(State.STOPPED).result(5.0).code is Code.OK
    thread.join(5.0)
    assert [(str(c), c.again, c.asked_for) for c in cuts] == [("stopped", False, True)]
    assert len(passed) == 106


@pytest.mark.parametrize(
    "state, request_of, code, words",
    [
        (State.STOPPED, ("set_state", State.STOPPED), Code.ALREADY_IN_TARGET_STATE, "stopped"),
        (State.STOPPED, ("set_state", State.NO_WORLD), Code.INCORRECT_TRANSITION, "must be one of"),
        (State.STOPPED, ("set_state", 77), Code.INCORRECT_TRANSITION, "state 77"),
        (State.STOPPED, ("set_state", State.PAUSED), Code.OK, ""),
        (State.STOPPED, ("step", 1), Code.OPERATION_FAILED, "this one is stopped"),
        (State.PLAYING, ("step", 1), Code.OPERATION_FAILED, "this one is playing"),
        (State.PAUSED, ("step", 0), Code.OK, ""),
        (State.STOPPED, ("reset", 0), Code.OK, ""),
        *(
            (State.PAUSED, ("reset", scope), Code.FEATURE_UNSUPPORTED, "reset together")
            for scope in (1, 2, 4)
        ),
        (State.QUITTING, ("set_state", State.PLAYING), Code.INCORRECT_STATE, "quitting"),
        (State.QUITTING, ("reset", 0), Code.INCORRECT_STATE, "quitting"),
    ],
)
def test_requests_that_are_answered_at_once(state, request_of, code, words):
    control = SimulationControl(state, Pacer(0.0))
    ask, argument = request_of
    answer = getattr(control, ask)(argument).result(0.0)
    assert answer.code is code
    assert words in answer.message
    if code is not Code.OK:
        assert control.state is state


@pytest.mark.parametrize("scope", [0, 3, 7, 255])
def test_reset_is_done_when_the_run_could_begin_again(scope):
    control = SimulationControl(State.PAUSED, Pacer(0.0))
    control.begin()
    reset = control.reset(scope)
    with pytest.raises(RunCut, match="reset"):
        control.tick(0.0)
    control.end()
    control.begin()
    assert not reset.done()
    control.ready()
    assert reset.result(0.0).code is Code.OK
    assert control.state is State.PAUSED


def test_pause_is_answered_when_nothing_passes_any_more():
    control = SimulationControl(State.PLAYING, Pacer(0.0))
    passed, _, thread = stepping(control)
    for _ in range(50):
        assert control.set_state(State.PAUSED).result(5.0).code is Code.OK
        held = len(passed)
        assert control.step(2).result(5.0).code is Code.OK
        assert len(passed) == held + 2
        assert control.set_state(State.PLAYING).result(5.0).code is Code.OK
    control.set_state(State.QUITTING)
    thread.join(5.0)


def test_step_that_is_interrupted_says_how_far_it_came():
    control = SimulationControl(State.PAUSED, Pacer(0.0))
    control.begin()
    step = control.step(3)
    control.tick(0.0)
    assert control.step(1).result(0.0).code is Code.OPERATION_FAILED  # one at a time
    reset = control.reset(0)
    assert "after 1 of 3 steps" in step.result(0.0).message
    with pytest.raises(RunCut, match="reset") as cut:
        control.check()
    assert cut.value.again
    control.end()
    assert not reset.done()
    control.begin()
    control.ready()
    assert reset.result(0.0).code is Code.OK


def test_end_leaves_nobody_waiting():
    control = SimulationControl(State.PAUSED, Pacer(0.0))
    control.begin()
    step = control.step(3)
    control.close()
    assert step.result(0.0).code is Code.OPERATION_FAILED


def test_a_pause_holds_even_while_a_tick_is_waited_for():
    control = SimulationControl(State.PLAYING, Pacer(1.0))
    passed = []

    def work():
        for t in (0.0, 0.3):
            control.tick(t)
            passed.append(time.monotonic())
        control.end()

    control.begin()
    thread = threading.Thread(target=work, daemon=True)
    thread.start()
    while not passed:
        time.sleep(1e-3)
    assert control.set_state(State.PAUSED).result(5.0).code is Code.OK
    time.sleep(0.4)
    assert len(passed) == 1
    control.set_state(State.PLAYING)
    thread.join(5.0)
    assert passed[1] - passed[0] > 0.6  # the pause, and what was left of the wait


def player(state, rate=0.0):
    return SimulationControl(state, Pacer(rate), states=(State.PLAYING, State.PAUSED), resets=False)


def test_a_step_of_a_player_passes_all_of_one_time():
    control = player(State.PAUSED)
    passed = []

    def work():
        for t in (7.0, 7.0, 8.0, 9.0, 9.0):
            control.tick(t)
            passed.append(t)
        control.end()

    control.begin()
    thread = threading.Thread(target=work, daemon=True)
    thread.start()
    assert control.step(1).result(5.0).code is Code.OK
    assert passed == [7.0, 7.0]
    assert control.step(2).result(5.0).code is Code.OK
    thread.join(5.0)
    assert passed == [7.0, 7.0, 8.0, 9.0, 9.0]
    assert "the run is over after 0 of 1" in _message_at_the_end(control)


def _message_at_the_end(control):
    request = control.step(1)
    control.end()
    return request.result(5.0).message


def test_a_player_has_neither_stop_nor_reset():
    control = player(State.PLAYING)
    answer = control.set_state(State.STOPPED).result(0.0)
    assert answer == (Code.INCORRECT_TRANSITION, "state 0: must be one of 1 playing, 2 paused")
    assert control.reset(0).result(0.0).code is Code.FEATURE_UNSUPPORTED
    assert control.set_state(State.PLAYING).result(0.0).code is Code.ALREADY_IN_TARGET_STATE
    assert control.step(1).result(0.0).message == "stepping needs a paused run; this one is playing"


def test_answers_are_given_outside_of_the_lock():
    """A callback of an answer may wait for a thread that makes a request of its own."""
    control = SimulationControl(State.PAUSED, Pacer(0.0))
    _, _, thread = stepping(control)
    done = []

    def ask_from_another_thread(_):
        other = threading.Thread(target=control.set_factor, args=(0.0,), daemon=True)
        other.start()
        other.join(5.0)
        done.append(not other.is_alive())

    for ask in (lambda: control.step(3), lambda: control.set_state(State.STOPPED)):
        request = ask()
        request.add_done_callback(ask_from_another_thread)
        assert request.result(5.0).code is Code.OK
    thread.join(5.0)
    wait_for = time.monotonic() + 5.0
    while len(done) < 2 and time.monotonic() < wait_for:
        time.sleep(0.01)
    assert done == [True, True]


def test_factor_changes_at_any_moment_of_a_tick():
    control = SimulationControl(State.PLAYING, Pacer(0.0))
    interval = sys.getswitchinterval()
    sys.setswitchinterval(1e-6)
    try:
        passed, cuts, thread = stepping(control)
        end = time.monotonic() + 1.0
        for factor in itertools.cycle((1000.0, 0.0)):
            control.set_factor(factor)
            control.pacer.wall  # noqa: B018  # as the diagnostics read it
            if time.monotonic() > end or not thread.is_alive():
                break
        assert thread.is_alive()
    finally:
        sys.setswitchinterval(interval)
    control.set_state(State.STOPPED).result(5.0)
    thread.join(5.0)
    assert len(passed) > 100
    assert len(cuts) == 1


def test_waiting_is_interrupted_when_the_process_is_to_end():
    for state, wait in (
        (State.STOPPED, lambda control: control.await_start()),
        (State.PAUSED, lambda control: control.tick(1.0)),
        (State.PLAYING, lambda control: [control.tick(t) for t in (0.0, 1e6)]),
        (State.PLAYING, lambda control: control.check()),
    ):
        stop = threading.Event()
        control = SimulationControl(state, Pacer(1.0), stop=stop)
        threading.Timer(0.2, stop.set).start()
        with pytest.raises(KeyboardInterrupt):
            while True:
                wait(control)
