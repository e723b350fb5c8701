"""Kernels in vector registers: what Numba's compiler does not make of scalar code by itself.

A kernel with scalars says what is computed; the code for vectors is written when it is compiled.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property
from typing import Any

from capture_sim.base.compiled.kernels import Kernel, kernel


class VectorKernel:
    """A function that is compiled into its callers with vector code.

    ``scalar`` is a kernel that does the same; it is used if Numba's internals are unknown.
    ``generate`` writes the code.
    """

    def __init__(self, scalar: Kernel, generate: Callable[..., Any], results: int) -> None:
        self.scalar = scalar
        self.generate, self._results = generate, results

    @cached_property
    def _numba_type_(self) -> Any:
        """Its type in kernels (Numba's protocol for external objects)."""
        from capture_sim.base.compiled import compiler  # half a second: Numba

        if compiler.internals is None:
            return self.scalar._numba_type_
        from capture_sim.base.compiled import vector_code

        return vector_code.function_type(self.generate, self._results)

    def __call__(self, *arguments: Any) -> Any:
        """Call the scalar kernel, where Numba is switched off."""
        return self.scalar(*arguments)


def vectorized(scalar: Any, results: int = 0) -> Callable[[Callable[..., Any]], Any]:
    """Let a function that writes vector code stand for a scalar kernel; see ``function_type``."""
    return lambda generate: VectorKernel(scalar, generate, results)


@kernel
def _write_one_by_one(out, start, a, b, c, d):  # type: ignore[no-untyped-def]
    """Write four numbers into out[start : start + 4]."""
    out[start] = a
    out[start + 1] = b
    out[start + 2] = c
    out[start + 3] = d


@vectorized(_write_one_by_one)
def write_four(code: Any, out: Any, start: int, a: Any, b: Any, c: Any, d: Any) -> None:
    """Write four numbers at once.

    Those that are written one by one, and read as a vector soon after, are late: the processor
    must first write each of them to its cache.
    """
    code.store(code.vector([a, b, c, d]), out, start, 4)
