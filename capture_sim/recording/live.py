"""The half of the live recorder that knows no ROS: bytes in, one checked file out."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

from rosbags.serde import SerdeError

from capture_sim.errors import RecordingError
from capture_sim.messages.convert import RunDescription
from capture_sim.messages.topics import BENCH_STATE, RECORDED, RUN_INFO, STREAM_COUNTS, Topic
from capture_sim.recording.cdr import PaddingCleaner, sequence_of
from capture_sim.recording.definitions import typestore
from capture_sim.recording.files import RecordingFiles, Split
from capture_sim.recording.tally import Tally, TopicTally

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
class RecordingReport:
    """What came of a recording.

    Attributes
    ----------
    path
        The file, or the folder of files; None when no run was announced, so that nothing
        was written.
    complete
        Every publisher told its counts and every message came.
    topics
        Messages seen, written, expected and missing, by topic name.
    problems
        One line for everything that is wrong; empty when complete.
    """

    path: Path | None
    complete: bool
    topics: Mapping[str, TopicTally]
    problems: tuple[str, ...]


class LiveRecorder:
    """Records one run from serialised messages as they come.

    A RunInfo names the run and opens ``<directory>/<name>.mcap`` (``<name>_2.mcap`` when that
    exists); what came before it is kept and written after it.  Messages are written by a
    thread of the recorder's own.  The publishers' StreamCounts are written last, since they
    carry no time.

    :meth:`take` may be called from any one thread.  Use it as a context manager or call
    :meth:`close`.

    Parameters
    ----------
    directory
        Where the file goes.
    metadata
        Further entries for the file's metadata record.
    queue_bytes
        Bound of the memory for waiting messages; as much again may be being written.
    topics
        Those that are recorded; others are ignored.  RunInfo and StreamCounts always are.
    split
        When a new file is begun, in a folder ``<directory>/<name>``; None never.

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
        always = (RUN_INFO, STREAM_COUNTS)
        self._topics = tuple(topic for topic in RECORDED if topic in topics or topic in always)
        self._split = split
        self._tally = Tally(topics=self._topics)
        self._run: RunDescription | None = None
        self._path: Path | None = None
        self._counts: dict[str, bytes] = {}  # StreamCounts by publisher
        self._early_counts: list[bytes] = []  # came before the run was announced
        self._remarks: dict[str, None] = {}  # each once, in order
        self._first_state: float | None = None  # s, of a steady clock
        self._last_message = 0.0
        self._queue = _WriteQueue(queue_bytes)
        self._report: RecordingReport | None = None
        self.paused = False

    @property
    def run(self) -> RunDescription | None:
        """The run that is recorded; None until it is announced."""
        return self._run

    @property
    def path(self) -> Path | None:
        """The file, or the folder of files; None until the run is announced."""
        return self._path

    @property
    def done(self) -> bool:
        """Whether all publishers have ended the run and all their messages have come."""
        return self._run is not None and self._tally.satisfied

    def take(self, topic: Topic, data: bytes) -> None:
        """Take in one serialised message.

        Raises
        ------
        RecordingError
            The file cannot be written, or the bytes are no such message.
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
            self._tally.add(topic, sequence_of(topic, data), written=not paused)
            if not paused:
                self._queue.put(topic, data)

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
                self._queue.put(STREAM_COUNTS, data)
            closing = {}
            if self._first_state is not None:
                closing["wall_time"] = repr(self._last_message - self._first_state)
            self._queue.close(closing)
        return self._report

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def _take_info(self, data: bytes) -> None:
        info = _decoded(RUN_INFO, data)
        if self._run is None:
            run = RunDescription(
                run_id=info.run_id,
                name=info.name,
                scene=info.scene,
                software=tuple(info.software),
                state_rate=info.state_rate,
                rate=info.rate,
                publishers=tuple(info.publishers),
            )
            self._path = self._queue.open(
                lambda: RecordingFiles(
                    self._directory, run, self._metadata, self._topics, self._split
                ),
                data,
            )
            self._tally.add(RUN_INFO, None)
            self._run = run
            self._tally.publishers = run.publishers
            for early in self._early_counts:
                self._take_counts(early)
        elif info.run_id != self._run.run_id:
            self._remarks[f"another run was announced meanwhile: {info.run_id}"] = None

    def _take_counts(self, data: bytes) -> None:
        if self._run is None:
            self._early_counts.append(data)
            return
        told = _decoded(STREAM_COUNTS, data)
        if told.run_id != self._run.run_id:
            return  # latched by an earlier run
        self._counts.setdefault(told.publisher, data)
        counts = dict(zip(told.topics, told.counts.tolist(), strict=True))
        self._tally.end(told.publisher, counts, complete=told.complete, reason=told.reason)

    def _make_report(self) -> RecordingReport:
        problems = [*self._remarks, *self._tally.problems()]
        if self._run is None:
            problems.insert(0, "no run was announced: nothing recorded")
        return RecordingReport(
            path=self.path,
            complete=not problems,
            topics={topic.name: entry for topic, entry in self._tally.topics.items()},
            problems=tuple(problems),
        )


def _decoded(topic: Topic, data: bytes) -> Any:
    try:
        return typestore().deserialize_cdr(data, topic.type_name)
    except SerdeError as error:
        raise RecordingError(f"{topic.name}: {error}") from None


class _WriteQueue:
    """Hands messages to a writer in a thread of its own, in batches, in bounded memory.

    The thread looks every :data:`WRITE_PERIOD` instead of being woken by each message:
    at 1 kHz the waking costs more than the writing.
    """

    def __init__(self, limit: int) -> None:
        self._limit = limit
        self._lock = threading.Condition()
        self._waiting: list[tuple[Topic, bytes]] = []
        self._bytes = 0
        self._closing: dict[str, str] | None = None
        self._thread: threading.Thread | None = None
        self._error: RecordingError | None = None

    def open(self, make: Callable[[], RecordingFiles], info: bytes) -> Path:
        """Open the file and start writing: the RunInfo, then what waits; return its path.

        Raises
        ------
        RecordingError
            The file cannot be written.
        """
        try:
            files = make()
        except RecordingError as error:
            self._error = error
            raise
        self._waiting.insert(0, (RUN_INFO, info))
        self._thread = threading.Thread(
            target=self._work, args=(files,), name="recording", daemon=True
        )
        self._thread.start()
        return files.path

    def put(self, topic: Topic, data: bytes) -> None:
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
            self._waiting.append((topic, data))
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
        store = typestore()
        clean = {topic: PaddingCleaner(store, topic.type_name) for topic in RECORDED}
        while True:
            with self._lock:
                self._lock.wait_for(lambda: self._closing is not None, WRITE_PERIOD)
                batch, self._waiting = self._waiting, []
                self._bytes = 0
                closing = self._closing
                self._lock.notify_all()
            for topic, data in batch:
                files.write_raw(topic, clean[topic](data))
            if closing is not None:
                files.closing.update(closing)
                return
            if time.monotonic() - flushed > FLUSH_PERIOD:
                files.flush()
                flushed = time.monotonic()
