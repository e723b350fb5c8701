"""Who is waited for, by the parts that have been heard and the publishers that are there."""

import pytest

from capture_sim.messages.topics import ROLL
from capture_sim.nodes.base.endpoints import message_class
from capture_sim.nodes.protocol import roll as roll_module
from capture_sim.nodes.protocol.roll import FREE, NAMESAKE_LIMIT, READY, Roll

RECORDER, SECOND = "/recorder#1", "/recorder#2"


class Graph:
    """What a roll needs of its node, with a graph that the test sets."""

    def __init__(self):
        self.publishers = ["/simulator"]
        self.sent, self.warnings, self.infos = [], [], []

    def get_fully_qualified_name(self):
        return "/simulator"

    def guarded(self, callback):
        return callback

    def open(self, topics):
        assert topics == [ROLL]

    def listen(self, topic, hear, event_callbacks):
        self.hear = hear

    def send(self, topic, message):
        self.sent.append(message)

    def every(self, period, callback):
        self.period = period

    def get_logger(self):
        return self

    def warning(self, text):
        self.warnings.append(text)

    def info(self, text):
        self.infos.append(text)

    def nodes_that_publish(self, topic):
        return self.publishers


@pytest.fixture
def graph(monkeypatch):
    monkeypatch.setattr(roll_module, "POLL", -1.0)  # looked up every time
    return Graph()


def report(graph, state):
    part = message_class(ROLL.type_name)(participant=RECORDER, role="recorder")
    part.state, part.run = state, "a run"
    graph.hear(part)


def test_participant_is_waited_for_from_before_it_is_discovered_until_it_leaves(graph):
    """Discovery lags behind messages: a node can be heard before its name is known."""
    roll = Roll(graph, "simulator")

    def not_ready():
        return roll.pending([roll.id, RECORDER], lambda part: part.is_ready("a run"))

    assert roll.pending([RECORDER]) == not_ready() == ["/recorder"]  # neither heard nor there
    report(graph, FREE)
    assert roll.pending([RECORDER]) == []
    assert not_ready() == ["/recorder"]  # heard, its name unknown
    graph.publishers = ["/simulator", "/recorder"]
    assert not_ready() == ["/recorder"]
    graph.publishers = ["/simulator"]
    assert not_ready() == []  # it has left
    graph.publishers = ["/simulator", "/recorder"]
    report(graph, READY)
    assert not_ready() == []


@pytest.fixture
def clock(monkeypatch):
    class Clock:
        now = 100.0

        def monotonic(self):
            return self.now

        def time_ns(self):
            return 0

    monkeypatch.setattr(roll_module, "time", Clock())
    return roll_module.time


def hear_second(graph):
    graph.hear(message_class(ROLL.type_name)(participant=SECOND, role="recorder"))


def test_of_namesakes_the_newest_are_there(graph, clock):
    """A recorder that was killed, and the one started after it."""
    roll = Roll(graph, "simulator")
    report(graph, FREE)
    clock.now += 2.0 * NAMESAKE_LIMIT
    hear_second(graph)
    graph.publishers = ["/simulator", "/recorder"]
    assert not roll.is_there(RECORDER)
    assert roll.is_there(SECOND)
    graph.publishers.append("/recorder")
    assert roll.is_there(RECORDER)


def test_a_namesake_that_is_heard_before_it_is_discovered_takes_nobodys_place(graph, clock):
    """Two recorders on a busy machine: the run went on without the first, and was refused."""
    roll = Roll(graph, "simulator")
    graph.publishers = ["/simulator", "/recorder"]
    report(graph, FREE)
    assert roll.is_there(RECORDER)
    clock.now += 1.0
    hear_second(graph)
    assert roll.is_there(RECORDER)
    assert roll.is_there(SECOND)
    pending = roll.pending([RECORDER, SECOND], lambda part: part.is_ready("a run"))
    assert pending == ["/recorder", "/recorder"]
    graph.publishers = ["/simulator"]
    assert not roll.is_there(RECORDER)  # no node of this name is left
    assert not roll.is_there(SECOND)


def pass_time(roll, clock, seconds, graph=None):
    """Let a roll repeat its part each second; the recorder does the same if it is heard."""
    for _ in range(seconds):
        clock.now += 1.0
        if graph is not None:
            report(graph, FREE)
        roll.repeat()


def test_a_node_that_is_connected_but_not_heard_is_named_once_and_again_after_it_was_heard(
    graph, clock
):
    graph.publishers = ["/simulator", "/recorder"]
    roll = Roll(graph, "simulator")
    pass_time(roll, clock, 10, graph)
    assert not graph.warnings
    pass_time(roll, clock, 5)
    assert not graph.warnings
    pass_time(roll, clock, 10)
    (line,) = graph.warnings
    assert line.startswith("/recorder: connected, but not heard for 5 s: ")
    pass_time(roll, clock, 1, graph)
    assert graph.infos == ["/recorder: heard again"]
    pass_time(roll, clock, 6)
    assert len(graph.warnings) == 2


def test_a_node_that_was_never_heard_is_named(graph, clock):
    graph.publishers = ["/simulator", "/recorder"]
    roll = Roll(graph, "simulator")
    pass_time(roll, clock, 6)
    assert not graph.warnings
    pass_time(roll, clock, 1)
    assert len(graph.warnings) == 1


def test_a_node_that_has_left_is_not_named(graph, clock):
    graph.publishers = ["/simulator", "/recorder"]
    roll = Roll(graph, "simulator")
    pass_time(roll, clock, 3, graph)
    graph.publishers = ["/simulator"]
    pass_time(roll, clock, 10)
    assert not graph.warnings


def test_a_node_that_stood_still_itself_names_no_other(graph, clock):
    graph.publishers = ["/simulator", "/recorder"]
    roll = Roll(graph, "simulator")
    pass_time(roll, clock, 3, graph)
    clock.now += 7.0
    pass_time(roll, clock, 3)
    assert not graph.warnings
    pass_time(roll, clock, 3, graph)
    assert not graph.warnings


def test_a_node_repeats_its_part_and_one_that_only_listens_does_not(graph, clock):
    roll = Roll(graph, "simulator")
    roll.report(READY)
    roll.repeat()
    assert graph.sent[-1] == graph.sent[-2]
    assert graph.sent[-1].state == READY
    graph.sent.clear()
    Roll(graph, "viewer", is_listed=False).repeat()
    assert not graph.sent
