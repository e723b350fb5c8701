"""Writing one run as one MCAP file that ``ros2 bag`` takes as it is."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import IO, NamedTuple, Self

import numpy as np

from capture_sim.errors import RecordingError
from capture_sim.messages.convert import EPOCH_NS, Message, RunDescription
from capture_sim.messages.topics import RECORDED, Topic
from capture_sim.recording.bag_metadata import (
    FileEntry,
    TopicEntry,
    bag_metadata,
    dump,
    qos_profile,
)
from capture_sim.recording.cdr import stamp_of
from capture_sim.recording.container import MESSAGE_HEAD, Container
from capture_sim.recording.definitions import schema_text, type_hash, typestore

#: Name of the attachment that holds the resolved scene.
SCENE_ATTACHMENT = "scene.yaml"
#: Name of the metadata record that tells how the run was made.
RUN_METADATA = "capture_sim"
#: Name of the metadata record that is written last, with what is known at the end only.
END_METADATA = "capture_sim_end"
#: Uncompressed size of a chunk, bytes: what a kill can lose at most.
CHUNK_SIZE = 128 * 1024


class Rows(NamedTuple):
    """Messages of one topic, all of one length.

    Attributes
    ----------
    topic
        What they are sent on.
    times : ndarray (n,) int64
        Log and publish times, ns.
    data : ndarray (n, size) uint8
        The serialised messages.
    """

    topic: Topic
    times: np.ndarray
    data: np.ndarray


class RunWriter:
    """Writes one run: ``with RunWriter(path, run) as writer: writer.write(topic, message)``.

    Scene and description stand in the file before the first message and survive a kill.
    Every message is logged and published at the simulated time it carries; one that
    carries none, at the latest time so far.

    Parameters
    ----------
    path
        File to write.
    run
        What is recorded.
    metadata
        Further entries for the metadata record.
    topics
        What may be written.
    replace
        Whether a file that exists may be replaced.

    Raises
    ------
    RecordingError
        The file cannot be written.
    """

    def __init__(
        self,
        path: Path | str,
        run: RunDescription,
        metadata: Mapping[str, str] | None = None,
        *,
        topics: Sequence[Topic] = RECORDED,
        replace: bool = False,
    ) -> None:
        self.path = Path(path)
        self.run = run
        self._counts: dict[Topic, int] = dict.fromkeys(topics, 0)
        self._channels: dict[Topic, int] = {}
        self._first_time: int | None = None
        self._last_time = EPOCH_NS
        self._store = typestore()
        #: Entries for the metadata record at the end.
        self.closing: dict[str, str] = {}
        self._file: IO[bytes] | None = None
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            self._file = self.path.open("wb" if replace else "xb")
            self._container = Container(self._file, CHUNK_SIZE)
            self._begin(dict(metadata or {}))
        except OSError as error:
            raise self._given_up(error) from None

    def write(self, topic: Topic, message: Message) -> None:
        """Write a message object of rosbags' classes.

        Raises
        ------
        RecordingError
            The file cannot be written.
        """
        self.write_raw(topic, self._store.serialize_cdr(message, topic.type_name))

    def write_raw(self, topic: Topic, data: bytes | memoryview) -> None:
        """Write a serialised message.

        Raises
        ------
        RecordingError
            The file cannot be written, or is closed.
        """
        self._check_open()
        stamp = stamp_of(topic, data)
        time = self._last_time if stamp is None else stamp
        count = self._counts[topic]
        try:
            self._container.add(self._channels[topic], count, time, time, bytes(data))
        except OSError as error:
            raise self._given_up(error) from None
        self._counts[topic] = count + 1
        self._note_times(time, time)

    def write_rows(self, blocks: Sequence[Rows], order: np.ndarray) -> None:
        """Write many serialised messages at once.

        Parameters
        ----------
        blocks
            A topic's blocks follow each other in time.
        order
            (n,) which of all their messages, counted through, comes next in the file.

        Raises
        ------
        RecordingError
            The file cannot be written, or is closed.
        """
        self._check_open()
        records: list[bytes] = []
        for rows in blocks:
            records += self._records(rows)
        if not records:
            return
        sizes = [len(rows.times) for rows in blocks]
        channels = np.repeat([self._channels[rows.topic] for rows in blocks], sizes)[order]
        times = np.concatenate([rows.times for rows in blocks])
        try:
            in_order = [records[i] for i in order.tolist()]
            self._container.add_records(in_order, channels, times[order])
        except OSError as error:
            raise self._given_up(error) from None
        self._note_times(int(times.min()), int(times.max()))

    def flush(self) -> None:
        """End the chunk in progress and hand all to the operating system.

        Raises
        ------
        RecordingError
            The file cannot be written.
        """
        if self._file is None:
            return
        try:
            self._container.flush()
        except OSError as error:
            raise self._given_up(error) from None

    def close(self) -> None:
        """Write index and summary and close the file; a second call does nothing.

        Raises
        ------
        RecordingError
            The file cannot be written.
        """
        if self._file is None:
            return
        try:
            self._container.end_chunk()
            if self.closing:
                self._container.add_metadata(END_METADATA, self.closing)
            text = bag_metadata(self.topic_entries(), [self.file_entry], self._custom)
            self._container.add_metadata("rosbag2", {"serialized_metadata": text})
            self._container.finish()
            self._file.close()
            self._file = None
        except OSError as error:
            raise self._given_up(error) from None

    @property
    def counts(self) -> dict[str, int]:
        """Messages written so far, by topic name."""
        return {topic.name: count for topic, count in self._counts.items()}

    @property
    def size(self) -> int:
        """Bytes written so far, the chunk in progress not counted."""
        return self._container.size

    @property
    def span(self) -> float:
        """Simulated time from the first to the last message so far, s."""
        first = self._last_time if self._first_time is None else self._first_time
        return (self._last_time - first) / 1e9

    @property
    def file_entry(self) -> FileEntry:
        """What a bag's metadata tells of the file."""
        start = EPOCH_NS if self._first_time is None else self._first_time
        return FileEntry(self.path.name, start, self._last_time, sum(self._counts.values()))

    def topic_entries(self) -> list[TopicEntry]:
        """Return what a bag's metadata tells of its topics."""
        return [
            TopicEntry(
                topic.absolute_name,
                topic.type_name,
                [qos_profile(topic)],
                type_hash(topic.type_name),
                count,
            )
            for topic, count in self._counts.items()
        ]

    @property
    def _custom(self) -> dict[str, str]:
        return {"run_id": self.run.run_id}

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        if kind is None:
            self.close()
        else:  # what is there stays readable; the first error is the one to show
            with suppress(RecordingError):
                self.close()

    def _begin(self, metadata: dict[str, str]) -> None:
        self._container.add_attachment(
            SCENE_ATTACHMENT, "application/yaml", self.run.scene.encode(), EPOCH_NS
        )
        self._container.add_metadata(RUN_METADATA, {**describing(self.run), **metadata})
        schemas = {
            name: self._container.add_schema(name, "ros2msg", schema_text(name).encode())
            for name in dict.fromkeys(topic.type_name for topic in self._counts)
        }
        for topic in self._counts:
            self._channels[topic] = self._container.add_channel(
                topic.absolute_name,
                "cdr",
                schemas[topic.type_name],
                {
                    "offered_qos_profiles": dump([qos_profile(topic)]),
                    "topic_type_hash": type_hash(topic.type_name),
                },
            )
        self._container.define()
        if self._file is not None:
            self._file.flush()

    def _records(self, rows: Rows) -> list[bytes]:
        """Return the message records of a block, as bytes each."""
        n, size = rows.data.shape
        first = self._counts[rows.topic]
        self._counts[rows.topic] = first + n
        heads = np.empty(n, dtype=MESSAGE_HEAD)
        heads["opcode"] = 5
        heads["length"] = MESSAGE_HEAD.itemsize - 9 + size
        heads["channel"] = self._channels[rows.topic]
        heads["sequence"] = np.arange(first, first + n)
        heads["log_time"] = heads["publish_time"] = rows.times
        whole = np.empty((n, MESSAGE_HEAD.itemsize + size), dtype=np.uint8)
        whole[:, : MESSAGE_HEAD.itemsize] = heads.view(np.uint8).reshape(n, -1)
        whole[:, MESSAGE_HEAD.itemsize :] = rows.data
        text, step = whole.tobytes(), whole.shape[1]
        return [text[at : at + step] for at in range(0, len(text), step)]

    def _note_times(self, first: int, last: int) -> None:
        self._last_time = max(self._last_time, last)
        self._first_time = first if self._first_time is None else min(self._first_time, first)

    def _check_open(self) -> None:
        if self._file is None:
            raise RecordingError(f"{self.path}: already closed")

    def _given_up(self, error: OSError) -> RecordingError:
        """Close the file as it is, and say why; buffered bytes that the disk refuses are lost."""
        if self._file is not None:
            with suppress(OSError):
                self._file.close()
            self._file = None
        return RecordingError(f"{self.path}: cannot write: {error.strerror or error}")


def describing(run: RunDescription) -> dict[str, str]:
    """Return the entries of a file's metadata record that describe its run."""
    return {
        "run_id": run.run_id,
        "name": run.name,
        "scene_sha256": run.scene_sha256,
        "software": "\n".join(run.software),
        "state_rate": repr(run.state_rate),
        "rate": repr(run.rate),
        "publishers": "\n".join(run.publishers),
    }


def free_path(path: Path, taken: Iterable[Path] = ()) -> Path:
    """Return the path, or with ``_2``, ``_3`` ... behind its stem the first that is free."""
    others = set(taken)
    candidate, number = path, 1
    while candidate.exists() or candidate in others:
        number += 1
        candidate = path.with_name(f"{path.stem}_{number}{path.suffix}")
    return candidate
