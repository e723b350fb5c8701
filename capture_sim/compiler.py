"""How Numba compiles the kernels; loaded with the first that is called."""

from __future__ import annotations

import ctypes
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numba
from numba.core.compiler import Compiler
from numba.core.registry import cpu_target


def _load_without_blas() -> None:
    """Load what Numba knows of Python and NumPy, without scipy.linalg, which no kernel needs.

    It would be 0.3 s of every start; that SciPy may be missing Numba allows for.
    """
    blas = "scipy.linalg.cython_blas"
    loaded = sys.modules.get(blas)
    sys.modules[blas] = loaded  # type: ignore[assignment]  # None: an ImportError
    try:
        cpu_target.typing_context.refresh()
        cpu_target.target_context.refresh()
    finally:
        if loaded is None:
            del sys.modules[blas]


_load_without_blas()

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


def inner(function: Callable[..., Any], *, inline: bool) -> Any:
    """Compile a function that only other kernels call."""
    options = {"forceinline": True} if inline else {}
    return numba.njit(error_model="numpy", _nrt=False, fastmath=_FAST, **options, **_INNER)(
        function
    )


def entry(function: Callable[..., Any], folder: Path) -> Any:
    """Compile a function that Python calls; keep the result in a folder."""
    previous = numba.config.CACHE_DIR
    try:
        numba.config.CACHE_DIR = str(folder)
        return numba.njit(error_model="numpy", _nrt=False, cache=True, no_cfunc_wrapper=True)(
            function
        )
    finally:
        numba.config.CACHE_DIR = previous
