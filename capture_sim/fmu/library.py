"""The library in C: the scene's data as a header, the sources beside this module, the compiler."""

from __future__ import annotations

import hashlib
import math
import shutil
import subprocess
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from capture_sim import __version__
from capture_sim.bench import CAUSES, Bench
from capture_sim.engine.state import EVENT, WORKSPACE, Status
from capture_sim.files import whole_file
from capture_sim.fmu.machine_code import FmuError, instructions, machine_code
from capture_sim.fmu.variables import Variable, offset_of, outputs, parameters
from capture_sim.samples import SAMPLE
from capture_sim.scene.parts import Scene

_SOURCES = Path(__file__).resolve().parent
#: The library's own names are bound within it: two units in one process do not mix.
_FLAGS = ("-std=c11", "-O2", "-fPIC", "-Wl,-Bsymbolic", "-Wall", "-Wextra")


@dataclass(frozen=True)
class Unit:
    """A scene with all that its sources need.

    Attributes
    ----------
    scene
        The scene.
    parameters, outputs
        Its variables, in the order of their numbers.
    header
        Text of ``scene.h``.
    token
        Hash of header and version, the unit's ``instantiationToken``.
    portable
        True for the instructions of any processor of the architecture.
    """

    scene: Scene
    parameters: list[Variable]
    outputs: list[Variable]
    header: str
    token: str
    portable: bool


def make_unit(scene: Scene, *, portable: bool = False) -> Unit:
    """Return a scene's unit; nothing is compiled yet.

    Raises
    ------
    SceneError
        The scene is invalid.
    """
    workspace = Bench(scene).initial_workspace()
    found, results = parameters(scene, workspace), outputs()
    data = _header(scene, workspace, found, results, instructions(portable=portable))
    token = hashlib.sha256(f"{__version__}\n{data}".encode()).hexdigest()[:32]
    header = f'{data}\n#define CS_TOKEN "{token}"\n'
    return Unit(scene, found, results, header, token, portable)


def write_sources(unit: Unit, folder: Path) -> None:
    """Write the header, the sources and the kernels' object file into a folder."""
    folder.mkdir(parents=True, exist_ok=True)
    for name in ("bench.h", "bench.c", "fmi3.c"):
        shutil.copy(_SOURCES / name, folder)
    (folder / "scene.h").write_text(unit.header, encoding="utf-8")
    (folder / "kernels.o").write_bytes(machine_code(portable=unit.portable))


def link(sources: Sequence[Path], library: Path, *flags: str) -> None:
    """Compile and link a shared library; ``flags`` are further ones for the compiler.

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
        raise FmuError(f"{compiler} failed: {done.stderr.strip().splitlines()[-1:]}")


def write_library(unit: Unit, folder: Path) -> Path:
    """Write ``lib<scene>.so`` and ``bench.h`` into a folder; return the library's path."""
    library = folder / f"lib{unit.scene.name}.so"
    with tempfile.TemporaryDirectory() as name:
        sources = Path(name)
        write_sources(unit, sources)
        with whole_file(library) as part:
            link([sources / "bench.c", sources / "kernels.o"], part)
        with whole_file(folder / "bench.h") as part:
            shutil.copy(sources / "bench.h", part)
    return library


def _header(
    scene: Scene,
    workspace: np.ndarray,
    found: Sequence[Variable],
    results: Sequence[Variable],
    needs: Sequence[str],
) -> str:
    """Return the text of ``scene.h``."""
    data = workspace.tobytes().rstrip(b"\0")
    places = max(len(variable.places) for variable in found)
    constants = {
        "WORKSPACE_SIZE": WORKSPACE.itemsize,
        "STATE_SIZE": offset_of(WORKSPACE, "log"),
        "SAMPLE_SIZE": SAMPLE.itemsize,
        "SAMPLE_TIME": offset_of(SAMPLE, "t"),
        "STATUS": offset_of(WORKSPACE, "progress", "status"),
        "STATUS_SERVED": int(Status.SERVED),
        "STATUS_INTERRUPTED": int(Status.INTERRUPTED),
        "T_STOP": offset_of(WORKSPACE, "progress", "t_stop"),
        "N_LOG": offset_of(WORKSPACE, "progress", "n_log"),
        "LOG": offset_of(WORKSPACE, "log"),
        "EVENT_SIZE": EVENT.itemsize,
        "EVENT_TIME": offset_of(EVENT, "t"),
        "STEP_START": offset_of(WORKSPACE, "step", "t0"),
        "HAS_SHAPED_BUFFER": offset_of(WORKSPACE, "system", "par", "has_shaped_buffer"),
        "PLACES": places,
        "PARAMETER_COUNT": len(found),
        "OUTPUT_COUNT": len(results),
    }
    checks = [f"CS_NEED({_c(name)})" for name in needs]
    causes = [CAUSES.get(status, "") for status in Status]
    rows = [", ".join(map(str, data[k : k + 32])) for k in range(0, len(data), 32)]
    return "\n".join(
        [
            "/* Data of one scene; made by capture-sim fmu. */",
            f'#define CS_SCENE "{scene.name}"',
            f"/* of capture_sim {__version__} */",
            *(f"#define CS_{name} {value}" for name, value in constants.items()),
            "#define CS_NEVER (1.0 / 0.0)",
            *([f"#define CS_NEEDS {' '.join(checks)}"] if needs else []),
            "static const unsigned char cs_initial[] = {",
            ",\n".join(rows),
            "};",
            "static const char *const cs_causes[] = {",
            *(f"  {_c(cause)}," for cause in causes),
            "};",
            "static const cs_variable cs_parameters[] = {",
            *(_variable(variable) for variable in found),
            "};",
            "/* Places of a parameter in the workspace; 0: none. */",
            f"static const size_t cs_places[][{places}] = {{",
            *(f"  {{{', '.join(map(str, variable.places))}}}," for variable in found),
            "};",
            "static const int cs_shapes_buffer[] = {",
            "  " + ", ".join(str(int(variable.shapes_buffer)) for variable in found),
            "};",
            "static const cs_variable cs_outputs[] = {",
            *(_variable(variable) for variable in results),
            "};",
            "static const size_t cs_output_places[] = {",
            "  " + ", ".join(str(variable.places[0]) for variable in results),
            "};",
        ]
    )


def _variable(variable: Variable) -> str:
    """Return a variable as an initialiser of ``cs_variable``."""
    allowed, cells = variable.allowed, [_c(variable.name), _c(variable.unit)]
    if allowed is None:
        cells += ["0"] * 6
    else:
        cells += [_c(str(allowed)), *map(_number, (variable.start, allowed.low, allowed.high))]
        cells += [str(int(allowed.low_open)), str(int(allowed.high_open))]
    return f"  {{{', '.join([*cells, str(int(variable.is_integer))])}}},"


def _number(value: float) -> str:
    """Return a double as C writes it, exactly."""
    if math.isinf(value):
        return "CS_NEVER" if value > 0.0 else "-CS_NEVER"
    return float(value).hex()


def _c(text: str) -> str:
    """Return a text as a literal of C."""
    escaped = text.replace("\\", "\\\\").replace('"', '\\"')
    return f'"{escaped}"'
