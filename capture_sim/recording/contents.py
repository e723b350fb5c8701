"""The contents of an MCAP file, or of a bag's folder of files, by topic."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from mcap.records import Attachment, Channel, Metadata, Schema

from capture_sim.errors import MemoryLimitError, RecordingError
from capture_sim.messages.topics import HOLD, topic_named
from capture_sim.recording.bag_folder import bag_files
from capture_sim.recording.log_times import JUMP, settle
from capture_sim.recording.records import (
    MAX_UNPACKED_RATIO,
    MEMORY_LIMIT,
    MESSAGE_COST,
    Damage,
    RecordContents,
)
from capture_sim.recording.scan import scan

#: Encoding of ROS 2 messages.
CDR = "cdr"

_KeepMessage = Callable[[bytes | memoryview], None]


@dataclass
class Contents:
    """Contents of the files of a recording, up to the first damage of each."""

    types: dict[str, str] = field(default_factory=dict)  # message type by topic
    # quality of service by topic, YAML as rosbag2 writes it; empty when not recorded
    schemas: dict[str, str] = field(default_factory=dict)  # definition text by message type
    encodings: dict[str, str] = field(default_factory=dict)  # ... and its language, e.g. ros2msg
    # serialised messages by topic, in the order of their log times
    messages: dict[str, Sequence[bytes]] = field(default_factory=dict)
    log_times: dict[str, list[int]] = field(default_factory=dict)  # their log times, ns, ascending
    attachments: dict[str, bytes] = field(default_factory=dict)  # by name
    metadata: dict[str, dict[str, str]] = field(default_factory=dict)  # by name
    # why messages were left out, by topic as it may be printed, or why a file was, by its name
    left_out: dict[str, str] = field(default_factory=dict)
    doubts: tuple[str, ...] = ()  # what is odd in messages that are used
    damage: tuple[str, ...] = ()  # why files were not read to their ends
    # the metadata at the end is under the checksum of the data section
    has_verified_end: bool = True


def read_contents(path: Path) -> Contents:
    """Read a recording, which is a file or a bag's folder, each file up to its first damage.

    A file may unpack to 100 times its size, and to 64 MiB in any case.  Messages of topics
    that the suite does not know, e.g. of cameras, are read when they are first used.  The others
    are kept; MemoryLimitError if they need more than MEMORY_LIMIT (1 GiB) in all.  RecordingError
    if no file can be read.
    """
    contents = Contents()
    files, left_out, doubts = bag_files(path)
    contents.left_out.update(left_out)
    rejected: Counter[tuple[str, str]] = Counter()
    errors, memory = [], MemoryBudget(MEMORY_LIMIT.get())
    for file in files:
        reader = _Reader(contents, rejected, memory, lambda topic: UnreadMessages(files, topic))
        try:
            for part in scan(file, MAX_UNPACKED_RATIO):
                if isinstance(part, Damage):
                    name = f"{file.name}: " if path.is_dir() else ""
                    contents.damage += (f"{name}{part}",)
                    contents.has_verified_end &= part.in_index
                else:
                    reader.add(part)
                    memory.check(path)
        except MemoryLimitError:
            raise
        except RecordingError as error:
            errors.append(error)
            contents.damage += (str(error).removeprefix(f"{file.parent}/"),)
            contents.has_verified_end = False
    if len(errors) == len(files):
        raise errors[0]
    _note_rejected(contents, rejected)
    contents.doubts = (*doubts, *_put_in_order(contents))
    return contents


def _put_in_order(contents: Contents) -> list[str]:
    """Sort the messages of each topic by log time, in place, and settle log times that jump.

    Return a line for each jump, and one if messages have no log time.
    """
    lines: list[str] = []
    used = {topic: sorted(times) for topic, times in contents.log_times.items() if times}
    low, high = (
        min((t[0] for t in used.values()), default=0),
        max((t[-1] for t in used.values()), default=0),
    )
    if used and (low == 0 or high - low > JUMP):
        lines = settle(contents.log_times)
        used = {topic: sorted(contents.log_times[topic]) for topic in used}
    for topic, ordered in used.items():
        times = contents.log_times[topic]
        if times != ordered:
            order = sorted(range(len(times)), key=times.__getitem__)
            messages = contents.messages[topic]
            if isinstance(messages, UnreadMessages):
                messages.order = order
            else:
                contents.messages[topic] = [messages[i] for i in order]
            contents.log_times[topic] = ordered
    return lines


def _note_rejected(contents: Contents, rejected: Mapping[tuple[str, str], int]) -> None:
    totals: Counter[str] = Counter()
    for (topic, _), number in rejected.items():
        totals[topic] += number
    for (topic, reason), number in rejected.items():
        if topic in contents.messages:
            total = totals[topic] + len(contents.messages[topic])
            line = f"{number} of {total} messages: {reason}"
            contents.left_out[topic] = "; ".join(
                filter(None, (contents.left_out.get(topic, ""), line))
            )


class MemoryBudget:
    """The memory that the messages of a recording need, beside a limit, bytes."""

    def __init__(self, limit: int) -> None:
        self.limit, self.used = limit, 0

    def check(self, path: Path) -> None:
        """Raise MemoryLimitError, which names the recording, if the limit is exceeded."""
        if self.used > self.limit:
            raise MemoryLimitError(
                f"{path}: its messages need more than {self.limit / 2**30:.3g} GiB of memory: "
                "--memory raises this limit"
            )


class UnreadMessages(Sequence[bytes]):
    """Messages of a topic that are read from the files when they are first used.

    ``order``: indices of the messages in the files, in the order of their log times; None if that
    is their order.
    """

    def __init__(self, files: Sequence[Path], topic: str) -> None:
        self._files, self._topic = files, topic
        self._count = 0
        self._messages: list[bytes] | None = None
        self.order: list[int] | None = None

    def count_one(self) -> None:
        """Note a message in the files."""
        self._count += 1

    def __len__(self) -> int:
        return self._count

    def __getitem__(self, index: Any) -> Any:
        if self._messages is None:
            found = list(self._read())
            self._messages = found if self.order is None else [found[i] for i in self.order]
        return self._messages[index]

    def _read(self) -> Iterator[bytes]:
        contents, memory = Contents(), MemoryBudget(MEMORY_LIMIT.get())
        for file in self._files:
            reader = _Reader(contents, Counter(), memory, None, only=self._topic)
            with suppress(RecordingError):  # of a file that was not read the first time, either
                for part in scan(file, MAX_UNPACKED_RATIO):
                    if not isinstance(part, Damage):
                        reader.add(part)
                    memory.check(file)
        yield from contents.messages[self._topic][: self._count]


def rename_topics(contents: Contents, recorded_names: Mapping[str, str]) -> None:
    """Rename topics from the names in the file to the bench's names, in place.

    ``recorded_names`` maps the bench's names to those in the file.  A pair of equal names is
    ignored.  RecordingError if a topic is in the file under neither name, or under both.
    """
    for name, recorded_name in recorded_names.items():
        is_there = bool(contents.messages.get(name))
        if recorded_name == name or (is_there and recorded_name not in contents.types):
            continue
        if recorded_name not in contents.types:
            available = ", ".join(sorted(contents.types)) or "none"
            raise RecordingError(
                f"remap {name}:={recorded_name}: {recorded_name} is not recorded; "
                f"available topics: {available}"
            )
        if is_there:
            raise RecordingError(f"remap {name}:={recorded_name}: both topics are recorded")
        contents.types[name] = contents.types.pop(recorded_name)
        contents.messages[name] = contents.messages.pop(recorded_name)
        contents.log_times[name] = contents.log_times.pop(recorded_name)


def schema_problem(channel: Channel, schema: Schema | None) -> str:
    """Return why a topic cannot be used because of its name or its type's; empty if it can."""
    if not channel.topic.isprintable() or not (schema is None or schema.name.isprintable()):
        return "names of topics and types must be printable characters"
    return ""


