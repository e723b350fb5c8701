"""A recording as tables for other tools: a column for every number, a table for every topic."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np

from capture_sim.errors import RecordingError
from capture_sim.messages.topics import CONTACT_TRACE
from capture_sim.recording.read import Run
from capture_sim.samples import TRACE

#: Column of the log times.
LOG_TIME = "log_time_ns"


def flat_columns(run: Run, topic: str) -> dict[str, np.ndarray]:
    """Return a topic's fields with the log time first; (n, m) ones as m columns ``name.i``.

    Sequences whose length differs stay one column of objects.  The contact's trace has a row
    for every point.
    """
    found: dict[str, np.ndarray] = {}
    for name, column in _table(run, topic).items():
        if column.ndim == 1:
            found[name] = column
        else:
            for i in range(column.shape[1]):
                found[f"{name}.{i}"] = column[:, i]
    return found


def _table(run: Run, topic: str) -> dict[str, np.ndarray]:
    """Return the log times and a topic's fields, (n,) or (n, m)."""
    columns, times = run.columns(topic), run.log_times(topic)
    if topic.strip("/") == CONTACT_TRACE.name:
        times = np.repeat(times, [len(t) for t in columns["t"]])
        columns = {name: run.trace[name] for name in TRACE.names or ()}
    return {LOG_TIME: times, **columns}


def table_name(topic: str) -> str:
    """Return a topic's name as part of a file's name."""
    return topic.strip("/").replace("/", "_")


def save_csv(run: Run, folder: Path) -> list[Path]:
    """Write a CSV file for each topic that makes a table; return their paths.

    Numbers are written so that reading gives the same bits.

    Raises
    ------
    RecordingError
        A file cannot be written.
    """
    written = []
    for topic in exported(run)[0]:
        columns = flat_columns(run, topic)
        path = folder / f"{table_name(topic)}.csv"
        try:
            with path.open("w", newline="", encoding="utf-8") as file:
                writer = csv.writer(file)
                writer.writerow(columns)
                writer.writerows(zip(*(_cells(c) for c in columns.values()), strict=True))
        except OSError as error:
            raise _failed(path, error) from None
        written.append(path)
    return written


def save_npz(run: Run, path: Path) -> Path:
    """Write all topics that make tables into one NumPy file, arrays named ``topic/field``.

    Texts become arrays of Unicode strings; the scene is in ``scene``.  Nothing in the file
    needs pickle.

    Raises
    ------
    RecordingError
        The file cannot be written.
    """
    arrays: dict[str, np.ndarray] = {}
    for topic in exported(run)[0]:
        for name, column in _table(run, topic).items():
            arrays[f"{topic.strip('/')}/{name}"] = (
                np.array([str(_cell(x)) for x in column]) if column.dtype == object else column
            )
    if run.has_scene:
        arrays["scene"] = np.array(run.scene_text)
    try:
        with path.open("wb") as file:
            np.savez_compressed(file, **arrays)  # type: ignore[arg-type]  # names may be any text
    except OSError as error:
        raise _failed(path, error) from None
    return path


def exported(run: Run) -> tuple[list[str], list[str]]:
    """Return the topics with messages that make tables, and why others do not, in lines."""
    topics, problems = [], []
    for topic, count in run.topics.items():
        if count:
            try:
                run.columns(topic)
            except RecordingError as error:
                problems.append(f"{topic} is left out: {error}")
            else:
                topics.append(topic)
    return topics, problems


def _cells(column: np.ndarray) -> list[object]:
    if column.dtype == object:
        return [_cell(value) for value in column]
    return list(column.tolist())  # float's repr is the shortest that gives the same bits


def _cell(value: object) -> object:
    if isinstance(value, np.ndarray):
        return " ".join(map(str, value.tolist()))
    return " ".join(map(str, value)) if isinstance(value, list) else value


def _failed(path: Path, error: OSError) -> RecordingError:
    return RecordingError(f"{path}: cannot write: {error.strerror or error}")
