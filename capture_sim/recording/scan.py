"""The records of an MCAP file up to the first damage, checked, and unpacked within bounds."""

from __future__ import annotations

import os
import struct
import zlib
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from io import BytesIO
from pathlib import Path
from typing import IO, NamedTuple

import lz4.frame
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import EndOfFile, InvalidMagic, McapError, RecordLengthLimitExceeded
from mcap.opcode import Opcode
from mcap.reader import SeekingReader
from mcap.records import Attachment, Channel, Chunk, DataEnd, McapRecord, Message, Metadata, Schema
from mcap.stream_reader import CRCValidationError, StreamReader
from mcap.writer import MCAP0_MAGIC

from capture_sim.errors import RecordingError, one_line

#: A file may unpack to so many times its size, and to UNPACKED_LEAST bytes in any case; the
#: bench's own recordings unpack to about five times.
UNPACKED_RATIO = 100.0
UNPACKED_LEAST = 64 * 1024 * 1024
#: Bytes that a message needs in memory besides its own.
_MESSAGE_COST = 100
#: Log times from here on (ns) do not fit into ROS's clock.
_TIME_LIMIT = 1 << 63

_HEAD = struct.Struct("<BQ")  # opcode, length
_MESSAGE = struct.Struct("<BQHIQQ")  # opcode, length, channel, sequence, log and publish time (ns)

#: A message: channel, log time (ns), bytes, publish time (ns), sequence.  The library's ``Message``
#: takes several times as long to make.
StoredMessage = tuple[int, int, bytes, int, int]
#: What parsing of a damaged record may raise.
_DAMAGE = (
    McapError,
    struct.error,
    ValueError,
    MemoryError,
    OverflowError,
    RuntimeError,  # lz4's
    zstandard.ZstdError,
)
#: ... because the file ends within it, or a length in it is wrong.
_INCOMPLETE = (
    EndOfFile,
    RecordLengthLimitExceeded,
    struct.error,
    OverflowError,
    MemoryError,
)


class RecordContents(NamedTuple):
    """What a record of the data section contains; a chunk contains several."""

    entries: Sequence[Schema | Channel | Attachment | Metadata]
    messages: Sequence[StoredMessage] = ()


class Damage(NamedTuple):
    """Why a file was not read to its end, and how far it was read."""

    start: int  # first byte that was not read
    size: int  # of the file, bytes
    reason: str
    messages: int  # messages read
    written: int | None  # messages written, if the file's index is intact and reports them
    duration: float  # s, from the first log time to the last that was read
    in_index: bool  # the data section before it is complete, with the right checksum if it has one

    def __str__(self) -> str:
        total = "" if self.written is None else f" of {self.written}"
        text = f"read up to byte {self.start} of {self.size} ({self.reason}): "
        text += f"{self.messages}{total} messages"
        return text + (f", the last {self.duration:.3f} s after the first" if self.messages else "")


def scan(path: Path, ratio: float) -> Iterator[RecordContents | Damage]:
    """Yield the contents of an MCAP file's data section; last its damage, if it has any.

    ``ratio`` is how many times its size the file may unpack to.  RecordingError if the file cannot
    be read or is not an MCAP file.
    """
    try:
        # without opening a file without a size: a pipe would block
        if not path.is_dir() and not path.stat().st_size:
            raise RecordingError(f"{path}: not an MCAP file")
        with path.open("rb") as file:
            if file.read(len(MCAP0_MAGIC)) != MCAP0_MAGIC:
                raise RecordingError(f"{path}: not an MCAP file")
            file.seek(0)
            yield from _contents_of_file(file, os.fstat(file.fileno()).st_size, ratio)
    except OSError as error:
        raise RecordingError(f"{path}: cannot read: {error.strerror or error}") from None


def head_metadata(path: Path) -> dict[str, Mapping[str, str]]:
    """Return the metadata records before a file's first message, by name; none of another file."""
    found: dict[str, Mapping[str, str]] = {}
    with suppress(Exception):  # whatever it is, it is no recording
        for part in scan(path, 1.0):
            if isinstance(part, Damage) or part.messages:
                break
            found |= {e.name: e.metadata for e in part.entries if isinstance(e, Metadata)}
    return found


