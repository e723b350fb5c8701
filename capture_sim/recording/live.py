"""Recorder of one run from serialised messages, without ROS; the recorder node uses it."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from capture_sim.base.files import file_name, free_path
from capture_sim.errors import MessageError, RecordingError
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
from capture_sim.recording.completeness import Completeness, TopicCount, counts_of
from capture_sim.recording.write import RunWriter

#: Origin of a live recording, in the metadata record.
LIVE = "live"
#: Bytes that may wait for the disk; beyond them take() waits.
QUEUE_BYTES = 64 * 1024 * 1024
#: Bytes that a waiting message needs besides its own.
MESSAGE_COST = 150
#: Seconds after which an incomplete chunk is written to the operating system.
FLUSH_PERIOD = 0.5
#: Period of the writing thread, s.
WRITE_PERIOD = 0.05
#: Seconds that a stalled disk is waited for, while the queue is full and while the file is closed:
#: shorter than a node's shutdown, and than a simulator waits for a recorder that reads nothing.
STALL_LIMIT = 5.0


@dataclass(frozen=True)
class RecordingReport:
    """Outcome of a live recording: its file, what is missing in it, and a summary."""

    path: Path  # the file
    complete: bool  # True if there are no problems
    # messages received, expected and missing, by topic name
    topics: Mapping[str, TopicCount]
    problems: tuple[str, ...]  # one line for each; empty if the recording is complete
    summary: tuple[str, ...] = ()  # messages, rate and longest gap of each required topic


class LiveRecorder:
    """Recorder of one run, which writes serialised messages to a new file in a folder.

    ``info`` is the run's serialised RunInfo message.  It names the file and is written first;
    MessageError if its bytes are invalid.  A separate thread writes the messages.  The log time of
    a message is the simulated time in its stamp if the run has a simulator, else the time of its
    arrival.  The StreamCounts messages of the publishers have no stamp and are written last.

    ``topics`` are the topics to record; they may include topics of the user's own.  RunInfo and
    StreamCounts are always recorded, and messages of further topics are ignored.  A recording in
    which one of the ``required`` topics has no message is not complete, unless the topic's
    publisher reports that it sent none.  ``remaps`` are the recorded names of topics that the user
    has renamed.  The messages that wait to be written need about ``queue_bytes`` of memory at
    most, and as much again while they are written.

    All calls of :meth:`take` must come from one thread, which may be any thread.  The constructor
    and all methods raise RecordingError if the file cannot be written.  The attribute ``run``
    describes the recorded run, and ``path`` is the path of its file.
    """

    def __init__(
        self,
        directory: Path | str,
        info: bytes,
        queue_bytes: int = QUEUE_BYTES,
        *,
        topics: Sequence[Topic] = TOPICS,
        required: Sequence[Topic] = (),
        remaps: Mapping[Topic, str] | None = None,
    ) -> None:
        self.run = RunDescription.of_message(decoded(RUN_INFO, info))
        chosen = {*topics, RUN_INFO, STREAM_COUNTS}
        others = [topic for topic in topics if topic not in TOPICS]
        self._topics = (*(topic for topic in TOPICS if topic in chosen), *others)
        remaps = remaps or {}
        self._completeness = Completeness(self.run.publishers, self._topics, required, remaps)
        self._closing: dict[str, str] = {}  # known at the end only
        self._simulated = SIMULATOR in self.run.publishers
        self._counts: dict[str, bytes] = {}  # StreamCounts by publisher
        self._first_state: float | None = None  # s, of a steady clock
        self._last_message = 0.0
        self._report: RecordingReport | None = None
        stamp = self._log_time(RUN_INFO, info)
        writer = _open_new(Path(directory), self.run, topics=self._topics, remaps=remaps)
        self.path = writer.path
        self._queue = _WriteQueue(writer, queue_bytes)
        self._completeness.add(RUN_INFO, None)
        self._queue.put(RUN_INFO, info, stamp)

    @property
    def done(self) -> bool:
        """True if all publishers have reported their message counts and these have arrived.

        Of a topic whose newest message replaces earlier ones, only the last message must arrive.
        """
        return self._completeness.satisfied

    def take(self, topic: Topic, data: bytes, arrival: int | None = None) -> None:
        """Record a serialised message.

        ``arrival`` is its time of arrival by the wall clock, ns (None: now); it is used only in a
        run without a simulator.  Messages of topics that are not recorded, and StreamCounts of
        other runs, are ignored.  MessageError if the bytes are invalid, RecordingError after
        :meth:`close`.
        """
        if self._report is not None:
            raise RecordingError(f"{topic.name}: message after the recording was closed")
        self._last_message = time.monotonic()
        if topic is BENCH_STATE and self._first_state is None:
            self._first_state = self._last_message
        if topic is STREAM_COUNTS:
            self._take_counts(data)
        elif topic in self._topics:
            stamp = self._log_time(topic, data, arrival)
            self._completeness.add(topic, sequence_of(topic, data), stamp)
            self._queue.put(topic, data, stamp)

    def close(self) -> RecordingReport:
        """Write all waiting messages and the closing metadata, close the file; return the report.

        RecordingError if the file cannot be written, or if the disk writes nothing for
        :data:`STALL_LIMIT` seconds; the file then ends with the last message that was written.
        A second call only returns the report again.
        """
        if self._report is None:
            problems = self._completeness.problems()
            self._report = RecordingReport(
                path=self.path,
                complete=not problems,
                topics={topic.name: entry for topic, entry in self._completeness.topics.items()},
                problems=tuple(problems),
                summary=tuple(self._completeness.summary()),
            )
            for data in self._counts.values():
                self._queue.put(STREAM_COUNTS, data, None)
            if self._first_state is not None:
                self._closing["wall_time"] = repr(self._last_message - self._first_state)
            self._queue.close(self._closing)
        return self._report

    def _log_time(self, topic: Topic, data: bytes, arrival: int | None = None) -> int | None:
        stamp = stamp_of(topic, data) if self._simulated else arrival or time.time_ns()
        if stamp is not None and stamp < 0:
            raise MessageError(f"stamp = {stamp / 1e9:g} s: must be >= 0")
        return stamp

    def _take_counts(self, data: bytes) -> None:
        ended = decoded(STREAM_COUNTS, data)
        counts = counts_of(ended)
        if ended.run_id == self.run.run_id:  # else kept from an earlier run
            self._counts.setdefault(ended.publisher, data)
            if ended.extremes:
                self._closing["extremes"] = ended.extremes
            self._completeness.end(
                ended.publisher, counts, complete=ended.complete, reason=ended.reason
            )


def _open_new(directory: Path, run: RunDescription, **options: Any) -> RunWriter:
    """Create ``<name of the run>.mcap``; if that file exists, ``<name>_2.mcap``, and so on.

    A live recording has its final name from the start, so that its user finds it under this name
    even if the recorder was killed.
    """
    while True:
        path = free_path(directory / f"{file_name(run.name)}.mcap")
        try:
            return RunWriter(path, run, {"origin": LIVE}, **options)
        except RecordingError as error:
            if not (isinstance(error.__cause__, FileExistsError) and os.path.lexists(path)):
                raise
            # another recorder was faster


#: Topic, bytes and log time (ns) of a message; None for the latest log time so far.
_Waiting = tuple[Topic, bytes, int | None]


class _WriteQueue:
    """Queue of bounded size whose own thread writes messages to the file, in batches.

    The thread polls the queue every :data:`WRITE_PERIOD`, because at 1 kHz waking it for each
    message would cost more than the writing.  After a failure of the thread, every later call
    raises its RecordingError.
    """

    def __init__(self, writer: RunWriter, limit: int) -> None:
        self._limit = limit
        self._lock = threading.Condition()
        self._waiting: list[_Waiting] = []
        self._bytes = 0  # that the waiting messages need
        self._closing: dict[str, str] | None = None
        self._error: RecordingError | None = None
        self._last_written = time.monotonic()
        self._thread = threading.Thread(target=self._work, args=(writer,), daemon=True)
        self._thread.start()

    def put(self, *message: *_Waiting) -> None:
        """Append a message; if the queue is full, wait for space while the disk writes.

        RecordingError if the disk has written nothing for :data:`STALL_LIMIT`, or if writing has
        failed.
        """
        with self._lock:
            began = time.monotonic()
            while self._is_full and self._error is None:
                # a slow disk may need longer than the limit for one batch, and writes all the while
                left = STALL_LIMIT - (time.monotonic() - max(began, self._last_written))
                if left <= 0.0:
                    self._error = _stall_error()
                else:
                    self._lock.wait(left)
            self._check()
            self._waiting.append(message)
            self._bytes += len(message[1]) + MESSAGE_COST

    def close(self, closing: dict[str, str]) -> None:
        """Write all waiting messages, then the closing metadata, and close the file.

        RecordingError if writing fails, or if nothing is written for :data:`STALL_LIMIT` seconds;
        the file then ends with the last message that was written.
        """
        with self._lock:
            self._closing = closing
            self._last_written = time.monotonic()
            self._lock.notify_all()
        while self._thread.is_alive():
            self._thread.join(WRITE_PERIOD)
            if time.monotonic() - self._last_written > STALL_LIMIT:
                raise self._error or _stall_error()
        self._check()

    @property
    def _is_full(self) -> bool:
        return self._bytes >= self._limit

    def _check(self) -> None:
        if self._error is not None:
            raise self._error

    def _work(self, writer: RunWriter) -> None:
        try:
            self._write_all(writer)
        except Exception as error:  # whatever it is, the callers of put() must learn of it
            with suppress(Exception):  # the file is as whole as it can be
                writer.close()
            if not isinstance(error, RecordingError):
                error = RecordingError(f"{writer.path}: {type(error).__name__}: {error}")
            with self._lock:
                self._error = self._error or error
                self._lock.notify_all()

    def _write_all(self, writer: RunWriter) -> None:
        flushed = time.monotonic()
        while self._closing is None or self._waiting:
            with self._lock:
                self._lock.wait_for(lambda: self._closing is not None, WRITE_PERIOD)
                batch, self._waiting = self._waiting, []
                self._bytes = 0
                self._lock.notify_all()
            for message in batch:
                writer.write(*message)
                self._last_written = time.monotonic()
            if time.monotonic() - flushed > FLUSH_PERIOD:
                writer.flush()
                flushed = time.monotonic()
        writer.closing.update(self._closing or {})
        writer.close()


def _stall_error() -> RecordingError:
    return RecordingError(f"the disk wrote nothing for {STALL_LIMIT:g} s: the recording ends there")
