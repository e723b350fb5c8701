"""Writing one run as one MCAP file that ``ros2 bag`` takes as it is."""

from __future__ import annotations

import io
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from functools import cache
from pathlib import Path
from types import TracebackType
from typing import IO, Self

from mcap.writer import IndexType, Writer

from capture_sim.errors import RecordingError
from capture_sim.files import is_device
from capture_sim.messages.convert import EPOCH_NS, RunDescription
from capture_sim.messages.definitions import schema_text, type_hash
from capture_sim.messages.topics import TOPICS, Topic
from capture_sim.recording.bag_metadata import (
    FileEntry,
    TopicEntry,
    bag_metadata,
    dump,
    qos_profile,
)

#: Name of the attachment that holds the resolved scene.
SCENE_ATTACHMENT = "scene.yaml"
#: Name of the attachment that holds the types and topics again, as an MCAP file of its own:
#: the first chunk holds them too, and may be damaged.
DEFINITIONS_ATTACHMENT = "definitions.mcap"
#: Name of the metadata record that says how the run was made.
RUN_METADATA = "capture_sim"
#: Name of the metadata record that is written last, with what is known at the end only.
END_METADATA = "capture_sim_end"
#: Name of the metadata record that says what a recovered file lacks.
RECOVERY_METADATA = "capture_sim_recovery"
#: Name of the metadata record that rosbag2 reads.
BAG_METADATA = "rosbag2"
#: Uncompressed size of a chunk, bytes: what a kill can lose at most.
CHUNK_SIZE = 128 * 1024


class RunWriter:
    """Writes one run: ``with RunWriter(path, run) as writer: writer.write(topic, data, time)``.

    Scene, description and definitions stand in the file before the first message and survive
    a kill, with a checksum each.

    Parameters
    ----------
    path
        File to write, which must not exist (a device may).
    run
        What is recorded.
    metadata
        Further entries for the metadata record.
    topics
        Those that stand in the file even without a message; others are added when they come.
    name
        That the file will have; of the path unless given.

    Raises
    ------
    RecordingError
        The file cannot be written, here or later, or is closed.
    """

    def __init__(
        self,
        path: Path,
        run: RunDescription,
        metadata: Mapping[str, str] | None = None,
        *,
        topics: Sequence[Topic] = TOPICS,
        name: str = "",
    ) -> None:
        self.path = path
        self._name = name or path.name
        self._run = run
        self._counts: dict[Topic, int] = {}
        self._channels: dict[Topic, int] = {}
        self._schemas: dict[str, int] = {}
        self._first_time: int | None = None
        self._last_time = EPOCH_NS
        #: Entries for the metadata record at the end.
        self.closing: dict[str, str] = {}
        self._file: IO[bytes] | None = None
        with self._checked():
            path.parent.mkdir(parents=True, exist_ok=True)
            self._file = path.open("wb" if is_device(path) else "xb")
            self._writer = Writer(self._file, chunk_size=CHUNK_SIZE, enable_data_crcs=True)
            self._writer.start("ros2")
            self._writer.add_metadata(RUN_METADATA, {**describing(run), **(metadata or {})})
            for attached in (
                (SCENE_ATTACHMENT, "application/yaml", run.scene.encode()),
                (DEFINITIONS_ATTACHMENT, "application/mcap", _definitions(topics)),
            ):
                self._writer.add_attachment(EPOCH_NS, EPOCH_NS, *attached)
            for topic in topics:
                self._channel(topic)
            self._file.flush()

    def write(self, topic: Topic, data: bytes, time: int | None) -> None:
        """Write a serialised message.

        Parameters
        ----------
        topic, data
            What is sent.
        time
            Log and publish time, ns; None for the latest so far.
        """
        if self._file is None:
            raise RecordingError(f"{self.path}: already closed")
        if time is None:
            time = self._last_time
        try:
            channel = self._channels.get(topic) or self._channel(topic)
            count = self._counts[topic]
            self._writer.add_message(channel, time, data, time, count)
        except OSError:
            with self._checked():
                raise
        self._counts[topic] = count + 1
        if time > self._last_time:
            self._last_time = time
        if self._first_time is None or time < self._first_time:
            self._first_time = time

    def flush(self) -> None:
        """End the chunk in progress and hand all to the operating system."""
        if self._file is not None:
            with self._checked():
                self._writer.flush()

    def close(self) -> None:
        """Write index and summary and close the file; a second call does nothing."""
        if self._file is None:
            return
        with self._checked():
            self._writer.flush()
            if self.closing:
                self._writer.add_metadata(END_METADATA, self.closing)
            text = bag_metadata(self.topic_entries(), [self.file_entry], self.run_id)
            self._writer.add_metadata(BAG_METADATA, {"serialized_metadata": text})
            self._writer.finish()
            self._file.close()
            self._file = None

    @property
    def run_id(self) -> dict[str, str]:
        """What a bag's metadata holds of the run."""
        return {"run_id": self._run.run_id}

    @property
    def size(self) -> int:
        """Bytes written so far, the chunk in progress not counted."""
        return 0 if self._file is None else self._file.tell()

    @property
    def span(self) -> float:
        """Time from the first to the last message so far, s."""
        first = self._last_time if self._first_time is None else self._first_time
        return (self._last_time - first) / 1e9

    @property
    def file_entry(self) -> FileEntry:
        """What a bag's metadata holds of the file."""
        start = EPOCH_NS if self._first_time is None else self._first_time
        return FileEntry(self._name, start, self._last_time, sum(self._counts.values()))

    def topic_entries(self) -> list[TopicEntry]:
        """Return what a bag's metadata holds of the topics."""
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

    def _channel(self, topic: Topic) -> int:
        self._counts[topic] = 0
        self._channels[topic] = _register(self._writer, topic, self._schemas)
        return self._channels[topic]

    @contextmanager
    def _checked(self) -> Iterator[None]:
        """Where the disk refuses, close the file as it is and say why."""
        try:
            yield
        except OSError as error:
            if self._file is not None:
                with suppress(OSError):  # buffered bytes are lost
                    self._file.close()
                self._file = None
            reason = error.strerror or error
            raise RecordingError(f"{self.path}: cannot write: {reason}") from error


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


def _register(writer: Writer, topic: Topic, schemas: dict[str, int]) -> int:
    """Write a topic's type, unless it is known, and the topic; return the topic's id."""
    type_name = topic.type_name
    if type_name not in schemas:
        text = schema_text(type_name).encode()
        schemas[type_name] = writer.register_schema(type_name, "ros2msg", text)
    metadata = {
        "offered_qos_profiles": _offered(topic),
        "topic_type_hash": type_hash(type_name),
    }
    return writer.register_channel(topic.absolute_name, "cdr", schemas[type_name], metadata)


@cache
def _offered(topic: Topic) -> str:
    return dump([qos_profile(topic)])


def _definitions(topics: Sequence[Topic]) -> bytes:
    """Return an MCAP file of types and topics alone, with the ids that the recording has."""
    file = io.BytesIO()
    writer = Writer(
        file,
        index_types=IndexType.NONE,
        repeat_channels=False,
        repeat_schemas=False,
        use_chunking=False,
        use_statistics=False,
        use_summary_offsets=False,
    )
    writer.start("ros2")
    schemas: dict[str, int] = {}
    for topic in topics:
        _register(writer, topic, schemas)
    writer.finish()
    return file.getvalue()
