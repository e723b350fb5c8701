"""Saving what is whole in a damaged recording into a new file, and saying what was lost.

A record is whole when it stands in the file as it would be written, a chunk when it unpacks and
its checksum fits.  Behind damage the next whole chunk is looked for byte by byte, since a
damaged length leads anywhere.
"""

from __future__ import annotations

import mmap
import re
import struct
import zlib
from collections import Counter
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import NamedTuple

import yaml
from mcap.data_stream import RecordBuilder
from mcap.records import (
    Attachment,
    AttachmentIndex,
    Channel,
    Chunk,
    DataEnd,
    McapRecord,
    Message,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
)
from mcap.stream_reader import StreamReader
from mcap.writer import MCAP0_MAGIC, Writer

from capture_sim.errors import RecordingError
from capture_sim.files import free_path, whole_file
from capture_sim.messages.cdr import stamp_of
from capture_sim.messages.convert import EPOCH_NS, LaunchAction, RunDescription
from capture_sim.messages.topics import (
    BENCH_STATE,
    LAUNCH_COMMAND,
    RUN_INFO,
    Topic,
    topic_named,
)
from capture_sim.recording.bag_metadata import FileEntry, TopicEntry, bag_metadata
from capture_sim.recording.contents import (
    DAMAGE,
    UNPACKED_RATIO,
    Records,
    allowance,
    bag_files,
    records_in,
    summary_of,
    unpacked,
)
from capture_sim.recording.live import decoded
from capture_sim.recording.write import (
    BAG_METADATA,
    CHUNK_SIZE,
    DEFINITIONS_ATTACHMENT,
    RECOVERY_METADATA,
    RUN_METADATA,
    SCENE_ATTACHMENT,
    describing,
)

#: Put before the name of a metadata record that no checksum confirms.
UNVERIFIED = "unverified."
#: Lines about losses of one kind, at most.
_MOST_LINES = 5
#: Bytes that a record takes in memory beside its data.
_RECORD_COST = 300

_HEAD = struct.Struct("<BQ")  # opcode, length
_CHUNK = struct.Struct("<QQQII")  # first and last time, size, checksum, length of a name
_SIZE = struct.Struct("<Q")
# opcode of a chunk, and a length below 4 GB; looked ahead, so that hits may overlap
_CHUNK_HEAD = re.compile(rb"(?=\x06[\s\S]{4}\x00\x00\x00\x00)")


class NothingWholeError(RecordingError):
    """A recording holds nothing that could be saved."""


@dataclass(frozen=True)
class Recovery:
    """What came of recovering a file.

    Attributes
    ----------
    path
        Of the new file.
    chunks
        How many were saved.
    messages
        How many were saved, by topic.
    losses
        A line for everything that was lost; empty if nothing was.
    unconfirmed
        A line for everything that was saved and that no checksum confirms.
    """

    path: Path
    chunks: int
    messages: dict[str, int]
    losses: tuple[str, ...]
    unconfirmed: tuple[str, ...] = ()


def recover(
    path: Path | str, out: Path | str | None = None, ratio: float = UNPACKED_RATIO
) -> Recovery:
    """Save all whole chunks of a recording, or of a bag's folder, into one new file.

    Parameters
    ----------
    path
        A file that was cut or damaged; it is left as it is.
    out
        File to write, which must not exist; None takes ``<name>_recovered.mcap`` beside it,
        or a free name like it.
    ratio
        How many times a file's size it may unpack to.

    Raises
    ------
    NothingWholeError
        No whole chunk with a message is in it.
    RecordingError
        The file cannot be read or is no MCAP file, or the new one cannot be written.
    """
    path = Path(path)
    files = bag_files(path)
    parts, lost = [], []
    for file in files:
        try:
            parts.append(_search(file, ratio))
        except RecordingError as error:
            if len(files) == 1:
                raise
            lost.append(f"all of {error}")
    if not any(m.channel_id in part.channels for part in parts for m in part.messages):
        raise NothingWholeError(f"{path}: nothing to recover: no whole chunk in it")
    target = free_path(path.with_name(f"{path.stem}_recovered.mcap")) if out is None else Path(out)
    try:
        with whole_file(target, replace=False) as beside:
            return _save(parts, lost, beside, target)
    except FileExistsError:
        raise RecordingError(f"{target}: cannot write: it exists") from None


