"""Compilation of the numerical kernels.

Numba's cache looks at the file of the outermost function only, and would serve stale
code after a change in a callee.  So the cache lies in a folder named by a hash of all
kernel sources: a change anywhere compiles anew, nothing else does.

With ``NUMBA_DISABLE_JIT=1`` all kernels run as plain Python, slowly, for a debugger.
"""

from __future__ import annotations

import ctypes
import hashlib
import os
import sys
import tempfile
from collections.abc import Callable
from functools import cache
from pathlib import Path
from types import FunctionType
from typing import Any, TypeVar

import numba
import numpy as np
from numba.core.compiler import Compiler

F = TypeVar("F", bound=Callable[..., Any])

_PACKAGE = Path(__file__).resolve().parent
_SOURCES = sorted(
    path for folder in ("model", "engine", "solver") for path in (_PACKAGE / folder).glob("*.py")
) + [_PACKAGE / name for name in ("kernels.py", "samples.py", "detection/exact.py")]


@cache
def source_hash() -> str:
    """Return a hash of all kernel sources, of where they are and of the compiler's version."""
    # Numba finds compiled code again by the path of its source, so another checkout has its own
    digest = hashlib.sha256(f"{numba.__version__} {_PACKAGE}".encode())
    for path in _SOURCES:
        digest.update(path.relative_to(_PACKAGE).as_posix().encode() + b"\0" + path.read_bytes())
    return digest.hexdigest()[:16]


@cache
def cache_folder() -> Path:
    """Return the folder of the compiled kernels of this very source, and make it.

    Below ``CAPTURE_SIM_CACHE``, ``XDG_CACHE_HOME`` or ``~/.cache``; where that cannot be written
    to, below the system's folder for temporary files, which a line on stderr says.
    """
    root = os.environ.get("CAPTURE_SIM_CACHE") or os.environ.get("XDG_CACHE_HOME")
    base = Path(root) if root else Path.home() / ".cache"
    name = f"kernels-{source_hash()}"
    folder = base / "capture_sim" / name
    try:
        folder.mkdir(parents=True, exist_ok=True)
        if os.access(folder, os.W_OK):
            return folder
    except OSError:
        pass
    other = Path(tempfile.gettempdir()) / f"capture_sim-{os.getuid()}" / name
    print(
        f"capture-sim: {base} cannot be written to; compiled kernels go to {other}",
        file=sys.stderr,
    )
    other.mkdir(parents=True, exist_ok=True)
    return other


def is_compiled() -> bool:
    """Return whether the kernels of this source have been compiled here before."""
    return any(cache_folder().rglob("loop.advance*.nbc"))


# what Python gets that calls a kernel for other kernels: a TypeError (for it, see ``plain``)
_REFUSE = ctypes.cast(ctypes.pythonapi.PyErr_BadArgument, ctypes.c_void_p).value


class _WithoutMachineCode:
    """Numba's code generator for kernels that only other kernels call."""

    def __init__(self, codegen: Any) -> None:
        self._codegen = codegen

    def __getattr__(self, name: str) -> Any:
        return getattr(self._codegen, name)

    def set_env(self, env_name: str, env: Any) -> None:
        """Set nothing: there is no code whose environment it could be."""


class _InnerCompiler(Compiler):
    """Numba's compiler, up to LLVM's code: the entry that calls a kernel does the rest.

    By itself Numba optimises every function with all that it calls, and makes machine code of it,
    before the caller does the same again: with kernels eight calls deep that is most of the time.
    """

    def define_pipelines(self) -> Any:
        """Return Numba's own pipelines, writing into a library that stays unoptimised."""
        state = self.state
        library = state.targetctx.codegen().create_library(state.func_id.func_qualname)
        library._codegen = _WithoutMachineCode(library._codegen)
        library._optimize_final_module = lambda: None
        library._finalize_final_module = lambda: setattr(library, "_finalized", True)
        library.get_pointer_to_function = lambda name: _REFUSE
        state.library = library
        return super().define_pipelines()


_FAST = {"contract", "nsz"}  # fused multiply and add; the sign of zero does not matter
_INNER = {
    "no_cpython_wrapper": True,
    "no_cfunc_wrapper": True,
    "pipeline_class": _InnerCompiler,
}


def kernel(function: F) -> F:
    """Compile a function that is called from other kernels."""
    compiled: F = numba.njit(error_model="numpy", _nrt=False, fastmath=_FAST, **_INNER)(function)
    return compiled


def inline_kernel(function: F) -> F:
    """Compile a small function into each of its callers: a call would cost as much as it."""
    compiled: F = numba.njit(
        error_model="numpy", _nrt=False, fastmath=_FAST, forceinline=True, **_INNER
    )(function)
    return compiled


def entry_kernel(function: F) -> F:
    """Compile a function that Python calls, and keep the result on disk."""
    previous = numba.config.CACHE_DIR
    try:
        numba.config.CACHE_DIR = str(cache_folder())
        compiled: F = numba.njit(
            error_model="numpy", _nrt=False, cache=True, no_cfunc_wrapper=True
        )(function)
    finally:
        numba.config.CACHE_DIR = previous
    return compiled


def plain(function: F) -> F:
    """Return the Python function of a kernel, calling those of other kernels, for use outside."""
    if not hasattr(function, "py_func"):
        return function
    python = function.py_func
    names = dict(python.__globals__)
    for name in python.__code__.co_names:
        if hasattr(names.get(name), "py_func"):
            names[name] = plain(names[name])
    copy: F = FunctionType(python.__code__, names, python.__name__)  # type: ignore[assignment]
    return copy


def records(array: np.ndarray) -> np.ndarray:
    """Return an array of records as the kernels take it: attributes are compiled, or NumPy's."""
    return array.view(np.recarray) if numba.config.DISABLE_JIT else array
