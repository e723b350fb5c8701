"""Finding what is whole in a damaged MCAP file.

A chunk is whole when it unpacks and its checksum fits; one that was written without a checksum,
as other writers may, when it unpacks to whole records, and is counted apart.
Behind damage the next whole chunk is looked for byte by byte, since a damaged length leads
anywhere.
"""

from __future__ import annotations

import re
import struct
import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from io import BytesIO
from typing import TypeVar

from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import (
    Attachment,
    AttachmentIndex,
    Channel,
    Chunk,
    Footer,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
)
from mcap.stream_reader import get_chunk_data_stream
from mcap.writer import MCAP0_MAGIC

from capture_sim.recording.records import DAMAGE

_RECORD = struct.Struct("<BQ")
_MESSAGE = struct.Struct("<HIQQ")  # channel, sequence, log time, publish time
_CRC = struct.Struct("<I")
_U4 = struct.Struct("<I")
_FOOTER_LENGTH = 20
#: What stands in a file beside messages, in words.
ATTACHMENT, METADATA = "attachment", "metadata"
# opcode of a chunk, and a length below 4 GB; looked ahead, so that hits may overlap
_CHUNK_HEAD = re.compile(rb"(?=\x06[\s\S]{4}\x00\x00\x00\x00)")

_T = TypeVar("_T")


@dataclass
class Definitions:
    """Types and topics of a file, by id."""

    schemas: dict[int, Schema] = field(default_factory=dict)
    channels: dict[int, Channel] = field(default_factory=dict)

    def update(self, other: Definitions) -> None:
        """Let another's entries stand over these."""
        self.schemas.update(other.schemas)
        self.channels.update(other.channels)


@dataclass
class Loss:
    """A stretch of a file that could not be read: bytes ``start`` to ``end``."""

    start: int
    end: int
    why: str
    after: int | None = None  # log time of the whole chunk before, ns
    before: int | None = None  # ... and of the one behind


@dataclass
class Findings:
    """What is whole in a file.

    Attributes
    ----------
    chunks
        Start and end of the body of each whole chunk, in order.
    unconfirmed
        How many of them carry no checksum.
    defined
        Types and topics under a checksum: in whole chunks, or in a whole summary.
    bare
        The same where no checksum covers them.
    attachments
        Whole ones, by name.
    metadata
        By name; under a checksum only if ``verified``.
    inside
        Messages in whole chunks.
    loose
        Start and end of the bodies of messages outside chunks, under a checksum only if
        ``verified``.
    losses
        Stretches that could not be read.
    verified
        The whole data section fits its checksum.
    unchecked
        The file was closed, and the data section carries no checksum.
    written
        Messages that the file's summary tells; None when the summary is not whole.
    named
        Attachments and metadata that the summary tells, in words and by name.
    """

    chunks: list[tuple[int, int]] = field(default_factory=list)
    unconfirmed: int = 0
    defined: Definitions = field(default_factory=Definitions)
    bare: Definitions = field(default_factory=Definitions)
    attachments: dict[str, Attachment] = field(default_factory=dict)
    metadata: dict[str, dict[str, str]] = field(default_factory=dict)
    inside: int = 0
    loose: list[tuple[int, int]] = field(default_factory=list)
    losses: list[Loss] = field(default_factory=list)
    verified: bool = False
    unchecked: bool = False
    written: int | None = None
    named: list[tuple[str, str]] = field(default_factory=list)

    @property
    def saved(self) -> int:
        """Messages in whole chunks and outside chunks."""
        return self.inside + len(self.loose)

    @property
    def all_saved(self) -> bool:
        """Whether the summary confirms that no message is lost."""
        return self.written is not None and self.written == self.saved

    @property
    def absent(self) -> list[tuple[str, str]]:
        """Attachments and metadata that the summary tells and that are not whole."""
        there = {ATTACHMENT: self.attachments, METADATA: self.metadata}
        return [(what, name) for what, name in self.named if name not in there[what]]


def search(data: bytes) -> Findings:
    """Find what is whole in the bytes of an MCAP file; the magic at its start is skipped."""
    return _Search(data).run()


def unpacked(data: bytes, start: int, end: int) -> bytes | None:
    """Return the records of the chunk whose body lies there; None if it is not whole."""
    records, _ = _unpacked(data, start, end)
    return records


def _unpacked(data: bytes, start: int, end: int) -> tuple[bytes | None, bool]:
    """Return the records as well, and whether a checksum confirms them."""
    try:
        chunk = Chunk.read(ReadDataStream(BytesIO(data[start:end])))
        # the library checks a checksum that is given
        stream, length = get_chunk_data_stream(chunk, validate_crc=True)
        records = stream.read(length)
    except DAMAGE:
        return None, False
    if len(records) != chunk.uncompressed_size:
        return None, False
    if not chunk.uncompressed_crc:
        ends = [end for _, _, end in _records_in(records)]
        return (records if ends and ends[-1] == len(records) else None), False
    return records, True


