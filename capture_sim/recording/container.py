"""An MCAP file written chunk by chunk, message by message or thousands at a time.

Every record but the messages and their index is made by the ``mcap`` library's own record
classes; its ``Writer`` takes one message at a time, which costs more than all the rest of
recording a run.  Definitions of types and topics stand twice before the first message:
bare, and in the first chunk, where a checksum covers them; so a file whose first chunk is
lost can still be understood.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterable, Mapping, Sequence
from typing import IO

import numpy as np
import zstandard
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import (
    Attachment,
    AttachmentIndex,
    Channel,
    Chunk,
    ChunkIndex,
    DataEnd,
    Footer,
    Header,
    McapRecord,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
    SummaryOffset,
)
from mcap.writer import MCAP0_MAGIC

_MESSAGE = struct.Struct("<BQHIQQ")  # opcode, length, channel, sequence, log and publish time
_INDEX = struct.Struct("<BQHI")  # opcode, length, channel, bytes that follow
_FOOTER = struct.Struct("<BQQQ")
#: What stands before a message's data, as a record; opcode to publish time.
MESSAGE_HEAD = np.dtype(
    [
        ("opcode", "u1"),
        ("length", "<u8"),
        ("channel", "<u2"),
        ("sequence", "<u4"),
        ("log_time", "<u8"),
        ("publish_time", "<u8"),
    ]
)
_RECORD_HEAD = 9  # opcode and length, not counted in a record's length


class Container:
    """Writes one file: definitions, attachments and metadata, messages, then :meth:`finish`.

    Methods raise :class:`OSError` when the stream does; what was written before stays.

    Parameters
    ----------
    stream
        Opened for writing, at its start; stays open.
    chunk_size
        Uncompressed size at which a chunk is ended, bytes.
    """

    def __init__(self, stream: IO[bytes], chunk_size: int, library: str = "capture_sim") -> None:
        self._stream = stream
        self._chunk_size = chunk_size
        self._compressor = zstandard.ZstdCompressor()
        self._crc = 0
        self._position = 0
        self._schemas: list[Schema] = []
        self._channels: list[Channel] = []
        self._attachments: list[AttachmentIndex] = []
        self._metadata: list[MetadataIndex] = []
        self._chunks: list[ChunkIndex] = []
        self._defined = 0  # definitions that stand bare in the file
        self._explained = 0  # definitions that stand in a chunk
        # of the chunk in progress
        self._parts: list[bytes] = []
        self._part_channels: list[int] = []
        self._part_times: list[int] = []
        self._size = 0
        # of the file
        self._counts = np.zeros(1, dtype=np.int64)  # by channel id
        self._first_time: int | None = None
        self._last_time = 0
        self._put(MCAP0_MAGIC)
        self._put(_bytes([Header("ros2", library)]))

    @property
    def size(self) -> int:
        """Bytes in the file, the chunk in progress not counted."""
        return self._position

    @property
    def counts(self) -> list[int]:
        """Messages written so far, by channel id (from 1; the first entry is unused)."""
        return [int(count) for count in self._counts]

    def add_schema(self, name: str, encoding: str, data: bytes) -> int:
        """Define a type; return its id."""
        self._schemas.append(Schema(len(self._schemas) + 1, data, encoding, name))
        return len(self._schemas)

    def add_channel(
        self, topic: str, encoding: str, schema_id: int, metadata: Mapping[str, str]
    ) -> int:
        """Define a topic; return its id."""
        channel_id = len(self._channels) + 1
        self._channels.append(Channel(channel_id, topic, encoding, dict(metadata), schema_id))
        self._counts = np.append(self._counts, 0)
        return channel_id

    def add_attachment(self, name: str, media_type: str, data: bytes, time: int) -> None:
        """Write an attachment; it stands in the file at once."""
        attachment = Attachment(
            create_time=0, log_time=time, name=name, media_type=media_type, data=data
        )
        record = _bytes([attachment])
        self._attachments.append(
            AttachmentIndex(
                offset=self._position,
                length=len(record),
                create_time=0,
                log_time=time,
                data_size=len(data),
                name=name,
                media_type=media_type,
            )
        )
        self._put(record)

    def add_metadata(self, name: str, entries: Mapping[str, str]) -> None:
        """Write a metadata record; it stands in the file at once."""
        record = _bytes([Metadata(name=name, metadata=dict(entries))])
        self._metadata.append(MetadataIndex(self._position, len(record), name))
        self._put(record)

    def add(
        self, channel: int, sequence: int, log_time: int, publish_time: int, data: bytes
    ) -> None:
        """Write one message."""
        length = _MESSAGE.size - _RECORD_HEAD + len(data)
        head = _MESSAGE.pack(Opcode.MESSAGE, length, channel, sequence, log_time, publish_time)
        self._parts.append(head + data)
        self._part_channels.append(channel)
        self._part_times.append(log_time)
        self._size += _MESSAGE.size + len(data)
        if self._size > self._chunk_size:
            self.end_chunk()

    def add_records(
        self, records: Sequence[bytes], channels: np.ndarray, log_times: np.ndarray
    ) -> None:
        """Write many messages.

        Parameters
        ----------
        records
            n message records, each headed by a :data:`MESSAGE_HEAD`.
        channels, log_times
            (n,) what stands in the heads, ns.
        """
        lengths = np.fromiter(map(len, records), dtype=np.int64, count=len(records))
        ends = np.cumsum(lengths)
        ids, times = channels.tolist(), log_times.tolist()
        done, written = 0, 0
        while done < len(records):
            room = self._chunk_size - self._size
            stop = min(int(np.searchsorted(ends, written + room, side="right")) + 1, len(records))
            self._parts.extend(records[done:stop])
            self._part_channels.extend(ids[done:stop])
            self._part_times.extend(times[done:stop])
            self._size += int(ends[stop - 1]) - written
            done, written = stop, int(ends[stop - 1])
            if self._size > self._chunk_size:
                self.end_chunk()

    def define(self) -> None:
        """Write the definitions made so far; they stand in the file at once."""
        fresh = [*self._schemas, *self._channels]
        if len(fresh) > self._defined:
            self._put(_bytes(fresh))
            self._defined = len(fresh)

    def end_chunk(self) -> None:
        """Write the messages that wait, as a chunk with its index."""
        if not self._parts:
            return
        definitions = [*self._schemas, *self._channels]
        head = b""
        if self._explained < len(definitions):
            head = _bytes(definitions)
            self._explained = len(definitions)
        data = b"".join([head, *self._parts])
        channels = np.array(self._part_channels)
        times = np.array(self._part_times, dtype=np.int64)
        sizes = np.fromiter(map(len, self._parts), dtype=np.int64, count=len(self._parts))
        offsets = len(head) + np.cumsum(sizes) - sizes
        self._parts, self._part_channels, self._part_times, self._size = [], [], [], 0
        chunk = Chunk(
            compression="zstd",
            data=self._compressor.compress(data),
            message_start_time=int(times.min()),
            message_end_time=int(times.max()),
            uncompressed_crc=zlib.crc32(data),
            uncompressed_size=len(data),
        )
        record = _bytes([chunk])
        index, starts = _message_index(channels, times, offsets)
        after = self._position + len(record)
        self._chunks.append(
            ChunkIndex(
                chunk_length=len(record),
                chunk_start_offset=self._position,
                compression=chunk.compression,
                compressed_size=len(chunk.data),
                message_end_time=chunk.message_end_time,
                message_index_length=len(index),
                message_index_offsets={name: after + start for name, start in starts.items()},
                message_start_time=chunk.message_start_time,
                uncompressed_size=chunk.uncompressed_size,
            )
        )
        self._put(record)
        self._put(index)
        self._counts += np.bincount(channels, minlength=len(self._counts))
        first = chunk.message_start_time
        self._first_time = first if self._first_time is None else min(first, self._first_time)
        self._last_time = max(self._last_time, chunk.message_end_time)

    def flush(self) -> None:
        """Write what waits, and hand all to the operating system."""
        self.end_chunk()
        self._stream.flush()

    def finish(self) -> None:
        """Write what waits, then index, statistics and end mark."""
        self.end_chunk()
        self.define()
        self._put(_bytes([DataEnd(self._crc)]))
        start = self._position
        groups: list[tuple[Opcode, Sequence[McapRecord]]] = [
            (Opcode.SCHEMA, self._schemas),
            (Opcode.CHANNEL, self._channels),
            (Opcode.STATISTICS, [self._statistics()]),
            (Opcode.CHUNK_INDEX, self._chunks),
            (Opcode.ATTACHMENT_INDEX, self._attachments),
            (Opcode.METADATA_INDEX, self._metadata),
        ]
        summary = b""
        offsets = []
        for opcode, records in groups:
            group = _bytes(records)
            if group:
                offsets.append(
                    SummaryOffset(
                        group_opcode=opcode,
                        group_start=start + len(summary),
                        group_length=len(group),
                    )
                )
            summary += group
        offset_start = start + len(summary)
        summary += _bytes(offsets)
        crc = zlib.crc32(_FOOTER.pack(Opcode.FOOTER, 20, start, offset_start), zlib.crc32(summary))
        self._put(summary)
        self._put(_bytes([Footer(start, offset_start, crc)]))
        self._put(MCAP0_MAGIC)

    def _statistics(self) -> Statistics:
        counts = {i: int(n) for i, n in enumerate(self._counts) if i > 0 and n > 0}
        return Statistics(
            attachment_count=len(self._attachments),
            channel_count=len(self._channels),
            channel_message_counts=counts,
            chunk_count=len(self._chunks),
            message_count=sum(counts.values()),
            message_end_time=self._last_time,
            message_start_time=self._first_time or 0,
            metadata_count=len(self._metadata),
            schema_count=len(self._schemas),
        )

    def _put(self, data: bytes) -> None:
        self._stream.write(data)
        self._crc = zlib.crc32(data, self._crc)
        self._position += len(data)


def _bytes(records: Iterable[McapRecord]) -> bytes:
    builder = RecordBuilder()
    for record in records:
        record.write(builder)
    return builder.end()


def _message_index(
    channels: np.ndarray, times: np.ndarray, offsets: np.ndarray
) -> tuple[bytes, dict[int, int]]:
    """Return the message index records of a chunk, and where each channel's starts."""
    order = np.argsort(channels, kind="stable")
    pairs = np.empty((len(order), 2), dtype="<u8")
    pairs[:, 0] = times[order]
    pairs[:, 1] = offsets[order]
    ids, first = np.unique(channels[order], return_index=True)
    parts: list[bytes] = []
    starts: dict[int, int] = {}
    position = 0
    for channel, begin, end in zip(
        ids.tolist(), first.tolist(), [*first[1:].tolist(), len(order)], strict=True
    ):
        entries = pairs[begin:end].tobytes()
        starts[channel] = position
        length = _INDEX.size - _RECORD_HEAD + len(entries)
        parts.append(_INDEX.pack(Opcode.MESSAGE_INDEX, length, channel, len(entries)) + entries)
        position += _INDEX.size + len(entries)
    return b"".join(parts), starts
