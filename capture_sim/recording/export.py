"""A recording as tables for other tools: a column for every number, a table for every topic."""

from __future__ import annotations

import csv
import json
from collections.abc import Callable, Collection, Iterable, Mapping
from pathlib import Path

import numpy as np

from capture_sim.errors import RecordingError
from capture_sim.files import file_name, whole_file
from capture_sim.messages.topics import BENCH_EVENT, CONTACT_TRACE
from capture_sim.messages.units import unit_of
from capture_sim.recording.read import Run
from capture_sim.recording.sweep_file import arrow, head_of, with_units
from capture_sim.samples import TOUCH, TRACE, columns_of

#: Column of the times since the release, s; of the sample, where messages carry one.
TIME = "t"
#: Column of the log times.
LOG_TIME = "log_time_ns"
#: Name of the table of the located touches, s since the release and SI units.
TOUCHES = "touches"
#: Kinds of files.
KINDS = ("csv", "npz", "parquet")


def save_tables(
    run: Run,
    folder: Path,
    to: str,
    topics: Collection[str] = (),
    columns: Collection[str] = (),
) -> list[Path]:
    """Write a recording as tables.

    Parameters
    ----------
    run
        The recording.
    folder
        Where the files go: one for every topic, or for ``npz`` ``<name>.npz`` with all, in
        arrays named ``topic/field``, texts as Unicode strings, the scene in ``scene``, units by
        column as JSON in ``units``; nothing in it needs pickle.
    to
        One of KINDS.  Numbers in CSV are written so that reading gives the same bits.  Units are
        in the header of a CSV (``t [s]``) and in the metadata of a Parquet's columns.
    topics
        Those that are written; all that make tables unless given, and the touches.
    columns
        Those that are written beside the time; all unless given.  ``q`` stands for ``q.x_S``
        and all others of ``q``.

    Returns
    -------
    list of Path
        Of the files.

    Raises
    ------
    RecordingError
        A topic or column is not there, or a file cannot be written.
    """
    known = exported(run)[0]
    wanted = ["/" + name.lstrip("/") for name in topics] or known
    if unknown := [name for name in wanted if name not in known]:
        raise RecordingError(
            f"{run.path}: makes no table of {', '.join(unknown)}; must be one of {', '.join(known)}"
        )
    tables = {topic: _with(columns, table(run, topic)) for topic in wanted}
    if run.touches.size and not topics:
        recorded = [name for name in TOUCH.names or () if name != "rate_ratio"]  # in no message
        tables[TOUCHES] = _with(columns, {name: run.touches[name] for name in recorded})
    there = {name for found in tables.values() for name in columns_of(found)}
    if missing := [name for name in columns if not any(map(_covers(name), there))]:
        raise RecordingError(f"{run.path}: no table has a column {', '.join(missing)}")
    tables = {topic: found for topic, found in tables.items() if found.keys() - {TIME}}
    if to == "npz":
        path = folder / f"{file_name(run.path.stem)}.npz"
        _save_npz(run, tables, path)
        return [path]
    paths = _paths(tables, folder, to)
    for topic, path in paths.items():
        found = _with(columns, columns_of(tables[topic]))
        units = _units(run, topic, found)
        (_save_csv if to == "csv" else _save_parquet)(found, units, path)
    return list(paths.values())


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


def table(run: Run, topic: str) -> dict[str, np.ndarray]:
    """Return a topic's fields, (n,) or (n, m), times first.

    The contact's trace has a row for every point.
    """
    columns, logged = run.columns(topic), run.log_times(topic)
    if topic.strip("/") == CONTACT_TRACE.name and columns:
        logged = np.repeat(logged, [len(t) for t in columns["t"]])
        columns = {name: run.trace[name] for name in TRACE.names or ()}
    if TIME in columns and columns[TIME].shape == logged.shape:
        t = columns[TIME]
    else:
        t = run.times(topic)
    return {TIME: t, LOG_TIME: logged, **{n: c for n, c in columns.items() if n != TIME}}


def _units(run: Run, topic: str, names: Iterable[str]) -> dict[str, str]:
    """Return the units of the columns of a table, of those that have one."""
    # a touch is sent in the event that ends it
    type_name = BENCH_EVENT.type_name if topic == TOUCHES else run.types[topic]
    times = {TIME: "s", LOG_TIME: "ns", **({"start": "s", "end": "s"} if topic == TOUCHES else {})}
    units = {name: times.get(name) or unit_of(type_name, name) for name in names}
    return {name: unit for name, unit in units.items() if unit}


def _covers(wanted: str) -> Callable[[str], bool]:
    """Return whether a column is meant by a name: itself, or what it is a part of."""
    return lambda name: name == wanted or name.startswith(f"{wanted}.")


def _with(wanted: Collection[str], columns: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return the columns that are wanted in whole or in part, and the time; all if none is."""
    return {
        name: column
        for name, column in columns.items()
        if name == TIME
        or not wanted
        or any(_covers(one)(part) for one in wanted for part in columns_of({name: column}))
    }


def _paths(topics: Collection[str], folder: Path, suffix: str) -> dict[str, Path]:
    """Return a file for each topic, no two of one name."""
    paths: dict[str, Path] = {}
    for topic in topics:
        stem = name = file_name(topic.strip("/"))
        number = 1
        while folder / f"{name}.{suffix}" in paths.values():
            number += 1
            name = f"{stem}_{number}"
        paths[topic] = folder / f"{name}.{suffix}"
    return paths


def _save_csv(columns: Mapping[str, np.ndarray], units: Mapping[str, str], path: Path) -> None:
    # of numbers tolist gives floats, whose repr is the shortest that gives the same bits
    cells = (_texts(c) if c.dtype == object else c.tolist() for c in columns.values())
    with whole_file(path) as part, part.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(head_of(name, units.get(name, "")) for name in columns)
        writer.writerows(zip(*cells, strict=True))


def _save_parquet(columns: Mapping[str, np.ndarray], units: Mapping[str, str], path: Path) -> None:
    pa, parquet = arrow()
    arrays = {
        name: pa.array(list(column) if column.dtype == object else column)
        for name, column in columns.items()
    }
    with whole_file(path) as part:
        parquet.write_table(with_units(pa.table(arrays), units), part, compression="zstd")


def _save_npz(run: Run, tables: Mapping[str, Mapping[str, np.ndarray]], path: Path) -> None:
    arrays = {
        f"{topic.strip('/')}/{name}": np.array(_texts(c)) if c.dtype == object else c
        for topic, columns in tables.items()
        for name, c in columns.items()
    }
    units = {
        f"{topic.strip('/')}/{name}": unit
        for topic, columns in tables.items()
        for name, unit in _units(run, topic, columns_of(columns)).items()
    }
    arrays["units"] = np.array(json.dumps(units))
    if run.has_scene:
        arrays["scene"] = np.array(run.scene_text)
    with whole_file(path) as part, part.open("wb") as file:
        np.savez_compressed(file, **arrays)  # type: ignore[arg-type]  # names may be any text


def _texts(column: np.ndarray) -> list[str]:
    """Return texts as they are, and sequences as their items between spaces."""
    lists = (x.tolist() if isinstance(x, np.ndarray) else x for x in column)
    return [x if isinstance(x, str) else " ".join(map(str, x)) for x in lists]
