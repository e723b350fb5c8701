"""Saving what is whole in a damaged recording into a new file, and saying what was lost.

A chunk is whole when it unpacks and its checksum fits.  Behind damage the next one is looked
for byte by byte, since a damaged length leads anywhere.
"""

from __future__ import annotations

import mmap
import re
import struct
import zlib
from collections import Counter
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path
from typing import Any, NamedTuple

import yaml
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import (
    Attachment,
    AttachmentIndex,
    Channel,
    Chunk,
    DataEnd,
    Footer,
    McapRecord,
    Message,
    MessageIndex,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
)
from mcap.stream_reader import StreamReader
from mcap.writer import MCAP0_MAGIC, Writer

from capture_sim.errors import RecordingError
from capture_sim.files import free_path, whole_file
from capture_sim.messages.convert import EPOCH_NS, LaunchAction, RunDescription
from capture_sim.messages.topics import (
    BENCH_STATE,
    LAUNCH_COMMAND,
    RUN_INFO,
    Topic,
    topic_named,
)
from capture_sim.recording.bag_metadata import FileEntry, TopicEntry, bag_metadata
from capture_sim.recording.cdr import stamp_of
from capture_sim.recording.contents import (
    DAMAGE,
    MESSAGE_HEAD,
    UNPACKED_RATIO,
    allowance,
    bag_files,
    definition,
    records_in,
    unpacked,
)
from capture_sim.recording.definitions import type_hash
from capture_sim.recording.live import decoded, described
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

_HEAD = struct.Struct("<BQ")  # opcode, length
_INDEX = struct.Struct("<HI")  # channel, bytes
_CHUNK = struct.Struct("<QQQII")  # first and last time, size, checksum, length of a name
_OPCODES = frozenset(Opcode)
_SIZE = struct.Struct("<Q")
#: Bytes that a record takes in memory beside its data.
_RECORD_COST = 300
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
    if not any(m.channel_id in part.known.channels for part in parts for m in part.messages):
        raise NothingWholeError(f"{path}: nothing to recover: no whole chunk in it")
    target = free_path(path.with_name(f"{path.stem}_recovered.mcap")) if out is None else Path(out)
    try:
        with whole_file(target, replace=False) as beside:
            saver = _Saver(parts, lost, several=len(files) > 1)
            return saver.save(beside, target)
    except OSError as error:
        raise RecordingError(f"{target}: cannot write: {error.strerror or error}") from None


@dataclass
class Definitions:
    """Types and topics, by id."""

    schemas: dict[int, Schema] = field(default_factory=dict)
    channels: dict[int, Channel] = field(default_factory=dict)

    def update(self, other: Definitions) -> None:
        """Let another's entries stand over these."""
        self.schemas.update(other.schemas)
        self.channels.update(other.channels)

    def add(self, record: McapRecord) -> None:
        """Take in a record, if it is a definition."""
        if isinstance(record, Schema):
            self.schemas[record.id] = record
        elif isinstance(record, Channel):
            self.channels[record.id] = record


class Loss(NamedTuple):
    """Bytes ``start`` to ``end`` of a file that could not be read."""

    start: int
    end: int
    why: str
    after: int | None  # log time of the whole chunk before, ns
    before: int | None  # ... and of the one behind


@dataclass
class Part:
    """What is whole in one file.

    Attributes
    ----------
    path, size
        Of the file, bytes.
    chunks, unchecked_chunks
        Whole ones, and how many of them carry no checksum.
    defined, bare
        Types and topics under a checksum, and without one.
    messages
        In the order of the file.
    loose
        How many of them stand outside chunks.
    attachments, metadata
        By name.
    losses
        What could not be read.
    verified
        Whether the data section as a whole fits its checksum.
    checked
        Whether it carries one.
    written
        Messages by the summary; None when it is not whole.
    named
        Attachments and metadata by the summary.
    """

    path: Path
    size: int
    chunks: int = 0
    unchecked_chunks: int = 0
    defined: Definitions = field(default_factory=Definitions)
    bare: Definitions = field(default_factory=Definitions)
    messages: list[Message] = field(default_factory=list)
    loose: int = 0
    attachments: dict[str, Attachment] = field(default_factory=dict)
    metadata: dict[str, dict[str, str]] = field(default_factory=dict)
    losses: list[Loss] = field(default_factory=list)
    verified: bool = False
    checked: bool = True
    written: int | None = None
    named: list[str] = field(default_factory=list)

    @property
    def known(self) -> Definitions:
        """Types and topics, those under a checksum before others."""
        known = Definitions()
        known.update(self.bare)
        known.update(self.defined)
        return known

    @property
    def all_saved(self) -> bool:
        """Whether the summary confirms that no message is lost."""
        return self.written == len(self.messages)


