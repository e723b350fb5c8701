"""Reading and writing of many serialised messages at once, as columns.

In a message of numbers and of texts of fixed length, every field has a fixed offset.  All messages
of a topic can therefore be read and written as one NumPy array of records.  Messages are the
little-endian CDR (XCDR1) of ROS 2: a 4-byte encapsulation header, then every number aligned to its
own size, counted from the end of the header.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from rosbags.interfaces import Nodetype
from rosbags.typesys.store import Typestore

from capture_sim.errors import MessageError
from capture_sim.messages.topics import Stamp, Topic

#: Fields of n messages, (n, ...) each, by their path in the message (``"header.stamp.sec"``).
Columns = Mapping[str, np.ndarray]

#: Bytes of the encapsulation header, from whose end fields are aligned (OMG DDSI-RTPS).
_HEADER = 4
#: Offset and length of a text, bytes.
_TextSlot = tuple[int, int]
_LITTLE_ENDIAN = b"\x00\x01"
#: Serialised format of each number type of ROS.
NUMBERS = {
    "bool": np.dtype("?"),
    **{name: np.dtype("u1") for name in ("byte", "char", "octet", "uint8")},
    **{
        f"{name}{bits}": np.dtype(f"<{letter}{bits // 8}")
        for name, letter, least in (("int", "i", 8), ("uint", "u", 16), ("float", "f", 32))
        for bits in (8, 16, 32, 64)
        if bits >= least
    },
}

#: Maximum number of fields of a message, including the fields of nested messages.
_MAX_FIELDS = 100_000

_TIME = struct.Struct("<iI")
_LENGTH = struct.Struct("<I")
_SEQUENCE = struct.Struct("<Q")


def stamp_of(topic: Topic, data: bytes | memoryview) -> int | None:
    """Return the stamp in a serialised message, ns; None if the type has no stamp."""
    if topic.stamp is Stamp.NONE:
        return None
    sec, nanosec = _unpacked(_TIME, topic, data, _HEADER)
    return sec * 1_000_000_000 + nanosec


def sequence_of(topic: Topic, data: bytes) -> int | None:
    """Return ``seq`` of a serialised message; None if the type has no such field."""
    if not topic.sequenced:
        return None
    (length,) = _unpacked(_LENGTH, topic, data, _HEADER + _TIME.size)  # of header.frame_id
    place = _HEADER + _aligned(_TIME.size + _LENGTH.size + length, _SEQUENCE.size)
    return _unpacked(_SEQUENCE, topic, data, place)[0]


def _unpacked(
    kind: struct.Struct, topic: Topic, data: bytes | memoryview, place: int
) -> tuple[int, ...]:
    try:
        return kind.unpack_from(data, place)
    except struct.error:
        raise MessageError(f"{topic.name}: message of {len(data)} bytes is truncated") from None


def columns(store: Typestore, type_name: str, messages: Sequence[bytes]) -> dict[str, np.ndarray]:
    """Return the fields of n serialised messages of a type as columns, by path.

    A path is e.g. ``"header.stamp.sec"``.  The column of a number is (n,), of an array of m numbers
    (n, m), and of a text (n,) with ``str`` objects.  Sequences of texts are (n,) with lists of
    ``str``; sequences of numbers whose length differs are (n,) with arrays.  MessageError is raised
    if a message does not fit the type, or if the type has a sequence of messages.
    """
    fields: dict[str, np.ndarray] = {}
    sizes = np.fromiter((len(data) for data in messages), dtype=np.int64, count=len(messages))
    by_size = np.argsort(sizes, kind="stable")
    for rows in np.split(by_size, np.flatnonzero(np.diff(sizes[by_size])) + 1):
        while len(rows):
            try:
                layout = Layout(store, type_name, messages[rows[0]])
            except KeyError as error:
                raise MessageError(f"{type_name}: {error} is not a known type") from None
            raw = np.frombuffer(b"".join([messages[i] for i in rows]), dtype=np.uint8)
            raw = raw.reshape(len(rows), -1)
            fits = (raw[:, layout.fixed] == raw[0, layout.fixed]).all(axis=1)
            _store_records(fields, layout, raw[fits], rows[fits], len(messages))
            rows = rows[~fits]
    for column in fields.values():
        column.flags.writeable = False
    return fields


class Numbers:
    """Reader of the numbers at given paths in messages that arrive one after another.

    The offsets are computed again only if the texts or sequences of a message have other lengths
    than in the previous message.
    """

    def __init__(self, store: Typestore, type_name: str, *paths: str) -> None:
        self._store, self._type_name, self._paths = store, type_name, list(paths)
        self._records = np.dtype([])
        self._fixed, self._lengths = np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.uint8)

    def __call__(self, data: bytes) -> np.void:
        """Return the numbers of a serialised message as a record, indexed by path.

        ``.item()`` of the record is a tuple of the numbers in the order of the paths.
        """
        raw = np.frombuffer(data, dtype=np.uint8)
        fits = len(raw) == self._records.itemsize and (raw[self._fixed] == self._lengths).all()
        if not fits:
            layout = Layout(self._store, self._type_name, data)
            self._records = layout.records[self._paths]
            self._fixed, self._lengths = layout.fixed, raw[layout.fixed]
        return raw.view(self._records)[0]  # type: ignore[no-any-return]  # of a record: np.void


class Template:
    """A serialised message in which the fields in ``columns`` are filled with n values each.

    All n messages share the texts and the lengths of sequences, so a field has the same offset in
    all of them.
    """

    def __init__(self, store: Typestore, message: Any, columns: Columns) -> None:
        for path, column in columns.items():
            fill(message, path, column[0])
        type_name = message.__msgtype__
        data = bytes(store.serialize_cdr(message, type_name))
        self._data = np.frombuffer(data, dtype=np.uint8)
        self._records = Layout(store, type_name, data).records

    def filled(self, columns: Columns) -> Iterator[bytes]:
        """Yield the n serialised messages with the values in ``columns``."""
        n, size = len(next(iter(columns.values()))), len(self._data)
        raw = np.tile(self._data, (n, 1))
        records = raw.view(self._records)[:, 0]
        for path, column in columns.items():
            records[path] = column
        whole = raw.tobytes()
        for start in range(0, len(whole), size):
            yield whole[start : start + size]


def fill(message: Any, path: str, value: Any) -> None:
    """Set the field at a path in a message of rosbags' classes."""
    *parts, name = path.split(".")
    for part in parts:
        message = getattr(message, part)
    current = getattr(message, name)
    if isinstance(current, np.ndarray):
        value = np.ascontiguousarray(value, dtype=current.dtype).ravel()
    setattr(message, name, value)


