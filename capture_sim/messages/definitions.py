"""Message definitions: the type store, schema texts and type hashes."""

from __future__ import annotations

import re
from collections.abc import Callable
from functools import cache, lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.interfaces import Nodetype
from rosbags.serde import SerdeError
from rosbags.typesys import (
    Stores,
    TypesysError,
    get_types_from_idl,
    get_types_from_msg,
    get_typestore,
)
from rosbags.typesys.store import Typestore

from capture_sim.base.resources import message_dir
from capture_sim.errors import MessageError
from capture_sim.messages.cdr import NUMBERS
from capture_sim.messages.standard import STANDARD
from capture_sim.messages.topics import Topic

_PACKAGE = "capture_sim"
#: Encodings of definitions in OMG's interface description language.
_IDL = ("ros2idl", "omgidl")
#: Errors of a text that defines no message type.
NO_DEFINITION = (
    *(TypesysError, ValueError, KeyError, RecursionError, NameError, SyntaxError, TypeError),
    *(OverflowError, MemoryError, AttributeError, IndexError),
)
#: Limits of a definition from a file: the largest of ROS 2's packages has 24 kB and 400 lines.
MAX_DEFINITION, MAX_LINES, MAX_DEPTH, MAX_ARRAY = 262_144, 5_000, 4, 10_000_000
_COMMENT = re.compile(r"#[^\n]*|//[^\n]*|/\*.*?\*/|\"[^\"\n]*\"|'[^'\n]*'", re.DOTALL)
_SIZE = re.compile(r"\[\s*(\d{1,40})\s*\]")
#: A shift, a power, or a number with a large exponent.
_ODD = re.compile(r"(?:<<|>>(?=\s*\d)|\*\*).*|=\s*[-+\d.]*[eE]\+?\d{4,}.*")


@cache
def typestore() -> Typestore:
    """Return the store of the types of capture_sim and of ROS 2 Jazzy.

    The types of Jazzy that no topic of the suite uses are loaded when one of them is requested.
    """
    store = get_typestore(Stores.EMPTY)
    store.types, store.fielddefs = _OnDemand(store), _OnDemand(store)
    types = dict(STANDARD)
    for path in _definition_files():
        types.update(get_types_from_msg(path.read_text(encoding="utf-8"), _type_name(path)))
    store.register(types)
    return store


@lru_cache(maxsize=100)
def store_of(type_name: str, definition: str, encoding: str = "ros2msg") -> Typestore:
    """Return a store that contains a type as a file defines it, in ros2msg or ros2idl.

    This is :func:`typestore` if its definition is equal, or if the file has no definition and the
    type is from another package.  An error of :data:`NO_DEFINITION` is raised if the text defines
    no message type.
    """
    store = typestore()
    is_own = type_name.startswith(f"{_PACKAGE}/")
    is_missing = not definition.strip() and not is_own
    if type_name in store.fielddefs and (is_missing or definition == schema_text(type_name)):
        return store
    store = get_typestore(Stores.EMPTY)
    is_idl = encoding in _IDL
    check_definition(definition, is_idl=is_idl)
    types = get_types_from_idl(definition) if is_idl else get_types_from_msg(definition, type_name)
    if type_name not in types:
        # as of rosidl's IDL, whose structures have other names: the package's own type is meant
        if not is_own and type_name in typestore().fielddefs:
            return typestore()
        raise TypesysError(f"does not define {type_name}")
    store.register(types)
    return store


def check_definition(text: str, *, is_idl: bool = False) -> None:
    """Raise TypesysError if a definition from a file is too large, or has what a parser may try.

    Its parser tries each bracket in several ways, and a message of it has each element of an array.
    """
    if len(text) > MAX_DEFINITION:
        raise TypesysError(f"has {len(text)} characters: must be at most {MAX_DEFINITION}")
    if (count := text.count(";" if is_idl else "\n")) > MAX_LINES:
        raise TypesysError(f"has {count} lines: must be at most {MAX_LINES}")
    code = _COMMENT.sub("", text).replace("<=", "")  # of bounded strings and arrays
    for opening, closing in ("()", "<>", "{}", "[]"):
        depth = deepest = 0
        for character in code:
            depth += (character == opening) - (character == closing)
            deepest = max(deepest, depth)
        if deepest > MAX_DEPTH:
            raise TypesysError(f"has {deepest} {opening} in each other: must be {MAX_DEPTH}")
    for size in map(int, _SIZE.findall(code)):
        if size > MAX_ARRAY:
            raise TypesysError(f"has an array of {size} elements: must be at most {MAX_ARRAY}")
    if odd := _ODD.search(code):
        raise TypesysError(f"has {odd[0].strip()[:40]!r}: must be a number or a name")


