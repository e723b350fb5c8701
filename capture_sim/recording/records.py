"""Walking over an MCAP file record by record, so that a file that was cut can be read too.

The library's own readers start at the index at the file's end, which a killed recorder
never wrote.  Checksums of chunks and of the whole data section are always checked.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from io import BytesIO
from itertools import pairwise
from pathlib import Path
from typing import TypeVar

import yaml
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import EndOfFile, McapError
from mcap.opcode import Opcode
from mcap.records import (
    Attachment,
    Channel,
    Chunk,
    DataEnd,
    Footer,
    Metadata,
    Schema,
    Statistics,
)
from mcap.stream_reader import CRCValidationError, get_chunk_data_stream
from mcap.writer import MCAP0_MAGIC

from capture_sim.errors import RecordingError
from capture_sim.recording.bag_metadata import FILE_NAME

#: Encoding of ROS 2 messages.
CDR = "cdr"

_RECORD = struct.Struct("<BQ")
_MESSAGE = struct.Struct("<HIQQ")  # channel, sequence, log time, publish time
_CRC = struct.Struct("<I")
_FOOTER_LENGTH = 20

#: What parsing of a damaged record may raise.
DAMAGE = (
    EndOfFile,
    McapError,
    struct.error,
    UnicodeDecodeError,
    ValueError,
    MemoryError,
    OverflowError,
    zstandard.ZstdError,
    RuntimeError,
)

_T = TypeVar("_T")


@dataclass
class Contents:
    """All that is in the data section of a file.

    Attributes
    ----------
    types
        Message type by topic.
    qos
        Quality of service by topic, YAML as rosbag2 writes it; empty when not recorded.
    schemas
        Definition text by message type.
    messages
        Serialised messages by topic, in the order of their log times.
    log_times
        Their log times, ns, ascending.
    attachments
        By name.
    metadata
        By name.
    left_out
        Encoding by topic of messages that are not CDR and were left out.
    damage
        Why reading stopped early; empty for a whole file.
    """

    types: dict[str, str] = field(default_factory=dict)
    qos: dict[str, str] = field(default_factory=dict)
    schemas: dict[str, str] = field(default_factory=dict)
    messages: dict[str, list[bytes]] = field(default_factory=dict)
    log_times: dict[str, list[int]] = field(default_factory=dict)
    attachments: dict[str, bytes] = field(default_factory=dict)
    metadata: dict[str, dict[str, str]] = field(default_factory=dict)
    left_out: dict[str, str] = field(default_factory=dict)
    damage: str = ""


def read_contents(path: Path) -> Contents:
    """Read a file, or a bag's folder of files, as far as the records are complete.

    Returns
    -------
    Contents
        ``damage`` is set when a file ends before its end mark.

    Raises
    ------
    RecordingError
        A file cannot be read, is no MCAP file, or a record inside it
        is damaged (as opposed to missing at the end).
    """
    contents = Contents()
    for part in bag_files(path):
        _Reader(part, file_bytes(part), contents).read()
    _order(contents)
    return contents


def _order(contents: Contents) -> None:
    """Bring each topic's messages into the order of their log times, equal ones as they are."""
    for topic, times in contents.log_times.items():
        if any(later < time for time, later in pairwise(times)):
            order = sorted(range(len(times)), key=times.__getitem__)
            contents.log_times[topic] = [times[i] for i in order]
            contents.messages[topic] = [contents.messages[topic][i] for i in order]


def bag_files(path: Path) -> list[Path]:
    """Return the files of a bag in order; for a file that file alone.

    Raises
    ------
    RecordingError
        The folder holds none.
    """
    if not path.is_dir():
        return [path]
    try:
        told = yaml.safe_load((path / FILE_NAME).read_text(encoding="utf-8"))
        names = told["rosbag2_bagfile_information"]["relative_file_paths"]
        files = [path / str(name) for name in names]
    except OSError:  # the recorder was killed: the files tell their order by their numbers
        files = sorted(path.glob("*.mcap"), key=_number)
    except (yaml.YAMLError, KeyError, TypeError, UnicodeDecodeError):
        raise RecordingError(f"{path / FILE_NAME}: is no metadata of a bag") from None
    if not files:
        raise RecordingError(f"{path}: holds no .mcap file")
    return files


