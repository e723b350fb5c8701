"""A recording as it is to be played: its topics, and its messages in the order of their times."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import chain, repeat
from operator import itemgetter
from pathlib import Path
from typing import Any

import numpy as np

from capture_sim.errors import RecordingError
from capture_sim.messages.definitions import decoded, typestore
from capture_sim.messages.topics import RUN_INFO, STREAM_COUNTS, topic_named
from capture_sim.recording.bag_file import profiles_in
from capture_sim.recording.contents import Contents, bag_files, read_contents


@dataclass(frozen=True)
class PlayedTopic:
    """A topic of a recording."""

    name: str  # as recorded, ``package/msg/Name``
    type_name: str  # as recorded, ``package/msg/Name``
    # the first recorded profile, as rosbag2 writes it; empty when none was recorded
    qos: dict[str, Any]


class Playback:
    """What a player plays.  Of a split recording one file at a time is in memory.

    Parameters
    ----------
    path
        A file, or a bag's folder.

    Attributes
    ----------
    topics : dict
        By name.
    counts : dict
        Messages by topic.
    start, end
        First and last log time, ns.
    damage
        A line for every file that ends early.
    left_out
        Encoding by topic of messages that are not CDR and cannot be played.

    Raises
    ------
    RecordingError
        It cannot be read, is damaged, or holds no message.
    """

    def __init__(self, path: Path | str) -> None:
        self.path = Path(path)
        self._files = bag_files(self.path)
        self.topics: dict[str, PlayedTopic] = {}
        self.counts: dict[str, int] = {}
        self._last: tuple[int, Contents] = (-1, Contents())
        self.damage: list[str] = []
        self.left_out: dict[str, str] = {}
        spans = []
        for i in range(len(self._files)):
            contents = self._read(i)
            if contents.damage:
                self.damage.append(f"{self._files[i]}: {contents.damage}")
            self.left_out.update(contents.left_out)
            for name, type_name in contents.types.items():
                qos = _profile(contents.qos.get(name, ""))
                self.topics.setdefault(name, PlayedTopic(name, type_name, qos))
            for name, messages in contents.messages.items():
                self.counts[name] = self.counts.get(name, 0) + len(messages)
            spans += [(min(times), max(times)) for times in contents.log_times.values() if times]
        if not spans:
            raise RecordingError(f"{self.path}: nothing to play: it holds no message")
        self.start = min(first for first, _ in spans)
        self.end = max(last for _, last in spans)

    def messages(
        self, offset: float = 0.0, topics: Collection[str] | None = None
    ) -> Iterator[tuple[int, str, bytes]]:
        """Yield log time (ns), topic and bytes of the messages, in the order of their times.

        Messages of one time come in the order of their topics in the file.  What is latched
        and lies before the offset comes first, at the offset's time: without the announcement
        of the run nobody could follow it.

        Parameters
        ----------
        offset
            s after the start.
        topics
            Names of those that are played; None for all.
        """
        begin = self.start + round(offset * 1e9)
        for i in range(len(self._files)):
            contents = self._read(i)
            streams = (
                zip(contents.log_times[name], repeat(_rank(name, k)), repeat(name), messages)
                for k, (name, messages) in enumerate(contents.messages.items())
                if topics is None or name in topics
            )
            for time, _, name, data in sorted(chain.from_iterable(streams), key=itemgetter(0, 1)):
                if time >= begin or self._is_latched(name):
                    yield max(time, begin), name, data

    def skipped(self, offset: float, topics: Collection[str]) -> dict[str, int]:
        """Return how many messages of each topic :meth:`messages` leaves out, where it does."""
        found = {name: count for name, count in self.counts.items() if name not in topics}
        begin = self.start + round(offset * 1e9)
        for i in range(len(self._files) if offset > 0.0 else 0):
            for name, times in self._read(i).log_times.items():
                if name in topics and not self._is_latched(name):
                    early = sum(time < begin for time in times)
                    found[name] = found.get(name, 0) + early
        return {name: count for name, count in found.items() if count}

    def _is_latched(self, name: str) -> bool:
        return self.topics[name].qos.get("durability") in ("transient_local", 1)

    def _read(self, i: int) -> Contents:
        if self._last[0] != i:
            self._last = (i, read_contents(self._files[i]))
        return self._last[1]


class Rewritten:
    """Makes the announcement and the end of a recorded run those of a played one.

    Parameters
    ----------
    suffix
        Put behind the run's id, so that it can be played again in one domain.
    consumers
        Nodes that take part: the recorded ones are not awaited, and the counts of what these
        publish themselves are left out.  Empty: the announcement stays as recorded.
    skipped
        Messages by topic that are not played: the counts promise so much less.
    """

    def __init__(
        self, suffix: str, consumers: Sequence[str] = (), skipped: Mapping[str, int] | None = None
    ) -> None:
        self._suffix = suffix
        self._consumers = list(consumers)
        self._skipped = {name.lstrip("/"): n for name, n in (skipped or {}).items()}

    def __call__(self, name: str, data: bytes) -> bytes | None:
        """Return the message as it is to be sent; None when it is left out."""
        topic = topic_named(name)
        unchanged = not (self._suffix or self._consumers or self._skipped)
        if topic not in (RUN_INFO, STREAM_COUNTS) or topic is None or unchanged:
            return data
        message = decoded(topic, data)
        message.run_id += self._suffix
        if topic is RUN_INFO and self._consumers:
            message.consumers = self._consumers
        if topic is STREAM_COUNTS:
            if message.publisher in self._consumers:
                return None
            # of a topic that is not played at all nothing is said: a player has its own clock
            counts = zip(message.topics, message.counts.tolist(), strict=True)
            left = {
                name: count - skipped
                for name, count in counts
                if (skipped := self._skipped.get(name.lstrip("/"), 0)) < count or count == 0
            }
            message.topics = list(left)
            message.counts = np.array(list(left.values()), dtype=np.uint64)
        return bytes(typestore().serialize_cdr(message, topic.type_name))


def run_id_of(data: bytes) -> str:
    """Return the run's id in a serialised RunInfo."""
    return str(decoded(RUN_INFO, data).run_id)


def _rank(name: str, place: int) -> int:
    # the counts end the run: they carry no time of their own, and come last of their time
    return 10_000 if topic_named(name) is STREAM_COUNTS else place


def _profile(text: str) -> dict[str, Any]:
    first = next(iter(profiles_in(text)), None)
    return dict(first) if isinstance(first, dict) else {}
