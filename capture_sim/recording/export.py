"""Writes a recording as tables for other tools: a table for each topic, a column for each field."""

from __future__ import annotations

import csv
import json
from collections.abc import Collection, Iterator, Mapping
from functools import partial
from pathlib import Path

import numpy as np

from capture_sim.base.files import file_name, whole_file
from capture_sim.dynamics.samples import TOUCH, TRACE, columns_of
from capture_sim.errors import RecordingError
from capture_sim.messages.topics import BENCH_EVENT, CONTACT_TRACE, SHOWN
from capture_sim.messages.units import unit_of
from capture_sim.recording.bag import Bag
from capture_sim.recording.sweep_file import arrow, head_of, with_units
from capture_sim.run.frames import Table
from capture_sim.run.lazy import LazyMapping

#: Column of the times since the release, s; of the sample, where messages carry one.
TIME = "t"
#: Column of the log times.
LOG_TIME = "log_time_ns"
#: Name of the table of the located touches, s since the release and SI units.
TOUCHES = "touches"
#: Kinds of files.
KINDS = ("csv", "npz", "parquet")


def save_tables(
    tables: Mapping[str, Table],
    folder: Path,
    to: str,
    *,
    name: str,
    topics: Collection[str] = (),
    columns: Collection[str] = (),
    scene: str = "",
) -> Iterator[Path]:
    """Write tables to files in a folder, and yield the path of each file when it is complete.

    It is a generator: nothing is checked or written before its first ``next``.

    Parameters
    ----------
    tables
        Tables by topic, of a run or recording; all must be readable.
    folder
        Where to write.
    to
        Kind of the files, one of KINDS.  ``csv``: a file for each table, with units in the header
        (``t [s]``); reading the numbers gives the same bits.  ``parquet``: a file for each table,
        with units in the metadata of the columns.  ``npz``: one file, ``<name>.npz``, with arrays
        named ``topic/field``, the text of the scene in ``scene``, and units by column as JSON in
        ``units``; none of them needs pickle.
    name
        Name of the npz file.
    topics
        The topics to write; all if empty.
    columns
        The columns to write besides the time; all if empty.  ``q`` stands for ``q.x_S`` and the
        other columns of ``q``.  A table that then has only the time is left out.
    scene
        Text of the scene, for npz.

    Raises
    ------
    RecordingError
        A topic or column is not recorded, a file cannot be written, or ``parquet`` needs pyarrow,
        which cannot be imported.
    """
    if topics:
        names = [topic if topic in tables else "/" + topic.lstrip("/") for topic in topics]
        if unknown := [topic for topic in names if topic not in tables]:
            available = ", ".join(tables)
            raise RecordingError(f"no table of {', '.join(unknown)}: must be one of {available}")
        tables = {topic: tables[topic] for topic in names}
    fields = {topic: _selected(columns, table.fields) for topic, table in tables.items()}
    available_columns = {column for each in fields.values() for column in columns_of(each)}
    if missing := [c for c in columns if not any(_covers(c, each) for each in available_columns)]:
        raise RecordingError(f"no table has a column {', '.join(missing)}")
    fields = {topic: each for topic, each in fields.items() if each.keys() - {TIME}}
    units = {topic: tables[topic].units for topic in fields}
    if to == "npz":
        path = folder / f"{file_name(name)}.npz"
        _save_npz(fields, units, scene, path)
        yield path
        return
    save = _save_csv if to == "csv" else _save_parquet
    for topic, path in _paths(fields, folder, to).items():
        save(_selected(columns, columns_of(fields[topic])), units[topic], path)
        yield path


def tables_of(bag: Bag) -> LazyMapping[Table]:
    """Return the tables of a recording by topic; each is decoded when it is first used.

    The topics that only show the bench have none.  If events are recorded, the touches that they
    describe are a further table, TOUCHES.
    """
    shown = {topic.absolute_name for topic in SHOWN}
    # ours: nested lists, made from the poses of other topics
    without = shown if shown <= bag.topics.keys() else set()
    there = [name for name, count in bag.topics.items() if count and name not in without]
    makers = {name: partial(_table, bag, name) for name in there}
    if bag.has(BENCH_EVENT):
        makers[TOUCHES] = partial(_touch_table, bag)
    return LazyMapping(makers)


