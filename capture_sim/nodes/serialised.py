"""The messages of many samples as bytes at once.

One message object a sample costs ten times what the core takes to compute it.  Here the
bytes of a whole block are written by columns; publishers take bytes as they take objects.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from rclpy.serialization import serialize_message

from capture_sim.errors import CaptureSimError
from capture_sim.messages import message_columns as columns_of
from capture_sim.messages.convert import Messages, SinceLastMessage
from capture_sim.messages.message_columns import Columns
from capture_sim.messages.telemetry import PERIODIC, OneByOne
from capture_sim.messages.topics import (
    BENCH_STATE,
    BUFFER_STATE,
    CHASER_ODOMETRY,
    CLOCK,
    CONTACT_STATE,
    CONTACT_WRENCH,
    JOINT_STATES,
    STRING_STATE,
    TARGET_ODOMETRY,
    Stamp,
    Topic,
)
from capture_sim.samples import SAMPLE
from capture_sim.scene.parts import Scene

_NUMBERS = {
    "boolean": "?",
    "uint8": "u1",
    "int32": "<i4",
    "uint32": "<u4",
    "uint64": "<u8",
    "double": "<f8",
}
_FIXED = re.compile(r"(\w+)\[(\d+)\]$")
_SEQUENCE = re.compile(r"sequence<(\w+)>$")
_ENCAPSULATION = 4


class SerialisedBlocks:
    """Makes what :class:`capture_sim.messages.telemetry.OneByOne` makes, as bytes.

    Parameters
    ----------
    messages
        Makes an example of each type.
    scene
        What is on the bench.

    Raises
    ------
    CaptureSimError
        ROS serialises a type otherwise than is thought here.
    """

    def __init__(self, messages: Messages, scene: Scene) -> None:
        self._columns: dict[Topic, Callable[[np.ndarray], Columns]] = {
            CLOCK: lambda samples: {},
            BUFFER_STATE: columns_of.buffer_states,
            CONTACT_STATE: lambda samples: columns_of.contact_states(samples, {}),
            STRING_STATE: lambda samples: columns_of.string_states(
                samples,
                has_string=scene.string is not None,
                rail_heading=scene.initial.chaser.theta,
            ),
            CHASER_ODOMETRY: columns_of.chaser_odometry,
            TARGET_ODOMETRY: columns_of.target_odometry,
            CONTACT_WRENCH: columns_of.contact_wrenches,
            JOINT_STATES: columns_of.joint_states,
        }
        one_by_one = OneByOne(messages, scene)
        sample = np.zeros(1, SAMPLE)
        for i, name in enumerate(SAMPLE.names or ()):
            sample[name] = i + 1
        nothing = SinceLastMessage(0.0, 0.0, 0)
        examples: dict[Topic, Any] = {BENCH_STATE: next(one_by_one.states(7, sample))}
        [make] = one_by_one.sets(7, sample)
        examples.update(zip(PERIODIC, make(nothing), strict=True))
        self._layouts = {topic: _Layout(example) for topic, example in examples.items()}
        self._compare(sample, examples, nothing)

    def states(self, first_seq: int, samples: np.ndarray) -> Iterator[bytes]:
        """Yield BenchState of each sample, (n,) of dtype SAMPLE; the first has ``first_seq``."""
        stamps = columns_of.stamps_ns(samples["t"])
        records = self._filled(BENCH_STATE, stamps, first_seq, columns_of.bench_states(samples))
        return _cut(records)

    def sets(
        self, first_seq: int, samples: np.ndarray
    ) -> Iterator[Callable[[SinceLastMessage], list[bytes]]]:
        """Yield for each sample what makes its periodic messages, as ``OneByOne.sets`` does."""
        if not len(samples):
            return
        stamps = columns_of.stamps_ns(samples["t"])
        records = {
            topic: self._filled(topic, stamps, first_seq, columns(samples))
            for topic, columns in self._columns.items()
        }
        contact = records[CONTACT_STATE]
        place = PERIODIC.index(CONTACT_STATE)
        others = [list(_cut(records[topic])) for topic in PERIODIC]
        for i, made in enumerate(zip(*others, strict=True)):

            def make(
                since: SinceLastMessage, i: int = i, made: tuple[bytes, ...] = made
            ) -> list[bytes]:
                # only now is known what the contact did
                contact["peak_force"][i] = since.peak_force
                contact["impulse"][i] = since.impulse
                contact["touches"][i] = since.touches
                return [*made[:place], contact[i].tobytes(), *made[place + 1 :]]

            yield make

    def _filled(self, topic: Topic, stamps: np.ndarray, seq: int, columns: Columns) -> np.ndarray:
        """Return the records of a topic's messages; the first one has ``seq``."""
        records = self._layouts[topic].blank(len(stamps))
        path = "clock" if topic.stamp is Stamp.CLOCK else "header.stamp"
        for name, column in columns_of.stamp_columns(stamps, path).items():
            records[name] = column
        if topic.sequenced:
            records["seq"] = np.arange(seq, seq + len(stamps))
        for name, column in columns.items():
            records[name] = column
        return records

    def _compare(
        self, sample: np.ndarray, examples: dict[Topic, Any], since: SinceLastMessage
    ) -> None:
        [make] = self.sets(7, sample)
        ours = {BENCH_STATE: next(self.states(7, sample))}
        ours.update(zip(PERIODIC, make(since), strict=True))
        for topic, data in ours.items():
            if not self._layouts[topic].same(data, serialize_message(examples[topic])):
                raise CaptureSimError(f"{topic.type_name}: ROS serialises it otherwise than this")


