"""What is in an MCAP file, or in a bag's folder of files: checked, and within bounds."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field
from itertools import pairwise
from mmap import mmap
from pathlib import Path

import yaml
from mcap.records import Attachment, Channel, DataEnd, Metadata, Schema

from capture_sim.errors import RecordingError
from capture_sim.recording.bag_file import FILE_NAME, IN_FOLDER
from capture_sim.recording.scan import (
    UNPACKED_RATIO,
    Damage,
    Whole,
    data_fit,
    ends_with_mark,
    index_of,
    mapped,
    scan,
)

#: Encoding of ROS 2 messages.
CDR = "cdr"


@dataclass
class Contents:
    """All that is in the data section of a file."""

    types: dict[str, str] = field(default_factory=dict)  # message type by topic
    # quality of service by topic, YAML as rosbag2 writes it; empty when not recorded
    qos: dict[str, str] = field(default_factory=dict)
    schemas: dict[str, str] = field(default_factory=dict)  # definition text by message type
    # serialised messages by topic, in the order of their log times
    messages: dict[str, list[bytes]] = field(default_factory=dict)
    log_times: dict[str, list[int]] = field(default_factory=dict)  # their log times, ns, ascending
    attachments: dict[str, bytes] = field(default_factory=dict)  # by name
    metadata: dict[str, dict[str, str]] = field(default_factory=dict)  # by name
    # encoding by topic of messages that are not CDR and were left out
    left_out: dict[str, str] = field(default_factory=dict)
    damage: str = ""  # why reading stopped early; empty for a whole file


def read_contents(path: Path, ratio: float = UNPACKED_RATIO) -> Contents:
    """Read a file, or a bag's folder of files, as far as the records are complete.

    Parameters
    ----------
    path
        The file or folder.
    ratio
        How many times a file's size it may unpack to.

    Returns
    -------
    Contents
        ``damage`` is set when a file ends before its end mark.

    Raises
    ------
    RecordingError
        A file cannot be read, is no MCAP file, a record inside it is damaged (as opposed to
        missing at the end), or it unpacks to more than is allowed.
    """
    contents = Contents()
    for part in bag_files(path):
        with mapped(part) as data:
            _Reader(part, contents).read(data, ratio)
    for topic, times in contents.log_times.items():
        if any(later < time for time, later in pairwise(times)):
            order = sorted(range(len(times)), key=times.__getitem__)
            contents.log_times[topic] = [times[i] for i in order]
            contents.messages[topic] = [contents.messages[topic][i] for i in order]
        if times and contents.log_times[topic][-1] >= 1 << 63:
            last = contents.log_times[topic][-1]
            raise RecordingError(f"{path}: {topic}: log time {last} ns: must be below 2^63")
    return contents


def bag_files(path: Path) -> list[Path]:
    """Return the files of a bag in order; for a file that file alone.

    Raises
    ------
    RecordingError
        The folder holds none.
    """
    if not path.is_dir():
        return [path]
    try:
        listed = yaml.safe_load((path / FILE_NAME).read_text(encoding="utf-8"))
        names = listed[IN_FOLDER]["relative_file_paths"]
        files = [path / Path(str(name)).name for name in names]  # nothing outside the folder
    except OSError:  # the recorder was killed: the files tell their order by their numbers
        files = sorted(path.glob("[!.]*.mcap"), key=_number)
    except (yaml.YAMLError, LookupError, TypeError, ValueError, RecursionError):
        raise RecordingError(f"{path / FILE_NAME}: is no metadata of a bag") from None
    if not files:
        raise RecordingError(f"{path}: holds no .mcap file")
    return files


def _number(path: Path) -> tuple[int, str]:
    digits = path.stem.rsplit("_", 1)[-1]
    return (int(digits) if digits.isdecimal() and len(digits) < 10 else -1, path.name)


class _Reader:
    """Reads one file into the contents of all."""

    def __init__(self, path: Path, contents: Contents) -> None:
        self._path = path
        self._contents = contents
        self._schemas: dict[int, Schema] = {}
        # messages and log times by channel; those that are left out go nowhere
        self._lists: dict[int, tuple[list[bytes] | deque[bytes], list[int] | deque[int]]] = {}
        self._count = 0

    def read(self, data: mmap, ratio: float) -> None:
        """Read all records, or those before the place where the file was cut."""
        end = 0
        for found in scan(data, ratio):
            if isinstance(found, Damage):
                if not found.cut or ends_with_mark(data):
                    raise self._damaged(found.start, found.why)
                break
            try:
                self._take(found)
            except ValueError as error:
                raise self._damaged(found.start, str(error)) from None
            end = found.end
            if isinstance(found.record, DataEnd):
                if data_fit(data, found) is False:
                    raise self._damaged(found.start, "wrong checksum of what is before it")
                break
        index = index_of(data)
        if index is not None:
            written = index.summary.statistics
            if written is not None and written.message_count != self._count:
                why = f"{self._count} messages read, {written.message_count} were written"
                raise self._damaged(index.start, why)
        elif ends_with_mark(data):
            raise self._damaged(end, "the index does not match its checksum")
        else:
            size = f"{end} of {len(data)} bytes"
            damage = f"the file ends without its end mark; {size} are complete records"
            before = self._contents.damage
            self._contents.damage = f"{before}; then {damage}" if before else damage

    def _take(self, found: Whole) -> None:
        for record in (*found.definitions, found.record):
            if isinstance(record, Schema):
                self._schemas[record.id] = record
            elif isinstance(record, Channel):
                self._channel(record)
            elif isinstance(record, Attachment):
                self._contents.attachments[record.name] = record.data
            elif isinstance(record, Metadata):
                self._contents.metadata[record.name] = dict(record.metadata)
        lists = self._lists
        for channel, log_time, message, _, _ in found.messages:
            if channel not in lists:
                raise ValueError(f"message of unknown channel {channel}")
            messages, times = lists[channel]
            messages.append(message)
            times.append(log_time)
        self._count += len(found.messages)

    def _channel(self, channel: Channel) -> None:
        topic, contents = channel.topic, self._contents
        if not topic.isprintable():
            raise ValueError(f"topic {topic!r}: must be printable characters")
        if channel.message_encoding != CDR:  # a type's name says nothing of other bytes
            self._lists[channel.id] = deque(maxlen=0), deque(maxlen=0)
            contents.left_out[topic] = channel.message_encoding
            return
        schema = self._schemas.get(channel.schema_id)
        if schema is not None:
            contents.schemas[schema.name] = schema.data.decode("utf-8", errors="replace")
        contents.types.setdefault(topic, "" if schema is None else schema.name)
        contents.qos[topic] = channel.metadata.get("offered_qos_profiles", "")
        messages = contents.messages.setdefault(topic, [])
        self._lists[channel.id] = messages, contents.log_times.setdefault(topic, [])

    def _damaged(self, position: int, why: str) -> RecordingError:
        return RecordingError(
            f"{self._path}: damaged at byte {position}: {why}; what is whole in it "
            "`capture-sim recover` saves"
        )
