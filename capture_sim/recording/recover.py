"""Saving what is whole in a damaged recording into a new file, and saying what was lost."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass
from mmap import mmap
from pathlib import Path

from mcap.records import Attachment, Channel, Chunk, DataEnd, Metadata, Schema
from mcap.writer import MCAP0_MAGIC

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
from capture_sim.recording.bag_file import BAG_METADATA, BagFile, TopicEntry, profiles_in
from capture_sim.recording.contents import bag_files
from capture_sim.recording.scan import (
    UNPACKED_RATIO,
    Damage,
    Whole,
    data_fit,
    definitions_in,
    index_of,
    mapped,
    scan,
)
from capture_sim.recording.write import (
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
    """What came of recovering a file."""

    path: Path  # of the new file
    chunks: int  # how many were saved
    messages: dict[str, int]  # how many were saved, by topic
    losses: tuple[str, ...]  # a line for everything that was lost; empty if nothing was
    # a line for everything that was saved and that no checksum confirms
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
    target = free_path(path.with_name(f"{path.stem}_recovered.mcap")) if out is None else Path(out)
    try:
        with whole_file(target, replace=False) as beside, beside.open("xb") as file:
            rescue = _Rescue(BagFile(file, target.name))
            for part in files:
                try:
                    rescue.add(part, ratio)
                except RecordingError as error:
                    if len(files) == 1:
                        raise
                    rescue.lost.append(f"all of {error}")
            if rescue.bag.span is None:
                raise NothingWholeError(f"{path}: nothing to recover: no whole chunk in it")
            return rescue.finish(target, several=len(files) > 1)
    except FileExistsError:
        raise RecordingError(f"{target}: cannot write: it exists") from None


@dataclass
class _Loss:
    """Bytes ``start`` to ``end`` of a file, and the log times (ns) of messages next to them."""

    start: int
    end: int
    why: str
    before: int | None
    behind: int | None = None


class _Part:
    """What is known of one file beside its messages."""

    def __init__(self, path: Path, data: mmap) -> None:
        self.path, self.size = path, len(data)
        self.messages = self.unknown = 0  # of them of topics that nothing whole defines
        self.chunks = self.unchecked = 0  # of them without checksum
        self.loose = False  # messages stand outside chunks
        self.metadata: dict[str, dict[str, str]] = {}
        self.whole: set[str] = set()  # attachments and metadata
        self.losses: list[_Loss] = []
        #: Whether the data section as a whole fits its checksum; None where it carries none.
        self.verified: bool | None = False
        #: By a summary that is whole: messages, attachments and metadata.
        self.written: int | None = None
        self.named: list[str] = []
        self.schemas: dict[int, Schema] = {}
        self.channels: dict[int, Channel] = {}
        self.ids: dict[int, int] = {}  # of the channels in the new file
        self._confirmed: set[tuple[type, int]] = set()  # definitions under a checksum
        self._last: int | None = None  # log time

    @property
    def all_saved(self) -> bool:
        """Whether the summary confirms that no message is lost."""
        return self.written == self.messages

    @property
    def outside(self) -> bool:
        """Whether messages, or topics' names and types, are known from outside the chunks only."""
        return self.loose or any((Channel, i) not in self._confirmed for i in self.channels)

    def define(self, record: Schema | Channel, *, confirmed: bool) -> None:
        """Take in a type or a topic; one under a checksum stands over others."""
        key = (type(record), record.id)
        if confirmed or key not in self._confirmed:
            kind = self.schemas if isinstance(record, Schema) else self.channels
            kind[record.id] = record  # type: ignore[assignment]  # each in its own
            self.ids.clear()
        if confirmed:
            self._confirmed.add(key)

    def lose(self, start: int, end: int, why: str) -> None:
        """Note bytes that could not be read."""
        self.losses.append(_Loss(start, end, why, self._last))

    def passed(self, log_time: int) -> None:
        """Note a message, ns."""
        self.messages += 1
        self._last = log_time
        if self.losses and self.losses[-1].behind is None:
            self.losses[-1].behind = log_time


