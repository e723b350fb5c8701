"""Who is waited for, by the parts that have been heard and the publishers that are there."""

import pytest

from capture_sim.messages.topics import ROLL
from capture_sim.nodes import roll as roll_module
from capture_sim.nodes.endpoints import message_class
from capture_sim.nodes.roll import FREE, READY, Roll

RECORDER = "/recorder#1"


class Graph:
    """What a roll needs of its node, with a graph that the test sets."""

    def __init__(self):
        self.publishers = ["/simulator"]

    def get_fully_qualified_name(self):
        return "/simulator"

    def guarded(self, callback):
        return callback

    def open(self, topics):
        assert topics == [ROLL]

    def listen(self, topic, hear, event_callbacks):
        self.hear = hear

    def send(self, topic, message):
        pass

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


def test_of_namesakes_the_newest_are_there(graph):
    """A recorder that was killed, and the one started after it."""
    roll = Roll(graph, "simulator")
    report(graph, FREE)
    part = message_class(ROLL.type_name)(participant="/recorder#2", role="recorder")
    graph.hear(part)
    graph.publishers = ["/simulator", "/recorder"]
    assert not roll.is_there(RECORDER)
    assert roll.is_there("/recorder#2")
    graph.publishers.append("/recorder")
    assert roll.is_there(RECORDER)
