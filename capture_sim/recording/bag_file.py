"""Writing MCAP files that rosbag2 reads: with rosbag2's metadata (version 9) and QoS profiles."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import IO

import yaml
from mcap.writer import Writer

from capture_sim.messages.convert import EPOCH_NS
from capture_sim.messages.topics import Topic

#: Name of the metadata record that rosbag2 reads.
BAG_METADATA = "rosbag2"
#: Uncompressed size of a chunk, bytes: what a kill can lose at most.
CHUNK_SIZE = 128 * 1024
#: Name of a message type, encoding of its definition (e.g. ``ros2msg``), and its definition.
Definition = tuple[str, str, bytes]

# libyaml's takes a tenth of the time
_SafeDumper = getattr(yaml, "CSafeDumper", yaml.SafeDumper)
_UNLIMITED = {"sec": 9223372036, "nsec": 854775807}  # as rosbag2 writes it


@dataclass
class TopicEntry:
    """A topic of a bag, as rosbag2's metadata lists it.

    ``qos_profiles`` has an item for each publisher, see :func:`qos_profile`; ``type_hash`` is the
    hash by which ROS 2 identifies the message type; ``count`` is the number of messages so far.
    """

    name: str
    type_name: str
    qos_profiles: Sequence[object]
    type_hash: str
    count: int


class BagFile:
    """Writes an MCAP file that rosbag2 can read without conversion.

    ``file`` is open for writing, and stays open; ``name`` is the file name in rosbag2's metadata.
    """

    def __init__(self, file: IO[bytes], name: str) -> None:
        #: Writer of the library mcap, for attachments and further metadata.
        self.writer = Writer(file, chunk_size=CHUNK_SIZE, enable_data_crcs=True)
        self.writer.start("ros2")
        #: Earliest and latest log time so far, ns; None without a message.
        self.span: tuple[int, int] | None = None
        self._name = name
        self._topics: dict[int, TopicEntry] = {}  # by the channel's id
        self._schemas: dict[Definition, int] = {}

    @property
    def counts(self) -> dict[str, int]:
        """Number of messages so far, by topic; those of all channels of a topic are added up."""
        counts: dict[str, int] = {}
        for topic in self._topics.values():
            counts[topic.name] = counts.get(topic.name, 0) + topic.count
        return counts

    def add_topic(
        self, topic: TopicEntry, encoding: str, schema: Definition | None, metadata: dict[str, str]
    ) -> int:
        """Write a channel for a topic, and return the channel's id.

        ``encoding`` is that of the messages, e.g. ``cdr``.  ``schema``, the message type, is
        written unless the file has it already; None if it is unknown.  ``metadata`` are further
        texts for the channel, by name.
        """
        if schema is not None and schema not in self._schemas:
            self._schemas[schema] = self.writer.register_schema(*schema)
        schema_id = 0 if schema is None else self._schemas[schema]
        channel = self.writer.register_channel(topic.name, encoding, schema_id, metadata)
        self._topics[channel] = topic
        return channel

    def add(self, channel: int, time: int, data: bytes) -> None:
        """Write a serialised message to a channel; ``time`` is its log and publish time, ns."""
        topic, span = self._topics[channel], self.span
        self.writer.add_message(channel, time, data, time, topic.count)
        topic.count += 1
        if span is None or not span[0] <= time <= span[1]:
            first, last = span or (time, time)
            self.span = min(first, time), max(last, time)

    def finish(self, custom: Mapping[str, str]) -> None:
        """Write rosbag2's metadata, the index and the summary; this ends the MCAP file.

        ``custom`` are entries for ``custom_data`` in that metadata.  The file stays open.
        """
        text = dump(self._metadata(custom))
        self.writer.add_metadata(BAG_METADATA, {"serialized_metadata": text})
        self.writer.finish()

    def _metadata(self, custom: Mapping[str, str]) -> dict[str, object]:
        """Return rosbag2's metadata of this file: what ``metadata.yaml`` has under its only key."""
        counts = self.counts
        first, last = self.span or (EPOCH_NS, EPOCH_NS)
        span = {
            "starting_time": {"nanoseconds_since_epoch": first},
            "duration": {"nanoseconds": last - first},
        }
        topics = {topic.name: topic for topic in self._topics.values()}
        return {
            "version": 9,
            "storage_identifier": "mcap",
            **span,
            "message_count": sum(counts.values()),
            "topics_with_message_count": [
                {
                    "topic_metadata": {
                        "name": topic.name,
                        "type": topic.type_name,
                        "serialization_format": "cdr",
                        "offered_qos_profiles": list(topic.qos_profiles),
                        "type_description_hash": topic.type_hash,
                    },
                    "message_count": counts[topic.name],
                }
                for topic in topics.values()
            ],
            "compression_format": "",
            "compression_mode": "",
            "relative_file_paths": [self._name],
            "files": [{"path": self._name, **span, "message_count": sum(counts.values())}],
            "custom_data": dict(custom),
            "ros_distro": os.environ.get("ROS_DISTRO", ""),
        }


def qos_profile(topic: Topic) -> dict[str, object]:
    """Return a topic's quality of service in the form in which rosbag2 writes it."""
    return {
        "history": "keep_last" if topic.keeps_last else "keep_all",
        "depth": topic.depth,
        "reliability": "reliable" if topic.reliable else "best_effort",
        "durability": "transient_local" if topic.transient_local else "volatile",
        "deadline": _UNLIMITED,
        "lifespan": _UNLIMITED,
        "liveliness": "automatic",
        "liveliness_lease_duration": _UNLIMITED,
        "avoid_ros_namespace_conventions": False,
    }


def dump(data: object) -> str:
    """Return data as YAML text without anchors, because rosbag2's reader does not accept them."""
    return yaml.dump(data, Dumper=_Plain, sort_keys=False)


class _Plain(_SafeDumper):  # type: ignore[valid-type, misc]  # one or the other
    def ignore_aliases(self, data: object) -> bool:
        return True
