"""One step of an explicit Runge-Kutta pair: stages, error and dense output.

Works on any compiled right-hand side ``rhs(t, y, f, system)`` that writes dy/dt into ``f``;
``system`` is its record of parameters.  ``y`` has the states first, then integrals that the
right-hand side does not read; the states and some of the integrals are under error control.
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
    """Return the dtype of a stepper's memory: a pair's coefficients and the data of a step.

    ``total`` is the length of the state with its integrals, ``watched`` the number of its first
    entries under error control.
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
    """Write the first ``n`` entries of y inside a step, at its fraction ``x`` (0..1)."""
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
    """Return entry ``i`` of y inside a step, as :func:`dense` does."""
    F, rows = step.F, step.rows
    total = 0.0
    for k in range(rows):
        r = rows - 1 - k
        total = (total + F[r, i]) * (x if r % 2 == 0 else 1.0 - x)
    return total + step.y[i]


class Stepper(NamedTuple):
    """The compiled steps of one right-hand side."""

    try_step: Callable[..., Any]
    prepare_dense: Callable[..., Any]


def make_stepper(rhs: Callable[..., Any], states: int, total: int, watched: int) -> Stepper:
    """Compile the steps for a compiled right-hand side ``rhs(t, y, f, system)``.

    ``states``, ``total`` and ``watched`` are the lengths of the states, of ``y`` and of its entries
    under error control.  They are bound here, not passed at run time: Numba's cache on disk does
    not accept functions as arguments, and sums of known length stay in registers
    (:mod:`capture_sim.dynamics.solver.rows`).
    """

    @kernel
    def stage(system, step, s, t, h):
        """Evaluate stage ``s`` from the stages before it into K[s]."""
        add_rows(
            step.y_stage, step.y, step.K, step.A_stages[s], step.A[s], step.A_count[s], h, states
        )
        rhs(t + step.C[s] * h, step.y_stage, step.K[s], system)

    @kernel
    def try_step(system, step, t, h):
        """Take a step of length ``h`` from (t, step.y) with K[0] known.

        Writes the result into ``y_new`` and its derivative into K[stages]; returns the
        weighted error, 1 being just good enough.
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
        """Fill ``F`` so that :func:`dense` can be called in this step."""
        for s in range(step.stages + 1, step.total_stages):
            stage(system, step, s, t, h)
        for r in range(step.rows):
            count = step.G_count[r]
            add_rows(step.F[r], None, step.K, step.G_stages[r], step.G[r], count, h, total)

    return Stepper(try_step, prepare_dense)