class _Loss(NamedTuple):
    """Bytes ``start`` to ``end`` of a file that could not be read."""

    start: int
    end: int
    why: str
    after: int  # whole messages before it


def _search(path: Path, ratio: float) -> _Part:
    """Find what is whole in a file."""
    try:
        with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
            if data[: len(MCAP0_MAGIC)] != MCAP0_MAGIC:
                raise RecordingError(f"{path}: not an MCAP file")
            return _Part(path, data, ratio)
    except OSError as error:
        raise RecordingError(f"{path}: cannot read: {error.strerror or error}") from None
    except ValueError:  # an empty file makes no map
        raise RecordingError(f"{path}: not an MCAP file") from None


class _Part:
    """What is whole in one file, in its order."""

    def __init__(self, path: Path, data: mmap.mmap, ratio: float) -> None:
        self.path, self.size = path, len(data)
        self.chunks = self.unchecked = self.loose = 0  # chunks without checksum, messages outside
        self.schemas: dict[int, Schema] = {}
        self.channels: dict[int, Channel] = {}
        self.messages: list[Message] = []
        self.attachments: dict[str, Attachment] = {}
        self.metadata: dict[str, dict[str, str]] = {}
        self.losses: list[_Loss] = []
        #: Whether the data section as a whole fits its checksum; None where it carries none.
        self.verified: bool | None = False
        #: By a summary that is whole: messages, and names of attachments and metadata.
        self.written: int | None = None
        self.named: list[str] = []
        self._confirmed: set[tuple[type, int]] = set()  # definitions under a checksum
        self._data, self._left = data, allowance(len(data), ratio)
        self._summary, self._summary_confirmed = summary_of(data)
        self._walk()
        self._take_summary()
        del self._data

    @property
    def all_saved(self) -> bool:
        """Whether the summary confirms that no message is lost."""
        return self.written == len(self.messages)

    @property
    def doubtful_topics(self) -> int:
        """How many topics' names and types no checksum confirms."""
        return sum((Channel, number) not in self._confirmed for number in self.channels)

    def _walk(self) -> None:
        """Take in all records, and look for the next chunk behind each damage."""
        position = sure = len(MCAP0_MAGIC)
        while True:
            for start, end, record in self._records(position):
                if not self._take(record, start):
                    break
                position = end
                if isinstance(record, Chunk | Attachment):
                    sure = end  # nothing before it needs another look
                if isinstance(record, DataEnd):
                    if self._summary is None:
                        self._lose(end, self.size, "index and end mark damaged")
                    return
            found = self._next_chunk(sure)
            if found is None:
                break
            if found > position:
                self._lose(position, found, "damaged")
            position = sure = found
        if self._summary is not None:
            self._lose(position, max(self._summary, position), "damaged")
        elif position == self.size:
            self._lose(position, position, "the file ends without index and end mark")
        else:
            head = self._data[position : position + _HEAD.size]
            cut = len(head) < _HEAD.size or position + _HEAD.unpack(head)[1] >= self.size
            why = "the file ends within a record" if cut else "damaged, up to the file's end"
            self._lose(position, self.size, why)

    def _records(self, start: int) -> Iterator[tuple[int, int, McapRecord]]:
        """Yield place, end and content of the records from a place on, while they are whole."""
        data = self._data
        data.seek(start)
        reader = Records(data, skip_magic=True, emit_chunks=True, record_size_limit=self.size)
        with suppress(*DAMAGE):
            for record in reader.records:
                end, builder = data.tell(), RecordBuilder()
                record.write(builder)
                if builder.end() != data[start:end]:
                    return
                yield start, end, record
                start = end

    def _take(self, record: McapRecord, start: int) -> bool:
        """Take in a record; return whether it is whole."""
        if isinstance(record, Chunk):
            try:
                definitions, messages = records_in(unpacked(record, self._left))
            except DAMAGE:
                return False
            self._left -= record.uncompressed_size + _RECORD_COST * len(messages)
            self.chunks += 1
            self.unchecked += not record.uncompressed_crc
            for each in definitions:
                self._define(each, confirmed=bool(record.uncompressed_crc))
            self.messages += [Message(*each) for each in messages]
        elif isinstance(record, Attachment):
            self.attachments[record.name] = record
            if record.name == DEFINITIONS_ATTACHMENT:
                with suppress(*DAMAGE):
                    for each in StreamReader(BytesIO(record.data)).records:
                        self._define(each, confirmed=True)
        elif isinstance(record, Metadata):
            self.metadata[record.name] = dict(record.metadata)
        elif isinstance(record, Message):
            self.messages.append(record)
            self.loose += 1
        elif isinstance(record, DataEnd):
            self.verified = None
            if record.data_section_crc:
                crc = zlib.crc32(memoryview(self._data)[:start])
                self.verified = crc == record.data_section_crc
        else:
            self._define(record, confirmed=False)
        return True

    def _define(self, record: McapRecord, *, confirmed: bool) -> None:
        """Take in a type or a topic; one under a checksum stands over others."""
        if isinstance(record, Schema | Channel):
            key = (type(record), record.id)
            if confirmed or key not in self._confirmed:
                kind = self.schemas if isinstance(record, Schema) else self.channels
                kind[record.id] = record  # type: ignore[assignment]  # each in its own
            if confirmed:
                self._confirmed.add(key)

    def _next_chunk(self, sure: int) -> int | None:
        """Return where the next whole chunk begins; it may lie in what a wrong length skipped."""
        for match in _CHUNK_HEAD.finditer(self._data, sure):
            at = match.start()
            if self._may_be_chunk(at):
                _, _, record = next(self._records(at), (at, at, None))
                if isinstance(record, Chunk):
                    with suppress(*DAMAGE):
                        records_in(unpacked(record, self._left))
                        return at
        return None

    def _may_be_chunk(self, at: int) -> bool:
        """Whether the lengths in a chunk's head fit together; looks at nothing behind it."""
        with suppress(struct.error):
            _, length = _HEAD.unpack_from(self._data, at)
            *_, name = _CHUNK.unpack_from(self._data, at + _HEAD.size)
            if name <= len("zstd"):
                (size,) = _SIZE.unpack_from(self._data, at + _HEAD.size + _CHUNK.size + name)
                return bool(length == _CHUNK.size + name + _SIZE.size + size)
        return False

    def _take_summary(self) -> None:
        """Take from the summary, where a checksum confirms it, what it says of the rest."""
        if self._summary is None or not self._summary_confirmed:
            return
        reader = StreamReader(BytesIO(self._data[self._summary :]), skip_magic=True)
        with suppress(*DAMAGE):
            for record in reader.records:
                if isinstance(record, Statistics):
                    self.written = record.message_count
                elif isinstance(record, AttachmentIndex):
                    self.named.append(f"attachment {record.name}")
                elif isinstance(record, MetadataIndex):
                    self.named.append(f"metadata {record.name}")
                elif (type(record), getattr(record, "id", None)) not in self._confirmed:
                    self._define(record, confirmed=True)

    def _lose(self, start: int, end: int, why: str) -> None:
        self.losses.append(_Loss(start, end, why, len(self.messages)))