def file_bytes(path: Path) -> bytes:
    """Return what is in an MCAP file.

    Raises
    ------
    RecordingError
        It cannot be read, or is no MCAP file.
    """
    try:
        data = path.read_bytes()
    except OSError as error:
        raise RecordingError(f"{path}: cannot read: {error.strerror or error}") from None
    if data[: len(MCAP0_MAGIC)] != MCAP0_MAGIC:
        raise RecordingError(f"{path}: not an MCAP file")
    return data


def _number(path: Path) -> tuple[int, str]:
    digits = path.stem.rsplit("_", 1)[-1]
    return (int(digits) if digits.isdecimal() else -1, path.name)


def in_words(error: Exception) -> str:
    """Return what is wrong with a record whose parsing raised one of DAMAGE."""
    if isinstance(error, UnicodeDecodeError):
        return "what should be text is none"
    if isinstance(error, CRCValidationError):
        return "wrong checksum"
    if isinstance(error, zstandard.ZstdError):
        return "a chunk that cannot be unpacked"
    if isinstance(error, struct.error | EndOfFile | OverflowError | MemoryError):
        return "a length that does not fit"
    return str(error) or "a record that cannot be read"


class _Reader:
    def __init__(self, path: Path, data: bytes, contents: Contents) -> None:
        self._path = path
        self._data = data
        self._contents = contents
        self._schemas: dict[int, Schema] = {}
        self._topics: dict[int, str] = {}
        self._foreign: set[int] = set()
        self._skipped = 0
        self._known = self._total()

    def read(self) -> None:
        finished = ended = False
        for opcode, start, end in self._records():
            if opcode == Opcode.DATA_END:
                self._check_data_section(start, end)
                self._check_summary(end)
                finished = True
            elif finished:
                if opcode == Opcode.STATISTICS:
                    self._check_count(start, end)
                ended = ended or self._data[end:] == MCAP0_MAGIC
            else:
                self._take(opcode, start, end)
        if not ended:
            damage = (
                f"the file ends without its end mark; {self._complete_until} of "
                f"{len(self._data)} bytes are complete records"
            )
            if self._contents.damage:
                damage = f"{self._contents.damage}; then {damage}"
            self._contents.damage = damage

    def _total(self) -> int:
        return sum(len(of_topic) for of_topic in self._contents.messages.values())

    def _records(self) -> Iterator[tuple[int, int, int]]:
        """Yield opcode, start and end of the body of every complete record."""
        position = len(MCAP0_MAGIC)
        self._complete_until = position
        while position + _RECORD.size <= len(self._data):
            opcode, length = _RECORD.unpack_from(self._data, position)
            start = position + _RECORD.size
            if start + length > len(self._data):
                return
            yield opcode, start, start + length
            position = start + length
            self._complete_until = position

    def _take(self, opcode: int, start: int, end: int) -> None:
        if opcode == Opcode.CHUNK:
            self._chunk(start, end)
        elif opcode == Opcode.MESSAGE:
            self._messages(self._data, start - _RECORD.size, end)
        elif opcode == Opcode.SCHEMA:
            self._schema(self._parsed(Schema.read, start, end))
        elif opcode == Opcode.CHANNEL:
            self._channel(self._parsed(Channel.read, start, end))
        elif opcode == Opcode.ATTACHMENT:
            attachment = self._parsed(Attachment.read, start, end)
            (crc,) = _CRC.unpack_from(self._data, end - _CRC.size)
            if crc and zlib.crc32(self._data[start : end - _CRC.size]) != crc:
                raise self._damaged(start, f"attachment {attachment.name}: wrong checksum")
            self._contents.attachments[attachment.name] = attachment.data
        elif opcode == Opcode.METADATA:
            metadata = self._parsed(Metadata.read, start, end)
            self._contents.metadata[metadata.name] = dict(metadata.metadata)

    def _parsed(self, read: Callable[[ReadDataStream], _T], start: int, end: int) -> _T:
        try:
            return read(ReadDataStream(BytesIO(self._data[start:end])))
        except DAMAGE as error:
            raise self._damaged(start, in_words(error)) from None

    def _chunk(self, start: int, end: int) -> None:
        chunk = self._parsed(Chunk.read, start, end)
        try:
            stream, length = get_chunk_data_stream(chunk, validate_crc=True)
            records = stream.read(length)
        except DAMAGE as error:
            raise self._damaged(start, in_words(error)) from None
        try:
            self._messages(records, 0, len(records))
        except DAMAGE as error:
            raise self._damaged(start, in_words(error)) from None

    def _messages(self, data: bytes, position: int, end: int) -> None:
        """Take in records of messages, schemas and channels; a plain loop, it is the hot one."""
        messages, times = self._contents.messages, self._contents.log_times
        topics = self._topics
        record, message = _RECORD.unpack_from, _MESSAGE.unpack_from
        head, inner = _RECORD.size, _MESSAGE.size
        while position < end:
            opcode, length = record(data, position)
            start = position + head
            position = start + length
            if opcode == Opcode.MESSAGE:
                channel, _, log_time, _ = message(data, start)
                topic = topics.get(channel)
                if topic is None:
                    if channel in self._foreign:
                        self._skipped += 1
                        continue
                    raise McapError(f"message of unknown channel {channel}")
                messages[topic].append(data[start + inner : position])
                times[topic].append(log_time)
            elif opcode == Opcode.SCHEMA:
                self._schema(Schema.read(ReadDataStream(BytesIO(data[start:position]))))
            elif opcode == Opcode.CHANNEL:
                self._channel(Channel.read(ReadDataStream(BytesIO(data[start:position]))))

    def _schema(self, schema: Schema) -> None:
        self._schemas[schema.id] = schema

    def _channel(self, channel: Channel) -> None:
        if channel.message_encoding != CDR:  # a type's name says nothing of other bytes
            self._foreign.add(channel.id)
            self._contents.left_out[channel.topic] = channel.message_encoding
            return
        self._topics[channel.id] = channel.topic
        schema = self._schemas.get(channel.schema_id)
        if schema is not None:
            text = schema.data.decode("utf-8", errors="replace")
            self._contents.schemas[schema.name] = text
        self._contents.types.setdefault(channel.topic, "" if schema is None else schema.name)
        self._contents.qos[channel.topic] = channel.metadata.get("offered_qos_profiles", "")
        self._contents.messages.setdefault(channel.topic, [])
        self._contents.log_times.setdefault(channel.topic, [])

    def _check_data_section(self, start: int, end: int) -> None:
        crc = self._parsed(DataEnd.read, start, end).data_section_crc
        if crc and zlib.crc32(self._data[: start - _RECORD.size]) != crc:
            raise self._damaged(start, "the data section does not match its checksum")

    def _check_summary(self, begin: int) -> None:
        """Check index, statistics and footer behind the data, where all of the file is there.

        Nothing is read by the index; but others find messages by it, and what is damaged there
        may be damaged elsewhere.
        """
        data = self._data
        if data[-len(MCAP0_MAGIC) :] != MCAP0_MAGIC:
            return  # it was cut: that is told
        start = len(data) - len(MCAP0_MAGIC) - _FOOTER_LENGTH
        head = start - _RECORD.size
        if head < begin or _RECORD.unpack_from(data, head) != (Opcode.FOOTER, _FOOTER_LENGTH):
            raise self._damaged(begin, "index and end mark do not fit together")
        told = self._parsed(Footer.read, start, start + _FOOTER_LENGTH)
        if not told.summary_crc:
            return  # not available
        summary = data[told.summary_start or head : start + _FOOTER_LENGTH - _CRC.size]
        if zlib.crc32(summary) != told.summary_crc:
            raise self._damaged(begin, "the index does not match its checksum")

    def _check_count(self, start: int, end: int) -> None:
        counted = self._parsed(Statistics.read, start, end).message_count
        read = self._total() - self._known + self._skipped
        if counted != read:
            raise self._damaged(start, f"{read} messages read, {counted} were written")

    def _damaged(self, position: int, why: str) -> RecordingError:
        return RecordingError(
            f"{self._path}: damaged at byte {position}: {why}; what is whole in it "
            "`capture-sim recover` saves"
        )
