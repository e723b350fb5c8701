"""Reads the records of a recording's file up to its first damage, and limits what it unpacks to."""

from __future__ import annotations

import os
import struct
import tempfile
import zlib
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from io import BytesIO
from pathlib import Path
from typing import IO

from mcap.data_stream import ReadDataStream
from mcap.exceptions import EndOfFile, InvalidMagic, McapError, RecordLengthLimitExceeded
from mcap.opcode import Opcode
from mcap.reader import SeekingReader
from mcap.records import (
    Attachment,
    Channel,
    Chunk,
    DataEnd,
    McapRecord,
    Message,
    MessageIndex,
    Metadata,
    Schema,
)
from mcap.stream_reader import CRCValidationError, StreamReader
from mcap.writer import MCAP0_MAGIC

from capture_sim.errors import RecordingError, one_line
from capture_sim.recording import sqlite
from capture_sim.recording.compression import (
    DAMAGED,
    TOO_LARGE,
    is_compressed,
    other_compression,
    unpack,
    unpacked,
)
from capture_sim.recording.records import (
    MESSAGE_COST,
    MIN_UNPACKED_LIMIT,
    TIME_LIMIT,
    Damage,
    RecordContents,
    StoredMessage,
    usable,
)

#: First bytes of a bag of ROS 1.
_ROS_1 = b"#ROSBAG V"
#: Bytes that tell the kind of a file.
_LONGEST_MAGIC = 16

_HEAD = struct.Struct("<BQ")  # opcode, length
_MESSAGE = struct.Struct("<BQHIQQ")  # opcode, length, channel, sequence, log and publish time (ns)
#: Messages from this size on, bytes, are not copied out of their chunk: most are of cameras.
_LARGE = 1 << 14

#: What parsing of a damaged record may raise.
_DAMAGE = (
    McapError,
    struct.error,
    ValueError,
    OverflowError,
    *DAMAGED,
)
#: ... because the file ends within it, or a length in it is wrong.
_INCOMPLETE = (
    EndOfFile,
    RecordLengthLimitExceeded,
    struct.error,
    OverflowError,
)


class _Reader(StreamReader):
    """Parses no index of a chunk, which nobody here uses: that was a third of a read."""

    def _read_record(self, opcode: int, length: int) -> McapRecord | None:
        if opcode == Opcode.MESSAGE_INDEX:
            self._stream.read(length)
            return MessageIndex(channel_id=0, records=[])
        return super()._read_record(opcode, length)


def scan(path: Path, ratio: float) -> Iterator[RecordContents | Damage]:
    """Yield the contents of a recording's file, record by record; last its damage, if it has any.

    The file may be an MCAP file or the .db3 file of a bag, each also compressed by zstd or lz4.  It
    may unpack to ``ratio`` times its size, or to MIN_UNPACKED_LIMIT (64 MiB) if that is more; each
    message counts MESSAGE_COST bytes in addition.  More counts as damage: reading ends there.
    RecordingError, at the first ``next``, if the file cannot be opened, is empty or is of another
    kind; also later, if it cannot be read further.
    """
    try:
        # without opening a file without a size: a pipe would block
        if not path.is_dir() and not path.stat().st_size:
            raise RecordingError(f"{path}: not an MCAP file: it is empty")
        with path.open("rb") as file:
            size = os.fstat(file.fileno()).st_size
            limit = int(max(MIN_UNPACKED_LIMIT, ratio * size))
            if is_compressed(file.read(_LONGEST_MAGIC)):
                yield from _contents_of_compressed(file, path, limit)
            else:
                yield from _contents_of_plain(file, path, path, size, limit)
    except OSError as error:
        is_named = path.suffix in (".mcap", ".db3") or path.exists()
        hint = "" if is_named else "; must be a recording (.mcap, .db3, or the folder of a bag)"
        raise RecordingError(f"{path}: cannot read: {error.strerror or error}{hint}") from None


def _contents_of_compressed(
    file: IO[bytes], path: Path, limit: int
) -> Iterator[RecordContents | Damage]:
    file.seek(0)
    with tempfile.NamedTemporaryFile(prefix="capture_sim_") as plain:
        reason = unpack(file, plain, limit)
        plain.flush()
        size = plain.tell()
        parts = _contents_of_plain(plain, Path(plain.name), path, size, limit, reason)
        for part in parts:
            if reason and isinstance(part, Damage):
                part = part._replace(reason=f"{part.reason}; {reason}")
            yield part


def _contents_of_plain(
    file: IO[bytes], path: Path, named: Path, size: int, limit: int, reason: str = ""
) -> Iterator[RecordContents | Damage]:
    """Yield the contents of a file that is not compressed, or no longer.

    Errors name it ``named``: if it was compressed, ``path`` is that of a temporary file.
    ``reason`` is why it was not unpacked to its end, empty if it was or was not compressed.
    """
    file.seek(0)
    head = file.read(_LONGEST_MAGIC)
    file.seek(0)
    if head.startswith(MCAP0_MAGIC):
        yield from _contents_of_file(file, size, limit)
    elif head.startswith(sqlite.MAGIC):
        yield from sqlite.scan_sqlite(path, named, size, limit)
    else:
        raise RecordingError(f"{named}: not an MCAP file{_other_kind(head, named, reason)}")