def _search(path: Path, ratio: float) -> Part:
    """Find what is whole in a file."""
    try:
        with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
            if data[: len(MCAP0_MAGIC)] != MCAP0_MAGIC:
                raise RecordingError(f"{path}: not an MCAP file")
            return _Search(path, data, allowance(len(data), ratio)).run()
    except OSError as error:
        raise RecordingError(f"{path}: cannot read: {error.strerror or error}") from None
    except ValueError:  # an empty file makes no map
        raise RecordingError(f"{path}: not an MCAP file") from None


class _Search:
    def __init__(self, path: Path, data: mmap.mmap, left: int) -> None:
        self._data = data
        self._left = left
        self._part = Part(path, len(data))
        self._last_time: int | None = None  # log time at the end of the last whole chunk
        self._open: list[tuple[int, int, str, int | None]] = []  # losses before the next chunk

    def run(self) -> Part:
        """Walk over the records, and look for the next chunk behind each damage."""
        data, position, sure = self._data, len(MCAP0_MAGIC), len(MCAP0_MAGIC)
        while position < len(data):
            record, end = self._record(position)
            if record is None or not self._take(record, position, end):
                found = self._next_chunk(sure)
                if found is None:
                    self._end(sure, position)
                    break
                if found > position:
                    self._lose(position, found, "damaged")
                position = sure = found
                continue
            if isinstance(record, Chunk | Attachment):
                sure = end  # nothing before it needs another look
            position = end
            if isinstance(record, DataEnd):
                self._summary(end)
                break
        else:
            self._lose(len(data), len(data), "the file ends without index and end mark")
        self._close_losses(None)
        return self._part

    def _record(self, position: int) -> tuple[McapRecord | None, int]:
        """Return the record at a place, and where it ends; None if it cannot be read."""
        if position + _HEAD.size > len(self._data):
            return None, position
        opcode, length = _HEAD.unpack_from(self._data, position)
        end = position + _HEAD.size + length
        if end > len(self._data) or opcode not in _OPCODES:
            return None, position
        if opcode == Opcode.MESSAGE_INDEX:  # is made anew; its own length must fit
            _, size = _INDEX.unpack_from(self._data, position + _HEAD.size)
            return (MessageIndex(0, []) if size == length - _INDEX.size else None), end
        stream = BytesIO(self._data[position:end])
        reader = StreamReader(stream, skip_magic=True, emit_chunks=True)
        with suppress(*DAMAGE):
            return next(iter(reader.records), None), end
        return None, position

    def _take(self, record: McapRecord, start: int, end: int) -> bool:
        """Take in a record; return whether it is whole."""
        part = self._part
        if isinstance(record, Chunk):
            return self._chunk(record)
        if isinstance(record, Attachment):
            builder = RecordBuilder()
            record.write(builder)
            if builder.end() != self._data[start:end]:  # its checksum is among that
                return False
            part.attachments[record.name] = record
            if record.name == DEFINITIONS_ATTACHMENT:
                with suppress(*DAMAGE):
                    for definition in StreamReader(BytesIO(record.data)).records:
                        part.defined.add(definition)
        elif isinstance(record, Metadata):
            part.metadata[record.name] = dict(record.metadata)
        elif isinstance(record, Message):
            part.messages.append(record)
            part.loose += 1
        elif isinstance(record, DataEnd):
            part.checked = bool(record.data_section_crc)
            crc = zlib.crc32(memoryview(self._data)[:start]) if part.checked else 0
            part.verified = part.checked and crc == record.data_section_crc
        else:
            part.bare.add(record)
        return True

    def _chunk(self, chunk: Chunk) -> bool:
        try:
            records = unpacked(chunk, self._left)
            inner = _inside(records)
        except DAMAGE:
            return False
        self._left -= len(records) + _RECORD_COST * len(inner)
        part = self._part
        part.chunks += 1
        part.unchecked_chunks += not chunk.uncompressed_crc
        where = part.defined if chunk.uncompressed_crc else part.bare
        messages = []
        for record in inner:
            where.add(record)
            if isinstance(record, Message):
                messages.append(record)
        part.messages += messages
        if messages:
            self._close_losses(min(message.log_time for message in messages))
            self._last_time = max(message.log_time for message in messages)
        return True

    def _next_chunk(self, sure: int) -> int | None:
        """Return where the next whole chunk begins; it may lie in what a wrong length skipped."""
        for match in _CHUNK_HEAD.finditer(self._data, sure):
            at = match.start()
            record, _ = self._record(at) if self._may_be_chunk(at) else (None, at)
            if isinstance(record, Chunk):
                with suppress(*DAMAGE):
                    _inside(unpacked(record, self._left))
                    return at
        return None

    def _may_be_chunk(self, at: int) -> bool:
        """Whether the lengths in a chunk's head fit together; looks at nothing behind it."""
        with suppress(struct.error):
            _, length = _HEAD.unpack_from(self._data, at)
            *_, name = _CHUNK.unpack_from(self._data, at + _HEAD.size)
            if name > len("zstd"):
                return False
            (size,) = _SIZE.unpack_from(self._data, at + _HEAD.size + _CHUNK.size + name)
            return bool(length == _CHUNK.size + name + _SIZE.size + size)
        return False

    def _end(self, sure: int, position: int) -> None:
        """Look for a whole summary behind damage, or say how the file ends."""
        data = self._data
        mark = _HEAD.pack(Opcode.DATA_END, 4)
        at = data.find(mark, sure)
        while at >= 0:
            if self._summary_is_whole(at + len(mark) + 4):
                if at > position:
                    self._lose(position, at, "damaged")
                self._summary(at + len(mark) + 4)
                return
            at = data.find(mark, at + 1)
        head = data[position : position + _HEAD.size]
        cut = len(head) < _HEAD.size or position + sum(_HEAD.unpack(head)[1:]) >= len(data)
        why = "the file ends within a record" if cut else "damaged, up to the file's end"
        self._lose(position, len(data), why)

    def _summary(self, start: int) -> None:
        """Take in the summary, if it is whole or nothing confirms it."""
        footer = self._footer(start)
        if footer is not None and not footer.summary_crc:
            return
        if not self._summary_is_whole(start):
            self._lose(start, len(self._data), "index and end mark damaged")
            return
        defined = Definitions()
        reader = StreamReader(BytesIO(self._data[start:]), skip_magic=True)
        with suppress(*DAMAGE):
            for record in reader.records:
                defined.add(record)
                if isinstance(record, Statistics):
                    self._part.written = record.message_count
                elif isinstance(record, AttachmentIndex):
                    self._part.named.append(f"attachment {record.name}")
                elif isinstance(record, MetadataIndex):
                    self._part.named.append(f"metadata {record.name}")
        defined.update(self._part.defined)
        self._part.defined = defined

    def _summary_is_whole(self, start: int) -> bool:
        """Whether the summary that begins there, up to the file's end, fits its checksum."""
        footer = self._footer(start)
        until = len(self._data) - len(MCAP0_MAGIC) - 4
        return (
            footer is not None
            and bool(footer.summary_crc)
            and zlib.crc32(self._data[start:until]) == footer.summary_crc
        )

    def _footer(self, start: int) -> Footer | None:
        """Return the footer of a summary that begins there; None without one."""
        place = len(self._data) - len(MCAP0_MAGIC) - 20 - _HEAD.size
        if place < start or self._data[-len(MCAP0_MAGIC) :] != MCAP0_MAGIC:
            return None
        record, _ = self._record(place)
        fits = isinstance(record, Footer) and record.summary_start in (0, start)
        return record if fits else None  # type: ignore[return-value]  # it is one

    def _lose(self, start: int, end: int, why: str) -> None:
        self._open.append((start, end, why, self._last_time))

    def _close_losses(self, before: int | None) -> None:
        self._part.losses += [Loss(*loss, before) for loss in self._open]
        self._open.clear()


