"""Builds the C library of a scene, by itself or for a co-simulation unit of FMI 3.0 (FMU).

The scene's data become a header, ``scene.h``.  The library consists of this header, the C sources
in this folder and the compiled integrator and detector.
"""

from __future__ import annotations

import hashlib
import math
import shutil
import subprocess
import tempfile
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from capture_sim.base.files import whole_file
from capture_sim.base.version import __version__
from capture_sim.detection.criteria import MEMORY, Criteria, new_memory
from capture_sim.detection.exact import ROW
from capture_sim.dynamics.bench import CAUSES, Bench
from capture_sim.dynamics.engine.state import EVENT, WORKSPACE, StepStatus
from capture_sim.dynamics.samples import EXTREME_NAMES, SAMPLE, EventKind
from capture_sim.fmu.machine_code import ENTRIES, FmuError, instructions, machine_code
from capture_sim.fmu.variables import UnitVariable, inputs, offset_of, outputs, parameters
from capture_sim.scene.parts import Scene

_SOURCES = Path(__file__).resolve().parent
#: -Bsymbolic: a library uses its own functions, also if two libraries are loaded in one process.
_FLAGS = ("-std=c11", "-O2", "-fPIC", "-Wl,-Bsymbolic", "-Wall", "-Wextra")


@dataclass(frozen=True)
class Unit:
    """A scene and what its C library and its co-simulation unit (FMU) are made from.

    Attributes
    ----------
    scene
        The scene.
    parameters, inputs, outputs
        Its variables; each position in a list is the index that the C functions use.
    header
        Text of ``scene.h``.
    token
        Hash of the header and of capture_sim's version, the ``instantiationToken`` of FMI.
    portable
        True if the library runs on any processor of this architecture; False if it may use all
        instructions of the processor on which it is made.
    """

    scene: Scene
    parameters: list[UnitVariable]
    inputs: list[UnitVariable]
    outputs: list[UnitVariable]
    header: str
    token: str
    portable: bool

    @property
    def variables(self) -> list[UnitVariable]:
        """Parameters, inputs and outputs, in this order."""
        return [*self.parameters, *self.inputs, *self.outputs]


def make_unit(scene: Scene, *, portable: bool = False) -> Unit:
    """Return the unit of a scene; its library is not compiled yet.

    ``portable``: see :class:`Unit`.

    Raises
    ------
    SceneError
        The scene is invalid.
    """
    bench = Bench(scene)
    workspace = bench.initial_workspace()
    bench.set_contact(0.0, 1.0, 0.0, 0.0, 0.0, 1.0)  # what that changes is done in C, see "words"
    unit = Unit(scene, parameters(scene, workspace), inputs(scene), outputs(), "", "", portable)
    data = _header(unit, workspace, bench.initial_workspace())
    token = hashlib.sha256(f"{__version__}\n{data}".encode()).hexdigest()[:32]
    header = f'{data}\n#define CS_TOKEN "{token}"\n'
    return replace(unit, header=header, token=token)


def write_sources(unit: Unit, folder: Path) -> list[Path]:
    """Write all sources of the library into a folder; return the paths of the object files.

    These are ``scene.h``, the C sources, and one object file for each compiled function
    (:func:`~capture_sim.fmu.machine_code.machine_code`).  The folder is created.

    Raises
    ------
    FmuError
        The machine or this version of Numba is not supported.
    """
    folder.mkdir(parents=True, exist_ok=True)
    for name in ("bench.h", "bench.c", "fmi3.c"):
        shutil.copy(_SOURCES / name, folder)
    (folder / "scene.h").write_text(unit.header, encoding="utf-8")
    objects = [folder / f"{entry}.o" for entry in ENTRIES]
    for entry, path in zip(ENTRIES, objects, strict=True):
        path.write_bytes(machine_code(entry, portable=unit.portable))
    return objects


