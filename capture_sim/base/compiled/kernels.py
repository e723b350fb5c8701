"""Decorators for kernels, the functions that Numba compiles.

An entry kernel is called from Python; any other kernel is called from kernels only.  Numba's own
cache checks the file of the outermost function only, and would return stale code after a change in
a function that it calls.  Each entry kernel therefore has a folder that is named by a hash of its
code, of all kernels that it calls, in any module, and of the constants that they read.

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

_COMPILER = Path(__file__).resolve().parent


@cache
def compiler_hash() -> str:
    """Return a hash of Numba's version, of the modules in this folder, and of the folder's path."""
    # Numba finds compiled code by the path of its source, so each checkout has its own
    digest = hashlib.sha256(f"{version('numba')} {_COMPILER}".encode())
    for path in sorted(_COMPILER.glob("*.py")):
        digest.update(path.name.encode() + b"\0" + path.read_bytes())
    return digest.hexdigest()[:16]


def code_hash(entry: Callable[..., Any]) -> str:
    """Return a hash of a kernel, of every kernel that it calls, and of all their constants."""
    digest = hashlib.sha256()
    done: set[Kernel] = set()
    left = [cast("Kernel", entry)]
    while left:
        kernel = left.pop()
        if kernel in done:
            continue
        done.add(kernel)
        function = kernel.py_func
        code = function.__code__
        literals = [value for value in code.co_consts if value is not function.__doc__]
        own = code.co_code, code.co_varnames, code.co_names, literals, function.__defaults__
        digest.update(repr((own, kernel.inline)).encode())
        for name, value in _names_outside(function).items():
            called = getattr(value, "scalar", value)  # of a VectorKernel
            if isinstance(called, Kernel):
                left.append(called)
            digest.update(f"{name} {_constant(value)}".encode())
    return digest.hexdigest()[:16]


def _names_outside(function: Callable[..., Any]) -> dict[str, Any]:
    """Return the objects that a function reads from its module and enclosing functions, by name."""
    code, known = function.__code__, function.__globals__
    cells = zip(code.co_freevars, function.__closure__ or (), strict=True)
    read = {name: known[name] for name in code.co_names if name in known}
    return read | {name: cell.cell_contents for name, cell in cells}


def _constant(value: Any) -> str:
    """Return a text for the hash of an object that a kernel reads, without memory addresses.

    It has the values of an array, an enumeration or a number; of a function or module, the name.
    """
    if isinstance(value, np.ndarray):
        return f"{value.dtype.descr} {value.shape} {value.tobytes().hex()}"
    if isinstance(value, type):
        members = getattr(value, "__members__", {})
        fields = getattr(value, "_fields", ())
        return f"{value.__qualname__} {fields} {[(name, int(members[name])) for name in members]}"
    if generate := getattr(value, "generate", None):  # of a VectorKernel
        return Path(generate.__code__.co_filename).read_text(encoding="utf-8")
    return str(getattr(value, "__name__", None) or repr(value))  # else a module or a function


@cache
def cache_folder() -> Path:
    """Return the folder of all compiled kernels of this checkout and Numba; create it if missing.

    It is in the folder ``CAPTURE_SIM_CACHE``, else ``XDG_CACHE_HOME``, else ``~/.cache``.  Compiled
    kernels are pickles, and loading one may run any code.  Therefore the folder must belong to this
    user or root, and nobody else may be able to write to it.  If it cannot be used, the kernels are
    in the system's folder for temporary files, and a line on stderr reports this.

    Raises
    ------
    CaptureSimError
        The path in the temporary folder is not a folder, belongs to another user, or others can
        write to it.
    """
    root = os.environ.get("CAPTURE_SIM_CACHE") or os.environ.get("XDG_CACHE_HOME")
    base = Path(root) if root else Path.home() / ".cache"
    name = f"kernels-{compiler_hash()}"
    folder = base / "capture_sim" / name
    try:
        base.mkdir(parents=True, exist_ok=True)
        reason = _make_own(folder.parent) or _make_own(folder)
    except OSError as error:
        reason = f"cannot be written to: {error.strerror}"
    if not reason:
        return folder
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
        f"capture-sim: {folder.parent}: {reason}; compiled kernels go to {fallback}",
        file=sys.stderr,
    )
    fallback.mkdir(parents=True, exist_ok=True)
    return fallback


def _make_own(folder: Path) -> str:
    """Create a folder of this user; return why it cannot be used, or an empty text if it can."""
    with contextlib.suppress(FileExistsError):
        folder.mkdir(mode=0o700)
    found = folder.stat()
    if found.st_uid not in (os.getuid(), 0):
        return f"belongs to user {found.st_uid}"
    if found.st_mode & 0o022:
        if found.st_uid != os.getuid() or found.st_mode & 0o002:
            return "others can write to it"
        folder.chmod(found.st_mode & 0o755)  # of a umask that lets the group write
    return "" if os.access(folder, os.W_OK) else "cannot be written to"


class Kernel:
    """A function that Numba compiles; Numba is imported at the first call.

    ``entry`` is True for a function that Python calls, whose compiled code is kept on disk.
    ``inline`` is True for a function that is compiled into each of its callers.  The attribute
    ``py_func`` is the Python function.
    """

    def __init__(
        self, function: Callable[..., Any], *, entry: bool = False, inline: bool = False
    ) -> None:
        update_wrapper(self, function)
        self.py_func = function
        self.inline = inline
        self._entry = entry

    @property
    def folder(self) -> Path:
        """Folder of the compiled code on disk; only an entry kernel writes to it."""
        return cache_folder() / code_hash(self)

    @cached_property
    def compiled(self) -> Any:
        """Numba's dispatcher of the function, which compiles it at its first call."""
        from capture_sim.base.compiled import compiler  # half a second: Numba

        if self._entry:
            return compiler.entry(self.py_func, self.folder)
        return compiler.inner(self.py_func, inline=self.inline)

    def __call__(self, *args: Any) -> Any:
        """Call the compiled function."""
        return self.compiled(*args)

    @property
    def _numba_type_(self) -> Any:
        """Type of this kernel in kernels that call it (Numba's protocol for external objects)."""
        from numba import types

        return types.Dispatcher(self.compiled)