def _save(parts: list[_Part], lost: list[str], beside: Path, target: Path) -> Recovery:
    """Write what was found, and say what was not."""
    run, release = _run(parts), _release(parts)
    unconfirmed: list[str] = []
    for part in parts:
        where = f"{part.path.name}: " if len(parts) + len(lost) > 1 else ""
        losses, doubts = _said_of(part, run, release)
        lost += [where + line for line in losses]
        unconfirmed += [where + line for line in doubts]
    lost += _absent_parts(parts)
    with beside.open("xb") as file:
        writer = Writer(file, chunk_size=CHUNK_SIZE, enable_data_crcs=True)
        writer.start("ros2")
        unconfirmed += _describe(writer, parts, run)
        saved = _Saved(writer)
        for part in parts:
            if unknown := saved.add(part):
                lost.append(f"{part.path.name}: {unknown} messages of unknown topics")
        writer.flush()
        if lost or unconfirmed:
            entries = {"lost": "\n".join(lost), "unconfirmed": "\n".join(unconfirmed)}
            writer.add_metadata(RECOVERY_METADATA, entries)
        text = saved.bag_metadata(target.name)
        writer.add_metadata(BAG_METADATA, {"serialized_metadata": text})
        writer.finish()
    chunks = sum(part.chunks for part in parts)
    return Recovery(target, chunks, saved.by_topic, tuple(lost), tuple(unconfirmed))