def link(sources: Sequence[Path], library: Path, *flags: str) -> None:
    """Compile C sources, and link them with object files into a shared library.

    ``sources``: paths of both.  ``flags``: arguments of the compiler in addition to the usual ones.

    Raises
    ------
    FmuError
        There is no C compiler, or it fails.
    """
    compiler = shutil.which("cc") or shutil.which("gcc")
    if compiler is None:
        raise FmuError("no C compiler: install gcc (Debian, Ubuntu: apt-get install gcc)")
    command = [compiler, *_FLAGS, *flags, "-shared", "-o", library, *sources, "-lm"]
    done = subprocess.run([str(word) for word in command], capture_output=True, text=True)
    if done.returncode:
        lines = done.stderr.strip().splitlines()
        errors = [line for line in lines if "error" in line] or lines[-1:] or ["no reason given"]
        raise FmuError(f"{compiler} failed: {errors[0].strip()}")


def write_library(unit: Unit, folder: Path) -> Path:
    """Write ``lib<scene>.so`` and ``bench.h`` into a folder; return the library's path.

    Raises
    ------
    FmuError
        There is no C compiler, it fails, or the machine or this version of Numba is not supported.
    RecordingError
        A file cannot be written.
    """
    library = folder / f"lib{unit.scene.name}.so"
    with tempfile.TemporaryDirectory() as name:
        sources = Path(name)
        objects = write_sources(unit, sources)
        with whole_file(library) as part:
            link([sources / "bench.c", *objects], part)
        with whole_file(folder / "bench.h") as part:
            shutil.copy(sources / "bench.h", part)
    return library


