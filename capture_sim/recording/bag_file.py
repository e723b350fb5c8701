"""A bag's file as rosbag2 takes it, and what it wants to know of it.

That is ``metadata.yaml``, version 9, in a bag's folder, and the same in the file.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import IO, Any

import yaml
from mcap.writer import Writer

from capture_sim.messages.convert import EPOCH_NS
from capture_sim.messages.topics import Topic

#: The file that rosbag2 looks for in a bag's folder.
FILE_NAME = "metadata.yaml"
#: The key in it that all stands under.
IN_FOLDER = "rosbag2_bagfile_information"
#: Name of the metadata record that rosbag2 reads.
BAG_METADATA = "rosbag2"
#: Uncompressed size of a chunk, bytes: what a kill can lose at most.
CHUNK_SIZE = 128 * 1024
#: Name, encoding and text of a message type.
Definition = tuple[str, str, bytes]

# libyaml's takes a tenth of the time
_SafeDumper = getattr(yaml, "CSafeDumper", yaml.SafeDumper)
_UNLIMITED = {"sec": 9223372036, "nsec": 854775807}  # as rosbag2 writes it


@dataclass
class TopicEntry:
    """A topic of a bag: name, type, quality of service (rosbag2's list), hash, messages."""

    name: str
    type_name: str
    qos_profiles: Sequence[object]
    type_hash: str
    count: int


class BagFile:
    """An MCAP file that rosbag2 takes as it is: mcap's writer, and what a bag's metadata counts.

    Attributes
    ----------
    name
        The file's, in its folder.
    writer
        Takes attachments and further metadata.
    topics
        What is in the file so far, by the channel's id.
    span
        Earliest and latest log time so far, ns; None without a message.

    Parameters
    ----------
    file
        To write into.
    name
        See above.
    options
        Of mcap's writer, other than those of a recording.
    """

    def __init__(self, file: IO[bytes], name: str = "", **options: Any) -> None:
        recording = {"chunk_size": CHUNK_SIZE, "enable_data_crcs": True}
        self.name = name
        self.writer = Writer(file, **(options or recording))
        self.writer.start("ros2")
        self.topics: dict[int, TopicEntry] = {}
        self.span: tuple[int, int] | None = None
        self._schemas: dict[Definition, int] = {}

    @property
    def counts(self) -> dict[str, int]:
        """Messages so far, by topic; one may have several channels."""
        found: dict[str, int] = {}
        for topic in self.topics.values():
            found[topic.name] = found.get(topic.name, 0) + topic.count
        return found

    def add_topic(
        self, topic: TopicEntry, encoding: str, schema: Definition | None, metadata: dict[str, str]
    ) -> int:
        """Write a topic, and its type unless it is known; return the channel's id."""
        if schema is not None and schema not in self._schemas:
            self._schemas[schema] = self.writer.register_schema(*schema)
        schema_id = 0 if schema is None else self._schemas[schema]
        channel = self.writer.register_channel(topic.name, encoding, schema_id, metadata)
        self.topics[channel] = topic
        return channel

    def add(
        self,
        channel: int,
        log_time: int,
        data: bytes,
        publish_time: int,
        sequence: int | None = None,
    ) -> None:
        """Write a message, numbered as the next of its channel unless told; times in ns."""
        topic, span = self.topics[channel], self.span
        number = topic.count if sequence is None else sequence
        self.writer.add_message(channel, log_time, data, publish_time, number)
        topic.count += 1
        if span is None or not span[0] <= log_time <= span[1]:
            first, last = span or (log_time, log_time)
            self.span = min(first, log_time), max(last, log_time)

    def finish(self, custom: Mapping[str, str]) -> None:
        """Write what rosbag2 reads (``custom``: beside its own), index and summary."""
        text = dump(bag_metadata([self], custom))
        self.writer.add_metadata(BAG_METADATA, {"serialized_metadata": text})
        self.writer.finish()


def bag_metadata(files: Sequence[BagFile], custom: Mapping[str, str]) -> dict[str, object]:
    """Return what ``metadata.yaml`` holds of a bag under :data:`IN_FOLDER`."""
    spans = [file.span or (EPOCH_NS, EPOCH_NS) for file in files]
    by_topic = [file.counts for file in files]
    counts = [sum(of.values()) for of in by_topic]
    topics = {topic.name: topic for file in files for topic in file.topics.values()}
    return {
        "version": 9,
        "storage_identifier": "mcap",
        **_span(min(first for first, _ in spans), max(last for _, last in spans)),
        "message_count": sum(counts),
        "topics_with_message_count": [
            {
                "topic_metadata": {
                    "name": topic.name,
                    "type": topic.type_name,
                    "serialization_format": "cdr",
                    "offered_qos_profiles": list(topic.qos_profiles),
                    "type_description_hash": topic.type_hash,
                },
                "message_count": sum(of.get(topic.name, 0) for of in by_topic),
            }
            for topic in topics.values()
        ],
        "compression_format": "",
        "compression_mode": "",
        "relative_file_paths": [file.name for file in files],
        "files": [
            {"path": file.name, **_span(*span), "message_count": count}
            for file, span, count in zip(files, spans, counts, strict=True)
        ],
        "custom_data": dict(custom),
        "ros_distro": "jazzy",
    }


def qos_profile(topic: Topic) -> dict[str, object]:
    """Return a topic's quality of service as rosbag2 writes it."""
    return {
        "history": "keep_last" if topic.latched else "keep_all",
        "depth": topic.depth,
        "reliability": "reliable",
        "durability": "transient_local" if topic.latched else "volatile",
        "deadline": _UNLIMITED,
        "lifespan": _UNLIMITED,
        "liveliness": "automatic",
        "liveliness_lease_duration": _UNLIMITED,
        "avoid_ros_namespace_conventions": False,
    }


def profiles_in(text: str) -> list[Any]:
    """Return the qualities of service that a topic was recorded with; empty if that is no list."""
    with suppress(yaml.YAMLError, ValueError, RecursionError):
        found = yaml.safe_load(text)
        if isinstance(found, list):
            return found
    return []


def dump(data: object) -> str:
    """Return data as YAML, without anchors: rosbag2's reader does not want them."""
    return yaml.dump(data, Dumper=_Plain, sort_keys=False)


def _span(start: int, end: int) -> dict[str, dict[str, int]]:
    return {
        "starting_time": {"nanoseconds_since_epoch": start},
        "duration": {"nanoseconds": end - start},
    }


class _Plain(_SafeDumper):  # type: ignore[valid-type, misc]  # one or the other
    def ignore_aliases(self, data: object) -> bool:
        return True