def kernel(function: F) -> F:
    """Make a kernel of a function that only other kernels call; a decorator."""
    return cast("F", Kernel(function))


def inline_kernel(function: F) -> F:
    """Make a kernel that is compiled into each kernel that calls it, to save the cost of the call.

    A decorator, for small functions.
    """
    return cast("F", Kernel(function, inline=True))


def entry_kernel(function: F) -> F:
    """Make a kernel of a function that Python calls; its compiled code is kept on disk.

    A decorator; the function is compiled at its first call.
    """
    return cast("F", Kernel(function, entry=True))


def is_compiled(entry: Callable[..., Any]) -> bool:
    """Return True if compiled code of an entry kernel, as its code is now, is on disk."""
    return any(cast("Kernel", entry).folder.rglob("*.nbc"))


@cache
def plain(function: F) -> F:
    """Return a kernel as plain Python; the kernels that it calls are plain Python in it too.

    Any other function is returned unchanged.
    """
    if not isinstance(function, Kernel):
        return function
    python = function.py_func
    names = dict(python.__globals__)
    for name, value in _names_outside(python).items():
        called = getattr(value, "scalar", value)  # of a VectorKernel
        if isinstance(called, Kernel):
            names[name] = plain(called)
    copy: F = FunctionType(  # type: ignore[assignment]
        python.__code__, names, python.__name__, python.__defaults__
    )
    return copy


def records(array: np.ndarray) -> np.ndarray:
    """Return an array of records as kernels need it: a recarray with ``NUMBA_DISABLE_JIT=1``.

    Otherwise the array itself is returned.  In plain Python, only a recarray has fields as
    attributes.
    """
    return array.view(np.recarray) if _PLAIN else array
