"""Recordings compared by their values: who serialises leaves other bytes between the fields."""

from __future__ import annotations


def values_of(run, topic):
    """Return all that a topic's messages say, for comparison to the last bit."""
    return {
        name: [getattr(value, "tolist", lambda value=value: value)() for value in column]
        if column.dtype == object
        else (column.dtype.str, column.shape, column.tobytes())
        for name, column in run.columns(topic).items()
    }
