"""What is in an MCAP file, or in a bag's folder of files: checked, and within bounds.

The library's indexed readers need the index at the file's end, which a killed recorder never
wrote; its sequential one reads a file that was cut as well.
"""

from __future__ import annotations

import os
import struct
import zlib
from collections import deque
from dataclasses import dataclass, field
from io import BytesIO
from itertools import pairwise
from mmap import mmap
from pathlib import Path
from typing import IO

import lz4.frame
import yaml
import zstandard
from mcap.data_stream import ReadDataStream, RecordBuilder
from mcap.exceptions import EndOfFile, InvalidMagic, McapError, RecordLengthLimitExceeded
from mcap.opcode import Opcode
from mcap.records import (
    Attachment,
    Channel,
    Chunk,
    Footer,
    McapRecord,
    Message,
    Metadata,
    Schema,
    Statistics,
)
from mcap.stream_reader import CRCValidationError, StreamReader
from mcap.writer import MCAP0_MAGIC

from capture_sim.errors import RecordingError
from capture_sim.recording.bag_metadata import FILE_NAME

#: Encoding of ROS 2 messages.
CDR = "cdr"
#: A file may unpack to so many times its size, and to UNPACKED_LEAST bytes in any case; the
#: bench's own recordings unpack to about five times.
UNPACKED_RATIO = 100.0
UNPACKED_LEAST = 64 * 1024 * 1024
#: Bytes that a message takes in memory beside its own.
_MESSAGE_COST = 100

_RECORD = struct.Struct("<BQ")  # opcode, length
#: What stands before a message's data: opcode, length, channel, sequence, log and publish
#: time (ns).
MESSAGE_HEAD = struct.Struct("<BQHIQQ")
_INDEX = struct.Struct("<HI")  # channel, bytes
_FOOTER = struct.Struct("<BQQQI")  # opcode, length, places of summary and offsets, checksum
_CRC_SIZE = 4
_Fields = tuple[int, int, bytes, int, int]

#: What parsing of a damaged record may raise.
DAMAGE = (
    EndOfFile,
    McapError,
    struct.error,
    UnicodeDecodeError,
    LookupError,
    ValueError,
    MemoryError,
    OverflowError,
    zstandard.ZstdError,
    RuntimeError,
)


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


def read_contents(path: Path, ratio: float = UNPACKED_RATIO) -> Contents:
    """Read a file, or a bag's folder of files, as far as the records are complete.

    Parameters
    ----------
    path
        The file or folder.
    ratio
        How many times a file's size it may unpack to.

    Returns
    -------
    Contents
        ``damage`` is set when a file ends before its end mark.

    Raises
    ------
    RecordingError
        A file cannot be read, is no MCAP file, a record inside it is damaged (as opposed to
        missing at the end), or it unpacks to more than is allowed.
    """
    contents = Contents()
    for part in bag_files(path):
        try:
            with part.open("rb") as file:
                _Reader(part, file, contents, ratio).read()
        except OSError as error:
            raise RecordingError(f"{part}: cannot read: {error.strerror or error}") from None
    for topic, times in contents.log_times.items():
        if any(later < time for time, later in pairwise(times)):
            order = sorted(range(len(times)), key=times.__getitem__)
            contents.log_times[topic] = [times[i] for i in order]
            contents.messages[topic] = [contents.messages[topic][i] for i in order]
        if times and contents.log_times[topic][-1] >= 1 << 63:
            last = contents.log_times[topic][-1]
            raise RecordingError(f"{path}: {topic}: log time {last} ns: allowed is below 2^63")
    return contents


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
        listed = yaml.safe_load((path / FILE_NAME).read_text(encoding="utf-8"))
        names = listed["rosbag2_bagfile_information"]["relative_file_paths"]
        files = [path / Path(str(name)).name for name in names]  # nothing outside the folder
    except OSError:  # the recorder was killed: the files tell their order by their numbers
        files = sorted(path.glob("[!.]*.mcap"), key=_number)
    except (yaml.YAMLError, LookupError, TypeError, ValueError, RecursionError):
        raise RecordingError(f"{path / FILE_NAME}: is no metadata of a bag") from None
    if not files:
        raise RecordingError(f"{path}: holds no .mcap file")
    return files


def _number(path: Path) -> tuple[int, str]:
    digits = path.stem.rsplit("_", 1)[-1]
    return (int(digits) if digits.isdecimal() and len(digits) < 10 else -1, path.name)


def allowance(size: int, ratio: float = UNPACKED_RATIO) -> int:
    """Return how many bytes a file of a size, bytes, may unpack to."""
    return int(max(UNPACKED_LEAST, ratio * size))


