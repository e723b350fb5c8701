"""Variables of a co-simulation unit (FMU) or its C library: parameters, inputs and outputs.

Each has a name, a physical unit, and its offset in the memory of a run.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from enum import Enum, IntEnum
from typing import Any

import numpy as np

from capture_sim.detection.criteria import MEMORY, CaptureState
from capture_sim.dynamics.engine.state import WORKSPACE
from capture_sim.dynamics.samples import SAMPLE, Phase, columns_of, unit_of_column
from capture_sim.scene.parts import Scene
from capture_sim.scene.quantities import ANY, Range, declared

#: Springs and dampers of the buffer: any value of these makes the buffer's general law apply.
_BUFFER = ("k_A", "c_A", "k_T", "c_T", "k_A3", "c_A2", "c_A_rebound", "k_T3", "c_T2")
#: Other fields of a scene whose value is in the record unchanged, with the record's name.
_OTHERS = {
    "contact.hysteresis_factor": "hysteresis",
    "friction.mu": "mu",
    "friction.mu_s": "mu_s",
    "latch.stiffness": "k_L",
    "latch.damping": "c_L",
    "stops.stiffness": "k_stop",
    "stops.damping": "c_stop",
}
#: Entries of the state that a body's initial values set; the probe is at rest in the chaser.
_CHASER = {"x": (0,), "y": (1,), "theta": (2, 3), "vx": (8,), "vy": (9,), "omega": (10, 11)}
_TARGET = {"x": (5,), "y": (6,), "theta": (7,), "vx": (13,), "vy": (14,), "omega": (15,)}
_INITIAL: tuple[tuple[str, Mapping[str, tuple[int, ...]]], ...] = (
    ("initial.chaser", _CHASER),
    ("initial.target", _TARGET),
)


class Kind(Enum):
    """Type of a variable; the value is the name of this type in ``bench.h``."""

    REAL = "CS_REAL"
    INTEGER = "CS_INTEGER"
    BOOLEAN = "CS_BOOLEAN"


@dataclass(frozen=True)
class UnitVariable:
    """A parameter, input or output of a co-simulation unit (FMU) or its C library.

    Attributes
    ----------
    name
        Field of the scene, column of a table of samples, or a name of its own.
    unit
        SI unit; ``1`` for a number without unit.
    places
        Offsets in bytes.  A parameter has one or two and an input has one, in the engine's record
        (WORKSPACE).  An output has one, in a sample (SAMPLE) that the detector's record (MEMORY)
        follows.
    kind
        Type; INTEGER and BOOLEAN are int64 in these records.
    allowed
        Range of a parameter; None for an input or output.
    start
        Value of a parameter in the exported scene; 0 for an input or output.
    doc
        Meaning in words; empty if the name is enough.
    shapes_buffer
        True for a spring or damper of the buffer: setting it selects the buffer's general force
        law, with cubic springs, quadratic dampers and separate damping of the rebound.
    values
        Named values of an INTEGER; None if its values have no names.
    """

    name: str
    unit: str
    places: tuple[int, ...]
    kind: Kind = Kind.REAL
    allowed: Range | None = None
    start: float = 0.0
    doc: str = ""
    shapes_buffer: bool = False
    values: type[IntEnum] | None = None

    @property
    def meaning(self) -> str:
        """``doc`` and the named values, such as ``verdict; 0 approach, 1 contact``."""
        named = [f"{value.value} {value.name.lower()}" for value in self.values or ()]
        return "; ".join(filter(None, (self.doc, ", ".join(named))))


def offset_of(record: np.dtype, *names: str) -> int:
    """Return the offset in bytes of a field in a record; names go from outer to inner fields."""
    offset = 0
    for name in names:
        fields: Mapping[str, Any] = record.fields or {}
        offset += fields[name][1]
        record = fields[name][0]
    return offset


#: Outputs of the detector, named as in its status; _REMEMBERED has their names in its record.
_DETECTED = (
    UnitVariable("capture_state", "1", (), Kind.INTEGER, doc="verdict", values=CaptureState),
    UnitVariable("capture_since", "s", (), doc="begin of the present capture_state"),
    UnitVariable("nearest_distance", "m", (), doc="closest approach of the tip to BE so far"),
)
_REMEMBERED = ("state", "since", "nearest")


def outputs() -> list[UnitVariable]:
    """Return the outputs: all numbers of a sample except its time, then three of the detector.

    Numbers of a sample are named as the columns of tables.  Those of the detector are the verdict,
    its begin and the closest approach.
    """
    places = np.zeros(1, [(name, "i8", SAMPLE[name].shape) for name in SAMPLE.names or ()])
    for name in SAMPLE.names or ():
        n = max(1, int(np.prod(SAMPLE[name].shape)))
        start = offset_of(SAMPLE, name)
        places[name] = (start + 8 * np.arange(n)).reshape(SAMPLE[name].shape)
    found = []
    for column, place in columns_of(places).items():
        is_integer = SAMPLE[column.partition(".")[0]].base.kind == "i"
        if column != "t":
            kind = Kind.INTEGER if is_integer else Kind.REAL
            values = Phase if column == "phase" else None
            unit = unit_of_column(column)
            found.append(UnitVariable(column, unit, (int(place[0]),), kind, values=values))
    for variable, name in zip(_DETECTED, _REMEMBERED, strict=True):
        found.append(replace(variable, places=(SAMPLE.itemsize + offset_of(MEMORY, name),)))
    return found


def inputs(scene: Scene) -> list[UnitVariable]:
    """Return the inputs: the external wrench on the tip, and that on each vehicle with thrusters.

    A scene with supports has no wrench on the tip.  Such a wrench acts in place of the cone's
    walls, and a scene with supports cannot be run without its walls.
    """
    numbers = (("force.x", "N"), ("force.y", "N"), ("torque.z", "N m"))

    def wrench(name: str, doc: str, place: int) -> list[UnitVariable]:
        return [
            UnitVariable(f"{name}.{part}", unit, (place + 8 * k,), doc=doc)
            for k, (part, unit) in enumerate(numbers)
        ]

    found = []
    if scene.supports is None:
        place = offset_of(WORKSPACE, "system", "mode", "wrench")
        doc = "wrench on the tip, about its centre, in the axes of target/cone"
        found += wrench("wrench", doc, place)
    place = offset_of(WORKSPACE, "system", "mode", "thrust")
    for k, vehicle in enumerate(("chaser", "target")):
        if getattr(scene.thrusters, vehicle, None) is not None:
            doc = f"held wrench on the {vehicle}, about its centre of mass, in its own axes"
            found += wrench(f"thrust.{vehicle}", doc, place + 24 * k)
    return found


def parameters(scene: Scene, workspace: np.ndarray) -> list[UnitVariable]:
    """Return the parameters, which may be set before the release.

    These are fields of the scene that the engine uses without conversion, and, in a scene without
    supports, the switch ``contact_outside``.  The launch and the scale of the integrator's error
    are computed when a scene is exported, so no parameter changes them.

    ``workspace``: the engine's record at the release, (1,) of dtype WORKSPACE, with the scene's
    values.
    """
    raw = workspace.view(np.uint8)

    def variable(path: str, *places: int, shapes_buffer: bool = False) -> UnitVariable:
        part_path, _, name = path.rpartition(".")
        part: Any = scene
        for step in part_path.split("."):
            part = getattr(part, step)
        spec = declared(type(part))[name]
        start = float(raw[places[0] : places[0] + 8].view(np.float64)[0])
        allowed = spec.allowed or ANY
        return UnitVariable(
            path, spec.unit, places, Kind.REAL, allowed, start, spec.doc, shapes_buffer
        )

    def parameter(name: str) -> int:
        return offset_of(WORKSPACE, "system", "par", name)

    found = []
    for name in _BUFFER:
        if name in ("k_A", "k_A3") and scene.buffer.force_table is not None:
            continue  # 0 with a table
        places = [parameter(name)]
        if name == "c_A" and scene.buffer.c_A_rebound is None:
            places.append(parameter("c_A_rebound"))
        found.append(variable(f"buffer.{name}", *places, shapes_buffer=True))
    if scene.buffer.friction > 0.0:
        # without it the probe of the exported scene is not held at the release
        found.append(variable("buffer.friction", parameter("slide_friction")))
    for path, name in _OTHERS.items():
        if getattr(scene, path.partition(".")[0]) is None:
            continue
        if path.startswith("friction") and scene.friction.law == "none":
            continue
        places = [parameter(name)]
        if name == "mu" and scene.friction.mu_s is None:
            places.append(parameter("mu_s"))
        found.append(variable(path, *places))
    if scene.rail is None and scene.supports is None:
        state = offset_of(WORKSPACE, "stepper", "y")
        for body, entries in _INITIAL:
            for name, numbers in entries.items():
                found.append(variable(f"{body}.{name}", *(state + 8 * k for k in numbers)))
    if scene.supports is None:
        place = offset_of(WORKSPACE, "system", "mode", "driven")
        doc = "the wrench inputs act in place of the cone's walls"
        flag = UnitVariable(
            "contact_outside", "1", (place,), Kind.BOOLEAN, Range(0.0, 1.0), doc=doc
        )
        found.append(flag)
    return found