def _inside(records: bytes) -> list[McapRecord]:
    """Return the definitions and messages of a chunk.

    Raises
    ------
    ValueError
        Its records do not fill it.
    """
    found: list[McapRecord] = []
    for opcode, start, end in records_in(records):
        if opcode == Opcode.MESSAGE:
            channel, sequence, log_time, publish_time = MESSAGE_HEAD.unpack_from(records, start)
            data = records[start + MESSAGE_HEAD.size : end]
            found.append(Message(channel, log_time, data, publish_time, sequence))
        elif (record := definition(records, opcode, start, end)) is not None:
            found.append(record)
    return found


class _Saver:
    """Writes what was found, and says what was not."""

    def __init__(self, parts: list[Part], lost: list[str], *, several: bool) -> None:
        self._parts = parts
        self._several = several
        self._losses = list(lost)
        self._unconfirmed: list[str] = []
        self._schemas: dict[tuple[str, str, bytes], int] = {}
        self._channels: dict[tuple[str, str, str], int] = {}  # by topic, type, encoding
        self._entries: dict[int, tuple[Channel, str]] = {}  # as registered, and its type
        self._counts: Counter[int] = Counter()

    def save(self, beside: Path, target: Path) -> Recovery:
        """Write all that was found."""
        run, release = self._run(), self._release()
        for part in self._parts:
            self._say(part, run, release)
        self._losses += _absent_parts(self._parts)
        with beside.open("xb") as file:
            self._writer = Writer(file, chunk_size=CHUNK_SIZE, enable_data_crcs=True)
            self._writer.start("ros2")
            self._describe(run)
            times = [time for part in self._parts for time in self._messages(part)] or [EPOCH_NS]
            self._writer.flush()
            notes = {"lost": self._losses, "unconfirmed": self._unconfirmed}
            if any(notes.values()):
                entries = {name: "\n".join(lines) for name, lines in notes.items()}
                self._writer.add_metadata(RECOVERY_METADATA, entries)
            entry = FileEntry(target.name, min(times), max(times), self._counts.total())
            text = self._bag_metadata(entry)
            self._writer.add_metadata(BAG_METADATA, {"serialized_metadata": text})
            self._writer.finish()
        counts: Counter[str] = Counter()
        for i, (channel, _) in self._entries.items():
            counts[channel.topic] += self._counts[i]
        chunks = sum(part.chunks for part in self._parts)
        lost, unconfirmed = tuple(self._losses), tuple(self._unconfirmed)
        return Recovery(target, chunks, dict(counts), lost, unconfirmed)

    def _messages(self, part: Part) -> Iterator[int]:
        """Write a file's messages; yield their log times."""
        known = part.known
        ids = {number: self._channel(known, number) for number in sorted(known.channels)}
        unknown = 0
        for message in part.messages:
            channel = ids.get(message.channel_id)
            if channel is None:
                unknown += 1
                continue
            self._writer.add_message(
                channel, message.log_time, message.data, message.publish_time, message.sequence
            )
            self._counts[channel] += 1
            yield message.log_time
        if unknown:
            self._losses.append(f"{part.path.name}: {unknown} messages of unknown topics")

    def _of_topics(self, *topics: Topic) -> Iterator[tuple[Topic, Message]]:
        """Yield the messages of the bench's topics whose type a checksum confirms."""
        for part in self._parts:
            ids = {
                i: topic
                for i, channel in part.defined.channels.items()
                if (topic := topic_named(channel.topic)) in topics
                and topic is not None
                and channel.metadata.get("topic_type_hash") == type_hash(topic.type_name)
            }
            for message in part.messages:
                if message.channel_id in ids:
                    yield ids[message.channel_id], message

    def _run(self) -> RunDescription | None:
        """Return the description of the run from its announcement, where that is whole."""
        for topic, message in self._of_topics(RUN_INFO):
            with suppress(RecordingError):
                return described(decoded(topic, message.data))
        return None

    def _release(self) -> int | None:
        """Return the log time of the release, ns; None where nothing whole holds it."""
        started = None
        for topic, message in self._of_topics(LAUNCH_COMMAND, BENCH_STATE):
            with suppress(RecordingError):
                if topic is LAUNCH_COMMAND:
                    if decoded(topic, message.data).action == LaunchAction.RELEASE:
                        return message.log_time
                elif started is None:
                    # simulated time, by whatever clock the log's is
                    stamp = stamp_of(topic, message.data) or message.log_time
                    started = message.log_time - stamp + EPOCH_NS
        return started

    def _say(self, part: Part, run: RunDescription | None, release: int | None) -> None:
        """Note what was lost of a file, and what nothing confirms."""
        lost: list[str] = []
        doubtful: list[str] = []
        for loss in part.losses[:_MOST_LINES]:
            lost.append(_in_words(part, loss, release))
        if more := part.losses[_MOST_LINES:]:
            size = sum(loss.end - loss.start for loss in more)
            lost.append(f"{len(more)} more places are damaged, {size} bytes in all")
        if part.loose and not part.verified:
            doubtful.append(f"{part.loose} messages outside chunks, which have no checksum")
        if part.written is not None and not part.all_saved:
            lost.append(f"{part.written - len(part.messages)} of {part.written} messages")
        if part.unchecked_chunks:
            doubtful.append(
                f"{part.unchecked_chunks} of {part.chunks} chunks, which have no checksum"
            )
        if not part.verified and not lost and not doubtful:
            if part.checked:
                whole = f"; all {part.written} messages are saved" if part.all_saved else ""
                lost.append(f"some bytes outside chunks are damaged, in their index perhaps{whole}")
            else:
                doubtful.append("what stands outside the chunks, which has no checksum")
        bare = set(part.bare.channels) - set(part.defined.channels)
        if bare and not part.verified:
            doubtful.append(f"names and types of {len(bare)} topics, which have no checksum")
        there = {f"attachment {name}" for name in part.attachments}
        there |= {f"metadata {name}" for name in part.metadata}
        for name in part.named:
            # the announcement of the run holds the same
            if name in there or (run is not None and name == f"metadata {RUN_METADATA}"):
                continue
            again = run is not None and name == f"attachment {SCENE_ATTACHMENT}"
            lost.append(name + "; the announced run holds the scene too" * again)
        where = f"{part.path.name}: " if self._several else ""
        self._losses += [where + line for line in lost]
        self._unconfirmed += [where + line for line in doubtful]

    def _describe(self, run: RunDescription | None) -> None:
        """Write attachments and metadata: each once, what no checksum confirms marked so."""
        attachments: dict[str, Attachment] = {}
        for part in self._parts:
            attachments = {**part.attachments, **attachments}
        for a in attachments.values():
            self._writer.add_attachment(a.create_time, a.log_time, a.name, a.media_type, a.data)
        done = {BAG_METADATA}  # it is made anew
        for part in self._parts:
            for name, entries in part.metadata.items():
                if name in done:
                    continue
                done.add(name)
                if part.verified:
                    self._writer.add_metadata(name, entries)
                elif name == RUN_METADATA and run is not None:
                    # the announcement among the messages has a checksum
                    self._writer.add_metadata(name, describing(run))
                else:
                    self._writer.add_metadata(UNVERIFIED + name, entries)
                    self._unconfirmed.append(f"metadata {name}, which has no checksum")
        if run is not None and RUN_METADATA not in done:
            self._writer.add_metadata(RUN_METADATA, describing(run))

    def _channel(self, known: Definitions, number: int) -> int:
        """Return the id of a topic in the new file, made when it is first needed."""
        entry = known.channels[number]
        schema = known.schemas.get(entry.schema_id)
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

    def _bag_metadata(self, file: FileEntry) -> str:
        topics = []
        for i, (channel, type_name) in self._entries.items():
            qos: Any = None
            with suppress(yaml.YAMLError, ValueError, RecursionError):
                qos = yaml.safe_load(channel.metadata.get("offered_qos_profiles", ""))
            profiles = qos if isinstance(qos, list) else []
            hash_ = channel.metadata.get("topic_type_hash", "")
            topics.append(TopicEntry(channel.topic, type_name, profiles, hash_, self._counts[i]))
        return bag_metadata(topics, [file], {})


