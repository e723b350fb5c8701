"""Changes of Numba's internals that save two thirds of compiling and half of the start.

The internals are not part of Numba's interface; :mod:`capture_sim.base.compiled.compiler` decides
whether the installed version supports the changes.
"""

from __future__ import annotations

import ctypes
import hashlib
import math
import pickle
import sys
import tempfile
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import llvmlite.binding as llvm
import numba
from numba.core.caching import FunctionCache, IndexDataCacheFile
from numba.core.compiler import Compiler
from numba.core.registry import cpu_target

from capture_sim.base.files import whole_file
from capture_sim.errors import RecordingError

#: Length of a checksum, bytes.
_CHECKSUM = hashlib.sha256().digest_size
#: True once compiled code could not be written, which is said once.
_has_failed = False


def _load_without_blas() -> None:
    """Load Numba's support of Python and NumPy without scipy.linalg, which no kernel needs.

    This saves 0.3 s; Numba treats SciPy as missing.
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


# Python gets a TypeError from an inner kernel; ``plain`` returns its Python function
_REFUSE = ctypes.cast(ctypes.pythonapi.PyErr_BadArgument, ctypes.c_void_p).value


class _WithoutMachineCode:
    """Numba's code generator for kernels that only other kernels call."""

    def __init__(self, codegen: Any) -> None:
        self._codegen = codegen

    def __getattr__(self, name: str) -> Any:
        return getattr(self._codegen, name)

    def set_env(self, env_name: str, env: Any) -> None:
        """Do nothing: there is no machine code that needs an environment."""


class _EntryCompiler(Compiler):
    """Numba's compiler, which loads the support of Python and NumPy when it compiles."""

    def __init__(self, *args: Any) -> None:
        _load_without_blas()
        super().__init__(*args)

    def define_pipelines(self) -> Any:
        """Return Numba's pipelines with a library of which only the machine code is kept."""
        state = self.state
        if state.library is None:
            library = state.targetctx.codegen().create_library(state.func_id.func_qualname)
            library.enable_object_caching()
            library.serialize_using_object_code = partial(_machine_code, library)
            state.library = library
        return super().define_pipelines()


def _read_text(library: Any, path: Path) -> Any:
    """Return LLVM's module of a loaded library, to compile it into others."""
    if library._shared_module is None:
        library._shared_module = llvm.parse_bitcode(path.read_bytes())
    return library._shared_module


def _machine_code(library: Any) -> tuple[str, str, tuple[bytes, bytes]]:
    """Return a library as Numba keeps it, with the names of its functions in place of their text.

    Numba would read LLVM's text at every start, to be able to compile the function into others,
    which takes nearly half of the time to load it; see :class:`_Cache`.
    """
    names = [
        f.name
        for f in library._final_module.functions
        if not f.is_declaration and f.linkage == llvm.Linkage.external
    ]
    stubs = "\n".join(f'define void @"{name}"() {{ ret void }}' for name in names)
    return (
        library.name,
        "object",
        (library._get_compiled_object(), llvm.parse_assembly(stubs).as_bitcode()),
    )


class _CheckedFile(IndexDataCacheFile):
    """Numba's files of compiled code, which are not used if they are damaged.

    The code is a pickle, and is read only if it has the checksum with which it was written.
    """

    def _load_index(self) -> Any:
        try:
            return super()._load_index()
        except OSError:
            raise
        except Exception as error:  # of a pickle that was cut, any
            _report_damage(Path(self._index_path), error)
            return {}

    def _load_data(self, name: str) -> Any:
        path = Path(self._data_path(name))
        data = path.read_bytes()
        if hashlib.sha256(data[_CHECKSUM:]).digest() != data[:_CHECKSUM]:
            _report_damage(path, "wrong checksum")
            return None
        return pickle.loads(data[_CHECKSUM:])

    def _save_data(self, name: str, data: Any) -> None:
        dumped = self._dump(data)
        with self._open_for_write(self._data_path(name)) as file:
            file.write(hashlib.sha256(dumped).digest() + dumped)


def _report_damage(path: Path, why: object) -> None:
    """Report a damaged file of the cache in a line, and remove it."""
    print(f"capture-sim: {path}: damaged ({why}): compiled again", file=sys.stderr)
    path.unlink(missing_ok=True)


class _Cache(FunctionCache):
    """Numba's cache on disk, without loading the compiler's support of Python and NumPy.

    Numba loads that first, which would add 0.3 s to every start.  What cannot be read or written is
    compiled in memory, and a line on stderr reports this.
    """

    def __init__(self, function: Callable[..., Any]) -> None:
        super().__init__(function)
        kept = self._cache_file
        kept.__class__ = _CheckedFile

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """Return the compiled code for a signature; None if there is none."""
        found = self._load_overload(sig, target_context)
        if found is not None and not self._text_file(found).is_file():
            return None
        if found is not None:
            library = found.library
            library._shared_module = None
            library._get_module_for_linking = partial(_read_text, library, self._text_file(found))
        return found

    def save_overload(self, sig: Any, data: Any) -> None:
        """Save the compiled code, and the text of its LLVM code in a separate file."""
        text = data.library._get_module_for_linking().as_bitcode()
        try:
            with whole_file(self._text_file(data)) as path:
                path.write_bytes(text)
            super().save_overload(sig, data)
        except (OSError, RecordingError) as error:
            global _has_failed
            if not _has_failed:
                _has_failed = True
                where = "" if str(self._cache_path) in str(error) else f"{self._cache_path}: "
                print(
                    f"capture-sim: {where}{error}: kernels are compiled again in each process",
                    file=sys.stderr,
                )

    def _text_file(self, compiled: Any) -> Path:
        """Return the file with LLVM's text of a function."""
        name = hashlib.sha256(compiled.fndesc.mangled_name.encode()).hexdigest()
        return Path(self._cache_path) / f"{name[:16]}.bc"


class _InnerCompiler(_EntryCompiler):
    """Numba's compiler up to LLVM's code; the entry that calls a kernel does the rest.

    Numba optimises every function with all its callees and generates machine code, then repeats
    this in the caller: with kernels eight calls deep, that is most of the time.
    """

    def define_pipelines(self) -> Any:
        """Return Numba's pipelines with a library that is not optimised."""
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
    """Return Numba's dispatcher of a function that only other kernels call.

    With ``inline``, the function is compiled into each caller.
    """
    options = {"forceinline": True} if inline else {}
    return numba.njit(error_model="numpy", _nrt=False, fastmath=_FAST, **options, **_INNER)(
        function
    )


def entry(function: Callable[..., Any]) -> Any:
    """Return Numba's dispatcher of a function that Python calls.

    It keeps the compiled code in ``numba.config.CACHE_DIR``, as set at the time of this call.
    """
    dispatcher = numba.njit(
        error_model="numpy", _nrt=False, no_cfunc_wrapper=True, pipeline_class=_EntryCompiler
    )(function)
    dispatcher._cache = _Cache(function)
    return dispatcher


def _half(x: float) -> float:
    return 0.5 * x


def compiles() -> bool:
    """Return True if a small test kernel, and an entry that calls it, give the right result.

    An unsupported Numba may also raise any error.
    """
    half = inner(_half, inline=False)

    def root_of_half(x: float) -> float:
        return math.sqrt(half(x))

    previous = numba.config.CACHE_DIR
    try:
        with tempfile.TemporaryDirectory() as folder:
            numba.config.CACHE_DIR = folder
            return bool(entry(root_of_half)(8.0) == 2.0)
    finally:
        numba.config.CACHE_DIR = previous
