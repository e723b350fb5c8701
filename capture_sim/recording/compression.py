"""Unpacks messages and files that are compressed by zstd or lz4, up to a limit of size."""

from __future__ import annotations

import zlib
from io import BytesIO
from typing import IO

import lz4.frame
import zstandard

_ZSTD, _LZ4 = b"\x28\xb5\x2f\xfd", b"\x04\x22\x4d\x18"
#: First bytes of what can be unpacked.  A CDR message begins with a byte of 0.
MAGICS = (_ZSTD, _LZ4)
#: What a damaged stream raises besides ValueError.
DAMAGED = (zstandard.ZstdError, RuntimeError, EOFError, zlib.error)
#: Kinds of compressed files that are named, not read: first bytes, name, command that unpacks.
_OTHERS = (
    (b"\x1f\x8b", "gzip", "gunzip -k"),
    (b"BZh", "bzip2", "bunzip2 -k"),
    (b"\xfd7zXZ\x00", "xz", "unxz -k"),
)
#: Bytes unpacked at a time, so that a small file cannot unpack to one that fills the memory.
_PIECE = 1 << 20
TOO_LARGE = "it unpacks to more than is accepted for the file"


def is_compressed(data: bytes) -> bool:
    """Return True if bytes begin like data that is compressed by zstd or lz4."""
    return data.startswith(MAGICS)


def other_compression(head: bytes) -> tuple[str, str] | None:
    """Return the name of a compression that is not supported, and a command that unpacks it.

    ``head`` are the first bytes of a file.  None if they are of no such compression.
    """
    for magic, name, command in _OTHERS:
        if head.startswith(magic):
            return name, command
    return None


def unpacked(data: bytes, limit: int, size: int | None = None) -> bytes:
    """Return bytes that are compressed by zstd or lz4 unpacked.

    ``size`` is the number of bytes that they should unpack to, None if it is not known.  ValueError
    if they unpack to more than ``limit`` bytes or not to ``size``, or if they are damaged.
    """
    out = BytesIO()
    reason = unpack(BytesIO(data), out, limit if size is None else min(size, limit))
    found = out.getvalue()
    try:  # -1: its first frame does not say its size
        least = zstandard.frame_content_size(data) if data.startswith(_ZSTD) else 0
    except DAMAGED as error:
        raise ValueError(str(error)) from None
    is_cut = not reason and len(found) < least
    if is_cut or (size is not None and (len(found) != size or reason == TOO_LARGE)):
        raise ValueError("it unpacks to another size than its own")
    if reason:
        raise ValueError(reason)
    return found


def unpack(file: IO[bytes], out: IO[bytes], limit: int) -> str:
    """Unpack a file compressed by zstd or lz4 into ``out``, at most ``limit`` bytes.

    Return the reason why not all of it was unpacked; empty if all was.
    """
    head = file.read(len(_ZSTD))
    file.seek(0)
    try:
        if head == _ZSTD:
            with zstandard.ZstdDecompressor().stream_reader(
                file, read_across_frames=True, closefd=False
            ) as stream:
                reason = _copy(stream, out, limit)
        else:
            with lz4.frame.LZ4FrameFile(file) as stream:
                reason = _copy(stream, out, limit)
    except (*DAMAGED, ValueError, MemoryError) as error:
        return f"damaged compression: {error}"
    return reason


def _copy(stream: IO[bytes], out: IO[bytes], limit: int) -> str:
    written = 0
    while piece := stream.read(_PIECE):
        out.write(piece[: limit - written])
        written += len(piece)
        if written > limit:
            return TOO_LARGE
    return ""
