"""Samples, touches, events and recorded topics as pandas tables with units."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from capture_sim.dynamics.samples import Event, EventKind, Phase, columns_of, unit_of_column
from capture_sim.errors import MissingPackageError, import_failure

if TYPE_CHECKING:
    import pandas


class Table(NamedTuple):
    """A recorded topic: its fields as arrays, and their units."""

    fields: Mapping[str, np.ndarray]  # by name, (n,) or (n, m) each; n messages
    units: Mapping[str, str]  # by column, see samples.columns_of; only columns with a unit


def samples_frame(samples: np.ndarray) -> pandas.DataFrame:
    """Return samples, (n,) of dtype SAMPLE, as a table indexed by time, s."""
    labels = [phase.label for phase in Phase]
    phases = _pandas().Categorical.from_codes(samples["phase"], categories=labels)
    return _frame({**columns_of(samples), "phase": phases})


def touches_frame(touches: np.ndarray) -> pandas.DataFrame:
    """Return touches, (n,) of dtype TOUCH, as a table with a row for each, numbered from 0."""
    return _frame(columns_of(touches))


def events_frame(events: Sequence[Event]) -> pandas.DataFrame:
    """Return events as a table of kind, wall, detail, ``q`` and ``v``, indexed by time, s."""
    columns = _event_columns(events)
    kinds = [kind.label for kind in EventKind]
    columns["kind"] = _pandas().Categorical(columns["kind"], categories=kinds)
    return _frame(columns)


def topic_frame(table: Table) -> pandas.DataFrame:
    """Return a recorded topic as a pandas table, indexed by time, s."""
    return _frame(columns_of(table.fields), table.units)


def _frame(columns: Mapping[str, Any], units: Mapping[str, str] | None = None) -> pandas.DataFrame:
    frame = _pandas().DataFrame(columns)
    frame = frame.set_index("t") if "t" in columns else frame.rename_axis("touch")
    if units is None:
        units = {name: unit_of_column(name) for name in columns}
    frame.attrs["units"] = {name: units.get(name, "") for name in columns}
    return frame


def _pandas() -> Any:
    try:
        import pandas
    except ImportError as error:
        text = import_failure("to_dataframe() needs pandas", error, "study")
        raise MissingPackageError(text) from None
    return pandas


def _event_columns(events: Sequence[Event]) -> dict[str, Any]:
    state = {name: np.array([getattr(e, name) for e in events]).reshape(-1, 8) for name in "qv"}
    return {
        "t": np.array([event.t for event in events]),
        "kind": [event.kind.label for event in events],
        "wall": [event.wall for event in events],
        "detail": [event.detail for event in events],
        **columns_of(state),
    }
