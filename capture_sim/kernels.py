"""Compilation of the numerical kernels.

Numba's cache looks at the file of the outermost function only, and would serve stale
code after a change in a callee.  So the cache lies in a folder named by a hash of all
kernel sources: a change anywhere compiles anew, nothing else does.

With ``NUMBA_DISABLE_JIT=1`` all kernels run as plain Python, slowly, for a debugger.
"""

from __future__ import annotations

import hashlib
import os
import sys
import tempfile
from collections.abc import Callable
from functools import cache, cached_property, update_wrapper
from importlib.metadata import version
from pathlib import Path
from types import FunctionType
from typing import Any, TypeVar, cast

import numpy as np

F = TypeVar("F", bound=Callable[..., Any])

_PLAIN = os.environ.get("NUMBA_DISABLE_JIT", "0") not in ("", "0")

_PACKAGE = Path(__file__).resolve().parent
_SOURCES = sorted(
    path for folder in ("model", "engine", "solver") for path in (_PACKAGE / folder).glob("*.py")
) + [
    _PACKAGE / name
    for name in (
        "kernels.py",
        "compiler.py",
        "numba_internals.py",
        "samples.py",
        "detection/exact.py",
    )
]


@cache
def source_hash() -> str:
    """Return a hash of all kernel sources, of where they are and of the compiler's version."""
    # Numba finds compiled code again by the path of its source, so another checkout has its own
    digest = hashlib.sha256(f"{version('numba')} {_PACKAGE}".encode())
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


class Kernel:
    """A function that Numba compiles; who never calls one does not load Numba.

    Parameters
    ----------
    function
        What is compiled.
    entry
        Whether Python calls it; the result is then kept on disk.
    inline
        Whether it is compiled into each of its callers.

    Attributes
    ----------
    py_func
        The function itself.
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
        from capture_sim import compiler  # half a second: Numba

        if self._entry:
            return compiler.entry(self.py_func, cache_folder())
        return compiler.inner(self.py_func, inline=self._inline)

    def __call__(self, *args: Any) -> Any:
        """Call the compiled function."""
        return self.compiled(*args)

    @property
    def _numba_type_(self) -> Any:
        """What Numba takes it for in other kernels (its protocol for foreign objects)."""
        from numba import types

        return types.Dispatcher(self.compiled)


def kernel(function: F) -> F:
    """Compile a function that is called from other kernels."""
    return cast("F", Kernel(function))


def inline_kernel(function: F) -> F:
    """Compile a small function into each of its callers: a call would cost as much as it."""
    return cast("F", Kernel(function, inline=True))


def entry_kernel(function: F) -> F:
    """Compile a function that Python calls, and keep the result on disk."""
    return cast("F", Kernel(function, entry=True))


@cache
def plain(function: F) -> F:
    """Return the Python function of a kernel, calling those of other kernels, for use outside."""
    if not isinstance(function, Kernel):
        return function
    python = function.py_func
    names = dict(python.__globals__)
    for name in python.__code__.co_names:
        if isinstance(names.get(name), Kernel):
            names[name] = plain(names[name])
    copy: F = FunctionType(python.__code__, names, python.__name__)  # type: ignore[assignment]
    return copy


def records(array: np.ndarray) -> np.ndarray:
    """Return an array of records as the kernels take it: attributes are compiled, or NumPy's."""
    return array.view(np.recarray) if _PLAIN else array
