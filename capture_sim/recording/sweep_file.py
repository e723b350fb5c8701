"""The table of a sweep as CSV or Parquet, with units in the header or in each column's metadata."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from capture_sim.errors import RecordingError
from capture_sim.files import whole_file

if TYPE_CHECKING:
    import pandas

#: Key in a Parquet file's metadata: how the table was made, as JSON.
METADATA = b"capture_sim.sweep"
_HEAD = re.compile(r"(.*\S)\s*\[(.*)\]")


def check_format(path: Path) -> None:
    """Raise RecordingError if a table cannot be written in the format of the path's suffix."""
    if path.suffix == ".parquet":
        arrow()
    elif path.suffix != ".csv":
        raise RecordingError(f"--out = {path}: must end in .csv or .parquet")
    _pandas()


def write_sweep(table: pandas.DataFrame, path: Path, about: Mapping[str, Any]) -> Path:
    """Write the table of :func:`capture_sim.sweep` in the format of the path's suffix; return it.

    ``about`` tells how the table was made; a Parquet file has it in its metadata, as JSON.
    RecordingError if the file cannot be written or pyarrow is not installed.
    """
    check_format(path)
    units = table.attrs["units"]
    with whole_file(path) as part:
        if path.suffix == ".csv":
            heads = {name: head_of(name, unit) for name, unit in units.items()}
            table.rename(columns=heads).to_csv(part)
        else:
            _write_parquet(table, units, part, about)
    return path


def _write_parquet(
    table: pandas.DataFrame, units: Mapping[str, str], path: Path, about: Mapping[str, Any]
) -> None:
    pa, parquet = arrow()
    columns = with_units(pa.Table.from_pandas(table.reset_index()), units)
    kept = {**(columns.schema.metadata or {}), METADATA: json.dumps(dict(about)).encode()}
    parquet.write_table(columns.replace_schema_metadata(kept), path, compression="zstd")


def head_of(name: str, unit: str) -> str:
    """Return the head of a column in a CSV: its name, and its unit in brackets if it has one."""
    return f"{name} [{unit}]" if unit else name


def with_units(columns: Any, units: Mapping[str, str]) -> Any:
    """Return a table of pyarrow with units by column in the metadata of its fields."""
    fields = [
        field.with_metadata({"unit": units[field.name]}) if units.get(field.name) else field
        for field in columns.schema
    ]
    pa, _ = arrow()
    return columns.cast(pa.schema(fields, metadata=columns.schema.metadata))


def read_cases(path: Path) -> pandas.DataFrame:
    """Read a table with a row a run; a number in a column ``name [unit]`` becomes a text with it.

    RecordingError if the file cannot be read.
    """
    pandas = _pandas()
    try:
        if path.suffix == ".parquet":
            table = pandas.read_parquet(path)
        else:
            # pandas would rename a column that is given twice
            cells = pandas.read_csv(
                path, header=None, dtype=str, keep_default_na=False, skipinitialspace=True
            )
            table = cells[1:].set_axis(cells.iloc[0], axis="columns")
    except OSError as error:
        raise RecordingError(f"{path}: cannot be read: {error.strerror or error}") from None
    except (ValueError, ImportError) as error:
        raise RecordingError(f"{path}: is not a table: {error}") from None
    columns = {}
    table = table.drop(columns="run", errors="ignore")  # a sweep's own number
    for head, values in table.items():
        named_unit = _HEAD.fullmatch(str(head))
        name, unit = named_unit.groups() if named_unit else (str(head).strip(), "1")
        if name in columns:
            raise RecordingError(f"{path}: column {name}: must be given once")
        if ";" in name:
            raise RecordingError(f"{path}: columns must be separated by commas")
        # a blank has no unit, nor has a number of a column "friction.mu [1]"
        columns[name] = [
            _number(cell) if unit == "1" or cell == "" else f"{cell} {unit}" for cell in values
        ]
    return pandas.DataFrame(columns)


def _number(cell: Any) -> Any:
    """Return the number in a cell; the cell itself if it is another text."""
    try:
        return float(cell)
    except ValueError:
        return cell


def _pandas() -> Any:
    try:
        import pandas
    except ImportError:
        raise RecordingError("sweep needs pandas: pip install 'capture_sim[study]'") from None
    return pandas


def arrow() -> tuple[Any, Any]:
    """Return pyarrow and its module for Parquet; RecordingError if it is not installed."""
    try:
        import pyarrow
        import pyarrow.parquet
    except ImportError:
        raise RecordingError("Parquet needs pyarrow: pip install 'capture_sim[study]'") from None
    return pyarrow, pyarrow.parquet
