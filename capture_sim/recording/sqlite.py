"""Reads a bag's .db3 file with the library rosbags, and gives it in the form of MCAP records."""

from __future__ import annotations

import sqlite3
import tempfile
from collections.abc import Iterator
from contextlib import closing, suppress
from itertools import islice
from pathlib import Path

from mcap.records import Channel, Schema

from capture_sim.errors import RecordingError, one_line
from capture_sim.recording.compression import TOO_LARGE
from capture_sim.recording.records import (
    MESSAGE_COST,
    Damage,
    RecordContents,
    StoredMessage,
    usable,
)

MAGIC = b"SQLite format 3\x00"
#: Messages that are read at a time.
_BATCH = 1000
_ENCODINGS = {"MSG": "ros2msg", "IDL": "ros2idl"}
#: Characters that end a path in an URI, by which the library opens the file.
_OF_URIS = frozenset("?#%")


def scan_sqlite(
    path: Path, named: Path, size: int, limit: int
) -> Iterator[RecordContents | Damage]:
    """Yield the contents of the .db3 file at ``path``; last its damage, if it has any.

    First come the definitions, one topic each, then the messages in batches.  ``size`` is the
    file's size, bytes, which a damage reports.  ``limit`` is how many bytes the messages may have
    in all, with those that compressed ones unpack to and MESSAGE_COST for each; more count as
    damage.  RecordingError, at the first ``next``, if the file is not a bag of rosbag2.  It names
    the file ``named``, because a compressed file is unpacked to a temporary ``path``.
    """
    if _OF_URIS & set(str(path)):
        with tempfile.TemporaryDirectory() as folder:
            link = Path(folder, "bag.db3")
            link.symlink_to(path.absolute())
            yield from _scan(link, named, size, limit)
        return
    yield from _scan(path, named, size, limit)


def _scan(path: Path, named: Path, size: int, limit: int) -> Iterator[RecordContents | Damage]:
    from rosbags.rosbag2.storage_sqlite3 import Sqlite3Reader  # 0.1 s, only for these files

    _check_tables(path, named)
    reader = Sqlite3Reader(path)
    try:
        reader.open()
    except Exception as error:  # whatever SQLite and the library make of foreign tables
        raise RecordingError(f"{named}: not a bag of rosbag2: {_in_words(error, path)}") from None
    count, first, last = 0, 0, 0
    try:
        for number, connection in enumerate(reader.connections, 1):
            encoding = _ENCODINGS.get(connection.msgdef.format.name, "")
            definition = connection.msgdef.data.encode()
            yield RecordContents(
                (
                    Schema(number, definition, encoding, connection.msgtype),
                    Channel(
                        connection.id,
                        connection.topic,
                        getattr(connection.ext, "serialization_format", "cdr"),
                        {},
                        number,
                    ),
                )
            )
        stored = reader.messages(reader.connections)
        while batch := list(islice(stored, _BATCH)):
            messages: list[StoredMessage] = [
                (connection.id, log_time, bytes(data)) for connection, log_time, data in batch
            ]
            found = usable(messages, limit)
            limit -= found.unpacked + sum(len(m[2]) + MESSAGE_COST for m in messages)
            if limit < 0:
                raise ValueError(TOO_LARGE)
            if found.times:
                first = min(found.times) if not count else min(first, *found.times)
                last = max(last, *found.times)
                count += len(found.times)
            yield RecordContents((), found.messages, found.rejected)
        wal = path.with_name(f"{path.name}-wal")
        if wal.is_file() and wal.stat().st_size:
            raise ValueError(
                f"{named.name}-wal beside it has messages that are not in it yet: close the "
                f"recorder, or run: sqlite3 {named.name} 'PRAGMA wal_checkpoint'"
            )
    except GeneratorExit:
        raise
    except Exception as error:
        reason = _in_words(error, path)
        yield Damage(None, size, reason, count, reader.metadata.message_count, (last - first) / 1e9)
    finally:
        reader.close()


def _check_tables(path: Path, named: Path) -> None:
    """Raise RecordingError if the file's tables are not plain: a column that SQLite computes may
    be of any size, and a view may be any query.
    """
    with suppress(sqlite3.Error), closing(sqlite3.connect(f"file:{path}?mode=ro", uri=True)) as bag:
        query = "SELECT name, type || ' ' || coalesce(sql, '') FROM sqlite_master"
        kinds = dict(bag.execute(query))
        for table in ("topics", "messages"):
            kind = kinds.get(table, "")
            hidden = [row[6] for row in bag.execute(f"PRAGMA table_xinfo({table})")]
            if kind and (not kind.upper().startswith("TABLE CREATE TABLE") or any(hidden)):
                raise RecordingError(
                    f"{named}: not a bag of rosbag2: {table} must be a table without computed "
                    "columns"
                )


def _in_words(error: Exception, path: Path) -> str:
    text = one_line(str(error) or type(error).__name__)
    return text.removeprefix(f"Cannot open database {path}: ")