class Layout:
    """Offsets of the fields of a message, found by parsing its bytes along its definition.

    ``records`` is the dtype of the numbers, by path.  ``texts`` are offset and length of each text,
    or a list of these for a sequence.  ``fixed`` are the offsets of bytes that must be equal in
    another message for the layout to apply to it.  MessageError is raised if the bytes are no
    message of the type, or if the type has a sequence of messages.
    """

    def __init__(self, store: Typestore, type_name: str, data: bytes) -> None:
        if data[:2] != _LITTLE_ENDIAN:
            raise MessageError(f"{type_name}: encapsulation {data[:2].hex()} is not supported")
        self._store, self._type_name, self._data = store, type_name, data
        self._position = _HEADER
        self._numbers: list[tuple[str, object, int]] = []  # path, format, offset
        self.texts: dict[str, _TextSlot | list[_TextSlot]] = {}
        self._lengths: list[int] = []  # offsets of the lengths of texts and sequences
        self._n_fields = 0
        self._message("", type_name)
        # a transport may pad a message to a multiple of 4 bytes
        if not 0 <= len(data) - self._position < 4:
            raise MessageError(
                f"{type_name}: message of {len(data)} bytes, its definition makes {self._position}"
            )
        names, formats, offsets = zip(*self._numbers, strict=True) if self._numbers else ((),) * 3
        records: Any = {"names": names, "formats": formats, "offsets": offsets}
        records["itemsize"] = len(data)
        self.records = np.dtype(records)
        fixed = [0, 1, *(start + i for start in self._lengths for i in range(_LENGTH.size))]
        self.fixed = np.array(fixed, dtype=np.int64)

    def _message(self, prefix: str, type_name: str) -> None:
        fields = self._store.fielddefs[type_name][1]
        self._n_fields += len(fields) + 1
        if self._n_fields > _MAX_FIELDS:
            raise MessageError(f"{self._type_name}: more than {_MAX_FIELDS} fields")
        for name, (kind, definition) in fields:
            path = f"{prefix}{name}"
            if kind == Nodetype.BASE:
                if definition[0] == "string":
                    self.texts[path] = self._text()
                else:
                    self._number(path, definition[0], ())
            elif kind == Nodetype.NAME:
                self._message(f"{path}.", str(definition))
            else:
                (item_kind, item), count = definition
                if kind == Nodetype.SEQUENCE:
                    count = self._length()
                if item_kind != Nodetype.BASE:
                    if kind == Nodetype.SEQUENCE:
                        raise MessageError(
                            f"{self._type_name}.{path}: a sequence of messages makes no column"
                        )
                    for i in range(count):
                        self._message(f"{path}.{i}.", str(item))
                elif item[0] != "string":
                    self._number(path, item[0], (count,))
                elif count > len(self._data):
                    raise self._truncated()
                else:
                    self.texts[path] = [self._text() for _ in range(count)]

    def _number(self, path: str, name: str, shape: tuple[int, ...]) -> None:
        item = NUMBERS[name]
        if shape != (0,):
            self._align(item.itemsize)
        self._numbers.append((path, (item, shape) if shape else item, self._position))
        self._position += item.itemsize * math.prod(shape)

    def _align(self, size: int) -> None:
        self._position = _HEADER + _aligned(self._position - _HEADER, size)

    def _length(self) -> int:
        self._align(_LENGTH.size)
        start = self._position
        self._position += _LENGTH.size
        if self._position > len(self._data):
            raise self._truncated()
        self._lengths.append(start)
        (length,) = _LENGTH.unpack_from(self._data, start)
        if self._position + length > len(self._data) + 3:
            raise self._truncated()
        return int(length)

    def _text(self) -> _TextSlot:
        length, start = self._length(), self._position
        self._position += length
        return start, max(length - 1, 0)  # without the closing zero

    def _truncated(self) -> MessageError:
        return MessageError(f"{self._type_name}: message of {len(self._data)} bytes is truncated")