def _other_kind(head: bytes, path: Path, reason: str) -> str:
    """Return what an error adds on a file that is no recording: ``": "`` and its kind, or empty.

    The kind is told by the first bytes, ``head``, with a tool that converts the file; if it is
    unknown, the text is empty.  If the file could not be unpacked, ``reason`` is added instead.
    """
    if reason:
        return f": {reason}"
    if head.startswith(_ROS_1):
        return f": a bag of ROS 1; convert it: rosbags-convert --src {path} --dst {path.stem}"
    if found := other_compression(head):
        name, command = found
        return f": compressed by {name}; unpack it: {command} {path}"
    return ""


def head_metadata(path: Path) -> dict[str, Mapping[str, str]]:
    """Return the metadata records that precede a file's first usable message, by name.

    No error is raised: the result is empty for a file that is missing, cannot be read or is no
    recording, and for a .db3 file.  For a damaged file it has the records before the damage.  Of
    several records of one name, the last is returned.
    """
    found: dict[str, Mapping[str, str]] = {}
    with suppress(Exception):  # whatever it is, it is no recording
        for part in scan(path, 1.0):
            if isinstance(part, Damage) or part.messages:
                break
            found |= {e.name: e.metadata for e in part.entries if isinstance(e, Metadata)}
    return found


def _contents_of_file(
    file: IO[bytes], file_size: int, limit: int
) -> Iterator[RecordContents | Damage]:
    remaining = limit
    channels: set[int] = set()
    first, last, count = TIME_LIMIT, 0, 0
    end, in_index = len(MCAP0_MAGIC), False
    try:
        reader = _Reader(file, emit_chunks=True, validate_crcs=True, record_size_limit=file_size)
        for record in reader.records:
            in_index = in_index or isinstance(record, DataEnd)
            if not in_index:
                contents = _contents_of_record(record, remaining)
                size = record.uncompressed_size if isinstance(record, Chunk) else 0
                remaining -= size + MESSAGE_COST * len(contents.messages)
                if remaining < 0:
                    raise ValueError(TOO_LARGE)
                channels.update(each.id for each in contents.entries if isinstance(each, Channel))
                if contents.messages:
                    _check(contents.messages, channels)
                    found = usable(contents.messages, remaining)
                    remaining -= found.unpacked
                    contents = contents._replace(messages=found.messages, rejected=found.rejected)
                    if found.times:
                        first, last = min(first, *found.times), max(last, *found.times)
                        count += len(found.times)
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
    """Return a record's contents, without any if it is of a kind that is not used.

    ValueError if a chunk unpacks to more than ``limit`` bytes or is damaged.
    """
    if isinstance(record, Chunk):
        return _records_in(_unpacked(record, limit))
    if isinstance(record, Message):
        return RecordContents((), [(record.channel_id, record.log_time, record.data)])
    is_used = isinstance(record, Schema | Channel | Attachment | Metadata)
    return RecordContents((record,) if is_used else ())  # type: ignore[arg-type]


def _unpacked(chunk: Chunk, limit: int) -> bytes:
    """Return the serialised records of a chunk, unpacked and checked.

    ValueError if they have more than ``limit`` bytes, another size or checksum than the chunk
    states (a checksum of 0 is not checked), an unknown compression, or a damaged one.
    """
    size = chunk.uncompressed_size
    if size > limit:
        raise ValueError(f"a chunk unpacks to {size} bytes, more than is accepted for the file")
    if chunk.compression in ("zstd", "lz4"):
        records = unpacked(chunk.data, limit, size)
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
    """Return the definitions and messages in a chunk's serialised records; skip other records.

    EndOfFile or struct.error if the last record is incomplete.
    """
    definitions: list[Schema | Channel] = []
    messages: list[StoredMessage] = []
    position, end, size = 0, len(data), _MESSAGE.size
    view = memoryview(data)
    head, message_opcode = _MESSAGE.unpack_from, int(Opcode.MESSAGE)
    kinds = {int(Opcode.SCHEMA): Schema, int(Opcode.CHANNEL): Channel}
    while position < end:
        start, opcode = position, data[position]
        if opcode == message_opcode:
            _, length, channel, _, log_time, _ = head(data, start)
            position = start + _HEAD.size + length
            if position > end or length < size - _HEAD.size:
                raise EndOfFile
            body = (data if length < _LARGE else view)[start + size : position]
            messages.append((channel, log_time, body))
        else:
            _, length = _HEAD.unpack_from(data, start)
            position = start + _HEAD.size + length
            if position > end:
                raise EndOfFile
            if opcode in kinds:
                record = BytesIO(data[start + _HEAD.size : position])
                definitions.append(kinds[opcode].read(ReadDataStream(record)))
    return RecordContents(definitions, messages)


def _check(messages: Sequence[StoredMessage], channels: set[int]) -> None:
    if unknown := {message[0] for message in messages} - channels:
        raise ValueError(f"a message of unknown channel {min(unknown)}")


def _written(file: IO[bytes], file_size: int) -> int | None:
    """Return how many messages the index at a file's end reports.

    None if the file has no index, or a damaged one, or one without statistics.
    """
    with suppress(*_DAMAGE, OSError):
        file.seek(0)
        summary = SeekingReader(file, record_size_limit=file_size).get_summary()
        if summary is not None and summary.statistics is not None:
            return summary.statistics.message_count
    return None


def _in_words(error: Exception) -> str:
    """Return in words what is wrong with a file; ``error`` is what reading it raised (_DAMAGE)."""
    if isinstance(error, _INCOMPLETE):
        return "incomplete record"
    if isinstance(error, InvalidMagic):
        return "no end mark"
    if isinstance(error, CRCValidationError):
        return "wrong checksum of the data section: a byte outside the chunks is damaged"
    return one_line(str(error))
