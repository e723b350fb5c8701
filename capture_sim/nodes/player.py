"""The node that plays a recording: the same bytes in the same rhythm."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

from rclpy.qos import QoSProfile
from std_srvs.srv import Trigger

from capture_sim.base.exit_status import FAILED, OK
from capture_sim.messages.topics import (
    CAPTURE_DETECTOR,
    HOLD,
    PLAYER,
    RECORDER,
    RUN_INFO,
    SHOWN,
    SIMULATOR,
    STREAM_COUNTS,
    RunSource,
    topic_named,
    topics_of,
)
from capture_sim.nodes.base.endpoints import message_class, qos_of
from capture_sim.nodes.base.node import BenchNode
from capture_sim.nodes.base.parameters import ParameterError
from capture_sim.nodes.base.process import run as run_process
from capture_sim.nodes.protocol.announcer import Announcer
from capture_sim.nodes.protocol.roll import Roll, has_streams
from capture_sim.nodes.simulation.control import SimulationControl, State
from capture_sim.nodes.simulation.pacing import RunPacer
from capture_sim.recording.bag import remap_of
from capture_sim.recording.playback import Playback, PlayedCounts, publisher_of, replayed
from capture_sim.scene.quantities import REAL_TIME_FACTORS

#: Nodes of the suite that can take part.
ROLES = (CAPTURE_DETECTOR, RECORDER)


class PlayerNode(BenchNode):
    """Publishes the messages of a recording, byte for byte.

    The topics of the bench, and those of its shape and frames, are published with their own quality
    of service, others reliable and volatile.  Topics whose type is not installed are left out with
    a warning.  At the start the player waits for the nodes named in ``wait_for``; later it waits
    whenever one of them falls behind.  A detector among them evaluates the run again, and the
    topics that it publishes are not played.  Recorders that are running take part as well.  The
    topic launcher/hold is never played, as it moves a real chaser.  docs/recording.md explains the
    options.
    """

    def __init__(self, **options: Any) -> None:
        super().__init__(PLAYER, **options)
        path = self.declare("bag", "", "recording: an .mcap file, or a bag's folder")
        if not path:
            raise ParameterError("parameter bag = '': must be an .mcap file or a bag's folder")
        factor = self.declare(
            "rtf",
            1.0,
            "real-time factor: recorded seconds per second; 0 plays without pacing",
            low=REAL_TIME_FACTORS.low,
            high=REAL_TIME_FACTORS.high,
        )
        self._offset = self.declare(
            "start", 0.0, "s after the recording's start, to begin at", low=0.0, high=1e9
        )
        remaps = self.declare(
            "remaps",
            list,
            "topics of the bench that were recorded under other names, e.g. "
            "chaser/odom:=/mocap/rb1/odom",
            allowed="TOPIC:=RECORDED_TOPIC each",
            check=lambda texts: dict(map(remap_of, texts)),
        )
        wanted = self.declare("topics", list, "topics to play (default: all)")
        paused = self.declare("paused", False, "start paused")
        self._wait_for = self.declare(
            "wait_for",
            list,
            "nodes that take part, by role or name, also nodes of your own: awaited, never outrun",
            allowed="capture_detector, recorder, or names of nodes",
        )
        self._start_timeout = self.declare(
            "start_timeout", 60.0, "s (wall), wait for the nodes in wait_for", low=1.0, high=86400.0
        )
        self._playback = Playback(path, dict(map(remap_of, remaps)))
        length = (self._playback.end - self._playback.start) / 1e9
        if self._offset > length:
            raise ParameterError(
                f"parameter start = {self._offset:g} s: must be 0 to {length:g} s, "
                "the recording's length"
            )
        self._played = self._chosen(wanted)
        has_run = any(
            topic_named(name) is RUN_INFO and self._playback.counts[name] for name in self._played
        )
        own = [name for name in self._wait_for if name in ROLES]
        if own and not has_run:
            raise ParameterError(
                f"parameter wait_for = {own!r}: must be empty: the replay contains no "
                f"{RUN_INFO.name}, so no node can join"
            )
        self._control = SimulationControl(
            State.PAUSED if paused else State.PLAYING,
            RunPacer(factor),
            lambda limit: self.wait(limit=limit),
        )
        for name, state in (("pause", State.PAUSED), ("resume", State.PLAYING)):
            serve = partial(self._set_state, state)
            self.create_service(Trigger, f"~/{name}", self.guarded(serve))
        self._not_installed: list[str] = []  # a line for each topic
        self._outlets: dict[str, Callable[[Any], object]] = {}
        # the announcement last, see nodes/protocol/roll.py
        for name in sorted(self._played, key=lambda name: topic_named(name) is RUN_INFO):
            self._open(name, self._playback.types[name])
        self._roll = Roll(self, PLAYER, on_part=lambda part: self._announcer.check_part(part))
        self._announcer = Announcer(self, self._roll, RunSource.REPLAY, self._wait_for)

    # set-up

    def _chosen(self, wanted: Sequence[str]) -> list[str]:
        """Return the names of the topics to play.

        ``wanted``: the parameter ``topics``; all of the recording if it is empty.  Left out are
        launcher/hold and what the nodes in ``wait_for`` publish themselves.  ParameterError if the
        recording does not contain a wanted topic.
        """
        there = self._playback.types
        names = [name if name.startswith("/") else f"/{name}" for name in wanted] or list(there)
        unknown = [name for name in names if name not in there]
        if unknown:
            raise ParameterError(
                f"parameter topics = {list(wanted)!r}: {', '.join(unknown)} not in the recording; "
                f"must be one of {', '.join(sorted(there))}"
            )
        own = {
            topic.absolute_name
            for name in self._wait_for
            for topic in topics_of(name)
            if topic is not STREAM_COUNTS
        }
        self._moving = [name for name in names if name.endswith(f"/{HOLD}")]
        return [name for name in names if name not in own and name not in self._moving]

    def _open(self, name: str, type_name: str) -> None:
        try:
            kind = message_class(type_name)
        except (ImportError, AttributeError, ValueError):
            self._not_installed.append(f"{name}: type {type_name} is not installed: not played")
            return
        topic = topic_named(name)
        if topic is not None and topic.type_name == type_name:
            self.open((topic,))
            self._outlets[name] = partial(self.send, topic)
            return
        shown = {each.absolute_name: each for each in SHOWN if each.type_name == type_name}
        qos = qos_of(shown[name]) if name in shown else QoSProfile(depth=1000)
        publisher = self.create_publisher(kind, name.lstrip("/"), qos)
        self._outlets[name] = publisher.publish

    def _set_state(self, state: State, _: Any, response: Any) -> Any:
        response.message = self._control.set_state(state).message
        response.success = not response.message
        return response

    # playing

    def work(self) -> int:
        """Play the recording once, with warnings of what is not played; return the exit status.

        It is FAILED if nothing could be played, or if a node in ``wait_for`` stopped reading.
        """
        for name, reason in self._playback.left_out.items():
            self.get_logger().warning(f"{name}: not played: {reason}")
        for line in (*self._playback.damage, *self._playback.doubts, *self._not_installed):
            self.get_logger().warning(line)
        for name in self._moving:
            self.get_logger().warning(f"{name}: not played: it moves a real chaser")
        try:
            count = self._play()
        finally:
            self._control.end()
        if count == 0:
            self.get_logger().error(
                "nothing was played: of the topics and times chosen the recording contains no "
                "message of an installed type"
            )
        return FAILED if count == 0 or self.topic_publishers.dropped else OK

    def _play(self) -> int:
        """Play the messages at their times; return how many were played."""
        name = self._playback.path.name
        count = 0
        stamp = self._playback.start
        self._control.begin()
        self._announcer.await_nodes(name, self._start_timeout)
        taking_part = self._announcer.participants(
            name,
            lambda part: not has_streams(part.role) or any(map(part.is_called, self._wait_for)),
        )
        skipped = self._playback.skipped(self._offset, self._outlets)
        adapt_counts = PlayedCounts(taking_part.publishers, skipped)
        known = {topic_name: topic_named(topic_name) for topic_name in self._outlets}
        is_ended = False  # the simulator's counts have been played
        self._control.pacer.reset()
        for stamp, topic_name, data in self._playback.messages(self._offset, self._outlets):
            self._control.tick((stamp - self._playback.start) / 1e9)
            topic = known[topic_name]
            if topic is RUN_INFO:
                self._end_run(is_ended)
                is_ended = False
                self._announcer.announce(
                    *replayed(data, self._roll.id, taking_part.participants, taking_part.publishers)
                )
                count += 1
                continue
            if topic is STREAM_COUNTS:
                adapted = adapt_counts(data)
                if adapted is None:
                    continue
                is_ended = is_ended or publisher_of(data) == SIMULATOR
                data = adapted
            count += 1
            self._outlets[topic_name](data)
        # measured before the others close their files
        spent = max(self._control.pacer.wall, 1e-9)
        self._control.pacer.pause()
        self._announcer.await_read()
        self._end_run(is_ended)
        played = (stamp - self._playback.start) / 1e9 - self._offset
        self.get_logger().info(
            f"{count} messages, {played:.2f} s played in {spent:.2f} s "
            f"({played / spent:.2f} x real time)"
        )
        return count

    def _end_run(self, is_ended: bool) -> None:
        """End the run that is on, if one is, and wait until the participants are done with it.

        ``is_ended``: the simulator's counts, which end a run for the participants, have been
        played.  A trial of a bench, and a recording that breaks off, have none.
        """
        if not is_ended:  # a bench's trial, or a recording without its end
            self._announcer.close()
        self._announcer.await_done()
        if is_ended:
            self._announcer.close()


main = partial(run_process, PlayerNode)

if __name__ == "__main__":
    raise SystemExit(main())
