"""What tests change in a node's process, where it takes more than a few lines."""

from __future__ import annotations

import math
import time
from collections import deque

import numpy as np

from capture_sim.hardware.pacing import LoopPacer
from capture_sim.hardware.rig import Rig
from capture_sim.nodes.base.publishers import Publishers
from tests.nodes.bench_client import LONGEST


def shared_numbers(path):
    """Return two numbers that processes share by a file, zeros at first."""
    if not path.exists():
        path.write_bytes(bytes(16))
    return np.memmap(path, np.float64, "r+")


def count_sent(path, name):
    """Let the node count what it sends of a topic, before it is on its way."""
    counts, send = np.memmap(path, np.float64, "r+"), Publishers.send

    def counted(self, topic, message):
        counts[0] += topic.name == name
        return send(self, topic, message)

    Publishers.send = counted


# a loop and its rig in lockstep


class Unpaced(LoopPacer):
    """Positions are sent as soon as they are known."""

    def time_to_work(self):
        return 0.0

    def time_to_send(self):
        return 0.0


class Wrenches(deque):
    """Wrenches that have arrived; ``last``: stamp of the newest one."""

    last = -math.inf

    def append(self, entry):
        self.last = entry[1]
        super().append(entry)


class Tips(dict):
    """Measured tips that have arrived; ``last``: stamp of the newest one."""

    last = -math.inf

    def __setitem__(self, stamp, tip):
        self.last = stamp
        super().__setitem__(stamp, tip)


def in_lockstep_rig(path):
    """Let a rig share the stamps of its last position and answer, s."""
    numbers, answer = np.memmap(path, np.float64, "r+"), Rig.answer

    def followed(self, pose):
        answers = answer(self, pose)
        if answers:
            numbers[1] = answers[-1].stamp
        numbers[0] = pose.t
        return answers

    Rig.answer = followed


def in_lockstep_loop(path, node):
    """Let each step of a loop wait for all answers to the one before."""
    numbers, make = np.memmap(path, np.float64, "r+"), node.LoopSimulatorNode.__init__
    hand_over = node.LoopSimulatorNode._hand_over_answers

    def begin(self, **options):
        make(self, **options)
        self._inbox, self._rig_tips = Wrenches(), Tips()

    def has_all(self):
        taken, sent = numbers
        if taken < self._loop.t - 1e-9:
            return False
        return min(self._inbox.last, self._rig_tips.last) >= sent - 1e-9

    def hand_over_all(self):
        deadline = time.monotonic() + LONGEST
        while self._pacer is not None and not has_all(self):  # the loop is closed
            assert time.monotonic() < deadline
            self.wait(limit=0.001)
        hand_over(self)

    node.LoopPacer = Unpaced
    node.LoopSimulatorNode.__init__ = begin
    node.LoopSimulatorNode._hand_over_answers = hand_over_all


def begin_after(is_known, node):
    """Let a loop's wait for answers at rest begin once this is true of its Loop."""
    await_rest = node.LoopSimulatorNode._await_rest

    def await_known(self):
        deadline = time.monotonic() + LONGEST
        while not is_known(self._loop):
            assert time.monotonic() < deadline
            self.wait(limit=0.01)
            self._hand_over_answers()
        await_rest(self)

    node.LoopSimulatorNode._await_rest = await_known
