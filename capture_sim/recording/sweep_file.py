"""The table of a sweep as CSV or Parquet, with units in the header or in each column's metadata."""

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
    """Raise RecordingError if a table cannot be written in the format of the path's suffix."""
    if path.suffix == ".parquet":
        arrow()
    elif path.suffix != ".csv":
        raise RecordingError(f"--out = {path}: must end in .csv or .parquet")
    _pandas()


def write_sweep(table: pandas.DataFrame, path: Path, about: Mapping[str, Any]) -> Path:
    """Write the table of :func:`capture_sim.sweep` in the format of the path's suffix; return it.

    ``about`` is what made the table, with the text of its scene in ``scene``.  It is written with
    the scene's name, overrides and hash and the software: in a Parquet file as the table's
    ``attrs["made_by"]``, next to a CSV as ``<name>_made_by.json``.  RecordingError if the file
    cannot be written or pyarrow is not installed.
    """
    check_format(path)
    scene = about["scene"]
    origin = {**scene_origin(load_scene_text(scene)), "software": list(software_versions())}
    made_by = {**origin, **about, "scene": origin["scene"], "scene_text": scene}
    units = table.attrs["units"]
    with whole_file(path) as part:
        if path.suffix == ".parquet":
            table = table.copy(deep=False)
            table.attrs = {"units": units, "made_by": made_by}
            table.to_parquet(part, compression="zstd")
            return path
        heads = {name: head_of(name, unit) for name, unit in units.items()}
        table.rename(columns=heads).to_csv(part)
    with whole_file(path.with_name(f"{path.stem}_made_by.json")) as part:
        part.write_text(json.dumps(made_by, indent=2) + "\n", encoding="utf-8")
    return path


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
        cells = ["" if _is_missing(cell) else cell for cell in values]
        columns[name] = [
            _number(cell) if unit == "1" or cell == "" else f"{cell} {unit}" for cell in cells
        ]
    return pandas.DataFrame(columns)


def _number(cell: Any) -> Any:
    """Return the number in a cell; the cell itself if it is another text."""
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
    """Return pyarrow and its module for Parquet; RecordingError if it cannot be imported."""
    try:
        import pyarrow
        import pyarrow.parquet
    except ImportError as error:
        raise RecordingError(import_failure("Parquet needs pyarrow", error, "study")) from None
    return pyarrow, pyarrow.parquet
