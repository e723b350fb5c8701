"""The capture detector's criteria as parameters of its node.

They are the fields of the scene's ``detector`` part, with its units and ranges.  One that
is not set follows the scene; one that is set holds from the next run on, as a run is
judged by one set of criteria from its start to its end.
"""

from __future__ import annotations

from dataclasses import Field, fields, replace
from typing import TYPE_CHECKING, Any

from rcl_interfaces.msg import ParameterDescriptor, SetParametersResult
from rclpy.exceptions import InvalidParameterTypeException
from rclpy.parameter import Parameter

from capture_sim.errors import SceneError
from capture_sim.nodes.running import ParameterError
from capture_sim.scene.parts import Detector, Scene

if TYPE_CHECKING:
    from rclpy.node import Node


class Criteria:
    """Declares the parameters on a node, refuses wrong values, and fits them to a scene.

    Raises
    ------
    ParameterError
        A value given at the start is wrong; one line that says what is allowed.
    """

    def __init__(self, node: Node) -> None:
        self._node = node
        self._fields: dict[str, Field[Any]] = {field.name: field for field in fields(Detector)}
        for field in self._fields.values():
            self._declare(field)
        node.add_on_set_parameters_callback(self._check)

    def of(self, scene: Scene) -> Scene:
        """Return the scene with the criteria that are set; the others are its own."""
        values = {name: self._node.get_parameter_or(name).value for name in self._fields}
        given = {name: float(value) for name, value in values.items() if value is not None}
        return replace(scene, detector=replace(scene.detector, **given)) if given else scene

    def given(self) -> str:
        """Return the criteria that are set, as text; empty when all are the scene's."""
        return ", ".join(
            f"{name} = {value:g} {field.metadata['unit']}"
            for name, field in self._fields.items()
            if (value := self._node.get_parameter_or(name).value) is not None
        )

    def _declare(self, field: Field[Any]) -> None:
        unit, allowed = field.metadata["unit"], field.metadata["allowed"]
        descriptor = ParameterDescriptor(
            description=f"{unit}, {field.metadata['doc']}; not set: the scene's",
            additional_constraints=f"{allowed} {unit}",
        )
        name = field.name
        try:
            self._node.declare_parameter(name, Parameter.Type.DOUBLE, descriptor)
        except InvalidParameterTypeException:
            given = self._node._parameter_overrides[name].value
            raise ParameterError(
                f"parameter {name} = {given!r}: allowed is a number with a decimal point, "
                f"{allowed} {unit}"
            ) from None
        parameter = self._node.get_parameter_or(name)
        if reason := self._wrong(parameter):
            raise ParameterError(reason)

    def _check(self, parameters: list[Parameter]) -> SetParametersResult:
        """Refuse what a scene would refuse."""
        for parameter in parameters:
            if reason := self._wrong(parameter):
                return SetParametersResult(successful=False, reason=reason)
        return SetParametersResult(successful=True)

    def _wrong(self, parameter: Parameter) -> str:
        """Return why a value is not allowed; empty if it is."""
        field = self._fields.get(parameter.name)
        if field is None or parameter.value is None:
            return ""
        try:
            Detector(**{parameter.name: parameter.value})
        except SceneError as error:
            return f"parameter {str(error).removeprefix('Detector.')}"
        return ""
