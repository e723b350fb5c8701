"""One step of an explicit Runge-Kutta pair: stages, error, dense output, step size.

Works on any compiled right-hand side ``rhs(t, y, f, par, mode, scratch)`` that writes dy/dt
into ``f``.  ``y`` holds ``n`` states followed by integrals that the right-hand side does
not read; error control looks at the states only.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

from capture_sim.kernels import inline_kernel, kernel
from capture_sim.solver.rows import add_rows

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


@inline_kernel
def dense(y, F, rows, x, y_x, n):
    """Write the first ``n`` states at the fraction ``x`` (0..1) of the step into ``y_x``."""
    for i in range(n):
        y_x[i] = 0.0
    for k in range(rows):
        r = rows - 1 - k
        factor = x if r % 2 == 0 else 1.0 - x
        for i in range(n):
            y_x[i] = (y_x[i] + F[r, i]) * factor
    for i in range(n):
        y_x[i] += y[i]


class Stepper(NamedTuple):
    """The compiled steps of one right-hand side."""

    try_step: Callable[..., Any]
    prepare_dense: Callable[..., Any]


def make_stepper(rhs: Callable[..., Any], states: int, total: int, watched: int) -> Stepper:
    """Compile the steps for a right-hand side.

    Parameters
    ----------
    rhs
        ``rhs(t, y, f, par, mode, scratch)``, compiled; reads the first places of ``y``, the
        states, and writes dy/dt of all into ``f``; those beyond the states are integrals.

    states, total, watched
        Lengths: of the states, of all of ``y``, and of what the error control looks at.

    Notes
    -----
    Right-hand side and lengths are bound here and not passed at run time: Numba keeps no
    compiled code on disk that takes functions as arguments, and with lengths known the sums
    stay in registers (:mod:`capture_sim.solver.rows`).
    """

    @inline_kernel
    def stage(par, mode, scratch, A, C, s, t, y, h, K, y_s):
        """Evaluate stage ``s`` from the stages before it into K[s]."""
        add_rows(y_s, y, K, A[s], s, h, states)
        rhs(t + C[s] * h, y_s, K[s], par, mode, scratch)

    @kernel
    def try_step(par, mode, scratch, pair, t, y, h, K, y_s, e_5, e_3, y_new, weights):
        """Take a step of length ``h`` from (t, y) with K[0] known.

        Writes the result into ``y_new`` and its derivative into K[stages]; returns the
        weighted error, 1 being just good enough: ``weights`` (watched,) are the inverse of
        what each place of ``y`` may be wrong by.  ``y_s`` (states,), ``e_5`` and ``e_3``
        (watched,) are scratch.
        """
        A, C, E5, E3, _, stages, _, _ = pair
        for s in range(1, stages):
            stage(par, mode, scratch, A, C, s, t, y, h, K, y_s)
        add_rows(y_new, y, K, A[stages], stages, h, total)
        rhs(t + h, y_new, K[stages], par, mode, scratch)
        add_rows(e_5, None, K, E5, stages + 1, h, watched)
        add_rows(e_3, None, K, E3, stages + 1, h, watched)
        sum5 = 0.0
        sum3 = 0.0
        for i in range(watched):
            a = e_5[i] * weights[i]
            b = e_3[i] * weights[i]
            sum5 += a * a
            sum3 += b * b
        if sum5 == 0.0:
            return 0.0
        return sum5 / math.sqrt((sum5 + 0.01 * sum3) * watched)

    @kernel
    def prepare_dense(par, mode, scratch, pair, t, y, h, K, y_s, F):
        """Fill ``F`` (rows, total) so that :func:`dense` can be called in this step."""
        A, C, _, _, G, stages, _, _ = pair
        for s in range(stages + 1, C.shape[0]):
            stage(par, mode, scratch, A, C, s, t, y, h, K, y_s)
        for r in range(G.shape[0]):
            add_rows(F[r], None, K, G[r], C.shape[0], h, total)

    return Stepper(try_step, prepare_dense)
