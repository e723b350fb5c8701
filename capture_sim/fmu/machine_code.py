"""Machine code of the integrator and of the detector, for programs without Python.

Only public parts of Numba and llvmlite are used: ``cfunc``, the text of its LLVM module, and LLVM's
code generator.  One assumption is not documented by Numba: the name of the compiled function in
that text contains the name of the Python function.  If it does not, FmuError is raised.
"""

from __future__ import annotations

import platform
from functools import cache

import llvmlite.binding as llvm
import numba
import numpy as np
from numba import carray, cfunc, types

from capture_sim.detection import criteria, exact
from capture_sim.dynamics.engine import loop
from capture_sim.dynamics.engine.state import WORKSPACE
from capture_sim.dynamics.samples import SAMPLE
from capture_sim.errors import CaptureSimError

#: Names of the C functions that are generated, by :func:`_advance` and :func:`_detect`.
ENTRIES = ("capture_sim_advance", "capture_sim_detect")
#: Instructions beyond the architecture's first generation that the C compiler can ask for.
_TESTABLE = ("avx", "avx2", "fma", "bmi", "bmi2", "avx512f", "avx512dq", "avx512bw", "avx512vl")
_OLDEST = {"x86_64": "x86-64", "aarch64": "generic"}


class FmuError(CaptureSimError):
    """A co-simulation unit (FMU) or its C library cannot be made on this machine."""


def instructions(*, portable: bool) -> tuple[str, ...]:
    """Return the instruction sets that a library must find on the processor when it starts.

    They are names that the C compiler knows, such as ``avx2``, of sets that
    :func:`machine_code` may use on this machine, or with the processor that Numba is told
    (``NUMBA_CPU_NAME``, ``NUMBA_CPU_FEATURES``).  The result is empty if ``portable`` is True, and
    on another architecture than x86-64: the library then checks nothing.

    FmuError if Numba is told a processor without its features, unless it is ``generic``.
    """
    if portable or platform.machine() != "x86_64":
        return ()
    told, features = numba.config.CPU_NAME, numba.config.CPU_FEATURES
    if told and told != "generic" and not features:
        raise FmuError(
            f"NUMBA_CPU_NAME = {told}: must be generic, or given with NUMBA_CPU_FEATURES, so that "
            "the unit can check its processor"
        )
    if told:
        return tuple(name for name in _TESTABLE if f"+{name}" in (features or "").split(","))
    has = llvm.get_host_cpu_features()
    return tuple(name for name in _TESTABLE if has.get(name))


@cache
def machine_code(entry: str, *, portable: bool) -> bytes:
    """Return the content of an object file that defines ``entry``, one of :data:`ENTRIES`.

    Compiling all entries needs about 10 s; a second call returns the same bytes at once.

    ``portable``: True for code that runs on any processor of this architecture; False for code
    that may use all instructions of this processor, or of the one in ``NUMBA_CPU_NAME``.  Results
    of portable code differ from those of other code by round-off.

    Raises
    ------
    FmuError
        The operating system, the architecture or this version of Numba is not supported.
    """
    if platform.machine() not in _OLDEST or platform.system() != "Linux":
        raise FmuError(
            f"platform = {platform.system()} {platform.machine()}: must be Linux on "
            + " or ".join(_OLDEST)
        )
    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()
    text = _advance() if entry == ENTRIES[0] else _detect()
    module = llvm.parse_assembly(text)
    _keep_only(entry, module)
    cpu, features = _OLDEST[platform.machine()], ""
    if not portable and numba.config.CPU_NAME:  # as the kernels in Python are compiled
        cpu, features = numba.config.CPU_NAME, numba.config.CPU_FEATURES or ""
    elif not portable:
        cpu, features = llvm.get_host_cpu_name(), llvm.get_host_cpu_features().flatten()
    target = llvm.Target.from_default_triple().create_target_machine(
        cpu=cpu, features=features, opt=3, reloc="pic"
    )
    passes = llvm.create_new_module_pass_manager()
    passes.add_global_dead_code_eliminate_pass()
    passes.run(module, llvm.create_pass_builder(target, llvm.PipelineTuningOptions(speed_level=3)))
    return bytes(target.emit_object(module))


def _pointer(record: np.dtype) -> types.CPointer:
    return types.CPointer(numba.from_dtype(record))


_NUMBERS = types.CPointer(types.float64)


def _advance() -> str:
    """Return the text of an LLVM module with the integrator's loop and all that it calls.

    The C function has the arguments of :func:`capture_sim.dynamics.engine.loop.advance`, with the
    lengths of ``times`` and ``trace`` (``samples`` is as long as ``times``).
    """
    advance = loop.advance.compiled  # type: ignore[attr-defined]

    def capture_sim_advance(w, times, n_times, samples, trace, n_trace):  # type: ignore[no-untyped-def]
        return advance(
            carray(w, 1), carray(times, n_times), carray(samples, n_times), carray(trace, n_trace)
        )

    workspace, sample = _pointer(WORKSPACE), _pointer(SAMPLE)
    signature = types.int64(workspace, _NUMBERS, types.int64, sample, sample, types.int64)
    text: str = cfunc(signature)(capture_sim_advance).inspect_llvm()
    return text


def _detect() -> str:
    """Return the text of an LLVM module with the function that evaluates the detector's criteria.

    The C function evaluates one sample.  With ``is_end`` not 0, it instead decides a run that has
    no verdict yet.  It returns the state of the detector.
    """
    last_undecided = int(criteria.CaptureState.CONTACT)  # a verdict before the end stays
    follow, decide_at_end = exact.follow.compiled, criteria.decide_at_end.compiled  # type: ignore[attr-defined]

    def capture_sim_detect(numbers, memory, sample, y, row, is_end):  # type: ignore[no-untyped-def]
        limits, memories = carray(numbers, 1)[0], carray(memory, 1)
        if is_end and memories[0].state <= last_undecided:
            decide_at_end(limits, memories[0], 0.0, False)
        else:
            follow(limits, memories, carray(sample, 1), carray(y, 16), carray(row, 1), False)
        return memories[0].state

    limits = _pointer(np.dtype([(name, "f8") for name in criteria.Criteria._fields]))
    memory, sample, row = map(_pointer, (criteria.MEMORY, SAMPLE, exact.ROW))
    signature = types.int64(limits, memory, sample, _NUMBERS, row, types.int64)
    text: str = cfunc(signature)(capture_sim_detect).inspect_llvm()
    return text


def _keep_only(entry: str, module: llvm.ModuleRef) -> None:
    """Name the compiled function ``entry``, and make all else in the module internal.

    LLVM then removes what the function does not use, such as Numba's wrapper around it, which
    reports exceptions to Python.  FmuError if the module does not have exactly one such function.
    """
    found = [
        function
        for function in module.functions
        if not function.is_declaration
        and entry in function.name
        and not function.name.startswith("cfunc")
    ]
    if len(found) != 1:
        raise FmuError(
            f"Numba {numba.__version__} names compiled functions in a way that is not known: "
            f"{len(found)} functions contain {entry!r}, not 1"
        )
    for thing in (*module.functions, *module.global_variables):
        if not thing.is_declaration:
            thing.linkage = "internal"
    found[0].name, found[0].linkage = entry, "external"
