"""The stages of a run as a participant sees it, without ROS."""

from types import SimpleNamespace

import pytest

from capture_sim.nodes.run_state import GONE_TIMEOUT, MAX_DRAIN, RunState, Stage


class Clock:
    """A clock that only the test moves."""

    now = 100.0

    def __call__(self):
        return self.now


@pytest.fixture
def clock():
    return Clock()


@pytest.fixture
def state(clock):
    return RunState(5.0, clock)


def info(run_id="a"):
    return SimpleNamespace(run_id=run_id)


def counts(run_id="a", **sent):
    return SimpleNamespace(run_id=run_id, topics=list(sent), counts=list(sent.values()))


def test_a_run_goes_through_its_stages(state):
    stages = [state.stage]
    state.request("a")
    stages.append(state.stage)
    state.announce(info())
    stages.append(state.stage)
    state.begin()
    stages.append(state.stage)
    state.end(counts(state=2))
    stages.append(state.stage)
    assert state.missing(["state"]) == ["state: 0 of 2 messages received"]
    state.receive("state")
    state.receive("state")
    assert state.missing(["state"]) == []
    state.finish()
    stages.append(state.stage)
    names = ["NONE", "REQUESTED", "ANNOUNCED", "ON", "ENDED", "NONE"]
    assert [stage.name for stage in stages] == names
    assert state.finished == 1


def test_only_other_runs_are_new(state):
    assert not state.is_new("")
    assert state.is_new("a")
    state.announce(info("a"))
    assert not state.is_new("a")
    assert state.is_new("b")
    state.begin()
    state.end(counts("a"))
    state.finish()
    assert not state.is_new("a")
    # the counts of a run may come before its announcement, both are latched
    state.end(counts("c"))
    assert state.stage is Stage.NONE
    assert not state.is_new("c")


def test_a_request_is_over_when_its_run_has_come_or_is_rejected(state):
    state.request("a")
    state.reject("b")
    assert state.stage is Stage.REQUESTED
    state.reject("a")
    assert state.stage is Stage.NONE
    state.request("c")
    state.announce(info("c"))
    state.drop()
    assert state.stage is Stage.NONE
    assert state.finished == 0


def test_the_next_run_begins_at_zero(state):
    for run_id in "ab":
        state.announce(info(run_id))
        state.begin()
        assert state.received.total() == 0
        assert state.counts is None
        state.receive("state")
        state.end(counts(run_id, state=1))
        assert state.missing(["state"]) == []
        state.finish()


def test_counts_of_another_run_end_nothing(state):
    state.announce(info("a"))
    state.begin()
    state.end(counts("b"))
    assert state.stage is Stage.ON


def test_a_run_that_was_ended_is_given_up_when_nothing_more_comes(state, clock):
    state.announce(info())
    state.begin()
    clock.now += 1000.0
    assert not state.is_overdue
    state.end(counts(state=10))
    clock.now += 4.0
    state.receive("state")
    clock.now += 4.0
    assert not state.is_overdue
    clock.now += 1.0
    assert state.is_overdue


def test_a_run_is_not_waited_for_forever_though_messages_still_come(state, clock):
    state.announce(info())
    state.begin()
    state.end(counts(state=1000))
    for _ in range(round(MAX_DRAIN) - 1):
        clock.now += 1.0
        state.receive("state")
        assert not state.is_overdue
    clock.now += 1.0
    state.receive("state")
    assert state.is_overdue


def test_a_run_whose_announcer_has_gone_is_given_up(state, clock):
    state.set_announcers(1)
    state.announce(info())
    state.begin()
    state.set_announcers(0)
    assert not state.has_announcer
    assert not state.is_overdue
    clock.now += GONE_TIMEOUT
    assert state.is_overdue
    state.set_announcers(1)  # it was only lost for a while
    assert not state.is_overdue
    state.end(counts())
    state.set_announcers(0)  # as it may once it has reported its counts
    clock.now += GONE_TIMEOUT
    assert not state.is_overdue
