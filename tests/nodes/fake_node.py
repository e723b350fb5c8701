"""A node without DDS: its clock, its graph and what comes are the test's."""

import copy
import math
import threading
from collections import defaultdict
from types import SimpleNamespace

from capture_sim.messages.convert import Messages
from capture_sim.nodes.base.node import POLL


class FakeLog:
    def __init__(self):
        self.lines = []
        self.info = self.warning = self.error = self.debug = self.lines.append


class FakeOutbox:
    """Topics with the readers of each and how many of them are matched."""

    def __init__(self):
        self.topics, self.dropped, self.reader_timeout = [], [], 10.0
        self.found = defaultdict(list)  # full names of the nodes, for each reader
        self.n_matched = defaultdict(int)

    def readers(self, topic):
        return self.found[topic]

    def matched(self, topic):
        return self.n_matched[topic]


class FakeNode:
    """What followers, announcers and rolls need of their node.

    ``listened`` and ``sent``: topics in the order in which they were subscribed to, and messages;
    ``publishers``: full names of the nodes on the roll.
    """

    def __init__(self, name="/recorder"):
        self.now = self.created = 0.0
        self.name, self.publishers = name, [name]
        self.listened, self.sent = [], []
        self.messages, self.topic_publishers, self.log = Messages(), FakeOutbox(), FakeLog()
        self.end_request, self.failure, self.exit_status = threading.Event(), None, 0
        self._callbacks, self._coming = {}, []  # by topic; s and function
        self._interrupted = False

    def clock(self):
        """Return what replaces the module time."""
        return SimpleNamespace(monotonic=lambda: self.now, time_ns=lambda: int(self.now * 1e9))

    # for the test

    def at(self, t, happen):
        """Let something happen at t, s."""
        self._coming.append((t, happen))
        self._coming.sort(key=lambda entry: entry[0])

    def hear(self, topic, message):
        """Let a message come now."""
        self._callbacks[topic](message)

    # for the node's parts

    def every(self, period, callback):
        def call():
            callback()
            self.at(self.now + period, call)

        self.at(self.now + period, call)

    def wait(self, until=None, limit=math.inf):
        deadline = self.now + limit
        while True:
            if self.end_request.is_set() and not self._interrupted:
                self._interrupted = True
                raise KeyboardInterrupt
            if until is not None and until():
                return True
            if self.now >= deadline:
                return False
            self.now = min(self.now + POLL / 4.0, deadline)
            while self._coming and self._coming[0][0] <= self.now:
                self._coming.pop(0)[1]()

    def listen(self, topic, callback, **options):
        self.listened.append(topic)
        self._callbacks[topic] = callback

    def open(self, topics):
        self.topic_publishers.topics += topics

    def send(self, topic, message):
        self.sent.append((self.now, topic, copy.copy(message)))
        return True

    def guarded(self, callback):
        return callback

    def freeze_objects(self):
        pass

    def get_logger(self):
        return self.log

    def get_fully_qualified_name(self):
        return self.name

    def resolve_topic_name(self, name):
        return f"/{name}"

    def get_subscriptions_info_by_topic(self, name):
        return []

    def nodes_that_publish(self, topic):
        return self.publishers
