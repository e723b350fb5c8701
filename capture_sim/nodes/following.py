"""What launcher, detector and recorder share: they follow the simulator's runs.

A follower greets the simulator (a StreamAck without run), takes up the run that is
announced, says how far it has come, and ends the run when all that the simulator says it
sent has arrived, or when the simulator has gone.
"""

from __future__ import annotations

import threading
import time
from collections import Counter
from collections.abc import Callable, Sequence
from typing import Any

from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.event_handler import SubscriptionEventCallbacks

from capture_sim.control.simulation import QUITTING, RESET, STOPPED
from capture_sim.messages.telemetry import samples_per_message
from capture_sim.messages.topics import (
    BENCH_STATE,
    BUFFER_STATE,
    CAPTURE_DETECTOR,
    CHASER_ODOMETRY,
    CHASER_POSE,
    CONTACT_STATE,
    LAUNCH_COMMAND,
    LAUNCHER,
    RECORDED,
    RUN_INFO,
    SIMULATOR,
    STREAM_ACK,
    STREAM_COUNTS,
    STRING_STATE,
    TARGET_ODOMETRY,
    TARGET_POSE,
    Topic,
    topics_of,
)
from capture_sim.nodes.flow_control import samples_between_acks
from capture_sim.nodes.memory import set_memory_aside, sweep_memory
from capture_sim.nodes.running import FAILED, OK, BenchNode

RECORDER = "recorder"

#: What each follower reads; the simulator waits until these subscriptions are connected.
FOLLOWED: dict[str, tuple[Topic, ...]] = {
    LAUNCHER: (STRING_STATE, CONTACT_STATE, CHASER_ODOMETRY),
    CAPTURE_DETECTOR: (CHASER_ODOMETRY, TARGET_ODOMETRY, BUFFER_STATE, CHASER_POSE, TARGET_POSE),
    RECORDER: RECORDED,
}

#: What a node waits for its readers to be connected at most, s (wall).
CONNECTING = 5.0
#: A follower says that it is there this often, s (wall).
HEARTBEAT = 0.5
#: Why a run ends that Ctrl-C ended.
INTERRUPTED = "interrupted"
_EARLY = "ended early: "
#: ... and that somebody asked the simulator to end: nothing has failed.
_AS_ASKED = tuple(_EARLY + reason for reason in (RESET, STOPPED, QUITTING))
#: What a node hears at its start is what others keep for latecomers: of the run that is on, or
#: of one that is over.  It greets the simulator when that has arrived, s (wall).
SETTLING = 0.5
#: ... and if a run was among it, when it has had this long to hear of that run's end, s (wall).
OVERTAKING = 1.5
#: Messages that were on their way when the simulator went are waited for this long, s (wall).
GRACE = 0.5
#: Ctrl-C mostly ends all nodes at once: a follower waits this long for the simulator's word on
#: how the run has ended, s (wall).
FAREWELL = 3.0


def connections(topic: Topic, consumers: Sequence[str]) -> int:
    """Return how many subscribers a topic has once all that take part are connected."""
    count = sum(topic in FOLLOWED.get(name, ()) for name in consumers)
    if topic is RUN_INFO:
        return len(consumers) + 1  # each follower, and the simulator, which looks for others
    if topic is STREAM_COUNTS:
        return count + len(consumers)
    return count + (topic is LAUNCH_COMMAND)  # the simulator


