"""One step of an explicit Runge-Kutta pair: stages, error and dense output.

It works on any compiled right-hand side ``rhs(t, y, f, system)`` that writes dy/dt into ``f``;
``system`` is the record of its parameters.  ``y`` begins with the states, and after them come
integrals that the right-hand side does not read.  The error control watches the states and the
first of the integrals.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from capture_sim.base.compiled.kernels import inline_kernel, kernel
from capture_sim.dynamics.solver.pairs import MAX_ROWS, MAX_STAGES, Pair
from capture_sim.dynamics.solver.rows import add_rows, squares_of_sums


def stepper_type(total: int, watched: int) -> np.dtype:
    """Return the dtype of a stepper's memory: the coefficients of a pair and the data of a step.

    ``total`` is the length of y, states and integrals; the error control watches its first
    ``watched`` entries.
    """
    square, room = (MAX_STAGES, MAX_STAGES), (MAX_STAGES,)
    return np.dtype(
        [
            ("C", "f8", room),
            # weights that are not zero, with the numbers of their stages and how many they are
            ("A", "f8", square),
            ("A_stages", "i8", square),
            ("A_count", "i8", room),
            ("E5", "f8", room),
            ("E3", "f8", room),
            ("E_stages", "i8", room),
            ("E_count", "i8"),
            ("G", "f8", (MAX_ROWS, MAX_STAGES)),
            ("G_stages", "i8", (MAX_ROWS, MAX_STAGES)),
            ("G_count", "i8", (MAX_ROWS,)),
            ("stages", "i8"),
            ("total_stages", "i8"),  # with those of the dense output
            ("rows", "i8"),
            ("order", "i8"),
            ("y", "f8", (total,)),  # at the start of the step
            ("y_new", "f8", (total,)),  # at its end
            ("y_stage", "f8", (total,)),
            ("K", "f8", (MAX_STAGES, total)),  # dy/dt at the stages
            ("F", "f8", (MAX_ROWS, total)),  # dense output
            ("weights", "f8", (watched,)),  # 1 / permitted error of a step
        ],
        align=True,
    )


def set_pair(memory: Any, pair: Pair) -> None:
    """Write a pair's coefficients into a stepper's memory."""
    total, rows, s = len(pair.C), len(pair.G), pair.stages
    memory["C"][:total] = pair.C
    for name, matrix in (("A", pair.A), ("G", pair.G)):
        for row, weights in enumerate(matrix):
            (chosen,) = np.nonzero(weights)
            memory[name][row, : len(chosen)] = weights[chosen]
            memory[f"{name}_stages"][row, : len(chosen)] = chosen
            memory[f"{name}_count"][row] = len(chosen)
    (chosen,) = np.nonzero((pair.E5 != 0.0) | (pair.E3 != 0.0))
    memory["E_stages"][: len(chosen)], memory["E_count"] = chosen, len(chosen)
    memory["E5"][: len(chosen)], memory["E3"][: len(chosen)] = pair.E5[chosen], pair.E3[chosen]
    memory["stages"], memory["total_stages"], memory["rows"] = s, total, rows
    memory["order"] = pair.order


@inline_kernel
def dense(step, x, y_inside, n):
    """Write the first ``n`` entries of y at the fraction ``x`` (0..1) of a step into ``y_inside``.

    ``step`` is the memory of a step for which ``prepare_dense`` has been called.
    """
    y, F, rows = step.y, step.F, step.rows
    for i in range(n):
        y_inside[i] = 0.0
    for k in range(rows):
        r = rows - 1 - k
        factor = x if r % 2 == 0 else 1.0 - x
        for i in range(n):
            y_inside[i] = (y_inside[i] + F[r, i]) * factor
    for i in range(n):
        y_inside[i] += y[i]


@inline_kernel
def dense_entry(step, x, i):
    """Return entry ``i`` of y at the fraction ``x`` (0..1) of a step, as :func:`dense` gives it."""
    F, rows = step.F, step.rows
    total = 0.0
    for k in range(rows):
        r = rows - 1 - k
        total = (total + F[r, i]) * (x if r % 2 == 0 else 1.0 - x)
    return total + step.y[i]


class Stepper(NamedTuple):
    """The compiled functions that take steps with one right-hand side: see make_stepper."""

    try_step: Callable[..., Any]
    prepare_dense: Callable[..., Any]


def make_stepper(rhs: Callable[..., Any], states: int, total: int, watched: int) -> Stepper:
    """Return the functions that take steps with a compiled right-hand side.

    ``rhs(t, y, f, system)`` writes dy/dt into ``f``.  ``states`` is the number of states, ``total``
    the length of y, and the error control watches the first ``watched`` entries of y.  All four are
    part of the compiled code and not passed at run time: Numba's cache on disk does not accept
    functions as arguments, and sums of known length stay in registers
    (:mod:`capture_sim.dynamics.solver.rows`).
    """

    @kernel
    def stage(system, step, s, t, h):
        """Write dy/dt at stage ``s`` into K[s], from those of the stages before it."""
        add_rows(
            step.y_stage, step.y, step.K, step.A_stages[s], step.A[s], step.A_count[s], h, states
        )
        rhs(t + step.C[s] * h, step.y_stage, step.K[s], system)

    @kernel
    def try_step(system, step, t, h):
        """Try a step of length ``h`` from (t, step.y); return its error over what is permitted.

        K[0] must contain dy/dt at the start.  The result is written into ``y_new``, and dy/dt
        there into K[stages].  A step is good enough if the returned value is at most 1; the
        value is 0 for a pair without error estimate.
        """
        K, stages = step.K, step.stages
        for s in range(1, stages):
            stage(system, step, s, t, h)
        count = step.A_count[stages]
        add_rows(step.y_new, step.y, K, step.A_stages[stages], step.A[stages], count, h, total)
        rhs(t + h, step.y_new, K[stages], system)
        sum5, sum3 = squares_of_sums(
            step.weights, K, step.E_stages, step.E5, step.E3, step.E_count, h, watched
        )
        if sum5 == 0.0:
            return 0.0
        return sum5 / math.sqrt((sum5 + 0.01 * sum3) * watched)

    @kernel
    def prepare_dense(system, step, t, h):
        """Compute the coefficients ``F`` of the dense output of the step that was just tried."""
        for s in range(step.stages + 1, step.total_stages):
            stage(system, step, s, t, h)
        for r in range(step.rows):
            count = step.G_count[r]
            add_rows(step.F[r], None, step.K, step.G_stages[r], step.G[r], count, h, total)

    return Stepper(try_step, prepare_dense)
