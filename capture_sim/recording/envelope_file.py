"""A capture envelope as a Parquet file: a row for each run, the plan in its metadata.

Any reader of Parquet has the table; the metadata's key ``capture_sim.envelope`` holds the
plan as JSON, with the scene as YAML in it, from which the map can be made again.
"""

from __future__ import annotations

import io
import json
from pathlib import Path
from typing import Any

import numpy as np

from capture_sim.detection.exact import CaptureState
from capture_sim.errors import RecordingError, SceneError
from capture_sim.files import whole_file
from capture_sim.studies.envelope import ROW, Envelope, replay
from capture_sim.studies.envelope_runs import plan_from_mapping, plan_to_mapping

_PLAN = b"capture_sim.envelope"
_UNITS = {
    "angle": "rad",
    "offset": "m",
    "speed": "m/s",
    "t": "s",
    "peak_force": "N",
    "axial_stroke": "m",
    "torsion": "rad",
    "nearest": "m",
}
_LABELS = ("verdict", "finer_verdict")


def check_parquet() -> None:
    """Raise RecordingError if Parquet cannot be written here."""
    _arrow()


def write_envelope(envelope: Envelope, path: Path | str) -> Path:
    """Write a map; the same map gives the same bytes.

    Returns
    -------
    Path
        Of the file.

    Raises
    ------
    RecordingError
        The file cannot be written, or pyarrow is not installed.
    """
    pa, parquet = _arrow()
    path = Path(path)
    columns, fields = [], []
    for name in ROW.names or ():
        values = envelope.rows[name]
        labels = name in _LABELS
        column = pa.array([CaptureState(v).label for v in values.tolist()] if labels else values)
        columns.append(column)
        unit = {"unit": _UNITS[name]} if name in _UNITS else None
        fields.append(pa.field(name, column.type, nullable=False, metadata=unit))
    plan = json.dumps(plan_to_mapping(envelope.plan), sort_keys=True)
    schema = pa.schema(fields, metadata={_PLAN: plan.encode()})
    buffer = io.BytesIO()
    parquet.write_table(pa.Table.from_arrays(columns, schema=schema), buffer, compression="zstd")
    with whole_file(path) as part:
        part.write_bytes(buffer.getvalue())
    return path


def read_envelope(path: Path | str) -> Envelope:
    """Read a map back, with its plan.

    Raises
    ------
    RecordingError
        The file is not there, is no Parquet file or holds no envelope.
    """
    pa, parquet = _arrow()
    try:
        table = parquet.read_table(path)
        plan = plan_from_mapping(json.loads(table.schema.metadata[_PLAN]))
        rows = np.zeros(table.num_rows, ROW)
        numbers = {state.label: state.value for state in CaptureState}
        for name in ROW.names or ():
            values = table.column(name).to_pylist()
            rows[name] = [numbers[value] for value in values] if name in _LABELS else values
        return replay(plan, rows)
    except OSError as error:
        raise RecordingError(f"{path}: cannot be read: {error}") from None
    except (KeyError, TypeError, ValueError, SceneError, pa.ArrowException) as error:
        raise RecordingError(f"{path}: holds no envelope: {error}") from None


def _arrow() -> tuple[Any, Any]:
    try:
        import pyarrow
        import pyarrow.parquet
    except ImportError:
        raise RecordingError("Parquet needs pyarrow: pip install 'capture_sim[study]'") from None
    return pyarrow, pyarrow.parquet
