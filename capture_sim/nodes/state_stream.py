"""Many samples as serialised BenchState messages at once.

One message object a sample costs ten times what the core takes to compute it.  Here the
bytes of a whole block are written by columns; publishers take bytes as they take objects.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import Any

import numpy as np
from rclpy.serialization import serialize_message

from capture_sim.errors import CaptureSimError
from capture_sim.messaging.messages import WORLD, Messages, stamp_ns
from capture_sim.messaging.topics import BENCH_STATE
from capture_sim.nodes.running import message_class
from capture_sim.samples import SAMPLE

_NUMBERS = {"uint8": "u1", "uint32": "<u4", "uint64": "<u8", "double": "<f8"}
_FIELD = re.compile(r"(\w+)(?:\[(\d+)\])?$")


class StateStream:
    """Makes BenchState messages as bytes.

    The layout is XCDR1, little-endian: a header of 4 bytes, then every number aligned to its
    own size.  It follows from the message's definition, and is compared with what ROS makes of
    one message, when this is made.

    Raises
    ------
    CaptureSimError
        ROS serialises otherwise.
    """

    def __init__(self, messages: Messages) -> None:
        kind = message_class(BENCH_STATE.type_name)
        self._record = _layout(kind, WORLD)
        self._names = [name for name in self._record.names or () if name in (SAMPLE.names or ())]
        self._blank = np.zeros((), self._record)
        self._blank["encapsulation"] = [0, 1, 0, 0]
        self._blank["length"] = len(WORLD) + 1
        self._blank["frame"] = WORLD.encode()
        self._compare(messages)

    def __call__(self, first_seq: int, samples: np.ndarray) -> Iterator[bytes]:
        """Yield the message of each sample, (n,) of dtype SAMPLE; the first has ``first_seq``."""
        n = len(samples)
        records = np.full(n, self._blank)
        stamps = np.array([stamp_ns(t) for t in samples["t"].tolist()], dtype=np.int64)
        records["sec"], records["nanosec"] = np.divmod(stamps, 1_000_000_000)
        records["seq"] = first_seq + np.arange(n)
        for name in self._names:
            records[name] = samples[name]
        size = self._record.itemsize
        data = records.tobytes()
        for start in range(0, n * size, size):
            yield data[start : start + size]

    def _compare(self, messages: Messages) -> None:
        sample = np.zeros(1, SAMPLE)
        for i, name in enumerate(SAMPLE.names or ()):
            sample[name] = i + 1
        [ours] = self(7, sample)
        theirs = serialize_message(messages.bench_state(7, sample[0]))
        # ROS leaves in the padding what its memory held
        same = len(theirs) == len(ours)
        if same:
            a, b = (np.frombuffer(data, self._record) for data in (ours, theirs))
            same = all(a[name].tobytes() == b[name].tobytes() for name in self._record.names or ())
        if not same:
            raise CaptureSimError("BenchState: ROS serialises it otherwise than this node")


def _layout(kind: Any, frame: str) -> np.dtype:
    """Return the record of a message of a header and numbers, for a frame's name."""
    names = ["encapsulation", "sec", "nanosec", "length", "frame"]
    formats: list[Any] = [("u1", 4), "<i4", "<u4", "<u4", f"S{len(frame) + 1}"]
    offsets = [0, 4, 8, 12, 16]
    position = 12 + len(frame) + 1  # behind the encapsulation
    fields = dict(kind.get_fields_and_field_types())
    fields.pop("header")
    for name, text in fields.items():
        match = _FIELD.match(text)
        assert match is not None
        number = np.dtype(_NUMBERS[match[1]])
        count = int(match[2] or 1)
        position = -(-position // number.itemsize) * number.itemsize
        names.append(name)
        formats.append((number, count) if match[2] else number)
        offsets.append(4 + position)
        position += count * number.itemsize
    return np.dtype(
        {
            "names": names,
            "formats": formats,
            "offsets": offsets,
            "itemsize": 4 + position,
        }  # type: ignore[arg-type]  # NumPy's stubs want a TypedDict
    )
