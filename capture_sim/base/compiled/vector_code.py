"""Generation of LLVM code that uses vector registers; imported when it is first compiled."""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.core.typing.templates import make_intrinsic_template

LANES = 4  # doubles in a vector register of AVX2; wider ones gain nothing at these lengths
_FLAGS = ("contract", "nsz")
_DOUBLE, _INDEX, _LANE = ir.DoubleType(), ir.IntType(64), ir.IntType(32)


class NumberArray(NamedTuple):
    """An array of float64 or int64 in generated code; both fields are values of LLVM."""

    data: Any  # pointer to its first number
    row_bytes: Any  # from one row to the next


class VectorCode:
    """Generates LLVM code; values are numbers, or vectors of ``width`` numbers."""

    def __init__(self, builder: Any) -> None:
        self.builder = builder

    @staticmethod
    def type_of(width: int) -> Any:
        """Return the type of ``width`` numbers."""
        return _DOUBLE if width == 1 else ir.VectorType(_DOUBLE, width)

    def constant(self, value: float, width: int) -> Any:
        """Return a constant ``width`` times."""
        return ir.Constant(self.type_of(width), value if width == 1 else width * [value])

    def _place(self, pointer: Any, start: int, width: int) -> Any:
        element = self.builder.gep(pointer, [ir.Constant(_INDEX, start)])
        return self.builder.bitcast(element, self.type_of(width).as_pointer())

    def load(self, array: NumberArray, start: int, width: int) -> Any:
        """Return ``width`` numbers from number ``start`` on."""
        value = self.builder.load(self._place(array.data, start, width))
        value.align = 8
        return value

    def store(self, value: Any, array: NumberArray, start: int, width: int) -> None:
        """Write ``width`` numbers from number ``start`` on."""
        self.builder.store(value, self._place(array.data, start, width)).align = 8

    def broadcast(self, value: Any, width: int) -> Any:
        """Return a number ``width`` times."""
        if width == 1:
            return value
        vector = ir.Constant(self.type_of(width), ir.Undefined)
        vector = self.builder.insert_element(vector, value, ir.Constant(_LANE, 0))
        zeros = ir.Constant(ir.VectorType(_LANE, width), None)
        return self.builder.shuffle_vector(vector, vector, zeros)

    def lane(self, value: Any, k: int, width: int) -> Any:
        """Return number ``k`` of a vector."""
        return value if width == 1 else self.builder.extract_element(value, ir.Constant(_LANE, k))

    def add(self, a: Any, b: Any) -> Any:
        """Return a + b."""
        return self.builder.fadd(a, b, flags=_FLAGS)

    def multiply(self, a: Any, b: Any) -> Any:
        """Return a b."""
        return self.builder.fmul(a, b, flags=_FLAGS)

    def multiply_add(self, a: Any, b: Any, c: Any, width: int) -> Any:
        """Return a b + c as one operation, rounded once if the processor can.

        With separate operations, the compiler would choose which product of a sum to fuse with the
        addition, and its choice for an exported FMU would differ.
        """
        kind, name = self.type_of(width), "llvm.fmuladd.f64"
        if width > 1:
            name = f"llvm.fmuladd.v{width}f64"
        signature = ir.FunctionType(kind, 3 * [kind])
        function = cgutils.get_or_insert_function(self.builder.module, signature, name)
        return self.builder.call(function, [a, b, c])

    def negative(self, a: Any) -> Any:
        """Return -a."""
        return self.builder.fneg(a)

    def divide(self, a: Any, b: Any) -> Any:
        """Return a / b."""
        return self.builder.fdiv(a, b, flags=_FLAGS)

    def root(self, a: Any, width: int) -> Any:
        """Return the square root of each number of ``a``."""
        kind = self.type_of(width)
        name = "llvm.sqrt.f64" if width == 1 else f"llvm.sqrt.v{width}f64"
        declare = cgutils.get_or_insert_function
        function = declare(self.builder.module, ir.FunctionType(kind, [kind]), name)
        return self.builder.call(function, [a])

    @staticmethod
    def blocks(n: int) -> list[tuple[int, int]]:
        """Divide ``n`` numbers into blocks (start, width) of 4, 2 and 1."""
        found = []
        start = 0
        for width in (LANES, 2, 1):
            while n - start >= width:
                found.append((start, width))
                start += width
        return found

    def sums(
        self,
        rows: NumberArray,
        places: NumberArray,
        count: Any,
        weights: Sequence[NumberArray],
        n: int,
    ) -> list[list[Any]]:
        """Return, for each array of weights, the sum over j of ``weight[j] * rows[places[j]]``.

        The sum has ``count`` terms; it is 0 if ``count`` is not positive.  A row has ``n`` numbers,
        and each sum is a list of the vectors of :meth:`blocks`.  Every row is read only once.
        """
        builder, blocks = self.builder, self.blocks(n)
        rows_p = builder.bitcast(rows.data, ir.IntType(8).as_pointer())
        zero = ir.Constant(_INDEX, 0)
        before, body = builder.block, builder.append_basic_block("rows")
        after = builder.append_basic_block("rows.end")
        builder.cbranch(builder.icmp_signed(">", count, zero), body, after)

        builder.position_at_end(body)
        j = builder.phi(_INDEX)
        j.add_incoming(zero, before)
        partial = [[builder.phi(self.type_of(width)) for _, width in blocks] for _ in weights]
        place = builder.load(builder.gep(places.data, [j]))
        row_p = builder.gep(rows_p, [builder.mul(place, rows.row_bytes)])
        row = NumberArray(builder.bitcast(row_p, _DOUBLE.as_pointer()), None)
        factors = [builder.load(builder.gep(array.data, [j])) for array in weights]
        totals: list[list[Any]] = [[] for _ in weights]
        for k, (start, width) in enumerate(blocks):
            values = self.load(row, start, width)
            for m, factor in enumerate(factors):
                factors_k = self.broadcast(factor, width)
                totals[m].append(self.multiply_add(values, factors_k, partial[m][k], width))
        next_j = builder.add(j, ir.Constant(_INDEX, 1))
        j.add_incoming(next_j, body)
        builder.cbranch(builder.icmp_signed("<", next_j, count), body, after)

        builder.position_at_end(after)
        final: list[list[Any]] = [[] for _ in weights]
        for m, (phis, sums) in enumerate(zip(partial, totals, strict=True)):
            for (_, width), phi, total in zip(blocks, phis, sums, strict=True):
                value = builder.phi(self.type_of(width))
                for incoming in (phi, value):
                    incoming.add_incoming(self.constant(0.0, width), before)
                    incoming.add_incoming(total, body)
                final[m].append(value)
        return final

    def sum_of_squares(self, values: Sequence[Any], n: int) -> Any:
        """Return the sum of the squares of ``n`` numbers in vectors as of :meth:`blocks`."""
        squares: dict[int, Any] = {}  # by width
        for (_, width), value in zip(self.blocks(n), values, strict=True):
            before = squares.get(width, self.constant(0.0, width))
            squares[width] = self.multiply_add(value, value, before, width)
        lanes = [self.lane(v, k, width) for width, v in squares.items() for k in range(width)]
        return functools.reduce(self.add, lanes)


