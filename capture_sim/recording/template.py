"""Serialising many messages of one type at once, by columns."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from rosbags.typesys.store import Typestore

from capture_sim.errors import RecordingError
from capture_sim.messages.convert import Message
from capture_sim.recording.cdr import message_layout


class Template:
    """Serialised messages that differ from an example in their numbers only.

    Texts, and the lengths of sequences, stay those of the example.

    Parameters
    ----------
    store
        Knows the type.
    type_name
        ``package/msg/Name``.
    example
        A message object of rosbags' classes.
    """

    def __init__(self, store: Typestore, type_name: str, example: Message) -> None:
        data = bytes(store.serialize_cdr(example, type_name))
        self._type_name = type_name
        self._records = message_layout(store, type_name, data).records
        self._example = np.frombuffer(data, dtype=np.uint8)

    def fill(self, columns: Mapping[str, np.ndarray]) -> np.ndarray:
        """Return the example n times, with these fields changed.

        Parameters
        ----------
        columns
            (n, ...) each, by the field's path (``"header.stamp.sec"``).

        Returns
        -------
        ndarray (n, size) uint8

        Raises
        ------
        RecordingError
            The type has no such field.
        """
        n = len(next(iter(columns.values())))
        raw = np.tile(self._example, (n, 1))
        records = raw.view(self._records)[:, 0]
        for path, column in columns.items():
            if path not in (self._records.names or ()):
                raise RecordingError(f"{self._type_name}: has no number {path}")
            records[path] = column
        return raw
