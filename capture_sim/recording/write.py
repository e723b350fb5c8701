"""Writes a run to an MCAP file, which ``ros2 bag`` can read and play."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from functools import cache
from pathlib import Path
from types import TracebackType
from typing import IO, Self

from capture_sim.base.files import is_device
from capture_sim.errors import RecordingError
from capture_sim.messages.convert import EPOCH_NS, RunDescription
from capture_sim.messages.definitions import schema_text, type_hash
from capture_sim.messages.topics import SHOWN, TF, TOPICS, Topic
from capture_sim.recording.bag_file import BagFile, TopicEntry, dump, qos_profile
from capture_sim.recording.frames import POSES, FrameMessages

#: Name of the attachment that holds the resolved scene.
SCENE_ATTACHMENT = "scene.yaml"
#: Name of the metadata record that describes how the run was made.
RUN_METADATA = "capture_sim"
#: Its entry of topics that were recorded under other names: a line NAME:=RECORDED_NAME for each.
REMAPS = "remaps"
#: Name of the metadata record that is written last, with what is known at the end only.
END_METADATA = "capture_sim_end"


class RunWriter:
    """Writes one run: ``with RunWriter(path, run) as writer: writer.write(topic, data, time)``.

    The scene and the description of the run precede the first message and so survive a kill.

    Parameters
    ----------
    path
        The file.  It must not exist, unless it is a device.
    run
        Description of the run.
    metadata
        Further entries for the metadata record at the start of the file.
    topics
        The topics that may be written.  The file lists them even without a message.  If
        poses are among them, and ``tf`` is not, `/tf`, `/tf_static` and `/robot_description` are
        written besides, from the measurements in the messages.
    name
        The name that the file will finally have, if it has another one while it is written.
    remaps
        The names of topics in the file, where they are not the bench's.  The metadata record lists
        them.

    Raises
    ------
    RecordingError
        The file cannot be written; the methods raise it too, and ``write`` also after ``close``.
    """

    def __init__(
        self,
        path: Path,
        run: RunDescription,
        metadata: Mapping[str, str] | None = None,
        *,
        topics: Sequence[Topic] = TOPICS,
        name: str = "",
        remaps: Mapping[Topic, str] | None = None,
    ) -> None:
        self.path = path
        self._shown_path = path.with_name(name) if name else path
        self._run = run
        #: Entries for the metadata record at the end.
        self.closing: dict[str, str] = {}
        self._file: IO[bytes] | None = None
        self._is_shape_written = False
        with self._checked():
            path.parent.mkdir(parents=True, exist_ok=True)
            self._file = path.open("wb" if is_device(path) else "xb")
            self.bag = BagFile(self._file, name or path.name)
            self._writer = self.bag.writer
            names = {topic.absolute_name: name for topic, name in (remaps or {}).items()}
            entries = {REMAPS: "\n".join(map(":=".join, names.items()))} if names else {}
            entries |= {**describing(run), **(metadata or {})}
            self._writer.add_metadata(RUN_METADATA, entries)
            scene = (SCENE_ATTACHMENT, "application/yaml", run.scene.encode())
            self._writer.add_attachment(EPOCH_NS, EPOCH_NS, *scene)
            listed = {topic.absolute_name for topic in topics}
            is_shown = not POSES.isdisjoint(topics)
            shown = [each for each in SHOWN if is_shown and each.absolute_name not in listed]
            self._channels = {
                topic: _add(topic, names.get(topic.absolute_name, topic.absolute_name), self.bag)
                for topic in (*topics, *shown)
            }
            # a user's own frames, if he records them, take their place
            self._frames = FrameMessages(run.scene) if TF in shown else None
            self._file.flush()

    def write(self, topic: Topic, data: bytes, time: int | None) -> None:
        """Write a serialised message of one of the file's topics.

        ``time`` is the log and publish time, ns; None for the latest so far.  KeyError if the topic
        is not one of the file's.
        """
        if self._file is None:
            raise RecordingError(f"{self._shown_path}: already closed")
        if time is None:
            time = self.bag.span[1] if self.bag.span else EPOCH_NS
        try:
            self.bag.add(self._channels[topic], time, data)
            if self._frames is not None:
                self._show(self._frames, topic, data, time)
        except OSError:
            with self._checked():
                raise

    def _show(self, frames: FrameMessages, topic: Topic, data: bytes, time: int) -> None:
        """Write the messages that show the bench, after those of the run that they follow from."""
        if not self._is_shape_written:
            self._is_shape_written = True
            for kind, constant in frames.constant():
                if kind in self._channels:
                    self.bag.add(self._channels[kind], time, constant)
        for moved in frames.of(topic, data):
            self.bag.add(self._channels[TF], time, moved)

    def flush(self) -> None:
        """Hand all that was written to the operating system, so that it survives a kill."""
        if self._file is not None:
            with self._checked():
                self._writer.flush()

    def close(self) -> None:
        """Write the entries ``closing``, index and summary, and close the file, if it is open."""
        if self._file is None:
            return
        with self._checked():
            self._writer.flush()
            if self.closing:
                self._writer.add_metadata(END_METADATA, self.closing)
            self.bag.finish({"run_id": self._run.run_id})
            self._file.close()
            self._file = None

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

    @contextmanager
    def _checked(self) -> Iterator[None]:
        """Turn an OSError of the block into a RecordingError, and close the file as it is then."""
        try:
            yield
        except OSError as error:
            if self._file is not None:
                with suppress(OSError):  # buffered bytes are lost
                    self._file.close()
                self._file = None
            reason = error.strerror or error
            raise RecordingError(f"{self._shown_path}: cannot write: {reason}") from error


def describing(run: RunDescription) -> dict[str, str]:
    """Return the entries that describe a run in the metadata record of its file, as texts."""
    return {
        "run_id": run.run_id,
        "name": run.name,
        "scene_sha256": run.scene_sha256,
        "software": "\n".join(run.software),
        "state_rate": repr(run.state_rate),
        "rate": repr(run.rate),
        "publishers": "\n".join(run.publishers),
    }


def _add(topic: Topic, topic_name: str, bag: BagFile) -> int:
    """Add a topic to the file under a name; return the id of its channel."""
    name, digest = topic.type_name, type_hash(topic.type_name)
    entry = TopicEntry(topic_name, name, [qos_profile(topic)], digest, 0)
    metadata = {"offered_qos_profiles": _offered(topic), "topic_type_hash": digest}
    return bag.add_topic(entry, "cdr", (name, "ros2msg", schema_text(name).encode()), metadata)


@cache
def _offered(topic: Topic) -> str:
    return dump([qos_profile(topic)])