def _aligned(position: int, size: int) -> int:
    return (position + size - 1) // size * size


def _store_records(
    fields: dict[str, np.ndarray], layout: Layout, raw: np.ndarray, rows: np.ndarray, total: int
) -> None:
    records = np.ascontiguousarray(raw).view(layout.records)[:, 0]
    for name in layout.records.names or ():
        values = records[name]
        column = fields.get(name)
        if column is None:
            column = fields[name] = np.empty((total, *values.shape[1:]), dtype=values.dtype)
        if column.dtype != object and column.shape[1:] != values.shape[1:]:
            column = fields[name] = _as_objects(column)
        if column.dtype == object:
            for row, value in zip(rows, values, strict=True):
                column[row] = value.copy()
        else:
            column[rows] = values
    for name, slots in layout.texts.items():
        texts = fields.setdefault(name, np.empty(total, dtype=object))
        if isinstance(slots, list):
            parts = [_texts(raw, slot) for slot in slots]
            for i, row in enumerate(rows):
                texts[row] = [part[i] for part in parts]
        else:
            texts[rows] = _texts(raw, slots)


def _as_objects(column: np.ndarray) -> np.ndarray:
    objects = np.empty(len(column), dtype=object)
    for i, value in enumerate(column):
        objects[i] = value.copy()
    return objects


def _texts(raw: np.ndarray, slot: _TextSlot) -> np.ndarray:
    start, length = slot
    block = raw[:, start : start + length]
    texts = np.empty(len(raw), dtype=object)
    if (block == block[:1]).all():  # all equal, e.g. frame names: decode once
        texts[:] = block[0].tobytes().decode("utf-8", errors="replace")
    else:
        for i, row in enumerate(block):
            texts[i] = row.tobytes().decode("utf-8", errors="replace")
    return texts
