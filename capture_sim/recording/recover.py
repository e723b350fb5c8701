"""Saving what is whole in a damaged recording into a new file, and saying what was lost."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from mmap import mmap
from pathlib import Path
from typing import NamedTuple

import yaml
from mcap.records import Attachment, Channel, Chunk, DataEnd, Metadata, Schema
from mcap.writer import MCAP0_MAGIC, Writer

from capture_sim.errors import RecordingError
from capture_sim.files import free_path, whole_file
from capture_sim.messages.cdr import stamp_of
from capture_sim.messages.convert import EPOCH_NS, LaunchAction, RunDescription
from capture_sim.messages.definitions import decoded
from capture_sim.messages.topics import (
    BENCH_STATE,
    LAUNCH_COMMAND,
    RUN_INFO,
    Topic,
    topic_named,
)
from capture_sim.recording.bag_metadata import FileEntry, TopicEntry, bag_metadata
from capture_sim.recording.contents import bag_files
from capture_sim.recording.scan import (
    UNPACKED_RATIO,
    Damage,
    Stored,
    Whole,
    data_fit,
    definitions_in,
    index_of,
    mapped,
    scan,
)
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
            with mapped(file) as data:
                parts.append(_Part(file, data, ratio))
        except RecordingError as error:
            if len(files) == 1:
                raise
            lost.append(f"all of {error}")
    if not any(channel in part.channels for part in parts for channel, *_ in part.messages):
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


class _Part:
    """What is whole in one file, in its order."""

    def __init__(self, path: Path, data: mmap, ratio: float) -> None:
        self.path, self.size = path, len(data)
        self.chunks = self.unchecked = 0  # of them without checksum
        self.loose = False  # messages stand outside chunks
        self.schemas: dict[int, Schema] = {}
        self.channels: dict[int, Channel] = {}
        self.messages: list[Stored] = []
        self.attachments: dict[str, Attachment] = {}
        self.metadata: dict[str, dict[str, str]] = {}
        self.losses: list[_Loss] = []
        #: Whether the data section as a whole fits its checksum; None where it carries none.
        self.verified: bool | None = False
        #: By a summary that is whole: messages, and names of attachments and metadata.
        self.written: int | None = None
        self.named: list[str] = []
        self._confirmed: set[tuple[type, int]] = set()  # definitions under a checksum
        self._scan(data, ratio)

    @property
    def all_saved(self) -> bool:
        """Whether the summary confirms that no message is lost."""
        return self.written == len(self.messages)

    @property
    def outside(self) -> bool:
        """Whether messages, or topics' names and types, are known from outside the chunks only."""
        topics = {(Channel, number) for number in self.channels}
        return self.loose or not topics <= self._confirmed

    def _scan(self, data: mmap, ratio: float) -> None:
        """Take in all that is whole, and note what is not."""
        index, end, gap = index_of(data), len(MCAP0_MAGIC), None
        for found in scan(data, ratio):
            if isinstance(found, Damage):
                gap = found
                continue
            if gap is not None and found.start > gap.start:
                self._lose(gap.start, found.start, "damaged")
            gap, end = None, found.end
            self._take(found)
            if isinstance(found.record, DataEnd):
                self.verified = data_fit(data, found)
        if index is not None and index.confirmed:
            summary = index.summary
            self.written = summary.statistics and summary.statistics.message_count
            self.named += [f"attachment {each.name}" for each in summary.attachment_indexes]
            self.named += [f"metadata {each.name}" for each in summary.metadata_indexes]
            for each in (*summary.schemas.values(), *summary.channels.values()):
                if (type(each), each.id) not in self._confirmed:
                    self._define(each, confirmed=True)
        if gap is None:
            if index is None:
                self._lose(end, self.size, "index and end mark damaged")
        elif index is not None:
            self._lose(gap.start, max(index.start, gap.start), "damaged")
        elif gap.start == self.size:
            self._lose(self.size, self.size, "the file ends without index and end mark")
        elif gap.cut:
            self._lose(gap.start, self.size, "the file ends within a record")
        else:
            self._lose(gap.start, self.size, "damaged, up to the file's end")

    def _take(self, found: Whole) -> None:
        record, checked = found.record, False
        if isinstance(record, Chunk):
            checked = bool(record.uncompressed_crc)
            self.chunks += 1
            self.unchecked += not checked
        elif isinstance(record, Attachment):
            self.attachments[record.name] = record
            if record.name == DEFINITIONS_ATTACHMENT:
                for each in definitions_in(record):
                    self._define(each, confirmed=True)
        elif isinstance(record, Metadata):
            self.metadata[record.name] = dict(record.metadata)
        elif isinstance(record, Schema | Channel):
            self._define(record, confirmed=False)
        else:
            self.loose |= bool(found.messages)
        for each in found.definitions:
            self._define(each, confirmed=checked)
        self.messages += found.messages

    def _define(self, record: Schema | Channel, *, confirmed: bool) -> None:
        """Take in a type or a topic; one under a checksum stands over others."""
        key = (type(record), record.id)
        if confirmed or key not in self._confirmed:
            kind = self.schemas if isinstance(record, Schema) else self.channels
            kind[record.id] = record  # type: ignore[assignment]  # each in its own
        if confirmed:
            self._confirmed.add(key)

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
        for number, log_time, *rest in part.messages:
            channel = ids.get(number)
            if channel is None:
                unknown += 1
                continue
            self._writer.add_message(channel, log_time, *rest)
            self._counts[channel] += 1
            self._times.append(log_time)
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


