"""Counts the arithmetic of one evaluation of the equations of motion.

The kernels are run as the Python functions that they were made from, with numbers that count
what is done with them.
"""

from __future__ import annotations

import math
from collections import Counter
from types import FunctionType, SimpleNamespace
from typing import Any

import numpy as np

from benchmarks.engines.problems import into_wall, packed
from capture_sim.model import equations
from capture_sim.scene.parts import Scene

tally: Counter[str] = Counter()


class Counted(float):
    """A number that counts its operations."""

    def _count(self, what: str, value: Any) -> Any:
        tally[what] += 1
        return Counted(value)

    def __add__(self, other: Any) -> Any:
        return self._count("add", float(self) + float(other))

    def __sub__(self, other: Any) -> Any:
        return self._count("add", float(self) - float(other))

    def __rsub__(self, other: Any) -> Any:
        return self._count("add", float(other) - float(self))

    def __mul__(self, other: Any) -> Any:
        return self._count("multiply", float(self) * float(other))

    def __truediv__(self, other: Any) -> Any:
        return self._count("divide", float(self) / float(other))

    def __rtruediv__(self, other: Any) -> Any:
        return self._count("divide", float(other) / float(self))

    def __neg__(self) -> Any:
        return Counted(-float(self))

    def __abs__(self) -> Any:
        return Counted(abs(float(self)))

    __radd__ = __add__
    __rmul__ = __mul__
    __hash__ = float.__hash__


def _watched(name: str) -> Any:
    function = getattr(math, name)

    def call(*values: Any) -> Any:
        tally[name] += 1
        return Counted(function(*map(float, values)))

    return call


_library = SimpleNamespace(**vars(math))
for _name in ("sqrt", "tanh", "sin", "cos", "hypot"):
    setattr(_library, _name, _watched(_name))


def plain(kernel: Any) -> Any:
    """Return a compiled kernel as the Python function that it was made from, counting.

    So are the kernels that it calls.
    """
    function = kernel.py_func
    names = dict(function.__globals__)
    for name in function.__code__.co_names:
        value = names.get(name)
        if value is math:
            names[name] = _library
        elif hasattr(value, "py_func"):
            names[name] = plain(value)
    return FunctionType(function.__code__, names)


def count(scene: Scene) -> dict[str, dict[str, int]]:
    """Return how often an evaluation adds, multiplies, divides, ..., in "free" and "contact".

    The scene stands as at its release, with the tip 3 um deep in the -y wall for "contact".
    """
    record = packed(scene)
    values = {name: record[name][0] for name in record.dtype.names or ()}
    par = SimpleNamespace(
        **{k: Counted(v) if isinstance(v, np.floating) else v for k, v in values.items()}
    )
    q, v = scene.initial_coordinates()
    mode = SimpleNamespace()
    for name in equations.MODE.names or ():
        shape = equations.MODE[name].shape
        setattr(mode, name, [0] * shape[0] if shape else 0)
    mode.chi = [Counted(1e9)] * 2
    rate_of_change = plain(equations.rate_of_change)
    counts = {}
    for phase, touching in (("free", [0, 0]), ("contact", [0, 1])):
        mode.touching = touching
        q[0] = into_wall(scene) if phase == "contact" else q[0]
        y = [Counted(value) for value in (*q, *v, *[0.0] * (equations.N_TOTAL - 16))]
        f = [Counted(0.0)] * equations.N_TOTAL
        scratch = [Counted(0.0)] * equations.N_SCRATCH
        tally.clear()
        rate_of_change(0.0, y, f, par, mode, scratch)
        counts[phase] = dict(tally)
    return counts