class RunFollower(BenchNode):
    """A node that takes part in the simulator's runs, one after another.

    A subclass calls :meth:`follow` for its topics and fills in :meth:`begin` and
    :meth:`end`.  Callbacks run one at a time.
    """

    def __init__(self, name: str) -> None:
        super().__init__(name)
        self._exit_when_done = self.declare(
            "exit_when_done", False, "end this process when the simulator has left after a run"
        )
        self._patience = self.declare(
            "drain_timeout",
            5.0,
            "s (wall), wait for missing messages after the simulator has ended a run",
            low=0.1,
            high=600.0,
        )
        self.run: Any = None  # RunInfo of the run that is on
        self._tally: Counter[str] = Counter()  # messages of the run taken in, by topic
        self._followed: list[Topic] = []
        self._counts: Any = None  # what the simulator says it has sent in the run
        self._last_counts: Any = None  # ... and in the last run that it ended
        self._deadline = float("inf")  # wall, when a run that has ended is given up
        self._received = 0  # samples of the run taken in
        self._runs = 0  # that have ended
        self._kept: Any = None  # RunInfo that is announced and not taken up yet
        self._connected_by: float | None = None  # wall, when that is waited for no longer
        self._settled = threading.Event()  # the simulator may be greeted
        self._settling_ends = time.monotonic() + SETTLING
        self._alone = True  # no simulator is alive
        self._leaving = False  # after Ctrl-C
        self._over = threading.Event()
        self._status = OK
        self._acknowledging = threading.Lock()
        self.open((STREAM_ACK,))
        watch = SubscriptionEventCallbacks(liveliness=self._liveliness_changed)
        self.listen(RUN_INFO, self._announced, event_callbacks=watch)
        self.listen(STREAM_COUNTS, self._counted)
        # a steady clock: this must also run when simulated time does not
        self.create_timer(0.1, self._look_at_clock, clock=Clock(clock_type=ClockType.STEADY_TIME))

    # what a subclass fills in

    def begin(self, info: Any) -> None:
        """Take up a run, from its RunInfo."""

    def end(self, reason: str) -> list[str]:
        """End the run; return what was wrong with it, one line each.

        Parameters
        ----------
        reason
            Why it ended early; empty if all that was sent has arrived.
        """
        return [reason] if reason else []

    def complete(self) -> bool:
        """Whether all has arrived that the simulator says it has sent."""
        return not self.missing()

    # what a subclass calls

    @property
    def cut(self) -> bool:
        """Whether the run that is on does not come to the end that its simulator had in mind."""
        if SIMULATOR not in self.run.publishers:
            return False  # a bench without one: whoever ends it ends it
        return self._counts is None or not self._counts.complete

    def missing(self) -> list[str]:
        """Return which of the followed streams lack messages that the simulator has sent."""
        sent = dict(zip(self._counts.topics, self._counts.counts, strict=True))
        return [
            f"{topic.name}: {self._tally[topic.name]} of {sent[topic.name]} messages came"
            for topic in self._followed
            if self._tally[topic.name] < sent.get(topic.name, 0)
        ]

    def follow(self, topic: Topic, callback: Callable[[Any], None], *, raw: bool = False) -> None:
        """Subscribe to one of the simulator's streams; it is counted until the run's end.

        ``raw``: the callback takes the message's bytes.
        """

        def take(message: Any) -> None:
            if self.run is None:
                return
            self._tally[topic.name] += 1
            callback(message)
            self.end_if_complete()

        self._followed.append(topic)
        self.listen(topic, take, raw=raw)

    def advance_to(self, received: int) -> None:
        """Acknowledge that this many samples of the run, or all up to them, were taken in."""
        before, self._received = self._received, received
        every = samples_between_acks(self.run.state_rate, self.run.rate)
        if received // every != before // every:
            self._acknowledge()

    def advance_past(self, periodic: int) -> None:
        """Acknowledge the ``periodic``-th set of the periodic topics, counted from 0.

        With it everything is taken in that is sent before the next one.
        """
        every = samples_per_message(self.run.state_rate, self.run.rate)
        self.advance_to((periodic + 1) * every)

    def end_if_complete(self) -> None:
        """End the run if the simulator has ended it and nothing is missing."""
        if self.run is None or self._counts is None or not self.complete():
            return
        sent = dict(zip(self._counts.topics, self._counts.counts, strict=True))
        self._received = sent.get(BENCH_STATE.name, 0)
        self._acknowledge()
        self._finish("" if self._counts.complete else f"{_EARLY}{self._counts.reason}")

    # the protocol

    def work(self) -> int:
        """Greet the simulator until the process is to end; return the exit status."""
        set_memory_aside()
        self._settled.wait()
        self.get_logger().info("ready, waiting for a run")
        # Sent by this thread and not by a timer: a callback may compile for a minute, and
        # must not be taken for dead meanwhile.
        self._acknowledge()
        while not self._over.wait(HEARTBEAT):
            self._acknowledge()
        return self._status

    def farewell(self) -> None:
        """Let the run that is on end as the simulator says, if it is ended too."""
        self._leaving = True
        deadline = time.monotonic() + FAREWELL
        while self.run is not None and not self._alone and time.monotonic() < deadline:
            time.sleep(0.02)
        if STREAM_COUNTS in topics_of(self.get_name()):
            self.linger(STREAM_COUNTS)

    def interrupted(self) -> None:
        """End the run that is on."""
        if self.run is not None:
            self._finish(INTERRUPTED)

    def _acknowledge(self) -> None:
        # locked: an older state must not be sent after a newer one by the other thread
        with self._acknowledging:
            run = self.run
            run_id = "" if run is None else run.run_id
            self.send(STREAM_ACK, self.messages.stream_ack(self.get_name(), run_id, self._received))

    def _announced(self, info: Any) -> None:
        if self.run is not None:
            if info.run_id != self.run.run_id:
                self._finish(f"another run, {info.name}, was announced meanwhile")
            else:
                return
        self._kept = info
        if self._settled.is_set():
            self._consider()
        else:
            # kept for latecomers; if it is over, that has been said and is on its way
            self._settling_ends = max(self._settling_ends, time.monotonic() + OVERTAKING)

    def _settle(self) -> None:
        """Take up the run that is on, if one is; what else was heard is of the past."""
        info, counts = self._kept, self._last_counts
        over = info is not None and counts is not None and counts.run_id == info.run_id
        self._settled.set()
        if over or self._alone:
            self._kept = None
        self._consider()
        if self._kept is None:
            self._acknowledge()

    def _consider(self) -> None:
        """Take up the run that is announced, once those that read this node are connected.

        At once if nobody waits for that: a bag is played, and its measurements come already.
        """
        info = self._kept
        if info is None:
            return
        lacking = self.matched(STREAM_ACK) > 0 and any(
            self.matched(topic) < connections(topic, info.consumers)
            for topic in topics_of(self.get_name())
        )
        if lacking and self._connected_by is None:
            self._connected_by = time.monotonic() + CONNECTING
        if not lacking or time.monotonic() > (self._connected_by or 0.0):
            self._kept = self._connected_by = None
            self._take_up(info)

    def _take_up(self, info: Any) -> None:
        self._tally.clear()
        self._counts = None
        self._received = 0
        self.begin(info)
        self.run = info
        self._set_deadline()
        self._acknowledge()
        self._compare()

    def _counted(self, counts: Any) -> None:
        if counts.publisher == SIMULATOR:
            self._last_counts = counts
            self._compare()

    def _compare(self) -> None:
        # one topic may overtake the other: the counts of a run that failed at once are here
        # before its announcement
        counts = self._last_counts
        if self.run is not None and counts is not None and counts.run_id == self.run.run_id:
            self._counts = counts
            self._set_deadline()
            self.end_if_complete()

    def _liveliness_changed(self, event: Any) -> None:
        self._alone = event.alive_count == 0
        self._set_deadline()
        self._leave_if_alone()

    def _set_deadline(self) -> None:
        """Let the run that is on be given up later, if the simulator has ended it or gone."""
        if self._counts is not None:
            self._deadline = min(self._deadline, time.monotonic() + self._patience)
        elif self._alone:
            self._deadline = time.monotonic() + GRACE
        else:
            self._deadline = float("inf")

    def _leave_if_alone(self) -> None:
        if self._exit_when_done and self._alone and self._runs > 0 and self.run is None:
            self._over.set()

    def _look_at_clock(self) -> None:
        if not self._settled.is_set() and time.monotonic() > self._settling_ends:
            self._settle()
        elif self._settled.is_set():
            self._consider()
        if self.run is None or self.failure or time.monotonic() < self._deadline:
            return
        if self._counts is None:
            self._finish("the simulator has gone without ending the run")
        else:
            self._finish("; ".join(["ended with messages missing", *self.missing()]))

    def _finish(self, reason: str) -> None:
        problems = self.end(reason)
        if reason == INTERRUPTED:
            problems = [reason]  # that something is missing goes without saying
        elif reason in _AS_ASKED or (self._leaving and reason == _EARLY + INTERRUPTED):
            self.get_logger().info(f"{self.run.name}: {reason}")
            problems = []
        for problem in problems:
            self._status = FAILED
            self.get_logger().error(f"{self.run.name}: {problem}")
        self.run = None
        self._deadline = float("inf")
        self._runs += 1
        sweep_memory()
        self._acknowledge()
        self._leave_if_alone()
