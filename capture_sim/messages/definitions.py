"""Message definitions: the type store, schema texts and type hashes."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.interfaces import Nodetype
from rosbags.serde import SerdeError
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from capture_sim.errors import MessageError
from capture_sim.messages.cdr import NUMBERS
from capture_sim.messages.topics import Topic
from capture_sim.resources import message_dir

_PACKAGE = "capture_sim"


@cache
def typestore() -> Typestore:
    """Return the types of ROS 2 Jazzy and of capture_sim."""
    store = get_typestore(Stores.ROS2_JAZZY)
    types = {}
    for path in _definition_files():
        types.update(get_types_from_msg(path.read_text(encoding="utf-8"), _type_name(path)))
    store.register(types)
    return store


def learn_type(type_name: str, share: Path) -> bool:
    """Learn a type from the definitions in a package's folder; return whether it is known now."""
    store, package = typestore(), type_name.split("/")[0]
    if type_name in store.types:
        return True
    types = {}
    for path in sorted(share.glob("msg/*.msg")):
        name = f"{package}/msg/{path.stem}"
        types.update(get_types_from_msg(path.read_text(encoding="utf-8"), name))
    store.register({name: kind for name, kind in types.items() if name not in store.types})
    return type_name in store.types


def blank(type_name: str) -> Any:
    """Return a message with zeros and nothing in it."""
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
    """Return a message of a topic from its bytes; MessageError if they are no such message."""
    try:
        return (store or typestore()).deserialize_cdr(data, topic.type_name)
    except (SerdeError, UnicodeDecodeError) as error:
        raise MessageError(f"{topic.name}: {error}") from None


@cache
def schema_text(type_name: str) -> str:
    """Return the ros2msg definition of a type with all types it is made of.

    Our own types are given by the text of their file, so that the units in its comments
    travel with every recording.
    """
    generated, _ = typestore().generate_msgdef(type_name, ros_version=2)
    separator = "=" * 80 + "\n"
    own, *parts = generated.split(separator)
    for path in _definition_files():
        if _type_name(path) == type_name:
            own = path.read_text(encoding="utf-8")
    return separator.join([own, *parts])


@cache
def type_hash(type_name: str) -> str:
    """Return the RIHS01 hash of a type, as ROS 2 computes it."""
    return typestore().hash_rihs01(type_name)


def _definition_files() -> list[Path]:
    return sorted(message_dir().glob("*.msg"))


def _type_name(path: Path) -> str:
    return f"{_PACKAGE}/msg/{path.stem}"
