"""One step of an explicit Runge-Kutta pair: stages, error, dense output, step size.

Works on any compiled right-hand side ``rhs(t, y, f, par, mode, scratch)`` that writes dy/dt
into ``f``.  ``y`` holds ``n`` states followed by integrals that the right-hand side does
not read; error control looks at the states only.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

from capture_sim.kernels import kernel

SAFETY = 0.9
SHRINK_MOST = 0.2
GROW_MOST = 6.0
BETA = 0.04  # share of the previous error: Gustafsson's PI control, as in DOPRI5


@kernel
def next_factor(error, previous, order):
    """Return by what to multiply the step after ``error`` (accepted if <= 1)."""
    if error == 0.0:
        return GROW_MOST
    if not error < 1e300:
        return SHRINK_MOST
    exponent = 1.0 / order - 0.75 * BETA
    factor = SAFETY * error**-exponent
    if error <= 1.0:
        factor *= max(previous, 1e-4) ** BETA
    return min(GROW_MOST, max(SHRINK_MOST, factor))


@kernel
def dense(y, F, rows, x, y_x):
    """Write the state at the fraction ``x`` (0..1) of the step into ``y_x``."""
    total = y.shape[0]
    for i in range(total):
        y_x[i] = 0.0
    for k in range(rows):
        r = rows - 1 - k
        factor = x if r % 2 == 0 else 1.0 - x
        for i in range(total):
            y_x[i] = (y_x[i] + F[r, i]) * factor
    for i in range(total):
        y_x[i] += y[i]


class Stepper(NamedTuple):
    """The compiled steps of one right-hand side."""

    try_step: Callable[..., Any]
    prepare_dense: Callable[..., Any]


def make_stepper(rhs: Callable[..., Any]) -> Stepper:
    """Compile the steps for a right-hand side.

    The right-hand side is bound here and not passed at run time: Numba keeps no compiled
    code on disk that takes functions as arguments.
    """

    @kernel
    def stage(par, mode, scratch, A, C, s, t, y, h, K, y_s, n):
        """Evaluate stage ``s`` from the stages before it into K[s]."""
        for i in range(n):
            y_s[i] = 0.0
        for j in range(s):
            weight = A[s, j]
            if weight != 0.0:
                for i in range(n):
                    y_s[i] += weight * K[j, i]
        for i in range(n):
            y_s[i] = y[i] + h * y_s[i]
        rhs(t + C[s] * h, y_s, K[s], par, mode, scratch)

    @kernel
    def try_step(par, mode, scratch, pair, t, y, h, K, y_s, y_new, n, scale):
        """Take a step of length ``h`` from (t, y) with K[0] known.

        Writes the result into ``y_new`` and its derivative into K[stages]; returns the error
        relative to ``scale`` (n,), 1 being just good enough.
        """
        A, C, E5, E3, _, stages, _, _ = pair
        total = y.shape[0]
        for s in range(1, stages):
            stage(par, mode, scratch, A, C, s, t, y, h, K, y_s, n)
        for i in range(total):
            y_new[i] = 0.0
        for j in range(stages):
            weight = A[stages, j]
            if weight != 0.0:
                for i in range(total):
                    y_new[i] += weight * K[j, i]
        for i in range(total):
            y_new[i] = y[i] + h * y_new[i]
        rhs(t + h, y_new, K[stages], par, mode, scratch)
        e5 = 0.0
        e3 = 0.0
        watched = scale.shape[0]
        for i in range(watched):
            a = 0.0
            b = 0.0
            for j in range(stages + 1):
                a += E5[j] * K[j, i]
                b += E3[j] * K[j, i]
            a /= scale[i]
            b /= scale[i]
            e5 += a * a
            e3 += b * b
        if e5 == 0.0:
            return 0.0
        return h * e5 / math.sqrt((e5 + 0.01 * e3) * watched)

    @kernel
    def prepare_dense(par, mode, scratch, pair, t, y, h, K, y_s, n, F):
        """Fill ``F`` (rows, total) so that :func:`dense` can be called in this step."""
        A, C, _, _, G, stages, _, _ = pair
        total = y.shape[0]
        for s in range(stages + 1, A.shape[0]):
            stage(par, mode, scratch, A, C, s, t, y, h, K, y_s, n)
        for r in range(G.shape[0]):
            for i in range(total):
                F[r, i] = 0.0
            for j in range(A.shape[0]):
                weight = h * G[r, j]
                if weight != 0.0:
                    for i in range(total):
                        F[r, i] += weight * K[j, i]

    return Stepper(try_step, prepare_dense)
