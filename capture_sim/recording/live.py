"""The half of the live recorder that knows no ROS: bytes in, one checked recording out."""

from __future__ import annotations

import threading
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Self

from rosbags.serde import SerdeError

from capture_sim.errors import MessageError, RecordingError
from capture_sim.files import file_name, free_path, whole_file
from capture_sim.messages.cdr import sequence_of, stamp_of
from capture_sim.messages.convert import RunDescription
from capture_sim.messages.definitions import typestore
from capture_sim.messages.topics import (
    BENCH_STATE,
    RECORDED,
    RUN_INFO,
    SIMULATOR,
    STREAM_COUNTS,
    Topic,
)
from capture_sim.recording.bag_metadata import FILE_NAME, TopicEntry, bag_metadata, in_folder
from capture_sim.recording.completeness import Completeness, TopicCount
from capture_sim.recording.write import RunWriter

#: What the metadata record says of a live recording's origin.
LIVE = "live"
#: Bytes that may wait for the disk; take() waits when there are more.
QUEUE_BYTES = 64 * 1024 * 1024
#: Seconds after which a begun chunk is handed to the operating system.
FLUSH_PERIOD = 0.5
#: Seconds between looks at the queue.
WRITE_PERIOD = 0.05
#: Seconds that take() waits for a stalled disk.
STALL_LIMIT = 10.0


@dataclass(frozen=True)
class Split:
    """When a new file is begun.

    Attributes
    ----------
    size
        Bytes in the file; 0 for no bound.
    time
        s, from its first message to its last; 0 for no bound.
    folder
        Lay the recording out as a bag's folder, even if no new file is ever begun.
    """

    size: int = 0
    time: float = 0.0
    folder: bool = False

    def __bool__(self) -> bool:
        return self.folder or self.size > 0 or self.time > 0.0


class RecordingFiles:
    """Writes a run to ``<directory>/<name>.mcap``, or split to a folder ``<directory>/<name>``.

    A folder holds ``<name>_0.mcap``, ``<name>_1.mcap`` ... and ``metadata.yaml``, as rosbag2
    lays out a bag.  What exists is never overwritten: ``<name>_2`` is taken instead.  The files
    have their names from the beginning, so that what a kill leaves is where it is looked for.

    Parameters
    ----------
    directory
        Where the recording goes.
    run, metadata, topics
        As of :class:`~capture_sim.recording.write.RunWriter`.
    split
        When a new file is begun.

    Raises
    ------
    RecordingError
        A file cannot be written.
    """

    def __init__(
        self,
        directory: Path,
        run: RunDescription,
        metadata: Mapping[str, str],
        topics: Sequence[Topic],
        split: Split,
    ) -> None:
        self._run = run
        self._metadata = dict(metadata)
        self._topics = topics
        self._split = split
        self._stem = file_name(run.name)
        self._finished: list[RunWriter] = []
        #: Entries for the metadata record at the end of the last file.
        self.closing: dict[str, str] = {}
        wanted = directory / (self._stem if split else f"{self._stem}.mcap")
        while True:
            #: The file, or the folder.
            self.path = free_path(wanted)
            try:
                if split:
                    self.path.mkdir(parents=True)
                self._writer = self._open()
            except FileExistsError:
                continue  # another recorder was faster
            except OSError as error:
                reason = error.strerror or error
                raise RecordingError(f"{self.path}: cannot write: {reason}") from None
            except RecordingError as error:
                if not isinstance(error.__cause__, FileExistsError):
                    raise
            else:
                break

    def write(self, topic: Topic, data: bytes, time: int | None) -> None:
        """Write a serialised message, into a new file when it is time for one.

        Raises
        ------
        RecordingError
            A file cannot be written.
        """
        size, span = self._split.size, self._split.time
        if (size and self._writer.size >= size) or (span and self._writer.span >= span):
            self._writer.close()
            self._finished.append(self._writer)
            self._writer = self._open()
        self._writer.write(topic, data, time)

    def flush(self) -> None:
        """Hand what waits to the operating system."""
        self._writer.flush()

    def close(self) -> None:
        """Write index and summary, and ``metadata.yaml`` of a folder.

        Raises
        ------
        RecordingError
            A file cannot be written.
        """
        self._writer.closing.update(self.closing)
        self._writer.close()
        if self._split:
            self._write_metadata()

    def give_up(self) -> None:
        """Close the file as far as that is possible."""
        with suppress(Exception):  # the file is as whole as it can be
            self._writer.close()

    def _open(self) -> RunWriter:
        path, metadata = self.path, self._metadata
        if self._split:
            number = len(self._finished)
            path = self.path / f"{self._stem}_{number}.mcap"
            metadata = {**metadata, "part": str(number)}
        return RunWriter(path, self._run, metadata, topics=self._topics)

    def _write_metadata(self) -> None:
        parts = [*self._finished, self._writer]
        topics: dict[str, TopicEntry] = {}
        for entry in (entry for part in parts for entry in part.topic_entries()):
            known = topics.get(entry.name)
            count = entry.count + (known.count if known else 0)
            topics[entry.name] = replace(entry, count=count)
        files = [part.file_entry for part in parts]
        text = bag_metadata(list(topics.values()), files, self._writer.run_id)
        with whole_file(self.path / FILE_NAME) as part:
            part.write_text(in_folder(text), encoding="utf-8")


