"""Saving what is whole in a damaged recording into a new file, and saying what was lost."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml
from mcap.records import Channel
from rosbags.serde import SerdeError

from capture_sim.errors import RecordingError
from capture_sim.messages.convert import EPOCH_NS, LaunchAction, RunDescription
from capture_sim.messages.topics import BENCH_STATE, LAUNCH_COMMAND, RUN_INFO, topic_named
from capture_sim.recording.bag_metadata import FileEntry, TopicEntry, bag_metadata
from capture_sim.recording.cdr import stamp_of
from capture_sim.recording.container import Container
from capture_sim.recording.definitions import type_hash, typestore
from capture_sim.recording.records import bag_files, file_bytes
from capture_sim.recording.salvage import (
    Definitions,
    Findings,
    messages_in,
    search,
    unpacked,
)
from capture_sim.recording.writer import (
    CHUNK_SIZE,
    RUN_METADATA,
    SCENE_ATTACHMENT,
    describing,
    free_path,
)

#: Name of the metadata record that tells what a recovered file lacks.
RECOVERY_METADATA = "capture_sim_recovery"
#: Put before the name of a metadata record that no checksum confirms.
UNVERIFIED = "unverified."


@dataclass(frozen=True)
class Recovery:
    """What came of recovering a file.

    Attributes
    ----------
    path
        Of the new file.
    chunks
        How many were saved.
    messages
        How many were saved, by topic.
    losses
        A line for everything that was lost; empty if nothing was.
    unconfirmed
        A line for everything that was saved and that no checksum confirms.
    """

    path: Path
    chunks: int
    messages: dict[str, int]
    losses: tuple[str, ...]
    unconfirmed: tuple[str, ...] = ()


def recover(path: Path | str, out: Path | str | None = None) -> Recovery:
    """Save all whole chunks of a recording, or of a bag's folder, into one new file.

    Parameters
    ----------
    path
        A file that was cut or damaged; it is left as it is.
    out
        File to write, which must not exist; None takes ``<name>_recovered.mcap`` beside it,
        or a free name like it.

    Raises
    ------
    RecordingError
        The file cannot be read, is no MCAP file or holds nothing whole, or the new one
        cannot be written.
    """
    path = Path(path)
    parts: list[tuple[Path, bytes, Findings]] = []
    lost: list[str] = []
    files = bag_files(path)
    for part in files:
        try:
            data = file_bytes(part)
        except RecordingError as error:
            if len(files) == 1:
                raise
            lost.append(f"all of {error}")
            continue
        parts.append((part, data, search(data)))
    if not any(found.chunks or found.loose for _, _, found in parts):
        raise RecordingError(f"{path}: nothing to recover: no whole chunk in it")
    target = free_path(path.with_name(f"{path.stem}_recovered.mcap")) if out is None else Path(out)
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        with target.open("xb") as file:
            return _Saver(target, Container(file, CHUNK_SIZE), lost).save(parts)
    except OSError as error:
        raise RecordingError(f"{target}: cannot write: {error.strerror or error}") from None


class _Saver:
    def __init__(self, path: Path, container: Container, lost: Sequence[str]) -> None:
        self._path = path
        self._container = container
        self._schemas: dict[tuple[str, str, bytes], int] = {}
        self._channels: dict[tuple[str, str, str], int] = {}  # by topic, type, encoding
        self._entries: list[Channel] = []
        self._counts: Counter[int] = Counter()
        self._span: list[int] = []
        self._losses = list(lost)
        self._unconfirmed: list[str] = []

    def save(self, parts: list[tuple[Path, bytes, Findings]]) -> Recovery:
        """Write all that was found."""
        several = len(parts) + len(self._losses) > 1
        run, release = _run_in(parts), _release_in(parts)
        for part, data, found in parts:
            where = f"{part.name}: " if several else ""
            lost, unconfirmed = _losses(found, data, release)
            self._losses += [where + line for line in lost]
            self._unconfirmed += [where + line for line in unconfirmed]
            absent = _absent(found, run)
            self._losses += [where + line for line in absent]
        self._losses += _absent_parts(found for _, _, found in parts)
        self._describe(parts, run)
        chunks = 0
        for part, data, found in parts:
            chunks += len(found.chunks)
            definitions = self._definitions(part, found)
            for channel in sorted(definitions.channels):
                self._channel(definitions, channel)  # also those without a message
            for channel, sequence, log_time, publish_time, message in _all_messages(found, data):
                known = self._channel(definitions, channel)
                if known is None:
                    self._losses.append(f"{part.name}: a message of unknown channel {channel}")
                    continue
                self._container.add(known, sequence, log_time, publish_time, message)
                self._counts[known] += 1
                self._span = [
                    min([log_time, *self._span[:1]]),
                    max([log_time, *self._span[1:]]),
                ]
        self._container.end_chunk()
        told = {"lost": self._losses, "unconfirmed": self._unconfirmed}
        if any(told.values()):
            entries = {name: "\n".join(lines) for name, lines in told.items()}
            self._container.add_metadata(RECOVERY_METADATA, entries)
        self._container.add_metadata("rosbag2", {"serialized_metadata": self._bag_metadata()})
        self._container.finish()
        counts: Counter[str] = Counter()
        for channel in self._entries:
            counts[channel.topic] += self._counts[channel.id]
        return Recovery(
            self._path, chunks, dict(counts), tuple(self._losses), tuple(self._unconfirmed)
        )

    def _describe(
        self, parts: list[tuple[Path, bytes, Findings]], run: RunDescription | None
    ) -> None:
        """Write attachments and metadata: each once, what no checksum confirms marked so."""
        done: set[str] = set()
        for _, _, found in parts:
            for name, attachment in found.attachments.items():
                if name not in done:
                    done.add(name)
                    self._container.add_attachment(
                        name, attachment.media_type, attachment.data, attachment.log_time
                    )
        records: set[str] = {"rosbag2"}  # it is made anew
        for _, _, found in parts:
            for name, entries in found.metadata.items():
                if name in records:
                    continue
                records.add(name)
                if found.verified:
                    self._container.add_metadata(name, entries)
                elif name == RUN_METADATA and run is not None:
                    # the announcement among the messages has a checksum
                    self._container.add_metadata(name, describing(run))
                else:
                    self._container.add_metadata(UNVERIFIED + name, entries)
                    self._unconfirmed.append(f"metadata {name}, which has no checksum")
        if run is not None and RUN_METADATA not in records:
            self._container.add_metadata(RUN_METADATA, describing(run))

    def _definitions(self, part: Path, found: Findings) -> Definitions:
        """Return types and topics by id, checked ones first."""
        known = Definitions()
        known.update(found.bare)
        known.update(found.defined)
        bare = set(known.channels) - set(found.defined.channels)
        if bare and not found.verified:
            self._unconfirmed.append(
                f"{part.name}: names and types of {len(bare)} topics, which have no checksum"
            )
        return known

    def _channel(self, definitions: Definitions, channel: int) -> int | None:
        entry = definitions.channels.get(channel)
        if entry is None:
            return None
        schema = definitions.schemas.get(entry.schema_id)
        key = (entry.topic, "" if schema is None else schema.name, entry.message_encoding)
        known = self._channels.get(key)
        if known is None:
            schema_id = 0
            if schema is not None:
                text = (schema.name, schema.encoding, bytes(schema.data))
                if text not in self._schemas:
                    self._schemas[text] = self._container.add_schema(*text)
                schema_id = self._schemas[text]
            known = self._container.add_channel(
                entry.topic, entry.message_encoding, schema_id, entry.metadata
            )
            self._channels[key] = known
            self._entries.append(
                Channel(known, entry.topic, entry.message_encoding, entry.metadata, schema_id)
            )
        return known

    def _bag_metadata(self) -> str:
        types = {i: key[1] for key, i in self._channels.items()}
        topics = []
        for channel in self._entries:
            qos: Any = None
            with suppress(yaml.YAMLError):
                qos = yaml.safe_load(channel.metadata.get("offered_qos_profiles", ""))
            topics.append(
                TopicEntry(
                    channel.topic,
                    types[channel.id],
                    qos if isinstance(qos, list) else [],
                    channel.metadata.get("topic_type_hash", ""),
                    self._counts[channel.id],
                )
            )
        start, end = self._span or (EPOCH_NS, EPOCH_NS)
        file = FileEntry(self._path.name, start, end, sum(self._counts.values()))
        return bag_metadata(topics, [file], {})


def _all_messages(found: Findings, data: bytes) -> Any:
    for start, end in found.chunks:
        yield from messages_in(unpacked(data, start, end) or b"")
    for start, end in found.loose:
        yield from messages_in(data[start - 9 : end])


def _run_in(parts: list[tuple[Path, bytes, Findings]]) -> RunDescription | None:
    """Return the description of the run from its announcement, where that is whole."""
    for _, data, found in parts:
        ids = {
            i
            for i, channel in found.defined.channels.items()
            if channel.topic == RUN_INFO.absolute_name
            and channel.metadata.get("topic_type_hash") == type_hash(RUN_INFO.type_name)
        }
        for start, end in found.chunks if ids else ():
            for channel, *_, message in messages_in(unpacked(data, start, end) or b""):
                if channel in ids:
                    try:
                        info: Any = typestore().deserialize_cdr(message, RUN_INFO.type_name)
                    except SerdeError:
                        return None
                    return RunDescription(
                        info.run_id,
                        info.name,
                        info.scene,
                        tuple(info.software),
                        info.state_rate,
                        info.rate,
                        tuple(info.publishers),
                    )
    return None


def _release_in(parts: list[tuple[Path, bytes, Findings]]) -> int | None:
    """Return the log time of the release, ns; None where nothing whole tells of it."""
    started = None
    for _, data, found in parts:
        topics = {
            i: topic
            for i, channel in found.defined.channels.items()
            if (topic := topic_named(channel.topic))
            and channel.metadata.get("topic_type_hash") == type_hash(topic.type_name)
        }
        for channel, _, log_time, _, message in _all_messages(found, data):
            topic = topics.get(channel)
            with suppress(SerdeError, RecordingError):
                if topic is LAUNCH_COMMAND:
                    command: Any = typestore().deserialize_cdr(message, topic.type_name)
                    if command.action == LaunchAction.RELEASE:
                        return log_time
                elif topic is BENCH_STATE and started is None:
                    # simulated time, by whatever clock the log's is
                    started = log_time - (stamp_of(topic, message) or log_time) + EPOCH_NS
    return started


def _losses(found: Findings, data: bytes, release: int | None) -> tuple[list[str], list[str]]:
    """Return lines for what was lost, and for what was saved unconfirmed."""
    lines: list[str] = []
    unconfirmed: list[str] = []
    for loss in found.losses:
        where = f"bytes {loss.start} to {loss.end} of {len(data)}"
        if loss.start == loss.end:
            lines.append(loss.why)
            continue
        if found.all_saved:
            where += f" (no message was in them: all {found.written} are saved)"
        elif loss.after is not None or loss.before is not None:
            where += f" (any messages {_between(loss.after, loss.before, release)})"
        lines.append(f"{loss.why}: {where}")
    if found.loose and not found.verified:
        unconfirmed.append(f"{len(found.loose)} messages outside chunks, which have no checksum")
    if found.written is not None and not found.all_saved:
        lines.append(f"{found.written - found.saved} of {found.written} messages")
    if found.unconfirmed:
        unconfirmed.append(
            f"{found.unconfirmed} of {len(found.chunks)} chunks, which have no checksum"
        )
    if not found.verified and not lines and not unconfirmed:
        if found.unchecked:
            unconfirmed.append("what stands outside the chunks, which has no checksum")
        else:
            whole = f"; all {found.written} messages are saved" if found.all_saved else ""
            lines.append(f"some bytes outside chunks are damaged, in their index perhaps{whole}")
    return lines, unconfirmed


def _absent(found: Findings, run: RunDescription | None) -> list[str]:
    """Return a line for attachments and metadata that were in the file and are lost."""
    lines = []
    for what, name in found.absent:
        if run is not None and name == RUN_METADATA:
            continue  # made anew, from the announcement
        again = run is not None and name == SCENE_ATTACHMENT
        lines.append(f"{what} {name}" + ("; the announced run holds the scene too" * again))
    return lines


def _absent_parts(parts: Iterable[Findings]) -> list[str]:
    """Return a line for the parts of a split recording that are not there."""
    told = (found.metadata.get(RUN_METADATA, {}).get("part", "") for found in parts)
    there = {int(number) for number in told if number.isdecimal()}
    gone = sorted(set(range(max(there, default=0))) - there)
    return [f"part {number} of the recording is not there" for number in gone]


def _between(after: int | None, before: int | None, release: int | None) -> str:
    """Return a stretch of log times in words, since the release where that is known."""
    zero, meaning = (0, "of the log") if release is None else (release, "since the release")

    def at(stamp: int) -> str:
        return f"{(stamp - zero) / 1e9:.3f} s"

    if after is not None and before is not None:
        return f"between {at(after)} and {at(before)} {meaning}"
    return (
        f"before {at(before)} {meaning}"
        if before is not None
        else f"after {at(after or 0)} {meaning}"
    )