class _Saved:
    """Messages of several files in a new one, each type and topic once."""

    def __init__(self, writer: Writer) -> None:
        self._writer = writer
        self._schemas: dict[tuple[str, str, bytes], int] = {}
        self._channels: dict[tuple[str, str, str], int] = {}  # by topic, type, encoding
        self._entries: dict[int, tuple[Channel, str]] = {}  # as registered, and its type
        self._counts: Counter[int] = Counter()
        self._times: list[int] = []

    def add(self, part: _Part) -> int:
        """Write a file's messages; return how many are of topics that nothing whole defines."""
        ids = {number: self._channel(part, number) for number in sorted(part.channels)}
        unknown = 0
        for m in part.messages:
            channel = ids.get(m.channel_id)
            if channel is None:
                unknown += 1
                continue
            self._writer.add_message(channel, m.log_time, m.data, m.publish_time, m.sequence)
            self._counts[channel] += 1
            self._times.append(m.log_time)
        return unknown

    @property
    def by_topic(self) -> dict[str, int]:
        """Messages by topic."""
        counts: Counter[str] = Counter()
        for i, (channel, _) in self._entries.items():
            counts[channel.topic] += self._counts[i]
        return dict(counts)

    def bag_metadata(self, name: str) -> str:
        """Return what rosbag2 wants to know."""
        topics = []
        for i, (channel, type_name) in self._entries.items():
            qos = None
            with suppress(yaml.YAMLError, ValueError, RecursionError):
                qos = yaml.safe_load(channel.metadata.get("offered_qos_profiles", ""))
            profiles = qos if isinstance(qos, list) else []
            hash_ = channel.metadata.get("topic_type_hash", "")
            topics.append(TopicEntry(channel.topic, type_name, profiles, hash_, self._counts[i]))
        file = FileEntry(name, min(self._times), max(self._times), len(self._times))
        return bag_metadata(topics, [file], {})

    def _channel(self, part: _Part, number: int) -> int:
        """Return the id of a topic in the new file, made when it is first needed."""
        entry = part.channels[number]
        schema = part.schemas.get(entry.schema_id)
        type_name = "" if schema is None else schema.name
        key = (entry.topic, type_name, entry.message_encoding)
        if key not in self._channels:
            schema_id = 0
            if schema is not None:
                text = (schema.name, schema.encoding, bytes(schema.data))
                if text not in self._schemas:
                    self._schemas[text] = self._writer.register_schema(*text)
                schema_id = self._schemas[text]
            made = self._writer.register_channel(
                entry.topic, entry.message_encoding, schema_id, entry.metadata
            )
            self._channels[key] = made
            self._entries[made] = (entry, type_name)
        return self._channels[key]


def _describe(writer: Writer, parts: list[_Part], run: RunDescription | None) -> list[str]:
    """Write attachments and metadata, each once; return which of them no checksum confirms."""
    attachments: dict[str, Attachment] = {}
    for part in parts:
        attachments = {**part.attachments, **attachments}
    for a in attachments.values():
        writer.add_attachment(a.create_time, a.log_time, a.name, a.media_type, a.data)
    unconfirmed = []
    done = {BAG_METADATA}  # it is made anew
    for part in parts:
        for name, entries in part.metadata.items():
            if name in done:
                continue
            done.add(name)
            if part.verified:
                writer.add_metadata(name, entries)
            elif name == RUN_METADATA and run is not None:
                # the announcement among the messages has a checksum
                writer.add_metadata(name, describing(run))
            else:
                writer.add_metadata(UNVERIFIED + name, entries)
                unconfirmed.append(f"metadata {name}, which has no checksum")
    if run is not None and RUN_METADATA not in done:
        writer.add_metadata(RUN_METADATA, describing(run))
    return unconfirmed


def _of_topics(parts: list[_Part], *topics: Topic) -> Iterator[tuple[Topic, Message]]:
    """Yield the messages of the bench's topics."""
    for part in parts:
        ids: dict[int, Topic] = {}
        for number, channel in part.channels.items():
            topic, schema = topic_named(channel.topic), part.schemas.get(channel.schema_id)
            if topic in topics and topic and schema and schema.name == topic.type_name:
                ids[number] = topic
        for message in part.messages:
            if message.channel_id in ids:
                yield ids[message.channel_id], message


