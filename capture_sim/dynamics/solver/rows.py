"""Weighted sums of rows, computed in the processor's vector registers.

Between its evaluations, a Runge-Kutta step computes ``out = base + h (w_0 K_0 + w_1 K_1 + ...)``.
Compiled from a loop, this passes over ``out`` once for every few rows.  The functions of this file
keep all partial sums in registers and read every row whose weight is not zero once.  Each is
written twice: as a plain kernel, which says what is computed, and as code for vector registers
(:mod:`capture_sim.base.compiled.vectors`).
"""

from __future__ import annotations

from typing import Any

from capture_sim.base.compiled.kernels import kernel
from capture_sim.base.compiled.vectors import vectorized


@kernel
def _add_rows(out, base, rows, places, weights, count, h, n):
    """Write base[:n] + h * sum(weights[j] * rows[places[j], :n] for j < count) into out[:n].

    Arrays are float64 with contiguous rows, but ``places`` is int64.  ``base`` may be None, for
    zeros.  ``n`` must be known when the caller is compiled; ``count`` need not.
    """
    for i in range(n):
        total = 0.0
        for j in range(count):
            total += weights[j] * rows[places[j], i]
        out[i] = h * total if base is None else base[i] + h * total


@vectorized(_add_rows)
def add_rows(
    code: Any, out: Any, base: Any, rows: Any, places: Any, weights: Any, count: Any, h: Any, n: int
) -> None:
    """Write the machine code of :func:`_add_rows` for vector registers.

    ``code`` writes it; the other arguments stand for those of the kernel.
    """
    (sums,) = code.sums(rows, places, count, [weights], n)
    for (start, width), total in zip(code.blocks(n), sums, strict=True):
        lengths = code.broadcast(h, width)
        if base is None:
            result = code.multiply(total, lengths)
        else:
            result = code.multiply_add(total, lengths, code.load(base, start, width), width)
        code.store(result, out, start, width)


@kernel
def _squares_of_sums(scale, rows, places, first, second, count, h, n):
    """Return the squared lengths of two scaled sums of rows.

    The first sum is h * scale * sum(first[j] * rows[places[j], :n] for j < count), with entries
    i < n; the other one has the weights ``second``.
    """
    a = 0.0
    b = 0.0
    for i in range(n):
        sum_a = 0.0
        sum_b = 0.0
        for j in range(count):
            sum_a += first[j] * rows[places[j], i]
            sum_b += second[j] * rows[places[j], i]
        sum_a *= h * scale[i]
        sum_b *= h * scale[i]
        a += sum_a * sum_a
        b += sum_b * sum_b
    return a, b


@vectorized(_squares_of_sums, results=2)
def squares_of_sums(
    code: Any,
    scale: Any,
    rows: Any,
    places: Any,
    first: Any,
    second: Any,
    count: Any,
    h: Any,
    n: int,
) -> list[Any]:
    """Write the machine code of :func:`_squares_of_sums` for vector registers.

    ``code`` writes it; the other arguments stand for those of the kernel.  The result is the two
    values that the code computes.
    """
    lengths = []
    for sums in code.sums(rows, places, count, [first, second], n):
        scaled = []
        for (start, width), total in zip(code.blocks(n), sums, strict=True):
            value = code.multiply(total, code.broadcast(h, width))
            scaled.append(code.multiply(value, code.load(scale, start, width)))
        lengths.append(code.sum_of_squares(scaled, n))
    return lengths