def unpacked(chunk: Chunk, limit: int) -> bytes:
    """Return the records of a chunk, its size and checksum being right.

    Parameters
    ----------
    chunk
        As it stands in the file.
    limit
        Bytes that it may unpack to.

    Raises
    ------
    ValueError
        It is damaged, or unpacks to more.
    """
    size = chunk.uncompressed_size
    if size > limit:
        raise ValueError(f"a chunk unpacks to {size} bytes, more than is allowed for the file")
    if chunk.compression == "zstd":
        with zstandard.ZstdDecompressor().stream_reader(chunk.data) as stream:
            records = stream.read(size + 1)
    elif chunk.compression == "lz4":
        records = lz4.frame.LZ4FrameDecompressor().decompress(chunk.data, max_length=size + 1)
    elif not chunk.compression:
        records = chunk.data
    else:
        raise ValueError(f"a chunk's compression {chunk.compression!r} is not known")
    if len(records) != size:
        raise ValueError("a chunk unpacks to another size than it says")
    if chunk.uncompressed_crc and zlib.crc32(records) != chunk.uncompressed_crc:
        raise CRCValidationError(chunk.uncompressed_crc, zlib.crc32(records), chunk)
    return records


@dataclass
class Unparsed(McapRecord):
    """A record as it stands in the file."""

    opcode: Opcode
    data: bytes

    def write(self, stream: RecordBuilder) -> None:
        """Write it as it was."""
        stream.start_record(self.opcode)
        stream.write(self.data)
        stream.finish_record()


class Records(StreamReader):
    """The library's reader, but for the messages' index, whose parsing takes the longest."""

    def _read_record(self, opcode: int, length: int) -> McapRecord | None:
        if opcode != Opcode.MESSAGE_INDEX:
            return super()._read_record(opcode, length)
        data = self._stream.read(length)
        _, size = _INDEX.unpack_from(data)
        if size != length - _INDEX.size:
            raise EndOfFile
        return Unparsed(Opcode.MESSAGE_INDEX, data)


def records_in(data: bytes) -> tuple[list[Schema | Channel], list[_Fields]]:
    """Return definitions and messages of a chunk.

    A message is channel, log time (ns), data, publish time (ns), sequence: the fields of
    mcap's ``Message``, which takes longer to make.

    Raises
    ------
    ValueError
        The records do not fill the chunk.
    """
    definitions: list[Schema | Channel] = []
    messages: list[_Fields] = []
    position, end, head, size = 0, len(data), MESSAGE_HEAD.unpack_from, MESSAGE_HEAD.size
    a_message = int(Opcode.MESSAGE)
    while position + size <= end:
        opcode, length, channel, sequence, log_time, publish_time = head(data, position)
        start, position = position, position + _RECORD.size + length
        if position > end:
            break
        if opcode == a_message:
            body = data[start + size : position]
            messages.append((channel, log_time, body, publish_time, sequence))
        elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
            stream = ReadDataStream(BytesIO(data[start + _RECORD.size : position]))
            kind = Schema if opcode == Opcode.SCHEMA else Channel
            definitions.append(kind.read(stream))
    if position != end:
        raise ValueError("a chunk ends within a record")
    return definitions, messages


def summary_of(file: IO[bytes] | mmap, footer: int | None = None) -> tuple[int | None, bool]:
    """Return where the summary begins, and whether a checksum confirms it.

    Index and statistics, which others find messages by, stand there.  No place if it is damaged.

    Parameters
    ----------
    file
        An MCAP file; it is read somewhere else afterwards.
    footer
        Where its footer begins; None looks before the mark at the file's end.
    """
    if footer is None:
        file.seek(0, os.SEEK_END)
        footer = file.tell() - len(MCAP0_MAGIC) - _FOOTER.size
        file.seek(max(footer + _FOOTER.size, 0))
        if footer < 0 or file.read() != MCAP0_MAGIC:
            return None, False
    file.seek(footer)
    opcode, length, start, _, crc = _FOOTER.unpack(file.read(_FOOTER.size))
    if (opcode, length) != (Opcode.FOOTER, _FOOTER.size - _RECORD.size) or start > footer:
        return None, False
    file.seek(start := start or footer)
    fits = not crc or zlib.crc32(file.read(footer + _FOOTER.size - _CRC_SIZE - start)) == crc
    return start if fits else None, bool(crc)


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
    return " ".join(str(error).split()) or "a record that cannot be read"


