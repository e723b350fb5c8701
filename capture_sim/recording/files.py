"""Where a live recording goes: one file, or a folder of files that follow each other."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

from capture_sim.errors import RecordingError
from capture_sim.messages.convert import RunDescription
from capture_sim.messages.topics import RECORDED, Topic
from capture_sim.recording.bag_metadata import FILE_NAME, bag_metadata, in_folder
from capture_sim.recording.writer import RunWriter, free_path

#: Recorders that may take a name before us, at the same moment.
_RIVALS = 100


@dataclass(frozen=True)
class Split:
    """When a new file is begun.

    Attributes
    ----------
    size
        Bytes in the file; 0 for no bound.
    time
        s, simulated, from its first message to its last; 0 for no bound.
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
    lays out a bag.  What exists is never overwritten: ``<name>_2`` is taken instead.

    Parameters
    ----------
    directory, run, metadata, topics
        As of :class:`~capture_sim.recording.writer.RunWriter`.
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
        metadata: Mapping[str, str] | None = None,
        topics: Sequence[Topic] = RECORDED,
        split: Split | None = None,
    ) -> None:
        self._run = run
        self._metadata = dict(metadata or {})
        self._topics = topics
        self._split = split or Split()
        self._finished: list[RunWriter] = []
        name = run.name if self._split else f"{run.name}.mcap"
        #: Entries for the metadata record at the end of the last file.
        self.closing: dict[str, str] = {}
        taken: list[Path] = []
        while True:
            #: The file, or the folder.
            self.path = free_path(directory / name, taken)
            try:
                self._writer = self._open()
            except RecordingError as error:
                # another recorder of the same run was faster
                if not isinstance(error.__context__, FileExistsError) or len(taken) > _RIVALS:
                    raise
                taken.append(self.path)
            else:
                break

    def write_raw(self, topic: Topic, data: bytes) -> None:
        """Write a serialised message, into a new file when it is time for one.

        Raises
        ------
        RecordingError
            A file cannot be written.
        """
        if self._split and self._is_full():
            self._writer.close()
            self._finished.append(self._writer)
            self._writer = self._open()
        self._writer.write_raw(topic, data)

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
        with suppress(RecordingError):
            self._writer.close()

    def _is_full(self) -> bool:
        size, time = self._split.size, self._split.time
        return bool((size and self._writer.size >= size) or (time and self._writer.span >= time))

    def _open(self) -> RunWriter:
        path, metadata = self.path, self._metadata
        if self._split:
            number = len(self._finished)
            path = self.path / f"{self._run.name}_{number}.mcap"
            metadata = {**metadata, "part": str(number)}
        return RunWriter(path, self._run, metadata, topics=self._topics)

    def _write_metadata(self) -> None:
        parts = [*self._finished, self._writer]
        files = [part.file_entry for part in parts]
        topics = []
        for entries in zip(*(part.topic_entries() for part in parts), strict=True):
            topics.append(replace(entries[0], count=sum(entry.count for entry in entries)))
        text = bag_metadata(topics, files, {"run_id": self._run.run_id})
        try:
            (self.path / FILE_NAME).write_text(in_folder(text), encoding="utf-8")
        except OSError as error:
            raise RecordingError(
                f"{self.path / FILE_NAME}: cannot write: {error.strerror or error}"
            ) from None