class _Reader:
    """Adds the records of one file to the contents of the whole recording."""

    def __init__(
        self,
        contents: Contents,
        rejected: Counter[tuple[str, str]],
        memory: MemoryBudget,
        deferred: Callable[[str], UnreadMessages] | None,
        only: str = "",
    ) -> None:
        self._contents, self._memory = contents, memory
        self._deferred, self._only = deferred, only
        self._rejected = rejected  # numbers of messages by topic and reason
        self._topics: dict[int, str] = {}  # by channel
        self._schemas: dict[int, Schema] = {}
        # what keeps messages and log times, by channel; those that are left out are discarded
        self._lists: dict[int, tuple[_KeepMessage, Callable[[int], None]]] = {}

    def add(self, record: RecordContents) -> None:
        """Add the entries and messages of a record to the contents."""
        for entry in record.entries:
            if isinstance(entry, Schema):
                self._schemas[entry.id] = entry
            elif isinstance(entry, Channel):
                self._add_channel(entry)
            elif isinstance(entry, Attachment):
                self._contents.attachments[entry.name] = entry.data
            elif isinstance(entry, Metadata):
                self._contents.metadata[entry.name] = dict(entry.metadata)
        lists = self._lists
        for channel, log_time, message in record.messages:
            keep_message, keep_time = lists[channel]
            keep_message(message)
            keep_time(log_time)
        for channel, why in record.rejected:
            self._rejected[self._topics[channel], why] += 1

    def _add_channel(self, channel: Channel) -> None:
        topic, contents = channel.topic, self._contents
        self._topics[channel.id] = topic
        schema = self._schemas.get(channel.schema_id)
        reason = schema_problem(channel, schema)
        if not reason and channel.message_encoding != CDR:  # the type does not describe other bytes
            reason = f"messages are encoded as {channel.message_encoding!r}, must be {CDR}"
        if reason:
            self._lists[channel.id] = _discard, _discard
            contents.left_out[topic if topic.isprintable() else repr(topic)] = reason
            return
        if schema is not None:
            text = schema.data.decode("utf-8", errors="replace")
            if text or schema.name not in contents.schemas:
                contents.schemas[schema.name] = text
                contents.encodings[schema.name] = schema.encoding
        contents.types.setdefault(topic, "" if schema is None else schema.name)
        times = contents.log_times.setdefault(topic, [])
        if self._only and topic != self._only:
            self._lists[channel.id] = _discard, _discard
            return
        if self._deferred is not None and not _is_of_suite(topic):
            if topic not in contents.messages:
                contents.messages[topic] = self._deferred(topic)
            deferred = contents.messages[topic]
            assert isinstance(deferred, UnreadMessages)
            self._lists[channel.id] = lambda _: deferred.count_one(), times.append
            return
        messages = contents.messages.setdefault(topic, [])
        assert isinstance(messages, list)
        memory = self._memory

        def keep(message: bytes | memoryview) -> None:
            messages.append(bytes(message))
            memory.used += len(message) + MESSAGE_COST

        self._lists[channel.id] = keep, times.append


def _discard(_: object) -> None:
    pass


def _is_of_suite(topic: str) -> bool:
    """Return True if the suite knows the topic: its messages are kept when a file is read."""
    return topic_named(topic) is not None or topic.endswith(f"/{HOLD}")
