"""What rosbag2 wants to know of a bag: ``metadata.yaml``, version 9, also kept in the file."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

import yaml

from capture_sim.messages.topics import Topic

#: The file that rosbag2 looks for in a bag's folder.
FILE_NAME = "metadata.yaml"

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


@dataclass(frozen=True)
class FileEntry:
    """A file of a bag: name in its folder, first and last log time (ns), messages."""

    name: str
    start: int
    end: int
    count: int


def bag_metadata(
    topics: Sequence[TopicEntry], files: Sequence[FileEntry], custom: Mapping[str, str]
) -> str:
    """Return the text that a file holds; :func:`in_folder` makes ``metadata.yaml`` of it."""
    start = min(file.start for file in files)
    end = max(file.end for file in files)
    return dump(
        {
            "version": 9,
            "storage_identifier": "mcap",
            **_span(start, end),
            "message_count": sum(file.count for file in files),
            "topics_with_message_count": [
                {
                    "topic_metadata": {
                        "name": topic.name,
                        "type": topic.type_name,
                        "serialization_format": "cdr",
                        "offered_qos_profiles": list(topic.qos_profiles),
                        "type_description_hash": topic.type_hash,
                    },
                    "message_count": topic.count,
                }
                for topic in topics
            ],
            "compression_format": "",
            "compression_mode": "",
            "relative_file_paths": [file.name for file in files],
            "files": [
                {
                    "path": file.name,
                    **_span(file.start, file.end),
                    "message_count": file.count,
                }
                for file in files
            ],
            "custom_data": dict(custom),
            "ros_distro": "jazzy",
        }
    )


def in_folder(text: str) -> str:
    """Return the text of ``metadata.yaml``, from :func:`bag_metadata`."""
    return dump({"rosbag2_bagfile_information": yaml.safe_load(text)})


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