def messages_in(records: bytes) -> Iterator[tuple[int, int, int, int, bytes]]:
    """Yield channel, sequence, log and publish time (ns) and data of a chunk's messages."""
    for opcode, start, end in _records_in(records):
        if opcode == Opcode.MESSAGE:
            yield *_MESSAGE.unpack_from(records, start), records[start + _MESSAGE.size : end]


def _records_in(records: bytes) -> Iterator[tuple[int, int, int]]:
    position = 0
    while position + _RECORD.size <= len(records):
        opcode, length = _RECORD.unpack_from(records, position)
        start = position + _RECORD.size
        position = start + length
        if position > len(records):
            return
        yield opcode, start, position


class _Search:
    def __init__(self, data: bytes) -> None:
        self._data = data
        self._found = Findings()
        self._seen_time: int | None = None  # log time at the end of the last whole chunk

    def run(self) -> Findings:
        found, data = self._found, self._data
        position = sure = len(MCAP0_MAGIC)  # `sure`: nothing before it needs another look
        while position < len(data):
            end = self._take(position)
            if end is None:
                position = sure = self._resume(position, sure)
                continue
            if data[position] in (Opcode.CHUNK, Opcode.ATTACHMENT):
                sure = end
            if data[position] == Opcode.DATA_END:
                self._check_data_section(position)
                self._summary(end)
                break
            position = end
        else:
            if not found.losses or found.losses[-1].end < len(data):
                found.losses.append(
                    Loss(len(data), len(data), "the file ends without index and end mark")
                )
        return found

    def _take(self, position: int) -> int | None:
        """Take in the record at a place; return its end, or None if it is not whole."""
        if position + _RECORD.size > len(self._data):
            return None
        opcode, length = _RECORD.unpack_from(self._data, position)
        start = position + _RECORD.size
        end = start + length
        if end > len(self._data):
            return None
        taken = {
            Opcode.HEADER: lambda: True,
            Opcode.SCHEMA: lambda: self._schema(start, end),
            Opcode.CHANNEL: lambda: self._channel(start, end),
            Opcode.MESSAGE: lambda: self._loose(start, end),
            Opcode.CHUNK: lambda: self._chunk(position, start, end),
            Opcode.MESSAGE_INDEX: lambda: self._is_message_index(start, end),
            Opcode.ATTACHMENT: lambda: self._attachment(start, end),
            Opcode.METADATA: lambda: self._metadata(start, end),
            Opcode.DATA_END: lambda: length == _CRC.size,
        }.get(opcode, lambda: False)()
        return end if taken else None

    def _resume(self, position: int, sure: int) -> int:
        """Note what is lost, and return where reading can go on: a whole chunk, or the end."""
        data = self._data
        for match in _CHUNK_HEAD.finditer(data, sure):
            at = match.start()
            _, length = _RECORD.unpack_from(data, at)
            start, end = at + _RECORD.size, at + _RECORD.size + length
            if end <= len(data) and unpacked(data, start, end) is not None:
                if at > position:
                    self._found.losses.append(Loss(position, at, "damaged", self._seen_time))
                return at
        return self._resume_at_end(position, sure)

    def _resume_at_end(self, position: int, sure: int) -> int:
        """As :meth:`_resume` where no whole chunk follows: at the end of the data section."""
        mark = struct.pack("<BQ", Opcode.DATA_END, _CRC.size)
        at = self._data.find(mark, sure)
        while at >= 0:
            # what the summary's own checksum confirms
            if self._summary_is_whole(at + _RECORD.size + _CRC.size):
                if at > position:
                    self._found.losses.append(Loss(position, at, "damaged", self._seen_time))
                return at
            at = self._data.find(mark, at + 1)
        cut = position + _RECORD.size > len(self._data)
        if not cut:
            _, length = _RECORD.unpack_from(self._data, position)
            cut = position + _RECORD.size + length > len(self._data)
        why = "the file ends within a record" if cut else "damaged, up to the file's end"
        self._found.losses.append(Loss(position, len(self._data), why, self._seen_time))
        return len(self._data)

    def _chunk(self, position: int, start: int, end: int) -> bool:
        records, confirmed = _unpacked(self._data, start, end)
        if records is None:
            return False
        where = self._found.defined if confirmed else self._found.bare
        self._found.unconfirmed += not confirmed
        times = []
        for opcode, begin, stop in _records_in(records):
            if opcode == Opcode.SCHEMA:
                self._define(where, self._parsed(Schema.read, records, begin, stop))
            elif opcode == Opcode.CHANNEL:
                self._define(where, self._parsed(Channel.read, records, begin, stop))
            elif opcode == Opcode.MESSAGE:
                times.append(_MESSAGE.unpack_from(records, begin)[2])
        self._found.chunks.append((start, end))
        self._found.inside += len(times)
        if times:
            for loss in self._found.losses:
                if loss.before is None and loss.end <= position:
                    loss.before = min(times)
            self._seen_time = max(times)
        return True

    def _schema(self, start: int, end: int) -> bool:
        return self._define(self._found.bare, self._parsed(Schema.read, self._data, start, end))

    def _channel(self, start: int, end: int) -> bool:
        return self._define(self._found.bare, self._parsed(Channel.read, self._data, start, end))

    @staticmethod
    def _define(where: Definitions, entry: Schema | Channel | None) -> bool:
        if isinstance(entry, Schema):
            where.schemas[entry.id] = entry
        elif isinstance(entry, Channel):
            where.channels[entry.id] = entry
        return entry is not None

    def _loose(self, start: int, end: int) -> bool:
        if end - start < _MESSAGE.size:
            return False
        self._found.loose.append((start, end))
        return True

    def _is_message_index(self, start: int, end: int) -> bool:
        if end - start < 6:
            return False
        (size,) = _U4.unpack_from(self._data, start + 2)
        return size == end - start - 6 and size % 16 == 0

    def _attachment(self, start: int, end: int) -> bool:
        attachment = self._parsed(Attachment.read, self._data, start, end)
        if attachment is None or end - start < _CRC.size:
            return False
        (crc,) = _CRC.unpack_from(self._data, end - _CRC.size)
        if zlib.crc32(self._data[start : end - _CRC.size]) != crc:
            return False
        self._found.attachments[attachment.name] = attachment
        return True

    def _metadata(self, start: int, end: int) -> bool:
        metadata = self._parsed(Metadata.read, self._data, start, end)
        if metadata is None:
            return False
        self._found.metadata[metadata.name] = dict(metadata.metadata)
        return True

    def _check_data_section(self, position: int) -> None:
        (crc,) = _CRC.unpack_from(self._data, position + _RECORD.size)
        self._found.unchecked = not crc
        self._found.verified = bool(crc) and zlib.crc32(self._data[:position]) == crc

    def _summary(self, start: int) -> None:
        if self._footer(start) == 0:
            return  # it is there, and nothing confirms it
        if not self._summary_is_whole(start):
            self._found.losses.append(Loss(start, len(self._data), "index and end mark damaged"))
            return
        summary = self._data[start:]
        told = Definitions()
        for opcode, begin, end in _records_in(summary):
            if opcode == Opcode.SCHEMA:
                self._define(told, self._parsed(Schema.read, summary, begin, end))
            elif opcode == Opcode.CHANNEL:
                self._define(told, self._parsed(Channel.read, summary, begin, end))
            elif opcode == Opcode.STATISTICS:
                statistics = self._parsed(Statistics.read, summary, begin, end)
                if statistics is not None:
                    self._found.written = statistics.message_count
            elif opcode == Opcode.ATTACHMENT_INDEX:
                self._name(ATTACHMENT, self._parsed(AttachmentIndex.read, summary, begin, end))
            elif opcode == Opcode.METADATA_INDEX:
                self._name(METADATA, self._parsed(MetadataIndex.read, summary, begin, end))
        told.update(self._found.defined)
        self._found.defined = told

    def _name(self, what: str, entry: AttachmentIndex | MetadataIndex | None) -> None:
        if entry is not None:
            self._found.named.append((what, entry.name))

    def _summary_is_whole(self, start: int) -> bool:
        """Whether the summary that begins there, up to the file's end, fits its checksum."""
        crc = self._footer(start)
        until = len(self._data) - len(MCAP0_MAGIC) - _CRC.size
        return bool(crc) and zlib.crc32(self._data[start:until]) == crc

    def _footer(self, start: int) -> int | None:
        """Return the checksum told of a summary that begins there; None without a footer."""
        data = self._data
        footer = len(data) - len(MCAP0_MAGIC) - _FOOTER_LENGTH - _RECORD.size
        if footer < start or data[-len(MCAP0_MAGIC) :] != MCAP0_MAGIC:
            return None
        if _RECORD.unpack_from(data, footer) != (Opcode.FOOTER, _FOOTER_LENGTH):
            return None
        told = self._parsed(Footer.read, data, footer + _RECORD.size, len(data))
        if told is None or told.summary_start not in (0, start):
            return None
        return told.summary_crc

    @staticmethod
    def _parsed(
        read: Callable[[ReadDataStream], _T], data: bytes, start: int, end: int
    ) -> _T | None:
        try:
            return read(ReadDataStream(BytesIO(data[start:end])))
        except DAMAGE:
            return None
