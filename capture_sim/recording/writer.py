"""Writing one run as one MCAP file that ``ros2 bag`` takes as it is."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import IO, Self

import yaml
from mcap.writer import CompressionType, IndexType, Writer

from capture_sim.errors import RecordingError
from capture_sim.messages import EPOCH_NS, Message, RunDescription
from capture_sim.recording.cdr import stamp_of
from capture_sim.recording.definitions import schema_text, type_hash, typestore
from capture_sim.topics import RECORDED, Topic

#: Name of the attachment that holds the resolved scene.
SCENE_ATTACHMENT = "scene.yaml"
#: Name of the metadata record that tells how the run was made.
RUN_METADATA = "capture_sim"
#: Name of the metadata record that is written last, with what is known at the end only.
END_METADATA = "capture_sim_end"
#: Uncompressed size of a chunk, bytes: what a kill can lose at most.
CHUNK_SIZE = 128 * 1024

_NANOSECONDS = 1_000_000_000


class RunWriter:
    """Writes one run: ``with RunWriter(path, run) as writer: writer.write(topic, message)``.

    Scene and description stand in the file before the first message and survive a kill.
    Every message is logged and published at the simulated time it carries; one that
    carries none, at the latest time so far.

    Parameters
    ----------
    path
        File to write; one that exists is replaced.
    run
        What is recorded.
    metadata
        Further entries for the metadata record.

    Raises
    ------
    RecordingError
        The file cannot be written.
    """

    def __init__(
        self, path: Path | str, run: RunDescription, metadata: Mapping[str, str] | None = None
    ) -> None:
        self.path = Path(path)
        self.run = run
        self._counts: dict[Topic, int] = {}
        self._channels: dict[Topic, int] = {}
        self._first_time: int | None = None
        self._last_time = EPOCH_NS
        self._store = typestore()
        #: Entries for the metadata record at the end.
        self.closing: dict[str, str] = {}
        self._file: IO[bytes] | None = None
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            self._file = self.path.open("wb")
            self._writer = Writer(
                self._file,
                chunk_size=CHUNK_SIZE,
                compression=CompressionType.ZSTD,
                index_types=IndexType.ALL,
                enable_crcs=True,
                enable_data_crcs=True,
            )
            self._begin(dict(metadata or {}))
        except OSError as error:
            self._give_up()
            raise self._failed(error) from None

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
        if self._file is None:
            raise RecordingError(f"{self.path}: already closed")
        stamp = stamp_of(topic, data)
        time = self._last_time if stamp is None else stamp
        count = self._counts[topic]
        try:
            # mcap only copies the bytes; a memoryview does
            self._writer.add_message(self._channels[topic], time, data, time, count)
        except OSError as error:
            self._give_up()
            raise self._failed(error) from None
        self._counts[topic] = count + 1
        self._last_time = max(self._last_time, time)
        self._first_time = time if self._first_time is None else min(self._first_time, time)

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
            self._writer.flush()
        except OSError as error:
            self._give_up()
            raise self._failed(error) from None

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
            self._writer.flush()
            if self.closing:
                self._writer.add_metadata(END_METADATA, self.closing)
            self._writer.add_metadata("rosbag2", {"serialized_metadata": self._rosbag2()})
            self._writer.finish()
            self._file.close()
            self._file = None
        except OSError as error:
            self._give_up()
            raise self._failed(error) from None

    @property
    def counts(self) -> dict[str, int]:
        """Messages written so far, by topic name."""
        return {topic.name: count for topic, count in self._counts.items()}

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
        run = self.run
        self._writer.start(profile="ros2", library="capture_sim")
        self._writer.add_attachment(
            create_time=0,
            log_time=EPOCH_NS,
            name=SCENE_ATTACHMENT,
            media_type="application/yaml",
            data=run.scene.encode(),
        )
        self._writer.add_metadata(
            RUN_METADATA,
            {
                "run_id": run.run_id,
                "name": run.name,
                "scene_sha256": run.scene_sha256,
                "software": "\n".join(run.software),
                "state_rate": repr(run.state_rate),
                "rate": repr(run.rate),
                "publishers": "\n".join(run.publishers),
                **metadata,
            },
        )
        # all channels at once: the first chunk then explains all that follow
        schemas = {
            name: self._writer.register_schema(name, "ros2msg", schema_text(name).encode())
            for name in dict.fromkeys(topic.type_name for topic in RECORDED)
        }
        for topic in RECORDED:
            self._channels[topic] = self._writer.register_channel(
                topic.absolute_name,
                "cdr",
                schemas[topic.type_name],
                {
                    "offered_qos_profiles": _dump([_qos(topic)]),
                    "topic_type_hash": type_hash(topic.type_name),
                },
            )
            self._counts[topic] = 0
        if self._file is not None:
            self._file.flush()

    def _rosbag2(self) -> str:
        start = EPOCH_NS if self._first_time is None else self._first_time
        count = sum(self._counts.values())
        span = {
            "starting_time": {"nanoseconds_since_epoch": start},
            "duration": {"nanoseconds": self._last_time - start},
            "message_count": count,
        }
        return _dump(
            {
                "version": 9,
                "storage_identifier": "mcap",
                **span,
                "topics_with_message_count": [
                    {
                        "topic_metadata": {
                            "name": topic.absolute_name,
                            "type": topic.type_name,
                            "serialization_format": "cdr",
                            "offered_qos_profiles": [_qos(topic)],
                            "type_description_hash": type_hash(topic.type_name),
                        },
                        "message_count": written,
                    }
                    for topic, written in self._counts.items()
                ],
                "compression_format": "",
                "compression_mode": "",
                "relative_file_paths": [self.path.name],
                "files": [{"path": self.path.name, **span}],
                "custom_data": {"run_id": self.run.run_id},
                "ros_distro": "jazzy",
            }
        )

    def _give_up(self) -> None:
        """Close the file as it is; buffered bytes that the disk refuses are lost."""
        if self._file is not None:
            with suppress(OSError):
                self._file.close()
            self._file = None

    def _failed(self, error: OSError) -> RecordingError:
        return RecordingError(f"{self.path}: cannot write: {error.strerror or error}")


def _qos(topic: Topic) -> dict[str, object]:
    unlimited = {"sec": 9223372036, "nsec": 854775807}  # as rosbag2 writes it
    lease = unlimited
    if topic.lease is not None:
        sec, nsec = divmod(round(topic.lease * _NANOSECONDS), _NANOSECONDS)
        lease = {"sec": sec, "nsec": nsec}
    return {
        "history": "keep_last",
        "depth": topic.depth,
        "reliability": "reliable",
        "durability": "transient_local" if topic.latched else "volatile",
        "deadline": unlimited,
        "lifespan": unlimited,
        "liveliness": "automatic",
        "liveliness_lease_duration": lease,
        "avoid_ros_namespace_conventions": False,
    }


class _Plain(yaml.SafeDumper):
    """Without anchors: rosbag2's YAML reader does not want them."""

    def ignore_aliases(self, data: object) -> bool:
        return True


def _dump(data: object) -> str:
    return yaml.dump(data, Dumper=_Plain, sort_keys=False)