class _Rescue:
    """Writes what is whole of one or more files into a new one as it is found."""

    def __init__(self, bag: BagFile) -> None:
        self.bag = bag
        self._writer = bag.writer
        self.lost: list[str] = []
        self._parts: list[_Part] = []
        self._channels: dict[tuple[str, str, str], int] = {}  # by topic, type, encoding
        self._descriptive: dict[int, Topic] = {}  # channels that describe the run
        self._done = {BAG_METADATA}  # attachments and metadata that are written; it is made anew
        self._run: RunDescription | None = None
        self._released: int | None = None  # log time, ns
        self._zero: int | None = None  # log time of the first state less its time, ns

    def add(self, path: Path, ratio: float) -> None:
        """Write what is whole of a file.

        Raises
        ------
        RecordingError
            It cannot be read, or is no MCAP file.
        """
        with mapped(path) as data:
            part, index, gap, end = _Part(path, data), index_of(data), None, len(MCAP0_MAGIC)
            self._parts.append(part)
            if index is not None and index.confirmed:
                summary = index.summary
                part.written = summary.statistics and summary.statistics.message_count
                part.named += [f"attachment {each.name}" for each in summary.attachment_indexes]
                part.named += [f"metadata {each.name}" for each in summary.metadata_indexes]
                for each in (*summary.schemas.values(), *summary.channels.values()):
                    part.define(each, confirmed=True)
            for found in scan(data, ratio):
                if isinstance(found, Damage):
                    gap = found
                    continue
                if gap is not None and found.start > gap.start:
                    part.lose(gap.start, found.start, "damaged")
                gap, end = None, found.end
                self._take(part, found)
                if isinstance(found.record, DataEnd):
                    part.verified = data_fit(data, found)
            for number in sorted(part.channels):  # those without a message too
                self._channel(part, number)
            if gap is None:
                if index is None:
                    part.lose(end, part.size, "index and end mark damaged")
            elif index is not None:
                part.lose(gap.start, max(index.start, gap.start), "damaged")
            elif gap.start == part.size:
                part.lose(gap.start, gap.start, "the file ends without index and end mark")
            elif gap.cut:
                part.lose(gap.start, part.size, "the file ends within a record")
            else:
                part.lose(gap.start, part.size, "damaged, up to the file's end")

    def finish(self, target: Path, *, several: bool) -> Recovery:
        """Write what is known at the end; return what came of it, for a file of this name."""
        unconfirmed: list[str] = []
        for part in self._parts:
            where = f"{part.path.name}: " if several else ""
            losses, doubts = self._summary_of(part)
            self.lost += [where + line for line in losses]
            unconfirmed += [where + line for line in doubts]
        self.lost += _absent(self._parts)
        unconfirmed += self._add_metadata()
        self._writer.flush()
        if self.lost or unconfirmed:
            entries = {"lost": "\n".join(self.lost), "unconfirmed": "\n".join(unconfirmed)}
            self._writer.add_metadata(RECOVERY_METADATA, entries)
        self.bag.finish({})
        chunks = sum(part.chunks for part in self._parts)
        return Recovery(target, chunks, self.bag.counts, tuple(self.lost), tuple(unconfirmed))

    def _take(self, part: _Part, found: Whole) -> None:
        record, checked = found.record, False
        if isinstance(record, Chunk):
            checked = bool(record.uncompressed_crc)
            part.chunks += 1
            part.unchecked += not checked
        elif isinstance(record, Attachment):
            if record.name == DEFINITIONS_ATTACHMENT:
                for each in definitions_in(record):
                    part.define(each, confirmed=True)
            part.whole.add(name := f"attachment {record.name}")
            if name not in self._done:
                self._done.add(name)
                fields = (record.name, record.media_type, record.data)
                self._writer.add_attachment(record.create_time, record.log_time, *fields)
        elif isinstance(record, Metadata):
            part.whole.add(f"metadata {record.name}")
            part.metadata[record.name] = dict(record.metadata)
        elif isinstance(record, Schema | Channel):
            part.define(record, confirmed=False)
        elif found.messages:
            part.loose = True
        for each in found.definitions:
            part.define(each, confirmed=checked)
        for number, log_time, data, *more in found.messages:
            part.passed(log_time)
            channel = part.ids.get(number) or self._channel(part, number)
            if not channel:
                part.unknown += 1
                continue
            self.bag.add(channel, log_time, data, *more)
            if channel in self._descriptive:
                self._learn(self._descriptive[channel], log_time, data)

    def _channel(self, part: _Part, number: int) -> int:
        """Return a topic's id in the new file, made when first needed; 0 if nothing defines it."""
        known = part.channels.get(number)
        if known is None:
            return 0
        schema = part.schemas.get(known.schema_id)
        type_name = "" if schema is None else schema.name
        key = (known.topic, type_name, known.message_encoding)
        if key not in self._channels:
            profiles = profiles_in(known.metadata.get("offered_qos_profiles", ""))
            type_hash = known.metadata.get("topic_type_hash", "")
            entry = TopicEntry(known.topic, type_name, profiles, type_hash, 0)
            definition = schema and (schema.name, schema.encoding, bytes(schema.data))
            made = self.bag.add_topic(entry, known.message_encoding, definition, known.metadata)
            self._channels[key] = made
            topic = topic_named(known.topic)
            if topic in (RUN_INFO, LAUNCH_COMMAND, BENCH_STATE) and topic.type_name == type_name:
                self._descriptive[made] = topic
        part.ids[number] = self._channels[key]
        return part.ids[number]

    def _learn(self, topic: Topic, log_time: int, data: bytes) -> None:
        """Learn from a message how the run was announced, and when it was released."""
        with suppress(RecordingError):
            if topic is RUN_INFO and self._run is None:
                self._run = RunDescription.of_message(decoded(topic, data))
            elif topic is LAUNCH_COMMAND and self._released is None:
                if decoded(topic, data).action == LaunchAction.RELEASE:
                    self._released = log_time
            elif topic is BENCH_STATE and self._zero is None:
                # simulated time, by whatever clock the log's is
                self._zero = log_time - (stamp_of(topic, data) or log_time) + EPOCH_NS

    def _add_metadata(self) -> list[str]:
        """Write all metadata once; return which of it no checksum confirms."""
        run, unconfirmed = self._run, []
        for part in self._parts:
            for name, entries in part.metadata.items():
                if name in self._done:
                    continue
                self._done.add(name)
                if part.verified:
                    self._writer.add_metadata(name, entries)
                elif name == RUN_METADATA and run is not None:
                    # the announcement among the messages has a checksum
                    self._writer.add_metadata(name, describing(run))
                else:
                    self._writer.add_metadata(UNVERIFIED + name, entries)
                    unconfirmed.append(f"metadata {name}, which has no checksum")
        if run is not None and RUN_METADATA not in self._done:
            self._writer.add_metadata(RUN_METADATA, describing(run))
        return unconfirmed

    def _summary_of(self, part: _Part) -> tuple[list[str], list[str]]:
        """Return what was lost of a file, and what nothing confirms, in lines."""
        lost = [self._in_words(part, loss) for loss in part.losses[:_MOST_LINES]]
        if more := part.losses[_MOST_LINES:]:
            size = sum(loss.end - loss.start for loss in more)
            lost.append(f"{len(more)} more places are damaged, {size} bytes in all")
        if part.written is not None and not part.all_saved:
            lost.append(f"{part.written - part.messages} of {part.written} messages")
        if part.unknown:
            lost.append(f"{part.unknown} messages of unknown topics")
        doubtful = []
        if part.unchecked:
            doubtful.append(f"{part.unchecked} of {part.chunks} chunks, which have no checksum")
        if part.verified is None or (part.outside and not part.verified):
            doubtful.append("what stands outside the chunks, which has no checksum")
        if part.verified is False and not lost and not doubtful:
            whole = f"; all {part.written} messages are saved" if part.all_saved else ""
            lost.append(f"some bytes outside chunks are damaged, in their index perhaps{whole}")
        announced = self._run is not None  # which holds the same
        for name in part.named:
            if name not in part.whole and not (announced and name == f"metadata {RUN_METADATA}"):
                again = announced and name == f"attachment {SCENE_ATTACHMENT}"
                lost.append(name + "; the announced run holds the scene too" * again)
        return lost, doubtful

    def _in_words(self, part: _Part, loss: _Loss) -> str:
        if loss.start == loss.end:
            return loss.why
        where = f"{loss.why}: bytes {loss.start} to {loss.end} of {part.size}"
        if part.all_saved:
            return f"{where} (no message was in them: all {part.written} are saved)"
        zero, meaning = self._zero, "since the release"
        if self._released is not None:
            zero = self._released
        if zero is None:
            zero, meaning = 0, "of the log"
        first, last = (
            "" if t is None else f"{(t - zero) / 1e9:.3f} s" for t in (loss.before, loss.behind)
        )
        if first and last:
            return f"{where} (any messages between {first} and {last} {meaning})"
        if first or last:
            side = f"after {first}" if first else f"before {last}"
            return f"{where} (any messages {side} {meaning})"
        return where


def _absent(parts: list[_Part]) -> list[str]:
    """Return which parts of a split recording are not there, in a line."""
    numbers = (part.metadata.get(RUN_METADATA, {}).get("part", "") for part in parts)
    there = {int(number) for number in numbers if number.isdecimal() and len(number) < 7}
    absent = sorted(set(range(max(there, default=0))) - there)
    shown = ", ".join(map(str, absent[:_MOST_LINES])) + ", ..." * (len(absent) > _MOST_LINES)
    return [f"part {shown} of the recording is not there"] if absent else []
