"""Data read from one file of a recording: definitions, messages, and where the file is damaged."""

from __future__ import annotations

from collections.abc import Sequence
from contextvars import ContextVar
from typing import NamedTuple

from mcap.records import Attachment, Channel, Metadata, Schema

from capture_sim.recording.compression import MAGICS, TOO_LARGE, is_compressed, unpacked

#: A file may unpack to so many times its size, and to MIN_UNPACKED_LIMIT bytes in any case; the
#: bench's own recordings unpack to about five times.
MAX_UNPACKED_RATIO = 100.0
MIN_UNPACKED_LIMIT = 64 * 1024 * 1024
#: Memory that the messages of a recording may need, bytes.
MEMORY_LIMIT: ContextVar[int] = ContextVar("memory limit", default=2**30)
#: Bytes that a message needs in memory besides its own.
MESSAGE_COST = 100
#: Log times from here on (ns) do not fit into ROS's clock.
TIME_LIMIT = 1 << 63

#: A message: channel, log time (ns), bytes or a view of those of its chunk.  The library's
#: ``Message`` takes several times as long to make.
StoredMessage = tuple[int, int, bytes | memoryview]
_FIRST_BYTES = frozenset(magic[:1] for magic in MAGICS)


class RecordContents(NamedTuple):
    """Contents of one record of a file's data section; those of a chunk are of all its records.

    A .db3 file has no records: the definition of each of its topics, and each batch of its
    messages, is given as the contents of one.
    """

    entries: Sequence[Schema | Channel | Attachment | Metadata]
    messages: Sequence[StoredMessage] = ()
    rejected: Sequence[tuple[int, str]] = ()  # channel and reason of each message without use


class Damage(NamedTuple):
    """Why a file was not read to its end, and how far it was read."""

    start: int | None  # first byte that was not read; None if unknown
    size: int  # of the file, bytes
    reason: str
    messages: int  # messages read
    written: int | None  # messages written, if the file's index is intact and reports them
    duration: float  # s, from the first log time to the last that was read
    # the data section before it is complete, with the right checksum if it has one
    in_index: bool = False

    def __str__(self) -> str:
        total = "" if self.written is None else f" of {self.written}"
        start = f"up to byte {self.start} of {self.size}" if self.start is not None else "in part"
        text = f"read {start} ({self.reason}): {self.messages}{total} messages"
        return text + (f", the last {self.duration:.3f} s after the first" if self.messages else "")


class Usable(NamedTuple):
    """The messages of a record, divided into those that can be used and those that cannot."""

    messages: Sequence[StoredMessage]
    times: Sequence[int]  # their log times, ns
    rejected: Sequence[tuple[int, str]]  # channel and reason of each other message
    unpacked: int  # bytes of those that were compressed


def usable(messages: Sequence[StoredMessage], limit: int) -> Usable:
    """Return the messages that can be used, compressed ones unpacked, and reject the others.

    A message cannot be used if its log time is not within ROS's clock or its compression is
    damaged.  There must be at least one message.  ValueError if the compressed messages unpack to
    more than ``limit`` bytes in all; messages that were not compressed do not count.
    """
    times = [message[1] for message in messages]
    are_plain = _FIRST_BYTES.isdisjoint([bytes(message[2][:1]) for message in messages])
    if are_plain and min(times) >= 0 and max(times) < TIME_LIMIT:
        return Usable(messages, times, (), 0)
    kept: list[StoredMessage] = []
    rejected = []
    total = 0
    for channel, log_time, data in messages:
        if not 0 <= log_time < TIME_LIMIT:
            rejected.append((channel, f"log time {log_time} ns: must be 0 to 2^63 ns"))
            continue
        data = bytes(data)
        if is_compressed(data):
            try:
                data = unpacked(data, limit - total)
            except ValueError as error:
                if str(error) == TOO_LARGE:
                    raise
                rejected.append((channel, "damaged compression"))
                continue
            total += len(data)
        kept.append((channel, log_time, data))
    return Usable(kept, [message[1] for message in kept], rejected, total)