def _run(parts: list[_Part]) -> RunDescription | None:
    """Return the description of the run from its announcement, where that is whole."""
    for topic, message in _of_topics(parts, RUN_INFO):
        with suppress(RecordingError):
            return RunDescription.of_message(decoded(topic, message.data))
    return None


def _release(parts: list[_Part]) -> int | None:
    """Return the log time of the release, ns; None where nothing whole holds it."""
    started = None
    for topic, message in _of_topics(parts, LAUNCH_COMMAND, BENCH_STATE):
        with suppress(RecordingError):
            if topic is LAUNCH_COMMAND:
                if decoded(topic, message.data).action == LaunchAction.RELEASE:
                    return message.log_time
            elif started is None:
                # simulated time, by whatever clock the log's is
                stamp = stamp_of(topic, message.data) or message.log_time
                started = message.log_time - stamp + EPOCH_NS
    return started


def _said_of(
    part: _Part, run: RunDescription | None, release: int | None
) -> tuple[list[str], list[str]]:
    """Return what was lost of a file, and what nothing confirms, in lines."""
    lost = [_in_words(part, loss, release) for loss in part.losses[:_MOST_LINES]]
    if more := part.losses[_MOST_LINES:]:
        size = sum(loss.end - loss.start for loss in more)
        lost.append(f"{len(more)} more places are damaged, {size} bytes in all")
    doubtful = []
    if part.loose and not part.verified:
        doubtful.append(f"{part.loose} messages outside chunks, which have no checksum")
    if part.written is not None and not part.all_saved:
        lost.append(f"{part.written - len(part.messages)} of {part.written} messages")
    if part.unchecked:
        doubtful.append(f"{part.unchecked} of {part.chunks} chunks, which have no checksum")
    if not part.verified and not lost and not doubtful:
        if part.verified is None:
            doubtful.append("what stands outside the chunks, which has no checksum")
        else:
            whole = f"; all {part.written} messages are saved" if part.all_saved else ""
            lost.append(f"some bytes outside chunks are damaged, in their index perhaps{whole}")
    if part.doubtful_topics and not part.verified:
        count = part.doubtful_topics
        doubtful.append(f"names and types of {count} topics, which have no checksum")
    there = {f"attachment {name}" for name in part.attachments}
    there |= {f"metadata {name}" for name in part.metadata}
    if run is not None:  # the announcement of the run holds the same
        there.add(f"metadata {RUN_METADATA}")
    for name in part.named:
        if name not in there:
            again = run is not None and name == f"attachment {SCENE_ATTACHMENT}"
            lost.append(name + "; the announced run holds the scene too" * again)
    return lost, doubtful


def _in_words(part: _Part, loss: _Loss, release: int | None) -> str:
    if loss.start == loss.end:
        return loss.why
    where = f"{loss.why}: bytes {loss.start} to {loss.end} of {part.size}"
    if part.all_saved:
        return f"{where} (no message was in them: all {part.written} are saved)"
    zero, meaning = (0, "of the log") if release is None else (release, "since the release")
    before, behind = part.messages[: loss.after][-1:], part.messages[loss.after :][:1]
    first, last = (
        "".join(f"{(m.log_time - zero) / 1e9:.3f} s" for m in some) for some in (before, behind)
    )
    if first and last:
        return f"{where} (any messages between {first} and {last} {meaning})"
    if first or last:
        return f"{where} (any messages {f'after {first}' if first else f'before {last}'} {meaning})"
    return where


def _absent_parts(parts: list[_Part]) -> list[str]:
    """Return a line for the parts of a split recording that are not there."""
    numbers = (part.metadata.get(RUN_METADATA, {}).get("part", "") for part in parts)
    there = {int(number) for number in numbers if number.isdecimal() and len(number) < 7}
    absent = sorted(set(range(max(there, default=0))) - there)
    lines = [f"part {number} of the recording is not there" for number in absent[:_MOST_LINES]]
    if len(absent) > _MOST_LINES:
        lines.append(f"{len(absent) - _MOST_LINES} more parts are not there")
    return lines
