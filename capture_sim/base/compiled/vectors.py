"""Kernels in vector registers: what Numba's compiler does not make of scalar code by itself.

A scalar kernel says what is computed; the code for vectors is written when it is compiled.  Without
it, runs take 1.6 times as long for the sums of stages (1.1 times with sums that are unrolled by
hand), 1.08 times for the error of a step, and 1.1 times for the balls' resistance.  Vector code for
anything else has brought less than 3 %.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property
from typing import Any

from capture_sim.base.compiled.kernels import Kernel


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