def _of_topics(parts: list[_Part], *topics: Topic) -> Iterator[tuple[Topic, int, bytes]]:
    """Yield topic, log time (ns) and bytes of the messages of the bench's topics."""
    for part in parts:
        ids: dict[int, Topic] = {}
        for number, channel in part.channels.items():
            topic, schema = topic_named(channel.topic), part.schemas.get(channel.schema_id)
            if topic in topics and topic and schema and schema.name == topic.type_name:
                ids[number] = topic
        for number, log_time, data, *_ in part.messages:
            if number in ids:
                yield ids[number], log_time, data


def _run(parts: list[_Part]) -> RunDescription | None:
    """Return the description of the run from its announcement, where that is whole."""
    for topic, _, data in _of_topics(parts, RUN_INFO):
        with suppress(RecordingError):
            return RunDescription.of_message(decoded(topic, data))
    return None


def _release(parts: list[_Part]) -> int | None:
    """Return the log time of the release, ns; None where nothing whole holds it."""
    started = None
    for topic, log_time, data in _of_topics(parts, LAUNCH_COMMAND, BENCH_STATE):
        with suppress(RecordingError):
            if topic is LAUNCH_COMMAND:
                if decoded(topic, data).action == LaunchAction.RELEASE:
                    return log_time
            elif started is None:
                # simulated time, by whatever clock the log's is
                started = log_time - (stamp_of(topic, data) or log_time) + EPOCH_NS
    return started


def _said_of(
    part: _Part, run: RunDescription | None, release: int | None
) -> tuple[list[str], list[str]]:
    """Return what was lost of a file, and what nothing confirms, in lines."""
    lost = [_in_words(part, loss, release) for loss in part.losses[:_MOST_LINES]]
    if more := part.losses[_MOST_LINES:]:
        size = sum(loss.end - loss.start for loss in more)
        lost.append(f"{len(more)} more places are damaged, {size} bytes in all")
    if part.written is not None and not part.all_saved:
        lost.append(f"{part.written - len(part.messages)} of {part.written} messages")
    doubtful = []
    if part.unchecked:
        doubtful.append(f"{part.unchecked} of {part.chunks} chunks, which have no checksum")
    if part.verified is None or (part.outside and not part.verified):
        doubtful.append("what stands outside the chunks, which has no checksum")
    if part.verified is False and not lost and not doubtful:
        whole = f"; all {part.written} messages are saved" if part.all_saved else ""
        lost.append(f"some bytes outside chunks are damaged, in their index perhaps{whole}")
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
        "".join(f"{(log_time - zero) / 1e9:.3f} s" for _, log_time, *_ in some)
        for some in (before, behind)
    )
    if first and last:
        return f"{where} (any messages between {first} and {last} {meaning})"
    if first or last:
        return f"{where} (any messages {f'after {first}' if first else f'before {last}'} {meaning})"
    return where


def _absent_parts(parts: list[_Part]) -> list[str]:
    """Return which parts of a split recording are not there, in a line."""
    numbers = (part.metadata.get(RUN_METADATA, {}).get("part", "") for part in parts)
    there = {int(number) for number in numbers if number.isdecimal() and len(number) < 7}
    absent = sorted(set(range(max(there, default=0))) - there)
    shown = ", ".join(map(str, absent[:_MOST_LINES])) + ", ..." * (len(absent) > _MOST_LINES)
    return [f"part {shown} of the recording is not there"] if absent else []