class _Reader:
    """Reads one file into the contents of all."""

    def __init__(self, path: Path, file: IO[bytes], contents: Contents, ratio: float) -> None:
        self._path = path
        self._file = file
        self._size = os.fstat(file.fileno()).st_size
        self._left = allowance(self._size, ratio)
        self._contents = contents
        self._schemas: dict[int, Schema] = {}
        # messages and log times by channel; those that are left out go nowhere
        self._lists: dict[int, tuple[list[bytes] | deque[bytes], list[int] | deque[int]]] = {}
        self._count = 0

    def read(self) -> None:
        """Read all records, or those before the place where the file was cut."""
        # a record that is longer than the file is no record
        limit = max(self._size, 1)
        reader = Records(self._file, emit_chunks=True, validate_crcs=True, record_size_limit=limit)
        position = len(MCAP0_MAGIC)
        try:
            for record in reader.records:
                try:
                    self._take(record)
                except DAMAGE as error:
                    raise self._damaged(position, in_words(error)) from None
                position = self._file.tell()
        except DAMAGE as error:
            if position == len(MCAP0_MAGIC) and (
                isinstance(error, InvalidMagic) or self._file.tell() < position
            ):
                raise RecordingError(f"{self._path}: not an MCAP file") from None
            # a length that leads behind the file's end is that of a file that was cut
            ended = not isinstance(error, RecordLengthLimitExceeded) and self._file.read(1)
            self._file.seek(-len(MCAP0_MAGIC), os.SEEK_END)
            if ended or (self._file.read() == MCAP0_MAGIC and self._size > position):
                raise self._damaged(position, in_words(error)) from None
            self._tell(
                f"the file ends without its end mark; {position} of {self._size} bytes are "
                "complete records"
            )
        else:
            if self._file.read(1):
                self._tell("the file goes on behind its end mark")

    def _tell(self, damage: str) -> None:
        before = self._contents.damage
        self._contents.damage = f"{before}; then {damage}" if before else damage

    def _take(self, record: McapRecord) -> None:
        if isinstance(record, Chunk):
            records, before = unpacked(record, self._left), self._count
            self._messages(records)
            self._left -= len(records) + _MESSAGE_COST * (self._count - before)
            if self._left < 0:
                raise ValueError("it unpacks to more than is allowed for the file")
        elif isinstance(record, Message):  # outside chunks
            messages, times = self._lists[record.channel_id]
            messages.append(record.data)
            times.append(record.log_time)
            self._count += 1
        elif isinstance(record, Schema):
            self._schemas[record.id] = record
        elif isinstance(record, Channel):
            self._channel(record)
        elif isinstance(record, Attachment):
            self._check_attachment(record)
            self._contents.attachments[record.name] = record.data
        elif isinstance(record, Metadata):
            self._contents.metadata[record.name] = dict(record.metadata)
        elif isinstance(record, Statistics):
            if record.message_count != self._count:
                raise ValueError(
                    f"{self._count} messages read, {record.message_count} were written"
                )
        elif isinstance(record, Footer):
            here = self._file.tell()
            if summary_of(self._file, here - _FOOTER.size)[0] is None:
                raise ValueError("the index does not match its checksum")
            self._file.seek(here)

    def _messages(self, data: bytes) -> None:
        """Take in the records of a chunk."""
        lists = self._lists
        definitions, messages = records_in(data)
        for definition in definitions:
            self._take(definition)
        for channel, log_time, message, _, _ in messages:
            if channel not in lists:
                raise ValueError(f"message of unknown channel {channel}")
            of_channel, times = lists[channel]
            of_channel.append(message)
            times.append(log_time)
        self._count += len(messages)

    def _channel(self, channel: Channel) -> None:
        topic, contents = channel.topic, self._contents
        if not topic.isprintable():
            raise ValueError(f"topic {topic!r}: allowed are printable characters")
        if channel.message_encoding != CDR:  # a type's name says nothing of other bytes
            self._lists[channel.id] = deque(maxlen=0), deque(maxlen=0)
            contents.left_out[topic] = channel.message_encoding
            return
        schema = self._schemas.get(channel.schema_id)
        if schema is not None:
            contents.schemas[schema.name] = schema.data.decode("utf-8", errors="replace")
        contents.types.setdefault(topic, "" if schema is None else schema.name)
        contents.qos[topic] = channel.metadata.get("offered_qos_profiles", "")
        messages = contents.messages.setdefault(topic, [])
        self._lists[channel.id] = messages, contents.log_times.setdefault(topic, [])

    def _check_attachment(self, attachment: Attachment) -> None:
        """Check an attachment's checksum, which ends its record; the library does not."""
        builder = RecordBuilder()
        attachment.write(builder)
        self._file.seek(-_CRC_SIZE, os.SEEK_CUR)
        stored = self._file.read(_CRC_SIZE)
        if any(stored) and stored != builder.end()[-_CRC_SIZE:]:
            raise ValueError(f"attachment {attachment.name!r}: wrong checksum")

    def _damaged(self, position: int, why: str) -> RecordingError:
        return RecordingError(
            f"{self._path}: damaged at byte {position}: {why}; what is whole in it "
            "`capture-sim recover` saves"
        )
