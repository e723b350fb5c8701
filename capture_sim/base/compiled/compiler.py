"""Compilation of kernels (functions that Numba compiles), imported when one is first called.

With :mod:`capture_sim.base.compiled.numba_internals`, compiling needs 17 s instead of 60 s and a
start 0.65 s instead of 1.45 s.  For a Numba with other internals, plain ``njit`` is used.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numba

#: Tested versions of Numba; others first compile a small kernel as a test.
_TESTED_VERSIONS = ("0.60", "0.61", "0.62", "0.63", "0.64", "0.65", "0.66", "0.67", "0.68")
_FAST = {"contract", "nsz"}  # fused multiply and add; the sign of zero does not matter


def _load_internals() -> Any:
    """Return the module that uses Numba's internals, if the installed Numba supports it.

    Otherwise print a warning on stderr and return None.
    """
    try:
        from capture_sim.base.compiled import numba_internals

        if numba.__version__.rsplit(".", 1)[0] in _TESTED_VERSIONS or numba_internals.compiles():
            return numba_internals
    except Exception:  # a change of Numba's internals may raise any error
        pass
    print(
        f"capture-sim: Numba {numba.__version__} differs inside from {_TESTED_VERSIONS[0]} to "
        f"{_TESTED_VERSIONS[-1]}: "
        "compiling takes about a minute, each start a second longer",
        file=sys.stderr,
    )
    return None


internals = _load_internals()


def inner(function: Callable[..., Any], *, inline: bool) -> Any:
    """Return Numba's dispatcher of a function that only other kernels call.

    With ``inline``, the function is compiled into each caller, if Numba's internals are supported.
    """
    if internals is not None:
        return internals.inner(function, inline=inline)
    return numba.njit(error_model="numpy", fastmath=_FAST)(function)


def entry(function: Callable[..., Any], folder: Path) -> Any:
    """Return Numba's dispatcher of a function that Python calls.

    It compiles at the first call, and keeps the result in the folder for later processes.
    """
    previous = numba.config.CACHE_DIR
    try:
        numba.config.CACHE_DIR = str(folder)
        if internals is not None:
            return internals.entry(function)
        return numba.njit(error_model="numpy", cache=True)(function)
    finally:
        numba.config.CACHE_DIR = previous
