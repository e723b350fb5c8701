"""The half of the live recorder that knows no ROS: bytes in, one checked recording out."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

from capture_sim.errors import MessageError, RecordingError
from capture_sim.files import file_name, free_path, whole_file
from capture_sim.messages.cdr import sequence_of, stamp_of
from capture_sim.messages.convert import RunDescription
from capture_sim.messages.definitions import decoded
from capture_sim.messages.topics import (
    BENCH_STATE,
    RUN_INFO,
    SIMULATOR,
    STREAM_COUNTS,
    TOPICS,
    Topic,
)
from capture_sim.recording.bag_file import FILE_NAME, IN_FOLDER, bag_metadata, dump
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
    """When a new file is begun."""

    size: int = 0  # bytes in the file; 0 for no bound
    time: float = 0.0  # s, from its first message to its last; 0 for no bound
    # lay the recording out as a bag's folder, even if no new file is ever begun
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
        A file cannot be written, here or later.
    """

    def __init__(
        self,
        directory: Path,
        run: RunDescription,
        metadata: Mapping[str, str],
        topics: Sequence[Topic],
        split: Split,
    ) -> None:
        self._run, self._metadata, self._topics, self._split = run, metadata, topics, split
        self._stem = file_name(run.name)
        self._finished: list[RunWriter] = []
        wanted = directory / (self._stem if split else f"{self._stem}.mcap")
        while True:
            #: The file, or the folder.
            self.path = free_path(wanted)
            try:
                if split:
                    self.path.mkdir(parents=True)
                self._writer = self._open()
                break
            except (OSError, RecordingError) as error:
                taken = isinstance(error.__cause__ or error, FileExistsError)
                if taken and os.path.lexists(self.path):
                    continue  # another recorder was faster
                if isinstance(error, RecordingError):
                    raise
                reason = error.strerror or error
                raise RecordingError(f"{self.path}: cannot write: {reason}") from None

    def write(self, topic: Topic, data: bytes, time: int | None) -> None:
        """Write a serialised message, into a new file when it is time for one."""
        size, span = self._split.size, self._split.time
        if (size and self._writer.size >= size) or (span and self._writer.span >= span):
            self._writer.close()
            self._finished.append(self._writer)
            self._writer = self._open()
        self._writer.write(topic, data, time)

    def flush(self) -> None:
        """Hand what waits to the operating system."""
        self._writer.flush()

    def close(self, closing: Mapping[str, str]) -> None:
        """Write what is known at the end, index and summary; ``metadata.yaml`` of a folder."""
        self._writer.closing.update(closing)
        self._writer.close()
        if not self._split:
            return
        parts = [*self._finished, self._writer]
        whole = {IN_FOLDER: bag_metadata([part.bag for part in parts], self._writer.run_id)}
        with whole_file(self.path / FILE_NAME) as file:
            file.write_text(dump(whole), encoding="utf-8")

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


@dataclass(frozen=True)
class RecordingReport:
    """What came of a recording."""

    # the file, or the folder of files; None when no run was announced, so that nothing was written
    path: Path | None
    complete: bool  # every publisher has ended its streams and every message came
    topics: Mapping[str, TopicCount]  # messages seen, written, expected and missing, by topic name
    problems: tuple[str, ...]  # one line for everything that is wrong; empty when complete


