"""What is whole in an MCAP file, in its order, and where it is damaged.

Everything is checked that carries a checksum, and within bounds.  The library's indexed readers
need the index at the file's end, which a killed recorder never wrote; its sequential one stops at
the first damage.
"""

from __future__ import annotations

import mmap
import re
import struct
import zlib
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from io import BytesIO
from pathlib import Path
from typing import Any, NamedTuple

import lz4.frame
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import EndOfFile, McapError
from mcap.opcode import Opcode
from mcap.reader import SeekingReader
from mcap.records import (
    Attachment,
    Channel,
    Chunk,
    DataEnd,
    McapRecord,
    Metadata,
    Schema,
)
from mcap.summary import Summary
from mcap.writer import MCAP0_MAGIC

from capture_sim.errors import RecordingError

#: A file may unpack to so many times its size, and to UNPACKED_LEAST bytes in any case; the
#: bench's own recordings unpack to about five times.
UNPACKED_RATIO = 100.0
UNPACKED_LEAST = 64 * 1024 * 1024
#: Bytes that a message takes in memory beside its own.
_MESSAGE_COST = 100
#: Opcodes from here on are anybody's own, and passed over.
_PRIVATE = 0x80

_HEAD = struct.Struct("<BQ")  # opcode, length
_MESSAGE = struct.Struct("<BQHIQQ")  # opcode, length, channel, sequence, log and publish time (ns)
_CHUNK = struct.Struct("<QQQII")  # first and last time, size, checksum, length of a name
_SIZE = struct.Struct("<Q")
_CRC = struct.Struct("<I")
_FOOTER = struct.Struct("<BQQQI")  # opcode, length, places of summary and offsets, checksum
# opcode of a chunk, and a length below 4 GB; looked ahead, so that hits may overlap
_CHUNK_HEAD = re.compile(rb"(?=\x06[\s\S]{4}\x00\x00\x00\x00)")

_READ: Mapping[int, Any] = {
    Opcode.SCHEMA: Schema,
    Opcode.CHANNEL: Channel,
    Opcode.CHUNK: Chunk,
    Opcode.ATTACHMENT: Attachment,
    Opcode.METADATA: Metadata,
    Opcode.DATA_END: DataEnd,
}
_PASSED_OVER = (Opcode.HEADER, Opcode.MESSAGE_INDEX)
#: A message: channel, log time (ns), bytes, publish time (ns), sequence.  The library's ``Message``
#: takes several times as long to make.
Stored = tuple[int, int, bytes, int, int]
#: What parsing of a damaged record may raise.
_DAMAGE = (
    McapError,
    struct.error,
    UnicodeDecodeError,
    ValueError,
    MemoryError,
    OverflowError,
    RuntimeError,  # lz4's
    zstandard.ZstdError,
)


class Whole(NamedTuple):
    """A whole record, and what a chunk holds; None for a kind that nothing is taken from."""

    start: int
    end: int
    record: McapRecord | None
    definitions: Sequence[Schema | Channel] = ()
    messages: Sequence[Stored] = ()


class Damage(NamedTuple):
    """Where a record is not whole, why, and whether the file ends within it."""

    start: int
    why: str
    cut: bool


class Index(NamedTuple):
    """What stands at a file's end; ``confirmed``: by a checksum."""

    start: int
    confirmed: bool
    summary: Summary


@contextmanager
def mapped(path: Path) -> Iterator[mmap.mmap]:
    """Map an MCAP file into memory.

    Raises
    ------
    RecordingError
        It cannot be read, or is none.
    """
    try:
        if not path.is_dir() and not path.stat().st_size:
            raise RecordingError(f"{path}: not an MCAP file")
        with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
            if data[: len(MCAP0_MAGIC)] != MCAP0_MAGIC:
                raise RecordingError(f"{path}: not an MCAP file")
            yield data
    except OSError as error:
        raise RecordingError(f"{path}: cannot read: {error.strerror or error}") from None


def scan(data: mmap.mmap, ratio: float) -> Iterator[Whole | Damage]:
    """Yield the whole records of a file's data section, and each place where one is not.

    Behind damage the next whole chunk is looked for byte by byte, since a damaged length leads
    anywhere; it may lie before the place that the length has led to.

    Parameters
    ----------
    data
        The file.
    ratio
        How many times its size it may unpack to.
    """
    left = int(max(UNPACKED_LEAST, ratio * len(data)))
    position = sure = len(MCAP0_MAGIC)
    while True:
        try:
            while True:
                found = _whole(data, position, left)
                if isinstance(found.record, Chunk):
                    left -= found.record.uncompressed_size + _MESSAGE_COST * len(found.messages)
                    if left < 0:
                        raise ValueError("it unpacks to more than is allowed for the file")
                yield found
                position = found.end
                if isinstance(found.record, Chunk | Attachment):
                    sure = position  # nothing before it needs another look
                if isinstance(found.record, DataEnd):
                    return
        except _DAMAGE as error:
            short = len(data) - position - _HEAD.size
            cut = short < 0 or _HEAD.unpack_from(data, position)[1] > short
            yield Damage(position, _in_words(error), cut)
        for match in _CHUNK_HEAD.finditer(data, sure):
            with suppress(*_DAMAGE):
                if _may_be_chunk(data, match.start()):
                    _whole(data, match.start(), left)
                    position = sure = match.start()
                    break
        else:
            return


