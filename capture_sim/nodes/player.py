"""The node that plays a recording: same bytes, same timing, and no faster than its consumers."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

from rclpy.qos import QoSProfile
from std_srvs.srv import Trigger

from capture_sim.control.pacing import FACTORS, Pacer
from capture_sim.control.simulation import Request, SimulationControl, State
from capture_sim.errors import CaptureSimError
from capture_sim.interrupts import STOP
from capture_sim.messages.topics import (
    CAPTURE_DETECTOR,
    LAUNCHER,
    RUN_INFO,
    SIMULATOR,
    STREAM_COUNTS,
    topic_named,
    topics_of,
)
from capture_sim.nodes.barrier import Barrier
from capture_sim.nodes.node import BenchNode, message_class
from capture_sim.nodes.parameters import ParameterError
from capture_sim.nodes.participant import RECORDER
from capture_sim.nodes.process import run
from capture_sim.nodes.services import SimulationServices
from capture_sim.nodes.start import FAILED, OK
from capture_sim.recording.playback import Playback, Rewritten, run_id_of
from capture_sim.recording.read import remap_of

PLAYER = "player"
#: Nodes that can take part.
ROLES = (CAPTURE_DETECTOR, RECORDER)
INFO = (
    "capture_sim's player: a step is all messages of the next time; playing and paused are the "
    "states it has."
)
#: Participants get this long to close their files, and the last messages to arrive, s (wall).
CLOSING_TIME, LAST = 60.0, 1.0


class PlayerNode(BenchNode):
    """Publishes the serialised messages of a recording.

    Topics of the bench have their own quality of service, others are reliable and volatile.
    Types that are not installed are left out with a warning.  Nodes of the bench that are
    named as consumers take part in the played run as in the simulator's: they are awaited
    at the start and never outrun, and what they publish themselves is not played.
    """

    has_coroutines = True

    def __init__(self) -> None:
        super().__init__(PLAYER)
        path = self.declare("bag", "", "recording: an .mcap file, or a bag's folder")
        if not path:
            raise ParameterError("parameter bag = '': must be an .mcap file or a bag's folder")
        factor = self.declare(
            "rtf",
            1.0,
            "real-time factor: recorded seconds per second; 0 plays without pacing",
            low=FACTORS.low,
            high=FACTORS.high,
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
        wanted = self.declare("topics", list, "those that are played; all unless given")
        paused = self.declare("paused", False, "start paused")
        self._consumers = self.declare(
            "consumers",
            list,
            "nodes of the bench that take part: awaited and never outrun",
            choices=ROLES,
        )
        self._start_timeout = self.declare(
            "start_timeout", 60.0, "s (wall), wait for the consumers", low=1.0, high=86400.0
        )
        self._delay = self.declare(
            "delay", 1.0, "s (wall), for subscribers to be found", low=0.0, high=3600.0
        )
        self._playback = Playback(path, dict(map(remap_of, remaps)))
        length = (self._playback.end - self._playback.start) / 1e9
        if self._offset > length:
            raise ParameterError(
                f"parameter start = {self._offset:g} s: must be 0 to {length:g} s, "
                "the recording's length"
            )
        self._played = self._chosen(wanted)
        if self._consumers and not any(
            topic_named(name) is RUN_INFO and self._playback.counts[name] for name in self._played
        ):
            raise ParameterError(
                f"parameter consumers = {self._consumers!r}: must be empty: the replay contains "
                f"no {RUN_INFO.name}, so no node can join"
            )
        self._control = SimulationControl(
            State.PAUSED if paused else State.PLAYING,
            Pacer(factor),
            states=(State.PLAYING, State.PAUSED),
            resets=False,
        )
        self._outlets: dict[str, Callable[..., object]] = {}
        for name in self._played:
            self._open(name, self._playback.types[name])
        own = [topic for topic in map(topic_named, self._outlets) if topic in self._senders]
        played = {SIMULATOR, LAUNCHER, *ROLES} - set(self._consumers)
        self._barrier = Barrier(self, self._consumers, own, played, self._control.check)
        for name, action in (
            ("pause", lambda: self._control.set_state(State.PAUSED)),
            ("resume", lambda: self._control.set_state(State.PLAYING)),
        ):
            self.create_service(Trigger, f"~/{name}", self._serving(action))
        self._simulation_services = SimulationServices(self, self._control, INFO)

    # set-up

    def _chosen(self, wanted: Sequence[str]) -> list[str]:
        """Return the names of the topics that are played."""
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
            for consumer in self._consumers
            for topic in topics_of(consumer)
            if topic is not STREAM_COUNTS
        }
        return [name for name in names if name not in own]

    def _open(self, name: str, type_name: str) -> None:
        try:
            kind = message_class(type_name)
        except (ImportError, AttributeError, ValueError):
            self.get_logger().warning(f"{name}: type {type_name} is not installed: not played")
            return
        topic = topic_named(name)
        if topic is not None and topic.type_name == type_name:
            self.open((topic,))
            self._outlets[name] = partial(self.send, topic)
            return
        publisher = self.create_publisher(kind, name.lstrip("/"), QoSProfile(depth=1000))
        self._outlets[name] = publisher.publish

    def _serving(self, ask: Callable[[], Request]) -> Any:
        def serve(_: Any, response: Any) -> Any:
            request = ask()
            response.message = request.result().message if request.done() else ""
            response.success = not response.message
            return response

        return serve

    # in the main thread

    def work(self) -> int:
        """Play; return the exit status."""
        for name, reason in self._playback.left_out.items():
            self.get_logger().warning(f"{name}: not played: {reason}")
        for line in self._playback.damage:
            self.get_logger().warning(line)
        try:
            count = self._play()
        except CaptureSimError as error:
            self.get_logger().error(str(error))
            return FAILED
        finally:
            self._control.end()
            self._simulation_services.close()
        if count == 0:
            self.get_logger().error(
                "nothing was played: of the topics and times chosen the recording contains no "
                "message of an installed type"
            )
        return FAILED if count == 0 or self.participants(self.dropped_readers) else OK

    def _play(self) -> int:
        """Play; return how many messages were played."""
        skipped = self._playback.skipped(self._offset, self._outlets)
        rewrite = Rewritten(self._consumers, skipped)
        name = self._playback.path.name
        count: Counter[str] = Counter()
        stamp = self._playback.start
        self._control.begin()
        if self._consumers:
            self._barrier.wait(name, self._barrier.all_there, self._start_timeout)
        else:
            STOP.wait(self._delay)
        self._control.pacer.reset()
        for stamp, topic, data in self._playback.messages(self._offset, self._outlets):
            self._control.tick((stamp - self._playback.start) / 1e9)
            sent = rewrite(topic, data)
            if sent is None:
                continue
            count[topic] += 1
            self._outlets[topic](sent)
            if topic_named(topic) is RUN_INFO:
                self._barrier.begin(run_id_of(sent))
                self.drain(self.reader_timeout, [RUN_INFO])
        # measured before the others close their files
        spent = max(self._control.pacer.wall, 1e-9)
        self._control.pacer.hold()
        self.drain(CLOSING_TIME if self._consumers else LAST)
        if self._consumers:
            self._barrier.wait(name, self._barrier.all_ended, CLOSING_TIME)
        played = (stamp - self._playback.start) / 1e9 - self._offset
        messages = count.total()
        self.get_logger().info(
            f"{messages} messages, {played:.2f} s played in {spent:.2f} s "
            f"({played / spent:.2f} x real time)"
        )
        return messages


main = partial(run, PlayerNode)

if __name__ == "__main__":
    raise SystemExit(main())