def _header(unit: Unit, workspace: np.ndarray, without_walls: np.ndarray) -> str:
    """Return the text of ``scene.h``, without the token.

    ``workspace``: the engine's record at the release.  ``without_walls``: the same record after
    the cone's walls were switched off, as the parameter ``contact_outside`` does.
    """
    scene, found = unit.scene, unit.parameters
    data = workspace.tobytes().rstrip(b"\0")
    before, after = (record.view("u8").tolist() for record in (workspace, without_walls))
    places_of_words = [k for k, word in enumerate(before) if word != after[k]]
    width = max(len(variable.places) for variable in found)
    nearest = offset_of(WORKSPACE, "totals", "extreme") + 8 * EXTREME_NAMES.index("tip_distance")
    constants = {
        "WORKSPACE_SIZE": WORKSPACE.itemsize,
        "STATE_SIZE": offset_of(WORKSPACE, "log"),
        "SAMPLE_SIZE": SAMPLE.itemsize,
        "SAMPLE_TIME": offset_of(SAMPLE, "t"),
        "MEMORY_SIZE": MEMORY.itemsize,
        "ROW_SIZE": ROW.itemsize,
        "RATE": _number(scene.run.rate),
        "STATUS": offset_of(WORKSPACE, "progress", "status"),
        "STATUS_SERVED": int(StepStatus.SERVED),
        "STATUS_INTERRUPTED": int(StepStatus.INTERRUPTED),
        "T_STOP": offset_of(WORKSPACE, "progress", "t_stop"),
        "N_LOG": offset_of(WORKSPACE, "progress", "n_log"),
        "LOG": offset_of(WORKSPACE, "log"),
        # the detector's own is of its samples only
        "NEAREST_PLACE": SAMPLE.itemsize + offset_of(MEMORY, "nearest"),
        "NEAREST_BEFORE": nearest,
        "NEAREST_AFTER": nearest + 8 * len(EXTREME_NAMES),
        "LATCHED": offset_of(WORKSPACE, "system", "mode", "latched"),
        "TIP_DISTANCE": offset_of(SAMPLE, "tip_distance"),
        "EVENT_SIZE": EVENT.itemsize,
        "EVENT_TIME": offset_of(EVENT, "t"),
        "EVENT_KIND": offset_of(EVENT, "kind"),
        "EVENT_LATCHED": int(EventKind.LATCHED),
        "STEP_START": offset_of(WORKSPACE, "step", "t0"),
        "EQUATIONS_CHANGED": offset_of(WORKSPACE, "step", "equations_changed"),
        "HAS_SHAPED_BUFFER": offset_of(WORKSPACE, "system", "par", "has_shaped_buffer"),
        "AFTER_LATCH": offset_of(WORKSPACE, "system", "par", "after_latch"),
        "THRUSTING": offset_of(WORKSPACE, "system", "mode", "thrusting"),
        "DRIVEN": offset_of(WORKSPACE, "system", "mode", "driven"),
        "WORD_COUNT": len(places_of_words),
        "PLACES": width,
        "PARAMETER_COUNT": len(found),
        "INPUT_COUNT": len(unit.inputs),
        "TIP_INPUT_COUNT": sum(each.name.startswith("wrench.") for each in unit.inputs),
        "OUTPUT_COUNT": len(unit.outputs),
    }
    needs = instructions(portable=unit.portable)
    checks = [f"CS_NEED({_c(name)})" for name in needs]

    def table(declaration: str, rows: Iterable[object]) -> str:
        """Return the definition of an array in C; an empty array gets one zero row."""
        lines = [f"  {row}" for row in rows] or ["  {0}"]
        return f"static const {declaration} = {{\n" + ",\n".join(lines) + "\n};"

    def in_lines(values: Sequence[object]) -> list[str]:
        return [", ".join(map(str, values[k : k + 32])) for k in range(0, len(values), 32)]

    def braced(values: Iterable[object]) -> str:
        return f"{{{', '.join(map(str, values))}}}"

    memory = new_memory(has_approached=True).tobytes()
    return "\n".join(
        [
            "/* Data of one scene; made by capture-sim fmu. */",
            f'#define CS_SCENE "{scene.name}"',
            f"/* of capture_sim {__version__} */",
            *(f"#define CS_{name} {value}" for name, value in constants.items()),
            "#define CS_NEVER (1.0 / 0.0)",
            *([f"#define CS_NEEDS {' '.join(checks)}"] if needs else []),
            table("unsigned char cs_initial[]", in_lines(data)),
            table("unsigned char cs_memory[]", in_lines(memory)),
            table("double cs_criteria[]", map(_number, Criteria.of(scene))),
            "/* What changes in the workspace if the contact is outside. */",
            table(
                "struct { size_t place; uint64_t word; } cs_words[]",
                (braced((8 * k, f"{after[k]:#x}u")) for k in places_of_words),
            ),
            table("char *const cs_causes[]", (_c(CAUSES.get(status, "")) for status in StepStatus)),
            table("cs_variable cs_parameters[]", map(_variable, found)),
            "/* Places of a parameter in the workspace; 0: none. */",
            table(f"size_t cs_places[][{width}]", (braced(v.places) for v in found)),
            table("int cs_shapes_buffer[]", (int(v.shapes_buffer) for v in found)),
            table("cs_variable cs_inputs[]", map(_variable, unit.inputs)),
            table("size_t cs_input_places[]", (v.places[0] for v in unit.inputs)),
            table("cs_variable cs_outputs[]", map(_variable, unit.outputs)),
            table("size_t cs_output_places[]", (v.places[0] for v in unit.outputs)),
        ]
    )


def _variable(variable: UnitVariable) -> str:
    """Return a variable as an initialiser of the C structure ``cs_variable`` in ``bench.h``."""
    allowed, cells = variable.allowed, [_c(variable.name), _c(variable.unit), _c(variable.meaning)]
    cells.append(variable.kind.value)
    if allowed is None:
        cells += ["0"] * 6
    else:
        cells += [_c(str(allowed)), *map(_number, (variable.start, allowed.low, allowed.high))]
        cells += [str(int(allowed.low_open)), str(int(allowed.high_open))]
    return f"{{{', '.join(cells)}}}"


def _number(value: float) -> str:
    """Return a number as a C expression of exactly this value, also for an infinite one."""
    if math.isinf(value):
        return "CS_NEVER" if value > 0.0 else "-CS_NEVER"
    return float(value).hex()


def _c(text: str) -> str:
    """Return a text of one line as a string literal of C."""
    escaped = text.replace("\\", "\\\\").replace('"', '\\"')
    return f'"{escaped}"'
