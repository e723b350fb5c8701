"""Trials with damaged recordings: what must be read of a file that was cut or changed."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from mcap.reader import make_reader
from mcap.records import Channel, Chunk, Message
from mcap.stream_reader import StreamReader, breakup_chunk

#: Start and end of a chunk's record, and topic and bytes of its messages.
KnownChunk = tuple[int, int, list[tuple[str, bytes]]]


def expected(path: Path) -> list[KnownChunk]:
    """Return what is in each chunk of a whole file, read by the library's own readers."""
    topics: dict[int, str] = {}
    contents = []
    with path.open("rb") as file:
        summary = make_reader(file).get_summary()
        assert summary is not None
        file.seek(0)
        for record in StreamReader(file, emit_chunks=True, validate_crcs=True).records:
            if not isinstance(record, Chunk):
                continue
            messages = []
            for inner in breakup_chunk(record):
                if isinstance(inner, Channel):
                    topics[inner.id] = inner.topic
                elif isinstance(inner, Message):
                    messages.append((topics[inner.channel_id], inner.data))
            contents.append(messages)
    places = [(i.chunk_start_offset, i.chunk_length) for i in summary.chunk_indexes]
    return [
        (start, start + length, messages)
        for (start, length), messages in zip(places, contents, strict=True)
    ]


def cuts(path: Path, count: int, seed: int) -> Iterator[tuple[bytes, int]]:
    """Yield a file's bytes cut at random places, and the places."""
    data = path.read_bytes()
    for at in np.random.default_rng(seed).integers(8, len(data), size=count).tolist():
        yield data[:at], at