def function_type(generate: Callable[..., Any], results: int) -> Any:
    """Return Numba's type of a function whose LLVM code ``generate`` writes.

    ``generate`` receives a :class:`VectorCode` and the arguments of the function: an array as
    :class:`NumberArray`, a number as value of LLVM, an integer that is known when compiling as
    Python integer, and None as None.  It returns a sequence of ``results`` numbers (values of
    LLVM), or None if ``results`` is 0.
    """

    def definition(typingctx: Any, *kinds: Any) -> Any:
        known = [_argument_type(kind) for kind in kinds]
        returned = types.UniTuple(types.float64, results) if results else types.void

        def write(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
            def taken(kind: Any, value: Any) -> Any:
                if isinstance(kind, types.IntegerLiteral):
                    return kind.literal_value
                if isinstance(kind, types.Array):
                    array = context.make_array(kind)(context, builder, value)
                    return NumberArray(array.data, builder.extract_value(array.strides, 0))
                return None if isinstance(kind, types.NoneType) else value

            given = map(taken, signature.args, arguments)
            found = generate(VectorCode(builder), *given)
            if not results:
                return context.get_dummy_value()
            return context.make_tuple(builder, signature.return_type, list(found))

        return returned(*known), write

    own = inspect.signature(generate)
    definition.__signature__ = own  # type: ignore[attr-defined]
    definition.__name__ = generate.__name__
    return types.Function(
        make_intrinsic_template(definition, definition, generate.__name__, prefer_literal=True)
    )


def _argument_type(kind: Any) -> Any:
    """Return the type as which an argument is passed."""
    if isinstance(kind, types.Float):
        return types.float64
    if isinstance(kind, types.Integer) and not isinstance(kind, types.IntegerLiteral):
        return types.intp
    return kind
