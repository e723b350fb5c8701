"""Writes a co-simulation unit of FMI 3.0 (FMU): its modelDescription.xml and its archive.

A unit is a zip archive of the description, the compiled library and the scene.
"""

from __future__ import annotations

import datetime
import platform
import tempfile
import xml.etree.ElementTree as ET
import zipfile
from pathlib import Path

from capture_sim.base.files import whole_file
from capture_sim.base.version import __version__
from capture_sim.fmu.library import Unit, link, write_sources
from capture_sim.fmu.variables import Kind, UnitVariable

#: Exponents of kg, m, s and rad by which FMI defines each unit.
_UNITS = {
    "s": {"s": 1},
    "m": {"m": 1},
    "m/s": {"m": 1, "s": -1},
    "rad": {"rad": 1},
    "rad/s": {"rad": 1, "s": -1},
    "N": {"kg": 1, "m": 1, "s": -2},
    "N m": {"kg": 1, "m": 2, "s": -2},
    "N s": {"kg": 1, "m": 1, "s": -1},
    "J": {"kg": 1, "m": 2, "s": -2},
    "N/m": {"kg": 1, "s": -2},
    "N/m^3": {"kg": 1, "m": -2, "s": -2},
    "N s/m": {"kg": 1, "s": -1},
    "N s^2/m^2": {"kg": 1, "m": -1},
    "N m/rad": {"kg": 1, "m": 2, "s": -2, "rad": -1},
    "N m/rad^3": {"kg": 1, "m": 2, "s": -2, "rad": -3},
    "N m s/rad": {"kg": 1, "m": 2, "s": -1, "rad": -1},
    "N m s^2/rad^2": {"kg": 1, "m": 2, "rad": -2},
}
_ELEMENTS = {Kind.REAL: "Float64", Kind.INTEGER: "Int64", Kind.BOOLEAN: "Boolean"}
#: Step that the description suggests to the importing program, s.
_STEP = 0.001


def identifier(unit: Unit) -> str:
    """Return ``capture_`` and the scene's name, as name of the library in the unit.

    FMI permits letters, digits and ``_`` only, so other characters become ``_``.
    """
    text = "".join(c if c.isascii() and c.isalnum() else "_" for c in unit.scene.name)
    return f"capture_{text}"


def description(unit: Unit) -> str:
    """Return the text of modelDescription.xml; it contains the present time."""
    now = datetime.datetime.now(datetime.UTC).strftime("%Y-%m-%dT%H:%M:%SZ")
    root = ET.Element(
        "fmiModelDescription",
        fmiVersion="3.0",
        modelName=unit.scene.name,
        instantiationToken=unit.token,
        description=unit.scene.title,
        generationTool=f"capture_sim {__version__}",
        generationDateAndTime=now,
        variableNamingConvention="flat",
    )
    ET.SubElement(
        root,
        "CoSimulation",
        modelIdentifier=identifier(unit),
        canHandleVariableCommunicationStepSize="true",
        mightReturnEarlyFromDoStep="true",
        canGetAndSetFMUState="true",
        canSerializeFMUState="true",
    )
    variables = unit.variables
    units = ET.SubElement(root, "UnitDefinitions")
    for name in dict.fromkeys(["s", *(v.unit for v in variables if v.unit in _UNITS)]):
        exponents = {key: str(value) for key, value in _UNITS[name].items()}
        ET.SubElement(ET.SubElement(units, "Unit", name=name), "BaseUnit", exponents)
    types = ET.SubElement(root, "TypeDefinitions")
    for names in dict.fromkeys(v.values for v in variables if v.values is not None):
        listed = ET.SubElement(types, "EnumerationType", name=names.__name__)
        for value in names:
            ET.SubElement(listed, "Item", name=value.name.lower(), value=str(value.value))
    ET.SubElement(root, "LogCategories").append(ET.Element("Category", name="logStatusError"))
    stop = f"{unit.scene.run.t_end:.17g}"
    ET.SubElement(root, "DefaultExperiment", startTime="0", stopTime=stop, stepSize=str(_STEP))
    model = ET.SubElement(root, "ModelVariables")
    ET.SubElement(
        model,
        "Float64",
        name="time",
        valueReference="0",
        causality="independent",
        variability="continuous",
        description="time since the release",
        unit="s",
    )
    causalities = ["parameter"] * len(unit.parameters) + ["input"] * len(unit.inputs)
    causalities += ["output"] * len(unit.outputs)
    for reference, (variable, causality) in enumerate(zip(variables, causalities, strict=True), 1):
        _add(model, reference, variable, causality)
    structure = ET.SubElement(root, "ModelStructure")
    for kind in ("Output", "InitialUnknown"):
        for reference in range(len(variables) - len(unit.outputs) + 1, len(variables) + 1):
            ET.SubElement(structure, kind, valueReference=str(reference))
    ET.indent(root)
    return '<?xml version="1.0" encoding="UTF-8"?>\n' + ET.tostring(root, encoding="unicode") + "\n"


def _add(model: ET.Element, reference: int, variable: UnitVariable, causality: str) -> None:
    """Add a variable to the element ModelVariables, with ``reference`` as its valueReference."""
    attributes = {"name": variable.name, "valueReference": str(reference), "causality": causality}
    element = _ELEMENTS[variable.kind]
    if variable.doc:
        attributes["description"] = variable.doc
    if variable.unit in _UNITS:
        attributes["unit"] = variable.unit
    if variable.values is not None:
        element, attributes["declaredType"] = "Enumeration", variable.values.__name__
    if causality == "output":
        attributes["initial"] = "calculated"
        attributes["variability"] = "continuous" if variable.kind is Kind.REAL else "discrete"
    else:
        is_parameter = causality == "parameter"
        attributes["variability"] = "fixed" if is_parameter else "continuous"
        if is_parameter:
            attributes["initial"] = "exact"
        attributes["start"] = f"{variable.start:.17g}"
        if variable.kind is Kind.BOOLEAN:
            attributes["start"] = "true" if variable.start else "false"
        elif variable.allowed is not None:
            for name, limit in (("min", variable.allowed.low), ("max", variable.allowed.high)):
                if abs(limit) < 1e300:
                    attributes[name] = f"{limit:.17g}"
    ET.SubElement(model, element, attributes)


def write_fmu(unit: Unit, path: Path) -> None:
    """Write a unit's archive (``.fmu``) with a library for this operating system and architecture.

    Raises
    ------
    FmuError
        There is no C compiler, it fails, or the machine or this version of Numba is not supported.
    RecordingError
        The archive cannot be written.
    """
    name = identifier(unit)
    folder = f"binaries/{platform.machine()}-linux"
    with tempfile.TemporaryDirectory() as sources_name:
        sources = Path(sources_name)
        objects = write_sources(unit, sources)
        library = sources / f"{name}.so"
        files = [sources / "fmi3.c", sources / "bench.c", *objects]
        link(files, library, "-fvisibility=hidden")
        with whole_file(path) as part, zipfile.ZipFile(part, "w", zipfile.ZIP_DEFLATED) as archive:
            archive.writestr("modelDescription.xml", description(unit))
            archive.write(library, f"{folder}/{name}.so")
            archive.writestr("extra/capture_sim/scene.yaml", unit.scene.to_yaml())