def readable(tables: Mapping[str, Table]) -> tuple[dict[str, Table], list[str]]:
    """Return the tables that can be read and have rows, and a line for each that is unreadable.

    If the events are unreadable, the table of touches, which come from them, has no line.
    """
    kept, problems = {}, []
    for topic in tables:
        try:
            table = tables[topic]
        except RecordingError as error:
            if topic != TOUCHES:  # the topic of the events has its line
                problems.append(f"{topic} is left out: {error}")
        else:
            if any(len(column) for column in table.fields.values()):
                kept[topic] = table
    return kept, problems


def _table(bag: Bag, topic: str) -> Table:
    """Return the table of a topic: its fields, (n,) or (n, m), after time and log time.

    It has a row for each message; that of the contact's trace, whose messages contain many points,
    has a row for each point.
    """
    columns, logged = bag.columns(topic), bag.log_times(topic)
    if topic.strip("/") == CONTACT_TRACE.name and columns:
        logged = np.repeat(logged, [len(t) for t in columns["t"]])
        columns = {name: bag.trace[name] for name in TRACE.names or ()}
    if TIME in columns and columns[TIME].shape == logged.shape:
        t = columns[TIME]
    else:
        t = bag.times(topic)
    fields = {TIME: t, LOG_TIME: logged, **{n: c for n, c in columns.items() if n != TIME}}
    times = {TIME: "s", LOG_TIME: "ns"}
    return Table(fields, _units(bag.types[topic], fields, times))


def _touch_table(bag: Bag) -> Table:
    """Return the table of the touches that the recorded events describe."""
    names = [name for name in TOUCH.names or () if name != "rate_ratio"]  # in no message
    fields = {name: bag.touches[name] for name in names}
    # a touch is sent in the event that ends it
    return Table(fields, _units(BENCH_EVENT.type_name, fields, {"start": "s", "end": "s"}))


def _units(
    type_name: str, fields: Mapping[str, np.ndarray], times: Mapping[str, str]
) -> dict[str, str]:
    """Return the units of a table's columns by column, without columns that have no unit.

    ``times`` are the units of columns with times; the others follow from the message type.
    """
    units = {name: times.get(name) or unit_of(type_name, name) for name in columns_of(fields)}
    return {name: unit for name, unit in units.items() if unit}


def _covers(name: str, column: str) -> bool:
    """Return True if a user's ``name`` selects a column: it is the column's name or its field's."""
    return column == name or column.startswith(f"{name}.")


def _selected(names: Collection[str], fields: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return the time and the fields that the user's names select; all fields without names."""
    return {
        field: values
        for field, values in fields.items()
        if field == TIME
        or not names
        or any(_covers(name, column) for name in names for column in columns_of({field: values}))
    }


def _paths(topics: Collection[str], folder: Path, suffix: str) -> dict[str, Path]:
    """Return the path of a file for each topic; equal names are numbered."""
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


def _save_npz(
    tables: Mapping[str, Mapping[str, np.ndarray]],
    units: Mapping[str, Mapping[str, str]],
    scene: str,
    path: Path,
) -> None:
    arrays = {
        f"{topic.strip('/')}/{name}": np.array(_texts(c)) if c.dtype == object else c
        for topic, columns in tables.items()
        for name, c in columns.items()
    }
    named_units = {
        f"{topic.strip('/')}/{name}": units[topic][name]
        for topic, columns in tables.items()
        for name in columns_of(columns)
        if name in units[topic]
    }
    arrays["units"] = np.array(json.dumps(named_units))
    if scene:
        arrays["scene"] = np.array(scene)
    with whole_file(path) as part, part.open("wb") as file:
        np.savez_compressed(file, **arrays)  # type: ignore[arg-type]  # names may be any text


def _texts(column: np.ndarray) -> list[str]:
    """Return the texts of a column; a sequence becomes its items, separated by spaces."""
    lists = (x.tolist() if isinstance(x, np.ndarray) else x for x in column)
    return [x if isinstance(x, str) else " ".join(map(str, x)) for x in lists]
