"""Compilation of the numerical kernels.

Numba's cache checks the file of the outermost function only, and would return stale code after a
change in a callee.  The cache folder is therefore named by a hash of all kernel sources, so any
change of these compiles them again.

With ``NUMBA_DISABLE_JIT=1`` all kernels run as plain Python, slowly, for a debugger.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import stat
import sys
import tempfile
from collections.abc import Callable
from functools import cache, cached_property, update_wrapper
from importlib.metadata import version
from pathlib import Path
from types import FunctionType
from typing import Any, TypeVar, cast

import numpy as np

from capture_sim.errors import CaptureSimError

F = TypeVar("F", bound=Callable[..., Any])

_PLAIN = os.environ.get("NUMBA_DISABLE_JIT", "0") not in ("", "0")

_PACKAGE = Path(__file__).resolve().parents[2]
_SOURCES = sorted(
    path
    for folder in ("model", "engine", "solver")
    for path in (_PACKAGE / "dynamics" / folder).glob("*.py")
) + [
    _PACKAGE / name
    for name in (
        "base/compiled/kernels.py",
        "base/compiled/compiler.py",
        "base/compiled/numba_internals.py",
        "base/compiled/vector_code.py",
        "base/compiled/vectors.py",
        "dynamics/samples.py",
        "scene/geometry.py",
        "detection/criteria.py",
        "detection/exact.py",
    )
]


@cache
def source_hash() -> str:
    """Return a hash of all kernel sources, their path and the compiler's version."""
    # Numba finds compiled code by the path of its source, so each checkout has its own
    digest = hashlib.sha256(f"{version('numba')} {_PACKAGE}".encode())
    for path in _SOURCES:
        digest.update(path.relative_to(_PACKAGE).as_posix().encode() + b"\0" + path.read_bytes())
    return digest.hexdigest()[:16]


@cache
def cache_folder() -> Path:
    """Return the folder of this version's compiled kernels, and make it.

    It is in ``CAPTURE_SIM_CACHE``, ``XDG_CACHE_HOME`` or ``~/.cache``, or, if that is not writable,
    in the system's folder for temporary files; a line on stderr reports it.  Compiled kernels are
    pickles, and loading one may run any code: in the temporary folder, which all users share, the
    folder must belong to this user alone.

    Raises
    ------
    CaptureSimError
        The folder in the temporary folder belongs to another user, or others can write to it.
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
    own = Path(tempfile.gettempdir()) / f"capture_sim-{os.getuid()}"
    with contextlib.suppress(FileExistsError):
        own.mkdir(mode=0o700)
    found = own.lstat()
    if not stat.S_ISDIR(found.st_mode) or found.st_uid != os.getuid() or found.st_mode & 0o022:
        raise CaptureSimError(
            f"{own}: must be a folder of this user to which nobody else can write; "
            "remove it, or set CAPTURE_SIM_CACHE to a folder for compiled kernels"
        )
    fallback = own / name
    print(
        f"capture-sim: {base} cannot be written to; compiled kernels go to {fallback}",
        file=sys.stderr,
    )
    fallback.mkdir(parents=True, exist_ok=True)
    return fallback


def is_compiled() -> bool:
    """Return True if the kernels of this version are compiled on this machine."""
    return any(cache_folder().rglob("loop.advance*.nbc"))


class Kernel:
    """A function that Numba compiles; Numba is loaded at the first call.

    ``entry`` is True for a function that Python calls, whose code is kept on disk; ``inline`` for
    one that is compiled into each of its callers.  ``py_func`` is the Python function.
    """

    def __init__(
        self, function: Callable[..., Any], *, entry: bool = False, inline: bool = False
    ) -> None:
        update_wrapper(self, function)
        self.py_func = function
        self._entry, self._inline = entry, inline

    @cached_property
    def compiled(self) -> Any:
        """Numba's dispatcher of the function."""
        from capture_sim.base.compiled import compiler  # half a second: Numba

        if self._entry:
            return compiler.entry(self.py_func, cache_folder())
        return compiler.inner(self.py_func, inline=self._inline)

    def __call__(self, *args: Any) -> Any:
        """Call the compiled function."""
        return self.compiled(*args)

    @property
    def _numba_type_(self) -> Any:
        """Its type in other kernels (Numba's protocol for external objects)."""
        from numba import types

        return types.Dispatcher(self.compiled)


def kernel(function: F) -> F:
    """Compile a function that is called from other kernels."""
    return cast("F", Kernel(function))


def inline_kernel(function: F) -> F:
    """Compile a small function into each of its callers, to save the cost of the call."""
    return cast("F", Kernel(function, inline=True))


def entry_kernel(function: F) -> F:
    """Compile a function that Python calls, and keep the result on disk."""
    return cast("F", Kernel(function, entry=True))


@cache
def plain(function: F) -> F:
    """Return a kernel as a Python function that calls the Python functions of other kernels."""
    if not isinstance(function, Kernel):
        return function
    python = function.py_func
    names = dict(python.__globals__)
    for name in python.__code__.co_names:
        value = getattr(names.get(name), "scalar", names.get(name))  # of a VectorKernel
        if isinstance(value, Kernel):
            names[name] = plain(value)
    copy: F = FunctionType(  # type: ignore[assignment]
        python.__code__, names, python.__name__, python.__defaults__
    )
    return copy


def records(array: np.ndarray) -> np.ndarray:
    """Return an array of records for a kernel, compiled or (as a recarray) plain Python."""
    return array.view(np.recarray) if _PLAIN else array