def index_of(data: mmap.mmap) -> Index | None:
    """Return index and statistics; None where they are damaged or not there."""
    footer = len(data) - len(MCAP0_MAGIC) - _FOOTER.size
    if footer < 0 or not ends_with_mark(data):
        return None
    opcode, length, start, _, crc = _FOOTER.unpack_from(data, footer)
    if (opcode, length) != (Opcode.FOOTER, _FOOTER.size - _HEAD.size) or start > footer:
        return None
    end = footer + _FOOTER.size - _CRC.size
    if crc and zlib.crc32(memoryview(data)[start or footer : end]) != crc:
        return None
    summary = None
    with suppress(*_DAMAGE):
        summary = SeekingReader(data, record_size_limit=len(data)).get_summary()
    return Index(start or footer, bool(crc), summary or Summary())


def ends_with_mark(data: mmap.mmap) -> bool:
    """Whether a file has its end mark."""
    size = len(MCAP0_MAGIC)
    return len(data) > size and data[-size:] == MCAP0_MAGIC


def data_fit(data: mmap.mmap, end: Whole) -> bool | None:
    """Whether the data section fits the checksum at its end; None where it carries none."""
    assert isinstance(end.record, DataEnd)
    stored = end.record.data_section_crc
    return zlib.crc32(memoryview(data)[: end.start]) == stored if stored else None


def definitions_in(attachment: Attachment) -> list[Schema | Channel]:
    """Return the types and topics of an attached MCAP file, as far as they are whole."""
    found, position = [], len(MCAP0_MAGIC)
    with suppress(*_DAMAGE):
        while True:
            position, record = _parsed(attachment.data, position)
            if isinstance(record, Schema | Channel):
                found.append(record)
    return found


def _parsed(data: bytes | mmap.mmap, start: int) -> tuple[int, McapRecord | None]:
    """Return where a record ends, and its content if it is of a kind that is read."""
    opcode, length = _HEAD.unpack_from(data, start)
    begin, end = start + _HEAD.size, start + _HEAD.size + length
    if end > len(data):
        raise EndOfFile
    kind = _READ.get(opcode)
    return end, kind and kind.read(ReadDataStream(BytesIO(data[begin:end])))


def _whole(data: mmap.mmap, start: int, limit: int) -> Whole:
    """Return a record of the data section with what it holds, checked."""
    end, record = _parsed(data, start)
    opcode = data[start]
    if isinstance(record, Chunk):
        return Whole(start, end, record, *_records_in(_unpacked(record, limit)))
    if isinstance(record, Attachment):
        (crc,) = _CRC.unpack(data[end - _CRC.size : end])
        if crc and zlib.crc32(memoryview(data)[start + _HEAD.size : end - _CRC.size]) != crc:
            raise ValueError(f"attachment {record.name!r}: wrong checksum")
    elif opcode == Opcode.MESSAGE:  # outside chunks
        messages = _records_in(data[start:end])[1]
        return Whole(start, end, None, (), messages)
    elif record is None and opcode not in _PASSED_OVER and opcode < _PRIVATE:
        raise ValueError(f"a record of kind {opcode} among the data")
    return Whole(start, end, record)


def _unpacked(chunk: Chunk, limit: int) -> bytes:
    """Return the records of a chunk, its size and checksum being right."""
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
        raise ValueError("wrong checksum of a chunk")
    return records


def _records_in(data: bytes) -> tuple[list[Schema | Channel], list[Stored]]:
    """Return definitions and messages of a chunk."""
    definitions: list[Schema | Channel] = []
    messages: list[Stored] = []
    position, end, size = 0, len(data), _MESSAGE.size
    head, a_message = _MESSAGE.unpack_from, int(Opcode.MESSAGE)
    while position < end:
        if data[position] != a_message:
            position, record = _parsed(data, position)
            if isinstance(record, Schema | Channel):
                definitions.append(record)
            continue
        _, length, channel, sequence, log_time, publish_time = head(data, position)
        start, position = position, position + _HEAD.size + length
        if position > end or length < size - _HEAD.size:
            raise EndOfFile
        body = data[start + size : position]
        messages.append((channel, log_time, body, publish_time, sequence))
    return definitions, messages


def _may_be_chunk(data: mmap.mmap, at: int) -> bool:
    """Whether the lengths in a chunk's head fit together; looks at nothing behind it."""
    _, length = _HEAD.unpack_from(data, at)
    *_, name = _CHUNK.unpack_from(data, at + _HEAD.size)
    if name > len("zstd"):
        return False
    (size,) = _SIZE.unpack_from(data, at + _HEAD.size + _CHUNK.size + name)
    return bool(length == _CHUNK.size + name + _SIZE.size + size)


def _in_words(error: Exception) -> str:
    """Return what is wrong with a record whose parsing raised one of _DAMAGE."""
    if isinstance(error, struct.error | EndOfFile | OverflowError | MemoryError):
        return "a length that does not fit"
    return " ".join(str(error).split())
