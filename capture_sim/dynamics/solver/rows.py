"""Weighted sums of rows in vector registers.

Between its evaluations, a Runge-Kutta step computes ``out = base + h (w_0 K_0 + w_1 K_1 + ...)``.
Compiled from a loop, this passes over ``out`` once for every few rows.  Here all partial sums stay
in registers, and every row whose weight is not zero is read once.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import Any

from llvmlite import ir
from numba import types
from numba.extending import intrinsic

from capture_sim.base.compiled.kernels import kernel
from capture_sim.base.compiled.vectors import LANES, VectorCode, vectorized

_INDEX = ir.IntType(64)


def _blocks(n: int) -> list[tuple[int, int]]:
    """Divide ``n`` numbers into blocks (start, width) of 4, 2 and 1."""
    blocks = []
    start = 0
    for width in (LANES, 2, 1):
        while n - start >= width:
            blocks.append((start, width))
            start += width
    return blocks


def _sums(
    code: VectorCode,
    rows: int,
    places: int,
    count: Any,
    weights: Sequence[int],
    blocks: Sequence[tuple[int, int]],
) -> list[list[Any]]:
    """Return, for each array of ``weights``, its sum of the rows at ``places``, in blocks.

    Integers are numbers of arguments; ``count`` is a value.
    """
    builder = code.builder
    rows_p = builder.bitcast(code.data(rows), ir.IntType(8).as_pointer())
    places_p, row_bytes = code.data(places), code.row_bytes(rows)
    weights_p = [code.data(i) for i in weights]
    zero = ir.Constant(_INDEX, 0)
    before, body = builder.block, builder.append_basic_block("rows")
    after = builder.append_basic_block("rows.end")
    builder.cbranch(builder.icmp_signed(">", count, zero), body, after)

    builder.position_at_end(body)
    j = builder.phi(_INDEX)
    j.add_incoming(zero, before)
    partial = [[builder.phi(code.type_of(width)) for _, width in blocks] for _ in weights]
    place = builder.load(builder.gep(places_p, [j]))
    row = builder.gep(rows_p, [builder.mul(place, row_bytes)])
    row = builder.bitcast(row, ir.DoubleType().as_pointer())
    factors = [builder.load(builder.gep(pointer, [j])) for pointer in weights_p]
    totals: list[list[Any]] = [[] for _ in weights]
    for k, (start, width) in enumerate(blocks):
        values = code.load(row, start, width)
        for m, factor in enumerate(factors):
            term = code.multiply(values, code.broadcast(factor, width))
            totals[m].append(code.add(partial[m][k], term))
    next_j = builder.add(j, ir.Constant(_INDEX, 1))
    j.add_incoming(next_j, body)
    builder.cbranch(builder.icmp_signed("<", next_j, count), body, after)

    builder.position_at_end(after)
    final: list[list[Any]] = [[] for _ in weights]
    for m, (phis, sums) in enumerate(zip(partial, totals, strict=True)):
        for (_, width), phi, total in zip(blocks, phis, sums, strict=True):
            value = builder.phi(code.type_of(width))
            for incoming in (phi, value):
                incoming.add_incoming(code.zero(width), before)
                incoming.add_incoming(total, body)
            final[m].append(value)
    return final


@intrinsic(prefer_literal=True)
def _add_rows(
    typingctx: Any,
    out: Any,
    base: Any,
    rows: Any,
    places: Any,
    weights: Any,
    count: Any,
    h: Any,
    n: Any,
) -> Any:
    """Write base[:n] + h * sum(weights[j] * rows[places[j], :n] for j < count) into out[:n].

    ``n`` is known when compiling, ``count`` is not; arrays float64, ``places`` int64, rows
    contiguous.  ``base`` None is zero.
    """
    if not isinstance(n, types.IntegerLiteral):
        return None
    signature = types.void(out, base, rows, places, weights, types.intp, types.float64, n)
    blocks = _blocks(n.literal_value)

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        code = VectorCode(context, builder, signature, arguments)
        base_p = None if isinstance(signature.args[1], type(types.none)) else code.data(1)
        out_p = code.data(0)
        (sums,) = _sums(code, 2, 3, arguments[5], [4], blocks)
        for (start, width), total in zip(blocks, sums, strict=True):
            result = code.multiply(total, code.broadcast(arguments[6], width))
            if base_p is not None:
                result = code.add(code.load(base_p, start, width), result)
            code.store(result, out_p, start, width)
        return context.get_dummy_value()

    return signature, generate


@intrinsic(prefer_literal=True)
def _squares_of_sums(
    typingctx: Any,
    scale: Any,
    rows: Any,
    places: Any,
    first: Any,
    second: Any,
    count: Any,
    h: Any,
    n: Any,
) -> Any:
    """Return the squared lengths of two sums of rows, each entry i < n times ``scale[i]``.

    The sums are h * sum(first[j] * rows[places[j], :n] for j < count), and with ``second``.
    """
    if not isinstance(n, types.IntegerLiteral):
        return None
    result = types.UniTuple(types.float64, 2)
    signature = result(scale, rows, places, first, second, types.intp, types.float64, n)
    blocks = _blocks(n.literal_value)

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        code = VectorCode(context, builder, signature, arguments)
        scale_p = code.data(0)
        lengths = []
        for sums in _sums(code, 1, 2, arguments[5], [3, 4], blocks):
            squares: dict[int, Any] = {}  # by width
            for (start, width), total in zip(blocks, sums, strict=True):
                value = code.multiply(total, code.broadcast(arguments[6], width))
                value = code.multiply(value, code.load(scale_p, start, width))
                square = code.multiply(value, value)
                squares[width] = code.add(squares[width], square) if width in squares else square
            lanes = [code.lane(v, k, width) for width, v in squares.items() for k in range(width)]
            lengths.append(functools.reduce(code.add, lanes))
        return context.make_tuple(builder, signature.return_type, lengths)

    return signature, generate


@kernel
def _add_rows_in_a_loop(out, base, rows, places, weights, count, h, n):
    """Do what :func:`_add_rows` does."""
    for i in range(n):
        total = 0.0
        for j in range(count):
            total += weights[j] * rows[places[j], i]
        out[i] = h * total if base is None else base[i] + h * total


@kernel
def _squares_in_a_loop(scale, rows, places, first, second, count, h, n):
    """Do what :func:`_squares_of_sums` does."""
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


add_rows = vectorized(_add_rows, _add_rows_in_a_loop)
squares_of_sums = vectorized(_squares_of_sums, _squares_in_a_loop)
