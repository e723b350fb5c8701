"""How many threads NumPy's linear algebra may use."""

from __future__ import annotations

import os

#: What OpenBLAS and Intel's MKL read when NumPy loads them.
_VARIABLES = ("OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


def limit_linear_algebra() -> None:
    """Let linear algebra use one thread, here and in processes that this one starts.

    Call it before NumPy is loaded.  What the environment already says stays.

    Matrices of this package are small.  With one thread for each core, the threads wait for each
    other by spinning: beside busy processes a product takes 15 times longer, and even alone a fit
    takes 1.6 times the CPU time (benchmarks/linear_algebra.py).  Also, a result must not depend on
    the number of cores.
    """
    for name in _VARIABLES:
        os.environ.setdefault(name, "1")