def _cut(records: np.ndarray) -> Iterator[bytes]:
    """Yield the bytes of each record."""
    data, size = records.tobytes(), records.dtype.itemsize
    for start in range(0, len(data), size):
        yield data[start : start + size]


class _Layout:
    """Where the numbers of a message are, given the lengths of its texts and sequences.

    XCDR1, little-endian: a header of 4 bytes, then every number aligned to its own size.

    Parameters
    ----------
    example
        Messages of this layout have its texts, and sequences of the same length.
    """

    def __init__(self, example: Any) -> None:
        self._position = 0
        self._numbers: dict[str, tuple[Any, int]] = {}  # format and offset, by path
        self._kept = [slice(0, _ENCAPSULATION)]  # all but padding
        self._walk(example, "")
        data = np.frombuffer(serialize_message(example), np.uint8)
        size = _ENCAPSULATION + self._position
        if not 0 <= len(data) - size < 4:  # ROS pads the end
            raise CaptureSimError(f"{type(example).__name__}: ROS serialises it otherwise")
        blank = np.zeros(size, np.uint8)
        for kept in self._kept:
            blank[kept] = data[kept]
        self._record = np.dtype(
            {
                "names": list(self._numbers),
                "formats": [kind for kind, _ in self._numbers.values()],
                "offsets": [offset for _, offset in self._numbers.values()],
                "itemsize": size,
            }  # type: ignore[arg-type]  # NumPy's stubs want a TypedDict
        )
        self._blank = blank

    def blank(self, n: int) -> np.ndarray:
        """Return n copies of the example, as records whose numbers can be set by their paths."""
        return np.tile(self._blank, (n, 1)).view(self._record)[:, 0]

    def same(self, a: bytes, b: bytes) -> bool:
        """Whether two messages are equal but for their padding."""
        mine, theirs = (np.frombuffer(data, np.uint8) for data in (a, b))
        return all(np.array_equal(mine[kept], theirs[kept]) for kept in self._kept)

    def _walk(self, message: Any, prefix: str) -> None:
        for name, text in message.get_fields_and_field_types().items():
            path, value = f"{prefix}{name}", getattr(message, name)
            if text in _NUMBERS:
                self._number(path, text, None)
            elif match := _FIXED.match(text):
                self._number(path, match[1], int(match[2]))
            elif text == "string":
                self._text(value)
            elif match := _SEQUENCE.match(text):
                self._bytes(4, 4)
                if match[1] == "string":
                    for item in value:
                        self._text(item)
                elif len(value):
                    self._number(path, match[1], len(value))
            else:
                self._walk(value, f"{path}.")

    def _number(self, path: str, text: str, count: int | None) -> None:
        kind = np.dtype(_NUMBERS[text])
        offset = self._bytes(kind.itemsize * (1 if count is None else count), kind.itemsize)
        self._numbers[path] = (kind if count is None else (kind, (count,)), offset)

    def _text(self, value: str) -> None:
        self._bytes(4, 4)
        self._bytes(len(value.encode()) + 1, 1)

    def _bytes(self, count: int, alignment: int) -> int:
        """Return where the next bytes are."""
        self._position = -(-self._position // alignment) * alignment
        start = _ENCAPSULATION + self._position
        self._kept.append(slice(start, start + count))
        self._position += count
        return start
