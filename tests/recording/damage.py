"""Trials with damaged recordings: what must be read of a file that was cut or changed."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from mcap.reader import make_reader
from mcap.records import Channel, Chunk, Message
from mcap.stream_reader import StreamReader, breakup_chunk

from capture_sim.errors import RecordingError
from capture_sim.recording.read import read_run
from capture_sim.recording.recover import recover

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


def flips(path: Path, count: int, seed: int) -> Iterator[tuple[bytes, int]]:
    """Yield a file's bytes with one random bit changed, and its place."""
    data = path.read_bytes()
    rng = np.random.default_rng([seed, 1])
    for at in rng.integers(8, len(data), size=count).tolist():
        changed = bytearray(data)
        changed[at] ^= 1 << int(rng.integers(8))
        yield bytes(changed), at


def messages_in(path: Path) -> Counter[tuple[str, bytes]]:
    """Return how often each message is in a file."""
    run = read_run(path)
    return Counter((topic, data) for topic in run.topics for data in run.raw(topic))


def copied_rightly(broken: Path, chunks: Sequence[KnownChunk], at: int) -> str:
    """Recover a file that was damaged at a byte; return what came of it, empty if it is wrong.

    Right is: every chunk before the damage is read and copied, with the very bytes of its
    messages, no other message is; a loss is reported, and again by the new file; a file without
    a chunk before the damage is refused.  ``"copied"`` or ``"refused"`` is returned.
    """
    before = Counter(message for _, end, messages in chunks if end <= at for message in messages)
    every = Counter(message for _, _, messages in chunks for message in messages)
    out = broken.with_name(f"{broken.stem}_copy.mcap")
    out.unlink(missing_ok=True)
    try:
        recovery = recover(broken, out)
    except RecordingError:
        return "" if before else "refused"
    copied = messages_in(out)
    is_reported = bool(recovery.losses) and not read_run(out).complete
    right = before <= copied <= every and copied == messages_in(broken)
    # a byte of the index, or behind all, loses nothing
    return "copied" if right and (is_reported or copied == every) else ""
