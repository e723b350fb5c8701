"""modelDescription.xml of FMI 3.0, and the archive that a unit is."""

from __future__ import annotations

import datetime
import platform
import tempfile
import xml.etree.ElementTree as ET
import zipfile
from pathlib import Path

from capture_sim import __version__
from capture_sim.files import whole_file
from capture_sim.fmu.library import Unit, link, write_sources
from capture_sim.fmu.variables import Variable

#: Exponents of kg, m, s and rad; FMI knows units by these.
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
#: The step that a master takes by default, s.
_STEP = 0.001


def identifier(unit: Unit) -> str:
    """Return the name of the unit's library: FMI permits letters, digits and ``_``."""
    text = "".join(c if c.isascii() and c.isalnum() else "_" for c in unit.scene.name)
    return f"capture_{text}"


def description(unit: Unit) -> str:
    """Return the text of modelDescription.xml."""
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
    variables = [*unit.parameters, *unit.outputs]
    units = ET.SubElement(root, "UnitDefinitions")
    for name in dict.fromkeys(["s", *(v.unit for v in variables if v.unit in _UNITS)]):
        exponents = {key: str(value) for key, value in _UNITS[name].items()}
        ET.SubElement(ET.SubElement(units, "Unit", name=name), "BaseUnit", exponents)
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
    for reference, variable in enumerate(variables, 1):
        _add(model, reference, variable)
    structure = ET.SubElement(root, "ModelStructure")
    for kind in ("Output", "InitialUnknown"):
        for reference in range(len(unit.parameters) + 1, len(variables) + 1):
            ET.SubElement(structure, kind, valueReference=str(reference))
    ET.indent(root)
    return '<?xml version="1.0" encoding="UTF-8"?>\n' + ET.tostring(root, encoding="unicode") + "\n"


def _add(model: ET.Element, reference: int, variable: Variable) -> None:
    """Add a variable to the ModelVariables."""
    attributes = {"name": variable.name, "valueReference": str(reference)}
    if variable.doc:
        attributes["description"] = variable.doc
    if variable.unit in _UNITS:
        attributes["unit"] = variable.unit
    if variable.allowed is not None:
        attributes |= {"causality": "parameter", "variability": "fixed", "initial": "exact"}
        attributes["start"] = f"{variable.start:.17g}"
        if abs(variable.allowed.low) < 1e300:
            attributes["min"] = f"{variable.allowed.low:.17g}"
        if abs(variable.allowed.high) < 1e300:
            attributes["max"] = f"{variable.allowed.high:.17g}"
    else:
        attributes |= {"causality": "output", "initial": "calculated"}
        attributes["variability"] = "discrete" if variable.is_integer else "continuous"
    ET.SubElement(model, "Int64" if variable.is_integer else "Float64", attributes)


def write_fmu(unit: Unit, path: Path) -> None:
    """Write a co-simulation unit for this operating system and architecture.

    Raises
    ------
    FmuError
        There is no C compiler, or the machine or Numba is not supported.
    RecordingError
        The file cannot be written.
    """
    name = identifier(unit)
    folder = f"binaries/{platform.machine()}-linux"
    with tempfile.TemporaryDirectory() as sources_name:
        sources = Path(sources_name)
        write_sources(unit, sources)
        library = sources / f"{name}.so"
        files = [sources / file for file in ("fmi3.c", "bench.c", "kernels.o")]
        link(files, library, "-fvisibility=hidden")
        with whole_file(path) as part, zipfile.ZipFile(part, "w", zipfile.ZIP_DEFLATED) as archive:
            archive.writestr("modelDescription.xml", description(unit))
            archive.write(library, f"{folder}/{name}.so")
            archive.writestr("extra/capture_sim/scene.yaml", unit.scene.to_yaml())