@dataclass(frozen=True)
class RecordingReport:
    """What came of a recording.

    Attributes
    ----------
    path
        The file, or the folder of files; None when no run was announced, so that nothing
        was written.
    complete
        Every publisher has ended its streams and every message came.
    topics
        Messages seen, written, expected and missing, by topic name.
    problems
        One line for everything that is wrong; empty when complete.
    """

    path: Path | None
    complete: bool
    topics: Mapping[str, TopicCount]
    problems: tuple[str, ...]


class LiveRecorder:
    """Records one run from serialised messages as they come.

    A RunInfo names the run and opens ``<directory>/<name>.mcap`` (``<name>_2.mcap`` when that
    exists); what came before it is kept and written after it.  Messages are written by a
    thread of the recorder's own, logged at the simulated time that they carry, or where no
    simulator takes part at the time of their arrival.  The publishers' StreamCounts are
    written last, since they carry no time.

    :meth:`take` may be called from any one thread.  Use it as a context manager or call
    :meth:`close`.

    Parameters
    ----------
    directory
        Where the recording goes.
    metadata
        Further entries for the file's metadata record.
    queue_bytes
        Bound of the memory for waiting messages; as much again may be being written.
    topics
        Those that are recorded, of the bench's or others; what is not among them is ignored.
        RunInfo and StreamCounts always are.
    split
        When a new file is begun, in a folder ``<directory>/<name>``.

    Attributes
    ----------
    paused : bool
        While set, messages are counted and not written; RunInfo and StreamCounts are.
    """

    def __init__(
        self,
        directory: Path | str,
        metadata: Mapping[str, str] | None = None,
        queue_bytes: int = QUEUE_BYTES,
        *,
        topics: Sequence[Topic] = RECORDED,
        split: Split | None = None,
    ) -> None:
        self._directory = Path(directory)
        self._metadata = {"origin": LIVE, **(metadata or {})}
        chosen = {*topics, RUN_INFO, STREAM_COUNTS}
        others = [topic for topic in topics if topic not in RECORDED]
        self._topics = (*(topic for topic in RECORDED if topic in chosen), *others)
        self._split = split or Split()
        self._completeness = Completeness(topics=self._topics)
        self._simulated = True  # a simulator takes part
        self._counts: dict[str, bytes] = {}  # StreamCounts by publisher
        self._early_counts: list[bytes] = []  # came before the run was announced
        self._remarks: dict[str, None] = {}  # each once, in order
        self._first_state: float | None = None  # s, of a steady clock
        self._last_message = 0.0
        self._queue = _WriteQueue(queue_bytes)
        self._report: RecordingReport | None = None
        self.paused = False
        #: The run that is recorded; None until it is announced.
        self.run: RunDescription | None = None
        #: The file, or the folder of files; None until the run is announced.
        self.path: Path | None = None

    @property
    def done(self) -> bool:
        """Whether all publishers have ended the run and all their messages have come."""
        return self.run is not None and self._completeness.satisfied

    def take(self, topic: Topic, data: bytes) -> None:
        """Take in one serialised message.

        Raises
        ------
        RecordingError
            The file cannot be written.
        MessageError
            The bytes are no such message.
        """
        if self._report is not None:
            raise RecordingError(f"{topic.name}: message after the recording was closed")
        self._last_message = time.monotonic()
        if topic is BENCH_STATE and self._first_state is None:
            self._first_state = self._last_message
        if topic is RUN_INFO:
            self._take_info(data)
        elif topic is STREAM_COUNTS:
            self._take_counts(data)
        elif topic in self._topics:
            paused = self.paused
            stamp = self._log_time(topic, data)
            self._completeness.add(topic, sequence_of(topic, data), written=not paused)
            if not paused:
                self._queue.put(topic, data, stamp)

    def close(self) -> RecordingReport:
        """Write what waits, close the file and say what is missing; again: same report.

        Raises
        ------
        RecordingError
            The file cannot be written.
        """
        if self._report is None:
            self._report = self._make_report()
            for data in self._counts.values():
                self._queue.put(STREAM_COUNTS, data, None)
            closing = {}
            if self._first_state is not None:
                closing["wall_time"] = repr(self._last_message - self._first_state)
            self._queue.close(closing)
        return self._report

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def _log_time(self, topic: Topic, data: bytes) -> int | None:
        stamp = stamp_of(topic, data) if self._simulated else time.time_ns()
        if stamp is not None and stamp < 0:
            raise MessageError(f"stamp = {stamp / 1e9:g} s: allowed is >= 0")
        return stamp

    def _take_info(self, data: bytes) -> None:
        info = decoded(RUN_INFO, data)
        if self.run is None:
            run = RunDescription.of_message(info)
            self._simulated = SIMULATOR in run.publishers
            stamp = self._log_time(RUN_INFO, data)
            files = self._queue.open(
                self._directory, run, self._metadata, self._topics, self._split
            )
            self._queue.begin(files, data, stamp)
            self.path = files.path
            self._completeness.add(RUN_INFO, None)
            self.run = run
            self._completeness.publishers = run.publishers
            for early in self._early_counts:
                self._take_counts(early)
        elif info.run_id != self.run.run_id:
            self._remarks[f"another run was announced meanwhile: {info.run_id!r}"] = None

    def _take_counts(self, data: bytes) -> None:
        ended = decoded(STREAM_COUNTS, data)
        if len(ended.topics) != len(ended.counts):
            raise MessageError(f"{len(ended.topics)} topics and {len(ended.counts)} counts")
        if self.run is None:
            self._early_counts.append(data)
            return
        if ended.run_id != self.run.run_id:
            return  # latched by an earlier run
        self._counts.setdefault(ended.publisher, data)
        counts = dict(zip(ended.topics, ended.counts.tolist(), strict=True))
        self._completeness.end(
            ended.publisher, counts, complete=ended.complete, reason=ended.reason
        )

    def _make_report(self) -> RecordingReport:
        problems = [*self._remarks, *self._completeness.problems()]
        if self.run is None:
            problems.insert(0, "no run was announced: nothing recorded")
        return RecordingReport(
            path=self.path,
            complete=not problems,
            topics={topic.name: entry for topic, entry in self._completeness.topics.items()},
            problems=tuple(problems),
        )