class _OnDemand(dict[str, Any]):
    """Entries of a store by type; a request for a missing type loads all types of ROS 2 Jazzy."""

    def __init__(self, store: Typestore) -> None:
        super().__init__()
        self._store = store
        self._is_complete = False

    def __contains__(self, type_name: object) -> bool:
        if not super().__contains__(type_name):
            self._load()
        return super().__contains__(type_name)

    def __missing__(self, type_name: str) -> Any:
        if type_name not in self:
            raise KeyError(type_name)
        return self[type_name]

    def _load(self) -> None:
        types, definitions = self._store.types, self._store.fielddefs
        if isinstance(types, _OnDemand) and not types._is_complete:
            types._is_complete = True
            jazzy = get_typestore(Stores.ROS2_JAZZY)
            for name in jazzy.types.keys() - types.keys():
                types[name], definitions[name] = jazzy.types[name], jazzy.fielddefs[name]


def is_known(type_name: str) -> bool:
    """Return True if a type is from capture_sim or ROS 2 Jazzy, or was learned."""
    try:
        return bool(typestore().types[type_name])
    except KeyError:
        return False


def learn_type(type_name: str, share: Path) -> bool:
    """Learn a type from the definitions in a package's folder; return True if it is then known."""
    if is_known(type_name):
        return True
    store, package = typestore(), type_name.split("/")[0]
    types = {}
    for path in sorted(share.glob("msg/*.msg")):
        name = f"{package}/msg/{path.stem}"
        types.update(get_types_from_msg(path.read_text(encoding="utf-8"), name))
    store.register({name: kind for name, kind in types.items() if name not in store.types})
    return type_name in store.types


def blank(type_name: str) -> Any:
    """Return a message in which numbers are zero, and texts and sequences are empty."""
    kinds: dict[Nodetype, Callable[[Any], Any]] = {
        Nodetype.BASE: lambda of: "" if of[0] == "string" else NUMBERS[of[0]].type(0).item(),
        Nodetype.NAME: blank,
        Nodetype.ARRAY: lambda of: np.zeros(of[1], NUMBERS[of[0][1][0]]),
        Nodetype.SEQUENCE: lambda of: (
            [] if of[0][1][0] not in NUMBERS else np.zeros(0, NUMBERS[of[0][1][0]])
        ),
    }
    fields = typestore().fielddefs[type_name][1]
    return typestore().types[type_name](*(kinds[kind](of) for _, (kind, of) in fields))


def decoded(topic: Topic, data: bytes, store: Typestore | None = None) -> Any:
    """Return a message of a topic from its bytes; MessageError if they do not fit its type."""
    try:
        return (store or typestore()).deserialize_cdr(data, topic.type_name)
    except (SerdeError, UnicodeDecodeError) as error:
        raise MessageError(f"{topic.name}: {error}") from None


@cache
def schema_text(type_name: str) -> str:
    """Return the ros2msg definition of a type, including all types that it contains.

    The definition of a type of this package is the text of its file, so that every recording
    includes the units in its comments.
    """
    generated, _ = typestore().generate_msgdef(type_name, ros_version=2)
    separator = "=" * 80 + "\n"
    own, *parts = generated.split(separator)
    return separator.join([own_definition(type_name) or own, *parts])


@cache
def own_definition(type_name: str) -> str:
    """Return the text of the file that defines a type of this package; empty for other types."""
    for path in _definition_files():
        if _type_name(path) == type_name:
            return path.read_text(encoding="utf-8")
    return ""


@cache
def type_hash(type_name: str) -> str:
    """Return the RIHS01 hash of a type, as ROS 2 computes it."""
    return typestore().hash_rihs01(type_name)


def _definition_files() -> list[Path]:
    return sorted(message_dir().glob("*.msg"))


def _type_name(path: Path) -> str:
    return f"{_PACKAGE}/msg/{path.stem}"
