"""Parameters of a node, with description and range; an error names the permitted values."""

from __future__ import annotations

import difflib
import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from rcl_interfaces.msg import (
    FloatingPointRange,
    IntegerRange,
    ParameterDescriptor,
    SetParametersResult,
)
from rclpy.exceptions import InvalidParameterValueException
from rclpy.node import Node
from rclpy.parameter import Parameter

from capture_sim.errors import CaptureSimError
from capture_sim.scene.loading import load_scene
from capture_sim.scene.parts import Scene
from capture_sim.scene.quantities import declared

#: Parameters that every ROS 2 node has, or that files for several nodes may carry.
_COMMON = ("use_sim_time", "start_type_description_service", "qos_overrides")
_KINDS = {
    float: "a number, with a decimal point",
    int: "a whole number",
    bool: "true or false",
    list: "a list of texts, one at least, none of them empty",
    str: "a text",
}
#: Values of parameters that are not set: ROS has no empty list of texts, and no absent number.
_UNSET: dict[type, Any] = {list: [""], float: math.nan}


class ParameterError(CaptureSimError):
    """A parameter of a node is invalid; the message gives the permitted values."""


class ParameterNode(Node):
    """A node whose parameters have a unit and a range."""

    def __init__(self, name: str, **options: Any) -> None:
        super().__init__(name, **options)
        self._checks: dict[str, tuple[type, Callable[[Any], object]]] = {}
        # if declared automatically, a parameter given as [] would end rclpy with a ValueError (7.1)
        with self.handle:
            given = self.handle.get_parameters(Parameter)
        self._given = {
            name: parameter.value
            for name, parameter in given.items()
            if name.split(".")[0] not in _COMMON
        }
        self.add_on_set_parameters_callback(self._check_parameters)

    def declare(
        self,
        name: str,
        default: Any,
        description: str,
        *,
        low: float | None = None,
        high: float | None = None,
        choices: Sequence[str] = (),
        read_only: bool = True,
        allowed: str = "",
        check: Callable[[Any], object] | None = None,
    ) -> Any:
        """Declare a parameter and return its value; ParameterError, in one line, if it is invalid.

        ``default``: a value, or the type ``list`` or ``float`` for a parameter that may be unset.
        An unset list of texts is returned as [] (in ROS it is ['']), an unset number as NaN.
        ``description`` includes the unit.  ``low`` and ``high``: range of a number, used if both
        are given.  ``choices``: permitted values of a text, or of the texts of a list, each at most
        once.  ``allowed``: further conditions in words.  ``check`` is called with the value, now
        and before every change, and raises CaptureSimError if the value is invalid.  A
        ``read_only`` value cannot be changed after the start.
        """
        kind = default if isinstance(default, type) else type(default)
        descriptor = ParameterDescriptor(description=description, read_only=read_only)
        allowed = allowed or _KINDS[kind]
        if choices:
            allowed = ", ".join(choices) + ", each once" * (kind is list)
        if low is not None and high is not None:
            if kind is float:
                span = FloatingPointRange(from_value=float(low), to_value=float(high))
                descriptor.floating_point_range = [span]
            else:
                span = IntegerRange(from_value=int(low), to_value=int(high))
                descriptor.integer_range = [span]
            allowed += f" from {low:g} to {high:g}"
        descriptor.additional_constraints = allowed
        may_be_unset = default is kind
        value = self._given.pop(name, _UNSET[kind] if may_be_unset else default)
        if may_be_unset and kind is list and value is None:  # given as [], which rclpy makes None
            value = _UNSET[kind]
        unset = may_be_unset and _is_unset(value, kind)
        right = unset or _fits(value, kind, choices)
        try:
            if right:
                self.declare_parameter(name, value, descriptor, ignore_override=True)
        except InvalidParameterValueException:
            right = False
        if not right:
            shown = "[]" if value is None else repr(value)  # rclpy: [] is None
            raise ParameterError(f"parameter {name} = {shown}: must be {allowed} ({description})")
        if check is not None:
            if not unset:
                check(value)
            self._checks[name] = kind, check
        return [] if unset and kind is list else value

    def declare_fields(
        self, defaults: Any, name_of: Callable[[str], str] = str, *, read_only: bool = True
    ) -> Any:
        """Declare a parameter for each quantity of a dataclass; return the dataclass with values.

        ``defaults``: dataclass instance with the default values.  ``name_of`` maps a field's name
        to its parameter's name, or to an empty text for a field without parameter.
        """
        values = {}
        for field in declared(type(defaults)).values():
            if field.allowed is not None and (name := name_of(field.name)):
                bounds: dict[str, Any] = {"low": field.allowed.low, "high": field.allowed.high}
                values[field.name] = self.declare(
                    name,
                    getattr(defaults, field.name),
                    ", ".join(filter(None, (field.doc, field.unit))),
                    **({} if field.kind is bool else bounds),
                    read_only=read_only,
                )
        return replace(defaults, **values)

    def declare_path(
        self,
        name: str,
        default: str,
        description: str,
        kind: str,
        reason_against: Callable[[Path], str],
    ) -> Path | None:
        """Declare a path; return None if it is empty.

        ``reason_against`` returns why a path is not of this ``kind``, or an empty text if it is.
        Raises ParameterError with that reason.
        """
        text = self.declare(name, default, description)
        if text and (reason := reason_against(Path(text))):
            raise ParameterError(f"parameter {name} = '{text}': must be {kind}: {reason}")
        return Path(text) if text else None

    def warn_of_unknown_parameters(self) -> None:
        """Warn of parameters that were given but never declared; probably they are mistyped."""
        declared = self.list_parameters([], 0).names
        for name in self._given:
            near = difflib.get_close_matches(name, declared, n=1)
            hint = f"; did you mean {near[0]}?" if near else ""
            self.get_logger().warning(f"parameter {name} is unknown here and has no effect{hint}")

    def _check_parameters(self, parameters: list[Parameter]) -> SetParametersResult:
        for parameter in parameters:
            kind, check = self._checks.get(parameter.name, (object, None))
            try:
                if check is not None and not _is_unset(parameter.value, kind):
                    check(parameter.value)
            except CaptureSimError as error:
                return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)


def declare_scene(node: ParameterNode, description: str, default: str = "") -> Scene | None:
    """Declare the parameters ``scene`` and ``overrides``; return the scene, None without one."""
    name = node.declare("scene", default, f"{description}; name in config/scenes, or file")
    overrides = node.declare("overrides", list, "changes of that scene (SI)")
    if overrides and not name and not default:
        raise ParameterError(f"parameter overrides = {overrides!r}: must be empty without a scene")
    return load_scene(name, overrides) if name or default else None


def _is_unset(value: object, kind: type) -> bool:
    """Return True if a value marks a parameter of this kind as unset."""
    if kind is float:
        return isinstance(value, float) and math.isnan(value)
    return kind is list and value == _UNSET[list]


def _fits(value: object, kind: type, choices: Sequence[str]) -> bool:
    """Return True if a given value has this type and, if there are choices, is one of them."""
    if type(value) is not kind:
        return False
    texts = value if isinstance(value, list) else [value]
    if choices:
        return set(texts) <= set(choices) and len(set(texts)) == len(texts)
    return kind is not list or all(isinstance(text, str) and text for text in texts)