def _contents_of_file(
    file: IO[bytes], file_size: int, ratio: float
) -> Iterator[RecordContents | Damage]:
    remaining = int(max(UNPACKED_LEAST, ratio * file_size))
    channels: set[int] = set()
    first, last, count = _TIME_LIMIT, 0, 0
    end, in_index = len(MCAP0_MAGIC), False
    try:
        reader = StreamReader(
            file, emit_chunks=True, validate_crcs=True, record_size_limit=file_size
        )
        for record in reader.records:
            in_index = in_index or isinstance(record, DataEnd)
            if not in_index:
                contents = _contents_of_record(record, remaining)
                size = record.uncompressed_size if isinstance(record, Chunk) else 0
                remaining -= size + _MESSAGE_COST * len(contents.messages)
                if remaining < 0:
                    raise ValueError("it unpacks to more than is accepted for the file")
                channels.update(each.id for each in contents.entries if isinstance(each, Channel))
                if contents.messages:
                    times = [message[1] for message in contents.messages]
                    _check(contents.messages, times, channels)
                    first, last = min(first, *times), max(last, *times)
                    count += len(times)
                yield contents
            end = file.tell()
        end = file.tell()
        if end < file_size:
            raise ValueError("more bytes follow the end mark")
    except _DAMAGE as error:
        duration = (last - first) / 1e9 if count else 0.0
        reason, written = _in_words(error), _written(file, file_size)
        yield Damage(end, file_size, reason, count, written, duration, in_index)


def _contents_of_record(record: McapRecord, limit: int) -> RecordContents:
    """Return a record's contents; at most ``limit`` bytes are unpacked."""
    if isinstance(record, Chunk):
        return _records_in(_unpacked(record, limit))
    if isinstance(record, Message):
        fields = (record.channel_id, record.log_time, record.data)
        return RecordContents((), [(*fields, record.publish_time, record.sequence)])
    is_used = isinstance(record, Schema | Channel | Attachment | Metadata)
    return RecordContents((record,) if is_used else ())  # type: ignore[arg-type]


def _unpacked(chunk: Chunk, limit: int) -> bytes:
    """Return the records of a chunk; its size and checksum are right."""
    size = chunk.uncompressed_size
    if size > limit:
        raise ValueError(f"a chunk unpacks to {size} bytes, more than is accepted for the file")
    if chunk.compression == "zstd":
        with zstandard.ZstdDecompressor().stream_reader(chunk.data) as stream:
            records = stream.read(size + 1)
    elif chunk.compression == "lz4":
        records = lz4.frame.LZ4FrameDecompressor().decompress(chunk.data, max_length=size + 1)
    elif not chunk.compression:
        records = chunk.data
    else:
        raise ValueError(f"unknown compression {chunk.compression!r}")
    if len(records) != size:
        raise ValueError("a chunk unpacks to another size than its own")
    if chunk.uncompressed_crc and zlib.crc32(records) != chunk.uncompressed_crc:
        raise ValueError("wrong checksum of a chunk")
    return records


def _records_in(data: bytes) -> RecordContents:
    """Return definitions and messages of a chunk."""
    definitions: list[Schema | Channel] = []
    messages: list[StoredMessage] = []
    position, end, size = 0, len(data), _MESSAGE.size
    head, message_opcode = _MESSAGE.unpack_from, int(Opcode.MESSAGE)
    kinds = {int(Opcode.SCHEMA): Schema, int(Opcode.CHANNEL): Channel}
    while position < end:
        start, opcode = position, data[position]
        if opcode == message_opcode:
            _, length, channel, sequence, log_time, publish_time = head(data, start)
            position = start + _HEAD.size + length
            if position > end or length < size - _HEAD.size:
                raise EndOfFile
            body = data[start + size : position]
            messages.append((channel, log_time, body, publish_time, sequence))
        else:
            _, length = _HEAD.unpack_from(data, start)
            position = start + _HEAD.size + length
            if position > end:
                raise EndOfFile
            if opcode in kinds:
                record = BytesIO(data[start + _HEAD.size : position])
                definitions.append(kinds[opcode].read(ReadDataStream(record)))
    return RecordContents(definitions, messages)


def _check(messages: Sequence[StoredMessage], times: Sequence[int], channels: set[int]) -> None:
    if max(times) >= _TIME_LIMIT:
        raise ValueError(f"log time {max(times)} ns: must be below 2^63 ns")
    if unknown := {message[0] for message in messages} - channels:
        raise ValueError(f"a message of unknown channel {min(unknown)}")


def _written(file: IO[bytes], file_size: int) -> int | None:
    """Return how many messages the index at a file's end reports; None without one."""
    with suppress(*_DAMAGE, OSError):
        file.seek(0)
        summary = SeekingReader(file, record_size_limit=file_size).get_summary()
        if summary is not None and summary.statistics is not None:
            return summary.statistics.message_count
    return None


def _in_words(error: Exception) -> str:
    """Return the fault of a record whose parsing raised one of _DAMAGE."""
    if isinstance(error, _INCOMPLETE):
        return "incomplete record"
    if isinstance(error, InvalidMagic):
        return "no end mark"
    if isinstance(error, CRCValidationError):
        return "wrong checksum of the data section: a byte outside the chunks is damaged"
    return one_line(str(error))
