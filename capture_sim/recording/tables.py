"""Tables as Parquet files."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from capture_sim.errors import RecordingError


def save_parquet(columns: Mapping[str, np.ndarray], path: Path) -> Path:
    """Write columns, (n,) each, as a Parquet file.

    Raises
    ------
    RecordingError
        The file cannot be written.
    """
    arrays = {
        name: pa.array([_plain(x) for x in column] if column.dtype == object else column)
        for name, column in columns.items()
    }
    try:
        pq.write_table(pa.table(arrays), path, compression="zstd")
    except OSError as error:
        raise RecordingError(f"{path}: cannot write: {error.strerror or error}") from None
    return path


def _plain(value: object) -> object:
    return value.tolist() if isinstance(value, np.ndarray) else value
