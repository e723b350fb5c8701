"""The topics of a recording as columns: an array for each field.  Decoded at their first use."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path

import numpy as np
from rosbags.typesys.store import Typestore

from capture_sim.errors import MessageError, RecordingError
from capture_sim.messages.cdr import Layout, columns
from capture_sim.messages.definitions import NO_DEFINITION, store_of
from capture_sim.messages.evolution import absent_fields, completed
from capture_sim.messages.joints import JointWaitsError, NoJointsError
from capture_sim.messages.measurements import OF_A_BENCH, MeasurementReader
from capture_sim.messages.topics import (
    Topic,
    topic_named,
)
from capture_sim.recording.contents import Contents

Columns = Mapping[str, np.ndarray]


class RecordedTopics:
    """The topics of a recording, which is a file or a folder of files.

    A method takes a topic as an object of :class:`Topic` or as a name.  A Topic is one of the bench
    and must have its own type in the file.  A name gives whatever the file contains under it.  The
    names are the bench's, where topics were recorded under other names.
    """

    def __init__(self, path: Path, contents: Contents) -> None:
        self.path = path
        #: A line for each file that could not be read to its end.
        self.damage = contents.damage
        self._contents = contents
        self._columns: dict[str, Columns] = {}  # as in the file
        self._completed: dict[Topic, Columns] = {}
        self._measured: dict[str, tuple[np.ndarray, np.ndarray, np.ndarray]] = {}
        self._unused: dict[str, Counter[str]] = {}  # messages without a measurement, by reason

    @property
    def topics(self) -> dict[str, int]:
        """Number of messages by name of the topic."""
        return {name: len(messages) for name, messages in self._contents.messages.items()}

    @property
    def types(self) -> dict[str, str]:
        """Type of the messages (``package/msg/Name``) by name of the topic."""
        return self._contents.types

    def has(self, topic: str | Topic) -> bool:
        """Return True if there are messages under the name of a topic, of whatever type."""
        name = topic if isinstance(topic, str) else topic.name
        return bool(self._contents.messages.get(self._resolved(name)))

    def holds(self, topic: Topic) -> bool:
        """Return True if there are messages of the topic, and they have its type."""
        name = self._resolved(topic.name)
        is_typed = self._contents.types.get(name) == topic.type_name
        return is_typed and bool(self._contents.messages[name])

    @property
    def typed(self) -> dict[Topic, Sequence[bytes]]:
        """Serialised messages by topic of the bench, for each that has its own type in the file."""
        return {
            topic: messages
            for name, messages in self._contents.messages.items()
            if (topic := topic_named(name)) and self._contents.types[name] == topic.type_name
        }

    def log_times(self, topic: str | Topic) -> np.ndarray:
        """Return the log times of a topic's messages, (n,) int64, ns, ascending.

        RecordingError if the topic is given as a Topic and has another type in the file.
        """
        return np.array(self._contents.log_times.get(self._resolved(topic), ()), dtype=np.int64)

    def raw(self, topic: str | Topic) -> list[bytes]:
        """Return the serialised messages of a topic, in the order of their log times.

        RecordingError if the topic is given as a Topic and has another type in the file.
        """
        return list(self._contents.messages.get(self._resolved(topic), ()))

    def columns(self, topic: str | Topic) -> Columns:
        """Return the fields of a topic's messages as arrays, by path, e.g. ``header.stamp.sec``.

        Empty for a topic without messages; see :func:`capture_sim.messages.cdr.columns`.  A Topic
        gets all fields of its type: fields that are newer than the recording have their defaults.
        A name gets the fields that the file defines.

        MessageError, a RecordingError, if a message does not fit its definition.  RecordingError if
        a Topic has another type in the file, or if the file's definition lacks a field that has no
        default.
        """
        name = self._resolved(topic)
        if isinstance(topic, Topic) and self._contents.messages.get(name):
            self.store_of_topic(topic)
        if name not in self._columns:
            self._columns[name] = self._decoded(name)
        if isinstance(topic, str) or not self._columns[name]:
            return self._columns[name]
        if topic not in self._completed:
            of_type = self.store_of_topic(topic), topic.type_name
            self._completed[topic] = completed(self._columns[name], *of_type)
        return self._completed[topic]

    def columns_if_typed(self, topic: Topic) -> Columns:
        """Return a topic's columns as :meth:`columns`; empty if it has another type in the file."""
        return self.columns(topic) if self.holds(topic) else {}

    def _decoded(self, name: str) -> Columns:
        messages = self._contents.messages.get(name)
        if not messages:
            return {}
        type_name = self._contents.types[name]
        try:
            return columns(self.store_for(type_name), type_name, messages)
        except RecursionError:
            raise RecordingError(
                f"{self.path}: definition of type {type_name!r} contains itself"
            ) from None
        except MessageError as error:
            raise self._unreadable(name, error) from None

    def store_of_topic(self, topic: Topic) -> Typestore:
        """Return the types of the file, with which a topic's messages are decoded.

        RecordingError if the topic's type lacks a field there that has no default.  :meth:`columns`
        of a Topic and :meth:`measured` make this check.
        """
        store = self.store_for(topic.type_name)
        try:
            absent_fields(store, topic.type_name)
        except MessageError as error:
            raise RecordingError(f"{self.path}: {topic.name}: {error}") from None
        return store

    def store_for(self, type_name: str) -> Typestore:
        """Return a store of types that has this type as the file defines it.

        RecordingError if the definition in the file cannot be read.
        """
        text = self._contents.schemas.get(type_name, "")
        try:
            return store_of(type_name, text, self._contents.encodings.get(type_name, ""))
        except NO_DEFINITION as error:
            reason = " ".join(str(error).split())
            raise RecordingError(
                f"{self.path}: definition of type {type_name!r} cannot be read: {reason}"
            ) from None

    def readable(self, topic: Topic) -> tuple[Columns, np.ndarray]:
        """Return columns, and log times (n,), ns, of a topic's messages, without damaged ones.

        MessageError if none of the messages fits its definition.
        """
        log_times = self.log_times(topic)
        try:
            return self.columns(topic), log_times
        except MessageError:  # a damaged message must not hide the others
            messages = self.raw(topic)
            fits = [self._fits(topic, data) for data in messages]
            if not any(fits):
                raise
            store = self.store_for(topic.type_name)
            kept = [data for data, is_kept in zip(messages, fits, strict=True) if is_kept]
            fields = columns(store, topic.type_name, kept)
            return completed(fields, store, topic.type_name), log_times[np.array(fits)]

    def _fits(self, topic: Topic, data: bytes) -> bool:
        try:
            Layout(self.store_for(topic.type_name), topic.type_name, data)
        except MessageError:
            return False
        return True

    def measured(self, topic: Topic) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return stamps (n,), ns, values (n, m) and log times (n,), ns, of a topic that measures.

        The topic is one of those that give the detector chaser, target or buffer; the values are
        the pose or the deflections, and then their rates, NaN if a message lacks them.  Messages
        that cannot be decoded, that have a stamp of 0, and joint states of other joints are left
        out; :meth:`unused` counts them.  MessageError if a message cannot be decoded and no other
        gives a measurement.
        """
        if topic.name not in self._measured:
            self._measured[topic.name] = self._measurements(topic)
        return self._measured[topic.name]

    def measures(self, topic: Topic) -> bool:
        """Return True if a message of a topic that measures gives values, finite or not."""
        try:
            return self.measured(topic)[0].size > 0
        except MessageError:
            return False

    def unused(self, topic: Topic) -> str:
        """Return how many messages of a topic that measures give no measurement, and why.

        The text names at most three reasons, the most frequent ones; one is that a measurement is
        not finite.  It is empty if the topic has no messages or another type.
        """
        if not self.holds(topic):
            return ""
        n_infinite = 0
        with suppress(MessageError):  # no message gives a measurement, for reasons that are counted
            values = self.measured(topic)[1][:, : OF_A_BENCH[topic].size]
            n_infinite = int(np.count_nonzero(~np.isfinite(values).all(axis=1)))
        counts = self._unused[topic.name] + Counter({"not finite": n_infinite})
        total = self.topics[self._resolved(topic)]
        return "; ".join(f"{n} of {total} messages: {why}" for why, n in counts.most_common(3))

    def _measurements(self, topic: Topic) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        messages = self.raw(topic)
        store = self.store_of_topic(topic) if messages else self.store_for(topic.type_name)
        read = MeasurementReader(topic, store)
        rows, size, first_error = [], OF_A_BENCH[topic].size, None
        unused = self._unused[topic.name] = Counter()
        waiting: Counter[str] = Counter()
        for log_time, data in zip(self.log_times(topic).tolist(), messages, strict=True):
            try:
                stamp, values = read(data)
            except JointWaitsError as error:
                waiting[str(error)] += 1
                continue
            except NoJointsError as error:
                unused[str(error)] += 1
                continue
            except MessageError as error:  # a damaged message must not hide the others
                first_error = first_error or error
                unused["cannot be decoded"] += 1
                continue
            if stamp == 0:
                unused["stamp 0, which is not set"] += 1
                continue
            values += (math.nan,) * (2 * size - len(values))
            rows.append((stamp, log_time, values))
        if not rows:
            unused.update(waiting)
        if first_error is not None and not rows:
            raise self._unreadable(topic.name, first_error)
        stamps, log_times = (np.array([row[i] for row in rows], dtype=np.int64) for i in (0, 1))
        return stamps, np.array([row[2] for row in rows]).reshape(len(rows), 2 * size), log_times

    def _unreadable(self, name: str, error: MessageError) -> MessageError:
        return MessageError(f"{self.path}: {name.lstrip('/')}: {error}")

    def _resolved(self, topic: str | Topic) -> str:
        name = topic if isinstance(topic, str) else topic.name
        absolute = name if name.startswith("/") else f"/{name}"
        name = absolute if absolute in self._contents.messages else name
        if isinstance(topic, Topic):
            type_name = self._contents.types.get(name, topic.type_name)
            if type_name != topic.type_name:
                raise RecordingError(
                    f"{self.path}: type of {name} = {type_name or 'none'}: must be "
                    f"{topic.type_name}"
                )
        return name