def _in_words(part: Part, loss: Loss, release: int | None) -> str:
    if loss.start == loss.end:
        return loss.why
    where = f"bytes {loss.start} to {loss.end} of {part.size}"
    if part.all_saved:
        where += f" (no message was in them: all {part.written} are saved)"
    elif loss.after is not None or loss.before is not None:
        where += f" (any messages {_between(loss.after, loss.before, release)})"
    return f"{loss.why}: {where}"


def _absent_parts(parts: list[Part]) -> list[str]:
    """Return a line for the parts of a split recording that are not there."""
    numbers = (part.metadata.get(RUN_METADATA, {}).get("part", "") for part in parts)
    there = {int(number) for number in numbers if number.isdecimal() and len(number) < 7}
    absent = sorted(set(range(max(there, default=0))) - there)
    lines = [f"part {number} of the recording is not there" for number in absent[:_MOST_LINES]]
    if len(absent) > _MOST_LINES:
        lines.append(f"{len(absent) - _MOST_LINES} more parts are not there")
    return lines


def _between(after: int | None, before: int | None, release: int | None) -> str:
    """Return an interval of log times in words, since the release where that is known."""
    zero, meaning = (0, "of the log") if release is None else (release, "since the release")
    first, last = (
        "" if time is None else f"{(time - zero) / 1e9:.3f} s" for time in (after, before)
    )
    if first and last:
        return f"between {first} and {last} {meaning}"
    return f"before {last} {meaning}" if last else f"after {first} {meaning}"
