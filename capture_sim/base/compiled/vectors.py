"""Vector registers in kernels: what Numba's compiler does not make of scalar code by itself."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from llvmlite import ir
from numba import config, types
from numba.core import cgutils
from numba.extending import intrinsic

from capture_sim.base.compiled import compiler
from capture_sim.base.compiled.kernels import kernel

LANES = 4  # doubles in a vector register of AVX2; wider ones gain nothing at these lengths
_FLAGS = ("contract", "nsz")
_DOUBLE, _INDEX, _LANE = ir.DoubleType(), ir.IntType(64), ir.IntType(32)

#: True if kernels can have code of their own; else their scalar versions are used.
HAS_VECTORS = not config.DISABLE_JIT and compiler.internals is not None


class VectorCode:
    """Writes LLVM's code for the arguments of an intrinsic, arrays and numbers of float64."""

    def __init__(self, context: Any, builder: Any, signature: Any, arguments: Any) -> None:
        self.context, self.builder = context, builder
        self.signature, self.arguments = signature, arguments

    def data(self, i: int) -> Any:
        """Return the pointer to the numbers of argument ``i``, an array."""
        return self._array(i).data

    def row_bytes(self, i: int) -> Any:
        """Return the bytes from one row of argument ``i`` to the next."""
        return self.builder.extract_value(self._array(i).strides, 0)

    def _array(self, i: int) -> Any:
        make = self.context.make_array(self.signature.args[i])
        return make(self.context, self.builder, self.arguments[i])

    @staticmethod
    def type_of(width: int) -> Any:
        """Return the type of ``width`` numbers."""
        return _DOUBLE if width == 1 else ir.VectorType(_DOUBLE, width)

    def zero(self, width: int) -> Any:
        """Return zeros."""
        return ir.Constant(self.type_of(width), None if width > 1 else 0.0)

    def constant(self, value: float, width: int) -> Any:
        """Return a constant ``width`` times."""
        kind = self.type_of(width)
        return ir.Constant(kind, value if width == 1 else width * [value])

    def _place(self, pointer: Any, start: int, width: int) -> Any:
        element = self.builder.gep(pointer, [ir.Constant(_INDEX, start)])
        return self.builder.bitcast(element, self.type_of(width).as_pointer())

    def load(self, pointer: Any, start: int, width: int) -> Any:
        """Return ``width`` numbers from number ``start`` on."""
        value = self.builder.load(self._place(pointer, start, width))
        value.align = 8
        return value

    def store(self, value: Any, pointer: Any, start: int, width: int) -> None:
        """Write ``width`` numbers from number ``start`` on."""
        self.builder.store(value, self._place(pointer, start, width)).align = 8

    def vector(self, values: Sequence[Any]) -> Any:
        """Return numbers as one vector."""
        result = ir.Constant(self.type_of(len(values)), ir.Undefined)
        for k, value in enumerate(values):
            result = self.builder.insert_element(result, value, ir.Constant(_LANE, k))
        return result

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

    def subtract(self, a: Any, b: Any) -> Any:
        """Return a - b."""
        return self.builder.fsub(a, b, flags=_FLAGS)

    def multiply(self, a: Any, b: Any) -> Any:
        """Return a b."""
        return self.builder.fmul(a, b, flags=_FLAGS)

    def divide(self, a: Any, b: Any) -> Any:
        """Return a / b."""
        return self.builder.fdiv(a, b, flags=_FLAGS)

    def root(self, a: Any, width: int) -> Any:
        """Return the square root of a vector."""
        kind = self.type_of(width)
        name = "llvm.sqrt.f64" if width == 1 else f"llvm.sqrt.v{width}f64"
        declare = cgutils.get_or_insert_function
        function = declare(self.builder.module, ir.FunctionType(kind, [kind]), name)
        return self.builder.call(function, [a])


@intrinsic(prefer_literal=True)
def _write_four(typingctx: Any, out: Any, start: Any, a: Any, b: Any, c: Any, d: Any) -> Any:
    """Write four numbers into out[start : start + 4] at once.

    Four numbers that are written one by one, and read as a vector soon after, are late: the
    processor must first write each of them to its cache.
    """
    if not isinstance(start, types.IntegerLiteral):
        return None
    signature = types.void(out, start, *4 * [types.float64])
    first = start.literal_value

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        code = VectorCode(context, builder, signature, arguments)
        code.store(code.vector(arguments[2:]), code.data(0), first, 4)
        return context.get_dummy_value()

    return signature, generate


@kernel
def _write_one_by_one(out, start, a, b, c, d):  # type: ignore[no-untyped-def]
    """Do what :func:`_write_four` does."""
    out[start] = a
    out[start + 1] = b
    out[start + 2] = c
    out[start + 3] = d


def vectorized(code: Any, scalar: Any) -> Any:
    """Return an intrinsic, or the kernel that does the same with scalars if it cannot be used."""
    if not HAS_VECTORS:
        return scalar
    code.scalar = scalar
    return code


write_four = vectorized(_write_four, _write_one_by_one)
