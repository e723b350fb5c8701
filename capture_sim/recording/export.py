"""A recording as tables for other tools: a column for every number, a table for every topic."""

from __future__ import annotations

import csv
import json
from collections.abc import Collection, Iterable, Mapping
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
    """Write a recording as tables of one of KINDS into a folder; return the paths of the files.

    Each topic makes a file; for ``npz`` there is one, ``<name>.npz``, with arrays named
    ``topic/field``, texts as Unicode strings, the scene in ``scene`` and units by column as JSON
    in ``units``; none needs pickle.  Numbers in CSV are written so that reading gives the same
    bits.  Units are in the header of a CSV (``t [s]``) and in the metadata of a Parquet's columns.

    Without ``topics`` all that make tables are written, and the touches.  Without ``columns`` all
    are; ``q`` stands for ``q.x_S`` and the other columns of ``q``.  The time is always written.
    RecordingError if a topic or column is not recorded, or if a file cannot be written.
    """
    exportable = exported(run)[0]
    names = ["/" + name.lstrip("/") for name in topics] or exportable
    if unknown := [name for name in names if name not in exportable]:
        raise RecordingError(
            f"{run.path}: no table of {', '.join(unknown)}: must be one of {', '.join(exportable)}"
        )
    tables = {topic: _selected(columns, table(run, topic)) for topic in names}
    if run.touches.size and not topics:
        recorded = [name for name in TOUCH.names or () if name != "rate_ratio"]  # in no message
        tables[TOUCHES] = _selected(columns, {name: run.touches[name] for name in recorded})
    available = {name for fields in tables.values() for name in columns_of(fields)}
    if missing := [name for name in columns if not any(_covers(name, each) for each in available)]:
        raise RecordingError(f"{run.path}: no table has a column {', '.join(missing)}")
    tables = {topic: fields for topic, fields in tables.items() if fields.keys() - {TIME}}
    if to == "npz":
        path = folder / f"{file_name(run.path.stem)}.npz"
        _save_npz(run, tables, path)
        return [path]
    paths = _paths(tables, folder, to)
    save = _save_csv if to == "csv" else _save_parquet
    for topic, path in paths.items():
        fields = _selected(columns, columns_of(tables[topic]))
        save(fields, _units(run, topic, fields), path)
    return list(paths.values())


def exported(run: Run) -> tuple[list[str], list[str]]:
    """Return the topics with messages that make tables, and a line for each that does not."""
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


def _covers(name: str, column: str) -> bool:
    """Return True if a name stands for a column: its own, or that of the field it is part of."""
    return column == name or column.startswith(f"{name}.")


def _selected(names: Collection[str], fields: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return the fields of which a name covers a column, and the time; without names all."""
    return {
        field: values
        for field, values in fields.items()
        if field == TIME
        or not names
        or any(_covers(name, column) for name in names for column in columns_of({field: values}))
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
