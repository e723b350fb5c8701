"""Messages of other versions of this package: fields that a file's definition lacks get defaults.

CONTRIBUTING.md has the rule of evolution: messages, scenes and results only gain fields.  A field
that was added after the first recordings has its default in its line of the ``.msg`` file, in
ROS's own syntax (``float64 dissipated_slide 0.0``).  MCAP files contain the definitions with which
they were written.  Fields that such a definition lacks are filled in here.  Additional fields of
such a definition come from a newer version and are left out.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from functools import cache
from typing import Any

import numpy as np
import yaml
from rosbags.interfaces import Nodetype
from rosbags.serde import SerdeError
from rosbags.typesys.store import Typestore

from capture_sim.errors import MessageError
from capture_sim.messages.cdr import Columns, fill
from capture_sim.messages.definitions import blank, own_definition, typestore

_FIELD_WITH_DEFAULT = re.compile(r"[^\s#]+\s+(?P<name>[a-z]\w*)\s+(?P<value>[^\s#=][^#]*)")


@cache
def defaults(type_name: str) -> dict[str, Any]:
    """Return the defaults that a type of this package declares, by field."""
    found = map(_FIELD_WITH_DEFAULT.match, own_definition(type_name).splitlines())
    declared = {match["name"]: yaml.safe_load(match["value"]) for match in found if match}
    message = blank(type_name)
    for name, value in declared.items():
        fill(message, name, value)
    return {name: getattr(message, name) for name in declared}


def absent_fields(store: Typestore, type_name: str) -> tuple[str, ...]:
    """Return the fields of a type that its definition in another store lacks.

    All returned fields have a default.  MessageError is raised if a missing field has no default,
    or if a field has another type in that store.
    """
    if store is typestore() or type_name not in typestore().fielddefs:
        return ()
    absent = tuple(_absent(store, type_name, ""))
    for name in absent:
        if name not in defaults(type_name):
            raise MessageError(f"{type_name}: the file's definition has no field {name}")
    return absent


def _absent(store: Typestore, type_name: str, prefix: str) -> Iterator[str]:
    theirs = dict(store.fielddefs[type_name][1])
    for name, kind in typestore().fielddefs[type_name][1]:
        if name not in theirs:
            yield f"{prefix}{name}"
        elif theirs[name] != kind:
            raise MessageError(f"{type_name}: {prefix}{name} has another type in the file")
        elif kind[0] is Nodetype.NAME:
            yield from _absent(store, str(kind[1]), f"{prefix}{name}.")


def completed(columns: Columns, store: Typestore, type_name: str) -> Columns:
    """Return the columns of n messages, with the defaults of fields that the store's type lacks.

    MessageError is raised as in :func:`absent_fields`.
    """
    absent = absent_fields(store, type_name)
    n = len(next(iter(columns.values()), ()))
    return {**columns, **{name: _repeated(defaults(type_name)[name], n) for name in absent}}


def _repeated(value: Any, n: int) -> np.ndarray:
    """Return a column in which a value is repeated n times.

    Its shape is (n,), or (n, m) for an array of m numbers.  Columns of texts have dtype object.
    """
    if isinstance(value, str | list):
        column = np.empty(n, dtype=object)
        column[:] = [value] * n if isinstance(value, str) else [[*value] for _ in range(n)]
    else:
        column = np.repeat(np.asarray(value)[np.newaxis], n, axis=0)
    column.flags.writeable = False
    return column


class Translation:
    """Converter of serialised messages from another store's definition to this version's.

    MessageError is raised as in :func:`absent_fields`.
    """

    def __init__(self, store: Typestore, type_name: str) -> None:
        absent = absent_fields(store, type_name)
        self._store, self._type_name = store, type_name
        names = (name for name, _ in typestore().fielddefs[type_name][1])
        self._kept = [name for name in names if name not in absent]
        self._message = blank(type_name)
        for name in absent:
            setattr(self._message, name, defaults(type_name)[name])

    def __call__(self, data: bytes) -> bytes:
        """Return the converted message; MessageError if the bytes do not fit the type."""
        try:
            message = self._store.deserialize_cdr(data, self._type_name)
        except (SerdeError, UnicodeDecodeError) as error:
            raise MessageError(f"{self._type_name}: {error}") from None
        for name in self._kept:
            setattr(self._message, name, getattr(message, name))
        return bytes(typestore().serialize_cdr(self._message, self._type_name))
