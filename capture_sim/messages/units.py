"""Units of numbers in messages: from the definitions of this package, or from REP-103 for ROS."""

from __future__ import annotations

import re
from functools import cache

from capture_sim.messages.definitions import schema_text, typestore

#: A number in a definition of this package, and the unit with which its comment begins.
_DECLARED = re.compile(
    r"^float64(?:\[\d*\])? +(\w+)(?: +[^#=\n]+?)? *# *([^,;\n]*[^,;\s])", re.MULTILINE
)
#: Units of x, y and z by the name of their vector in a standard message.
_VECTORS = {
    "position": "m",
    "translation": "m",
    "linear": "m/s",
    "linear_acceleration": "m/s^2",
    "angular": "rad/s",
    "angular_velocity": "rad/s",
    "force": "N",
    "torque": "N m",
}
_STAMPS = {"sec": "s", "nanosec": "ns"}


def unit_of(type_name: str, column: str) -> str:
    """Return the unit of a number in a message; empty if it has no unit or the unit is not known.

    Parameters
    ----------
    type_name
        Message type as ``package/msg/Name``.
    column
        Path of the number, e.g. ``q.x_S`` or ``pose.position.x``.
    """
    field, _, member = column.partition(".")
    *_, vector, last = ("", *column.split("."))
    if last in _STAMPS:
        return _STAMPS[last]
    if type_name.startswith("capture_sim/"):
        if field in ("q", "v"):  # coordinates of the bench, and their rates
            unit = "rad" if member.startswith("theta") else "m"
            return unit if field == "q" else f"{unit}/s"
        if field == "thrust":
            return "N m" if member.endswith("z") else "N"
        return _declared(type_name).get(field, "")
    is_acceleration = "Accel" in type_name
    return _VECTORS.get(vector, "") if last in ("x", "y", "z") and not is_acceleration else ""


@cache
def _declared(type_name: str) -> dict[str, str]:
    if type_name not in typestore().fielddefs:
        return {}  # a type of another version
    own, _, _ = schema_text(type_name).partition("=" * 80)
    return dict(_DECLARED.findall(own))
