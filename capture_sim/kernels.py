"""Compilation of the numerical kernels.

Numba's cache looks at the file of the outermost function only, and would serve stale
code after a change in a callee.  So the cache lies in a folder named by a hash of all
kernel sources: a change anywhere compiles anew, nothing else does.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import numba

F = TypeVar("F", bound=Callable[..., Any])

_PACKAGE = Path(__file__).resolve().parent
_SOURCES = sorted(
    path for folder in ("model", "engine", "solver") for path in (_PACKAGE / folder).glob("*.py")
) + [_PACKAGE / name for name in ("kernels.py", "samples.py", "detection/exact.py")]


def source_hash() -> str:
    """Return a hash of all kernel sources, of where they are and of the compiler's version."""
    # Numba finds compiled code again by the path of its source, so another checkout has its own
    digest = hashlib.sha256(f"{numba.__version__} {_PACKAGE}".encode())
    for path in _SOURCES:
        digest.update(path.relative_to(_PACKAGE).as_posix().encode() + b"\0" + path.read_bytes())
    return digest.hexdigest()[:16]


def cache_folder() -> Path:
    """Return the folder of the compiled kernels of this very source."""
    root = os.environ.get("CAPTURE_SIM_CACHE") or os.environ.get("XDG_CACHE_HOME")
    base = Path(root) if root else Path.home() / ".cache"
    return base / "capture_sim" / f"kernels-{source_hash()}"


def is_compiled() -> bool:
    """Tell whether the kernels of this source have been compiled here before."""
    return any(cache_folder().rglob("loop.advance*.nbc"))


def kernel(function: F) -> F:
    """Compile a function that is called from other kernels."""
    compiled: F = numba.njit(error_model="numpy", _nrt=False, fastmath={"contract", "nsz"})(
        function
    )
    return compiled


def inline_kernel(function: F) -> F:
    """Compile a small function into each of its callers: a call would cost as much as it."""
    compiled: F = numba.njit(
        error_model="numpy", _nrt=False, fastmath={"contract", "nsz"}, forceinline=True
    )(function)
    return compiled


def entry_kernel(function: F) -> F:
    """Compile a function that Python calls, and keep the result on disk."""
    previous = numba.config.CACHE_DIR
    folder = cache_folder()
    try:
        folder.mkdir(parents=True, exist_ok=True)
        numba.config.CACHE_DIR = str(folder)
        compiled: F = numba.njit(error_model="numpy", _nrt=False, cache=True)(function)
    except OSError:
        # nowhere to keep it: compile anew in each process
        compiled = numba.njit(error_model="numpy", _nrt=False)(function)
    finally:
        numba.config.CACHE_DIR = previous
    return compiled
