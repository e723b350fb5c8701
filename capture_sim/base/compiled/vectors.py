"""Kernels with hand-written vector code, where Numba's compiler makes none from scalar code.

A scalar kernel defines the result; a second function writes LLVM code for vector registers that
computes the same.  Without it, runs take 1.6 times as long for the sums of stages (1.1 times with
sums that are unrolled by hand), 1.08 times for the error of a step, and 1.1 times for the balls'
resistance.  Vector code for anything else has brought less than 3 %.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property
from typing import Any

from capture_sim.base.compiled.kernels import Kernel


class VectorKernel:
    """A function that is compiled into the kernels that call it, with vector code.

    ``generate`` writes the code, see :func:`capture_sim.base.compiled.vector_code.function_type`;
    the function returns ``results`` numbers.  ``scalar`` is a kernel that computes the same; it is
    used if the installed Numba's internals are not supported.
    """

    def __init__(self, scalar: Kernel, generate: Callable[..., Any], results: int) -> None:
        self.scalar = scalar
        self.generate, self._results = generate, results

    @cached_property
    def _numba_type_(self) -> Any:
        """Type of this function in kernels (Numba's protocol for external objects)."""
        from capture_sim.base.compiled import compiler  # half a second: Numba

        if compiler.internals is None:
            return self.scalar._numba_type_
        from capture_sim.base.compiled import vector_code

        return vector_code.function_type(self.generate, self._results)

    def __call__(self, *arguments: Any) -> Any:
        """Call the scalar kernel; for plain Python, with ``NUMBA_DISABLE_JIT=1``."""
        return self.scalar(*arguments)


def vectorized(scalar: Any, results: int = 0) -> Callable[[Callable[..., Any]], Any]:
    """Return a decorator that makes a VectorKernel of the function that writes its vector code.

    ``scalar`` is the kernel that computes the same, ``results`` how many numbers it returns.
    """
    return lambda generate: VectorKernel(scalar, generate, results)