class LiveRecorder:
    """Records one run from serialised messages as they come.

    A RunInfo names the run and opens its file; what came before it is kept and written after it.
    Messages are written by a thread of the recorder's own, logged at the simulated time that they
    carry, or where no simulator takes part at the time of their arrival.  The publishers'
    StreamCounts are written last, since they carry no time.

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
    run : RunDescription or None
        The run that is recorded; None until it is announced.
    path : Path or None
        The file, or the folder of files; None until the run is announced.

    Raises
    ------
    RecordingError
        From its methods: the file cannot be written.
    """

    def __init__(
        self,
        directory: Path | str,
        metadata: Mapping[str, str] | None = None,
        queue_bytes: int = QUEUE_BYTES,
        *,
        topics: Sequence[Topic] = TOPICS,
        split: Split | None = None,
    ) -> None:
        self._directory = Path(directory)
        self._metadata = {"origin": LIVE, **(metadata or {})}
        chosen = {*topics, RUN_INFO, STREAM_COUNTS}
        others = [topic for topic in topics if topic not in TOPICS]
        self._topics = (*(topic for topic in TOPICS if topic in chosen), *others)
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
        self.run: RunDescription | None = None
        self.path: Path | None = None

    @property
    def done(self) -> bool:
        """Whether all publishers have ended the run and all their messages have come."""
        return self.run is not None and self._completeness.satisfied

    def take(self, topic: Topic, data: bytes) -> None:
        """Take in one serialised message; MessageError where the bytes are none."""
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
            stamp, paused = self._log_time(topic, data), self.paused
            self._completeness.add(topic, sequence_of(topic, data), written=not paused)
            if not paused:
                self._queue.put(topic, data, stamp)

    def close(self) -> RecordingReport:
        """Write what waits, close the file and say what is missing; again: same report."""
        if self._report is None:
            problems = [*self._remarks, *self._completeness.problems()]
            if self.run is None:
                problems.insert(0, "no run was announced: nothing recorded")
            self._report = RecordingReport(
                path=self.path,
                complete=not problems,
                topics={topic.name: entry for topic, entry in self._completeness.topics.items()},
                problems=tuple(problems),
            )
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
            raise MessageError(f"stamp = {stamp / 1e9:g} s: must be >= 0")
        return stamp

    def _take_info(self, data: bytes) -> None:
        info = decoded(RUN_INFO, data)
        if self.run is None:
            run = RunDescription.of_message(info)
            self._simulated = SIMULATOR in run.publishers
            first = (RUN_INFO, data, self._log_time(RUN_INFO, data))
            files = (self._directory, run, self._metadata, self._topics, self._split)
            self.path = self._queue.begin(first, *files)
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
        elif ended.run_id == self.run.run_id:  # else latched by an earlier run
            self._counts.setdefault(ended.publisher, data)
            counts = dict(zip(ended.topics, ended.counts.tolist(), strict=True))
            self._completeness.end(
                ended.publisher, counts, complete=ended.complete, reason=ended.reason
            )


_Waiting = tuple[Topic, bytes, int | None]


class _WriteQueue:
    """Hands messages to the files in a thread of its own, in batches, in bounded memory.

    The thread looks every :data:`WRITE_PERIOD` instead of being woken by each message: at 1 kHz
    the waking costs more than the writing.  What it fails by is raised by every later call.
    """

    def __init__(self, limit: int) -> None:
        self._limit = limit
        self._lock = threading.Condition()
        self._waiting: list[_Waiting] = []
        self._bytes = 0
        self._closing: dict[str, str] | None = None
        self._thread: threading.Thread | None = None
        self._error: RecordingError | None = None

    def begin(self, first: _Waiting, *files: Any) -> Path:
        """Open the files and start writing: the first message, then what waits; return where."""
        try:
            opened = RecordingFiles(*files)
        except RecordingError as error:
            self._error = error
            raise
        self._waiting.insert(0, first)
        self._thread = threading.Thread(target=self._work, args=(opened,), daemon=True)
        self._thread.start()
        return opened.path

    def put(self, *message: *_Waiting) -> None:
        """Append a message; waits while the queue is full."""
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
            self._waiting.append(message)
            self._bytes += len(message[1])

    def close(self, closing: dict[str, str]) -> None:
        """Write all that waits, then the closing metadata, and close the files."""
        with self._lock:
            self._closing = closing
            self._lock.notify_all()
        if self._thread is not None:
            self._thread.join()
        self._check()

    def _check(self) -> None:
        if self._error is not None:
            raise self._error

    def _work(self, files: RecordingFiles) -> None:
        flushed = time.monotonic()
        try:
            while self._closing is None or self._waiting:
                with self._lock:
                    self._lock.wait_for(lambda: self._closing is not None, WRITE_PERIOD)
                    batch, self._waiting = self._waiting, []
                    self._bytes = 0
                    self._lock.notify_all()
                for message in batch:
                    files.write(*message)
                if time.monotonic() - flushed > FLUSH_PERIOD:
                    files.flush()
                    flushed = time.monotonic()
            files.close(self._closing or {})
        except Exception as error:  # whatever it is, the callers of put() must learn of it
            files.give_up()
            with self._lock:
                self._error = (
                    error
                    if isinstance(error, RecordingError)
                    else RecordingError(f"{files.path}: {type(error).__name__}: {error}")
                )
                self._lock.notify_all()
