"""Writes the table of a sweep, with its units, as CSV or Parquet, and reads tables of runs.

A CSV has the units in its header; a Parquet file has them in the table's ``attrs["units"]``.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from capture_sim.base.files import whole_file
from capture_sim.base.software import software_versions
from capture_sim.errors import RecordingError, import_failure
from capture_sim.run.origin import scene_origin
from capture_sim.scene.loading import load_scene_text

if TYPE_CHECKING:
    import pandas

_HEAD = re.compile(r"(.*\S)\s*\[(.*)\]")


def check_format(path: Path) -> None:
    """Raise RecordingError if a table cannot be written in the format of the path's suffix.

    The suffix must be .csv or .parquet.  pandas must be installed, for .parquet also pyarrow.
    """
    if path.suffix == ".parquet":
        arrow()
    elif path.suffix != ".csv":
        raise RecordingError(f"--out = {path}: must end in .csv or .parquet")
    _pandas()


def write_sweep(table: pandas.DataFrame, path: Path, about: Mapping[str, Any]) -> Path:
    """Write a table of :func:`capture_sim.sweep`, as CSV or Parquet by its suffix; return its path.

    ``about`` is what made the table, e.g. the seed; it must contain the text of the scene as
    ``scene``.  It is written together with the scene's name, overrides and hash, the software and
    the number of rows (``written``, fewer than ``runs`` after Ctrl-C): in a Parquet file as the
    table's ``attrs["made_by"]``, next to a CSV as ``<name>_made_by.json``.  There, ``scene`` is the
    scene's name and ``scene_text`` its text.

    RecordingError if a file cannot be written, if the suffix is another one, or if pandas, or
    pyarrow for a Parquet file, is not installed.
    """
    check_format(path)
    scene = about["scene"]
    origin = {**scene_origin(load_scene_text(scene)), "software": list(software_versions())}
    made_by = {**origin, **about, "scene": origin["scene"], "scene_text": scene}
    made_by["written"] = len(table)
    units = table.attrs["units"]
    description = _description_of(path)
    with whole_file(path) as part:
        if path.suffix == ".parquet":
            table = table.copy(deep=False)
            table.attrs = {"units": units, "made_by": made_by}
            table.to_parquet(part, compression="zstd")
            return path
        heads = {name: head_of(name, unit) for name, unit in units.items()}
        table.rename(columns=heads).to_csv(part)
        description.unlink(missing_ok=True)  # a kill leaves none of another table
    with whole_file(description) as part:
        part.write_text(json.dumps(made_by, indent=2) + "\n", encoding="utf-8")
    return path


def is_complete(path: Path, about: Mapping[str, Any]) -> bool:
    """Return True if a table was written with the same ``about``, and with all of its ``runs``.

    See :func:`write_sweep`.  Older tables do not say how many rows they have.
    """
    try:
        if path.suffix == ".parquet":
            metadata = arrow()[1].read_schema(path).metadata
            made_by = json.loads(metadata[b"PANDAS_ATTRS"])["made_by"]
        else:
            made_by = json.loads(_description_of(path).read_text(encoding="utf-8"))
        wanted = {**about, "scene_text": about["scene"], "software": list(software_versions())}
        del wanted["scene"]
        if made_by.get("written", about["runs"]) != about["runs"]:
            return False
        return path.is_file() and json.loads(json.dumps(wanted)) == {
            name: made_by.get(name) for name in wanted
        }
    except (OSError, ValueError, AttributeError, LookupError, TypeError):
        return False


def _description_of(path: Path) -> Path:
    """Return the path of the JSON file that describes how a CSV table was made."""
    return path.with_name(f"{path.stem}_made_by.json")


def head_of(name: str, unit: str) -> str:
    """Return the head of a column in a CSV: its name, and its unit in brackets if it has one."""
    return f"{name} [{unit}]" if unit else name


def with_units(columns: Any, units: Mapping[str, str]) -> Any:
    """Return a pyarrow table with the unit of each column in its field's metadata, as ``unit``.

    ``units`` are by column; a column without a unit, or with an empty one, gets no metadata.
    RecordingError if pyarrow cannot be imported.
    """
    fields = [
        field.with_metadata({"unit": units[field.name]}) if units.get(field.name) else field
        for field in columns.schema
    ]
    pa, _ = arrow()
    return columns.cast(pa.schema(fields, metadata=columns.schema.metadata))


def read_cases(path: Path) -> pandas.DataFrame:
    """Read a table with one row for each run, from a Parquet file or, with another suffix, a CSV.

    A column ``name [unit]`` is returned as ``name``, and its cells become texts with the unit, e.g.
    ``"600 N/m"``; blank cells get no unit.  In a column without a unit, or with the unit ``[1]``,
    numbers become floats and other texts stay.  The column ``run``, in which a sweep numbers its
    runs, is left out.

    RecordingError if the file cannot be read or is not a table, if a column is given twice, if a
    name contains a ``;``, or if pandas, or pyarrow for a Parquet file, is not installed.
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
        cells = ["" if _is_missing(cell) else cell for cell in values]
        columns[name] = [
            _number(cell) if unit == "1" or cell == "" else f"{cell} {unit}" for cell in cells
        ]
    return pandas.DataFrame(columns)


def _number(cell: Any) -> Any:
    """Return the number in a cell as a float; the cell itself if it is a text without a number."""
    try:
        return float(cell)
    except (ValueError, TypeError):
        return cell


def _is_missing(cell: Any) -> bool:
    """Return True for a cell of a Parquet file without a value, for which pandas has several."""
    return not isinstance(cell, str) and str(cell) in ("None", "nan", "<NA>", "NaT")


def _pandas() -> Any:
    try:
        import pandas
    except ImportError as error:
        raise RecordingError(import_failure("sweep needs pandas", error, "study")) from None
    return pandas


def arrow() -> tuple[Any, Any]:
    """Return the modules pyarrow and pyarrow.parquet; RecordingError if they cannot be imported."""
    try:
        import pyarrow
        import pyarrow.parquet
    except ImportError as error:
        raise RecordingError(import_failure("Parquet needs pyarrow", error, "study")) from None
    return pyarrow, pyarrow.parquet