def decoded(topic: Topic, data: bytes) -> Any:
    """Return a message of a topic from its bytes.

    Raises
    ------
    MessageError
        The bytes are no such message.
    """
    try:
        return typestore().deserialize_cdr(data, topic.type_name)
    except (SerdeError, UnicodeDecodeError) as error:
        raise MessageError(f"{topic.name}: {error}") from None


class _WriteQueue:
    """Hands messages to a writer in a thread of its own, in batches, in bounded memory.

    The thread looks every :data:`WRITE_PERIOD` instead of being woken by each message:
    at 1 kHz the waking costs more than the writing.
    """

    def __init__(self, limit: int) -> None:
        self._limit = limit
        self._lock = threading.Condition()
        self._waiting: list[tuple[Topic, bytes, int | None]] = []
        self._bytes = 0
        self._closing: dict[str, str] | None = None
        self._thread: threading.Thread | None = None
        self._error: RecordingError | None = None

    def open(self, *arguments: Any) -> RecordingFiles:
        """Return new files; what fails is raised by :meth:`put` too.

        Raises
        ------
        RecordingError
            The file cannot be written.
        """
        try:
            return RecordingFiles(*arguments)
        except RecordingError as error:
            self._error = error
            raise

    def begin(self, files: RecordingFiles, info: bytes, stamp: int | None) -> None:
        """Start writing: the RunInfo, then what waits."""
        self._waiting.insert(0, (RUN_INFO, info, stamp))
        self._thread = threading.Thread(
            target=self._work, args=(files,), name="recording", daemon=True
        )
        self._thread.start()

    def put(self, topic: Topic, data: bytes, stamp: int | None) -> None:
        """Append a message; waits while the queue is full.

        Raises
        ------
        RecordingError
            Writing failed, or the disk stands still.
        """
        with self._lock:
            if self._bytes >= self._limit and self._thread is not None:
                self._lock.wait_for(
                    lambda: self._bytes < self._limit or self._error is not None, STALL_LIMIT
                )
            self._check()
            if self._bytes >= self._limit:
                raise RecordingError(
                    "no run is announced that the waiting messages could belong to"
                    if self._thread is None
                    else f"the disk has not written anything for {STALL_LIMIT:g} s"
                )
            self._waiting.append((topic, data, stamp))
            self._bytes += len(data)

    def close(self, closing: dict[str, str]) -> None:
        """Write all that waits, then the closing metadata, and close the file.

        Raises
        ------
        RecordingError
            Writing failed.
        """
        with self._lock:
            self._closing = closing
            self._lock.notify_all()
        if self._thread is not None:
            self._thread.join()
            self._thread = None
        self._check()

    def _check(self) -> None:
        if self._error is not None:
            raise self._error

    def _work(self, files: RecordingFiles) -> None:
        try:
            self._write_until_closed(files)
            files.close()
        except Exception as error:  # whatever it is, the callers of put() must learn of it
            files.give_up()
            with self._lock:
                if isinstance(error, RecordingError):
                    self._error = error
                else:
                    self._error = RecordingError(f"{files.path}: {type(error).__name__}: {error}")
                self._lock.notify_all()

    def _write_until_closed(self, files: RecordingFiles) -> None:
        flushed = time.monotonic()
        while True:
            with self._lock:
                self._lock.wait_for(lambda: self._closing is not None, WRITE_PERIOD)
                batch, self._waiting = self._waiting, []
                self._bytes = 0
                closing = self._closing
                self._lock.notify_all()
            for message in batch:
                files.write(*message)
            if closing is not None:
                files.closing.update(closing)
                return
            if time.monotonic() - flushed > FLUSH_PERIOD:
                files.flush()
                flushed = time.monotonic()
