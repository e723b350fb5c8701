"""Pacing and control, without ROS."""

import itertools
import time

import pytest

from capture_sim.nodes.protocol.ends import CutKind
from capture_sim.nodes.simulation.control import Code, RunCut, SimulationControl, State
from capture_sim.nodes.simulation.pacing import MAX_RECOVERED_DELAY, RunPacer


class Clock:
    """A clock that only the test moves."""

    def __init__(self):
        self.now = 100.0

    def __call__(self):
        return self.now


def paced(factor):
    clock = Clock()
    return RunPacer(factor, clock), clock


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
    pacer.pause()
    clock.now += 60.0
    assert pacer.delay(3.0) == pytest.approx(1.0)  # two seconds of three are left, at 2 x
    assert pacer.wall == pytest.approx(0.5)
    assert pacer.lateness(None).max == 0.0


# control


def control_of(state, factor=0.0, requests=(), **options):
    """Return a control whose waits make one of the requests each, and how often it has waited."""
    left, waits = list(requests), []

    def wait(limit):
        waits.append(limit)
        assert left or len(waits) < 1000, "waits for ever"
        if left:
            left.pop(0)(control)

    control = SimulationControl(state, RunPacer(factor), wait, **options)
    return control, waits


@pytest.mark.parametrize(
    "state, request_of, code, words",
    [
        (State.STOPPED, ("set_state", State.STOPPED), Code.ALREADY_IN_TARGET_STATE, "stopped"),
        (State.STOPPED, ("set_state", 4), Code.INCORRECT_TRANSITION, "must be one of"),
        (State.STOPPED, ("set_state", 77), Code.INCORRECT_TRANSITION, "state 77"),
        (State.STOPPED, ("set_state", State.PAUSED), Code.OK, ""),
        (State.STOPPED, ("reset", 0), Code.OK, ""),
        *((State.PAUSED, ("reset", scope), Code.OK, "") for scope in (0, 3, 7, 255)),
        *(
            (State.PAUSED, ("reset", scope), Code.FEATURE_UNSUPPORTED, "reset together")
            for scope in (1, 2, 4)
        ),
        (State.QUITTING, ("set_state", State.PLAYING), Code.INCORRECT_STATE, "quitting"),
        (State.QUITTING, ("reset", 0), Code.INCORRECT_STATE, "quitting"),
    ],
)
def test_requests_are_answered_at_once(state, request_of, code, words):
    control, _ = control_of(state)
    name, argument = request_of
    answer = getattr(control, name)(argument)
    assert answer.code is code
    assert words in answer.message
    if code is not Code.OK:
        assert control.state is state


@pytest.mark.parametrize(
    "request_of, kind",
    [
        (lambda control: control.reset(0), CutKind.RESET),
        (lambda control: control.set_state(State.STOPPED), CutKind.STOPPED),
        (lambda control: control.set_state(State.QUITTING), CutKind.QUITTING),
        (lambda control: control.abort("broken"), CutKind.ABORTED),
    ],
)
@pytest.mark.parametrize("state", [State.PLAYING, State.PAUSED])
def test_run_is_cut_at_its_next_tick(request_of, kind, state):
    control, _ = control_of(state, requests=[request_of])
    control.begin()
    with pytest.raises(RunCut) as cut:
        for k in itertools.count():
            control.tick(k * 1e-3)
    assert cut.value.kind is kind
    assert kind.is_requested == (kind is not CutKind.ABORTED)
    control.end()
    control.begin()
    assert (control.cut_kind is None) == (control.state is state)


def test_nothing_passes_while_paused():
    passed = []
    control, waits = control_of(
        State.PAUSED,
        requests=[lambda _: None] * 5 + [lambda control: control.set_state(State.PLAYING)],
    )
    control.begin()
    for k in range(3):
        control.tick(k * 1e-3)
        passed.append(len(waits))
    assert passed[0] >= 6


def test_callbacks_have_their_turn_in_an_unpaced_run():
    control, waits = control_of(State.PLAYING)
    control.begin()
    deadline = time.monotonic() + 0.1
    ticks = 0
    while time.monotonic() < deadline:
        control.tick(ticks * 1e-3)
        ticks += 1
    assert 2 <= len(waits) < ticks


def test_messages_of_one_time_pass_together():
    control, _ = control_of(State.PLAYING)
    control.begin()
    control.tick(1.0)
    control.set_state(State.PAUSED)
    control.tick(1.0)  # without a wait


def test_interrupt_ends_the_wait():
    def wait(limit):
        raise KeyboardInterrupt

    control = SimulationControl(State.PAUSED, RunPacer(1.0), wait)
    control.begin()
    with pytest.raises(KeyboardInterrupt):
        control.tick(0.0)
