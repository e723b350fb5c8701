"""Copies the part of a recording before its damage into a new complete file."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from mcap.records import Channel, Metadata, Schema

from capture_sim.errors import RecordingError
from capture_sim.files import free_path, whole_file
from capture_sim.recording.bag_file import BAG_METADATA, BagFile, TopicEntry, profiles_in
from capture_sim.recording.contents import bag_files, why_unreadable
from capture_sim.recording.scan import UNPACKED_RATIO, Block, Damage, scan
from capture_sim.recording.write import END_METADATA, RECOVERY_METADATA


class NothingToRecoverError(RecordingError):
    """A recording contains no message before its damage."""


@dataclass(frozen=True)
class Recovery:
    """The outcome of :func:`recover`."""

    path: Path  # of the new file
    messages: dict[str, int]  # messages copied, by topic
    losses: tuple[str, ...]  # a line for each loss; empty if nothing was lost


def recover(
    path: Path | str, out: Path | str | None = None, ratio: float = UNPACKED_RATIO
) -> Recovery:
    """Copy a recording, or each file of a bag's folder, up to its first damage into one new file.

    The new file must not exist; without ``out`` it is ``<name>_recovered.mcap`` next to the
    recording, or a free name like it.  A file may unpack to ``ratio`` times its size.
    NothingToRecoverError if no message precedes the damage, RecordingError if the file cannot be
    read or is not an MCAP file, or if the new one cannot be written.
    """
    path = Path(path)
    files = bag_files(path)
    target = free_path(path.with_name(f"{path.stem}_recovered.mcap")) if out is None else Path(out)
    try:
        with whole_file(target, replace=False) as part, part.open("xb") as stream:
            bag = BagFile(stream, target.name)
            copy = _Copy(bag)
            for file in files:
                try:
                    copy.add(file, ratio, f"{file.name}: " if len(files) > 1 else "")
                except RecordingError as error:
                    if len(files) == 1:
                        raise
                    copy.losses.append(str(error))
            if bag.span is None:
                raise NothingToRecoverError(f"{path}: nothing to recover: {'; '.join(copy.losses)}")
            if copy.losses:
                earlier = copy.metadata.get(RECOVERY_METADATA, {}).get("lost", "").splitlines()
                losses = "\n".join([*earlier, *copy.losses])
                copy.metadata[RECOVERY_METADATA] = {"lost": losses}
            copy.metadata.pop(BAG_METADATA, None)  # written again
            bag.writer.flush()
            for name, entries in copy.metadata.items():
                bag.writer.add_metadata(name, entries)
            bag.finish({})
    except FileExistsError:
        raise RecordingError(f"{target}: cannot write: it exists") from None
    return Recovery(target, bag.counts, tuple(copy.losses))


class _Copy:
    """Writes the records of one or more files into a new one."""

    def __init__(self, bag: BagFile) -> None:
        self.losses: list[str] = []
        self.metadata: dict[str, dict[str, str]] = {}  # by name
        self._bag = bag
        self._attached: set[str] = set()
        self._channels: dict[tuple[str, str, str], int] = {}  # by topic, type, encoding
        self._schemas: dict[int, Schema] = {}
        self._ids: dict[int, int | None] = {}  # of the channels in the new file; None: left out

    def add(self, file: Path, ratio: float, prefix: str) -> None:
        """Copy a file up to its damage; ``prefix`` begins the line about that."""
        self._schemas, self._ids = {}, {}
        for part in scan(file, ratio):
            if not isinstance(part, Damage):
                self._write(part)
                continue
            self.losses.append(f"{prefix}{part}")
            if not part.in_index:
                self.metadata.pop(END_METADATA, None)  # no checksum covers it

    def _write(self, block: Block) -> None:
        for entry in block.entries:
            if isinstance(entry, Schema):
                self._schemas[entry.id] = entry
            elif isinstance(entry, Channel):
                self._ids[entry.id] = self._id_of(entry)
            elif isinstance(entry, Metadata):
                self.metadata.setdefault(entry.name, entry.metadata)
            elif entry.name not in self._attached:
                self._attached.add(entry.name)
                fields = (entry.name, entry.media_type, entry.data)
                self._bag.writer.add_attachment(entry.create_time, entry.log_time, *fields)
        for channel, log_time, data, publish_time, sequence in block.messages:
            copied = self._ids[channel]
            if copied is not None:
                self._bag.add(copied, log_time, data, publish_time, sequence)

    def _id_of(self, channel: Channel) -> int | None:
        schema = self._schemas.get(channel.schema_id)
        if reason := why_unreadable(channel, schema):
            self.losses.append(f"topic {channel.topic!r}: {reason}")
            return None
        type_name = "" if schema is None else schema.name
        key = (channel.topic, type_name, channel.message_encoding)
        if key not in self._channels:
            profiles = profiles_in(channel.metadata.get("offered_qos_profiles", ""))
            type_hash = channel.metadata.get("topic_type_hash", "")
            entry = TopicEntry(channel.topic, type_name, profiles, type_hash, 0)
            definition = schema and (schema.name, schema.encoding, bytes(schema.data))
            self._channels[key] = self._bag.add_topic(
                entry, channel.message_encoding, definition, channel.metadata
            )
        return self._channels[key]
