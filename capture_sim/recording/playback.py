"""A recording to be played: its topics, and its messages in the order of their log times."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import suppress
from itertools import repeat
from operator import itemgetter
from pathlib import Path

import numpy as np

from capture_sim.errors import MessageError, RecordingError
from capture_sim.messages.convert import RunDescription
from capture_sim.messages.definitions import NO_DEFINITION, decoded, store_of, typestore
from capture_sim.messages.evolution import Translation
from capture_sim.messages.topics import (
    RUN_INFO,
    SHOWN,
    STREAM_COUNTS,
    RunSource,
    topic_named,
)
from capture_sim.recording.bag import remap
from capture_sim.recording.contents import read_contents


class Playback:
    """A recording to be played, which is a file or a bag's folder of files.

    ``remaps``: recorded names of topics by the bench's names, as for
    :func:`capture_sim.recording.bag.read_bag`.  RecordingError if the recording cannot be read or
    has no message, if a topic of ``remaps`` is not in it, or if messages of another version of this
    package cannot be translated.
    """

    def __init__(self, path: Path | str, remaps: Mapping[str, str] | None = None) -> None:
        self.path = Path(path)
        self._contents = contents = read_contents(self.path)
        remap(self.path, contents, remaps or {})
        #: Message types by topic, ``package/msg/Name``.
        self.types = contents.types
        #: A line for every file that was not read to its end.
        self.damage = contents.damage
        #: Why messages cannot be played, by name of the topic or of the file.
        self.left_out = contents.left_out
        #: What is odd in messages that are played, a line each.
        self.doubts = contents.doubts
        #: Number of messages by topic.
        self.counts = {name: len(messages) for name, messages in contents.messages.items()}
        self._translations = dict(self._translated())
        times = [times for times in contents.log_times.values() if times]
        if not times:
            reason = "; ".join(self.damage) or "it contains no message"
            raise RecordingError(f"{self.path}: nothing to play: {reason}")
        #: First and last log time, ns.
        self.start = min(each[0] for each in times)
        self.end = max(each[-1] for each in times)

    def _translated(self) -> Iterator[tuple[str, Translation]]:
        """Yield name and translation of each topic of the bench whose type differs in the file.

        Such messages were written by another version of this package.  RecordingError if they
        cannot be translated.
        """
        for name, type_name in self.types.items():
            topic = topic_named(name)
            if topic is None or topic.type_name != type_name or not self.counts[name]:
                continue
            with suppress(*NO_DEFINITION):  # without a definition, of this version or not at all
                encoding = self._contents.encodings.get(type_name, "")
                store = store_of(type_name, self._contents.schemas.get(type_name, ""), encoding)
                if store.fielddefs.get(type_name) != typestore().fielddefs[type_name]:
                    try:
                        yield name, Translation(store, type_name)
                    except MessageError as error:
                        raise RecordingError(f"{self.path}: {name}: {error}") from None

    def messages(
        self, offset: float = 0.0, topics: Collection[str] | None = None
    ) -> Iterator[tuple[int, str, bytes]]:
        """Yield log time (ns), topic and bytes of the messages, in the order of their times.

        ``offset`` is the time after the start at which to begin, s.  Of a transient local topic,
        earlier messages come first, with the time of the offset: as many as a late subscriber would
        get, because without the announcement of the run no node could follow it.  ``topics`` are
        the names of the topics to play; None for all.

        Messages of one time come in the order of their topics in the file, but StreamCounts last,
        because they end the run.  Messages that another version wrote are translated to this one.
        """
        begin = self.start + round(offset * 1e9)
        played: list[tuple[int, int, str, bytes]] = []
        for rank, (name, messages) in enumerate(self._contents.messages.items()):
            if topics is None or name in topics:
                first = self._first(name, begin)
                # the counts end the run: without a time of their own they come last of their time
                rank = len(self.types) if topic_named(name) is STREAM_COUNTS else rank
                times = self._contents.log_times[name][first:]
                played += zip(times, repeat(rank), repeat(name), messages[first:])
        for time, _, name, data in sorted(played, key=itemgetter(0, 1)):
            translation = self._translations.get(name)
            yield max(time, begin), name, data if translation is None else translation(data)

    def skipped(self, offset: float, topics: Collection[str]) -> dict[str, int]:
        """Return how many messages of each topic :meth:`messages` leaves out with these arguments.

        Topics that are played completely are not in the result.
        """
        begin = self.start + round(offset * 1e9)
        skipped = {
            name: self._first(name, begin) if name in topics else count
            for name, count in self.counts.items()
        }
        return {name: count for name, count in skipped.items() if count}

    def _first(self, name: str, begin: int) -> int:
        """Return the index of the first message of a topic to play from the time ``begin`` (ns)."""
        first = bisect_left(self._contents.log_times[name], begin)
        topic = topic_named(name) or {each.absolute_name: each for each in SHOWN}.get(name)
        return max(0, first - topic.depth) if topic is not None and topic.transient_local else first


class PlayedCounts:
    """Adapts recorded StreamCounts, the numbers of messages that each node sent, to a replay.

    ``roles`` are the roles of nodes that take part in the replay themselves, e.g. a detector that
    evaluates the run again: their recorded counts are left out.  ``skipped`` are the numbers of
    messages that are not played, by topic; the counts are lowered by them.
    """

    def __init__(self, roles: Sequence[str] = (), skipped: Mapping[str, int] | None = None) -> None:
        self._roles = list(roles)
        self._skipped = {name.lstrip("/"): n for name, n in (skipped or {}).items()}

    def __call__(self, data: bytes) -> bytes | None:
        """Return a serialised StreamCounts as it is to be sent; None if it is to be left out.

        A topic of which nothing is played is not in it.
        """
        if not (self._roles or self._skipped):
            return data
        message = decoded(STREAM_COUNTS, data)
        if message.publisher in self._roles:
            return None
        # a topic that is not played at all is not counted
        counts = zip(message.topics, message.counts.tolist(), strict=True)
        played = {
            name: count - skipped
            for name, count in counts
            if (skipped := self._skipped.get(name.lstrip("/"), 0)) < count or count == 0
        }
        message.topics = list(played)
        message.counts = np.array(list(played.values()), dtype=np.uint64)
        return bytes(typestore().serialize_cdr(message, STREAM_COUNTS.type_name))


def replayed(
    data: bytes, announcer: str, participants: Sequence[str], roles: Sequence[str]
) -> tuple[RunDescription, bytes]:
    """Return a recorded RunInfo as a player announces it, as a description and serialised.

    ``data`` is the recorded message, ``announcer`` the player's id on bench/roll, ``participants``
    are the ids of the nodes that take part, and ``roles`` the roles of those that publish topics of
    the run themselves.
    """
    message = decoded(RUN_INFO, data)
    message.source, message.announcer = str(RunSource.REPLAY), announcer
    message.participants = list(participants)
    message.publishers = list(dict.fromkeys([*message.publishers, *roles]))
    data = bytes(typestore().serialize_cdr(message, RUN_INFO.type_name))
    return RunDescription.of_message(message), data


def publisher_of(data: bytes) -> str:
    """Return the role of the node that sent a serialised StreamCounts."""
    return str(decoded(STREAM_COUNTS, data).publisher)
