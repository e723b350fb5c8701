"""The bench with SUNDIALS' CVODE, a library in C, without Python between its steps.

CVODE locates the events itself (its root finding) and is restarted at each of them.  The
right-hand side is the engine's own, handed over as a C function.  The library is that in the wheels
of scikit-SUNDAE; its Python is not used.
"""

from __future__ import annotations

import ctypes
import functools
import importlib.metadata
import importlib.util
import math
from collections.abc import Callable
from ctypes import POINTER, byref, c_double, c_int, c_int64, c_long, c_void_p
from pathlib import Path
from typing import Any

import numpy as np
from numba import carray, cfunc, njit

from benchmarks.engines.own import packed
from benchmarks.engines.scipy_ivp import JUST_OFF
from benchmarks.trial import TOUCHED, Outcome
from capture_sim.base.compiled.kernels import kernel
from capture_sim.dynamics.engine.step_length import error_scale
from capture_sim.dynamics.model.equations import (
    N_STATE,
    N_TOTAL,
    SYSTEM,
    gap_and_rate,
    make_system,
    rate_of_change,
    tip_in_cone,
)
from capture_sim.scene.parts import Scene

#: CVODE's linear multistep methods, by its own numbers.
METHODS = {"Adams": 1, "BDF": 2}
_NORMAL, _ROOT_RETURN = 1, 2
_MAX_STEPS = 1_000_000
_ROOM = 4096  # touches
_FULL = -1000  # status of a run that has more; CVODE's own are above
#: What CVODE hands to the C functions: the system, and room for one evaluation.
_DATA = np.dtype([("system", SYSTEM), ("f", "f8", (N_TOTAL,))], align=True)


@kernel
def wall_gap(y, par, wall):
    """Return a wall's gap (m) and its rate (m/s)."""
    px, py, wx, wy = tip_in_cone(y, par)
    gap, rate, _, _ = gap_and_rate(px, py, wx, wy, 1.0 - 2.0 * wall, par)
    return gap, rate


def version() -> str:
    """Return the version of the wheel; empty if it is not installed."""
    try:
        return importlib.metadata.version("scikit-sundae")
    except importlib.metadata.PackageNotFoundError:
        return ""


@functools.cache
def _library(name: str) -> ctypes.CDLL:
    found = importlib.util.find_spec("sksundae")
    assert found is not None
    assert found.origin is not None
    folder = Path(found.origin).parents[1] / "scikit_sundae.libs"
    (path,) = folder.glob(f"libsundials_{name}-*.so*")
    return ctypes.CDLL(str(path))


def _function(library: str, name: str, result: Any, *arguments: Any) -> Any:
    function = _library(library)[name]
    function.restype, function.argtypes = result, arguments
    return function


@functools.cache
def _compiled() -> tuple[Any, Any, Any]:
    """Return the right-hand side and the gaps as C functions, and the compiled loop."""
    array_of = _function("core", "N_VGetArrayPointer", POINTER(c_double), c_void_p)
    # all pointers: CVode(memory, t_out, y, t, task) and what a restart needs
    cvode = _function("cvode", "CVode", c_int, c_void_p, c_double, c_void_p, c_void_p, c_int)
    restart = _function("cvode", "CVodeReInit", c_int, c_void_p, c_double, c_void_p)
    direct = _function("cvode", "CVodeSetRootDirection", c_int, c_void_p, c_void_p)
    roots = _function("cvode", "CVodeGetRootInfo", c_int, c_void_p, c_void_p)
    evaluations = _function("cvode", "CVodeGetNumRhsEvals", c_int, c_void_p, c_void_p)
    for_jacobian = _function("cvode", "CVodeGetNumLinRhsEvals", c_int, c_void_p, c_void_p)

    @cfunc("int32(float64, voidptr, voidptr, voidptr)")
    def rhs(t, y, f, data):
        record = carray(data, (1,), _DATA)[0]
        rate_of_change(t, carray(array_of(y), (N_STATE,)), record.f, record.system)
        rates = carray(array_of(f), (N_STATE,))
        for i in range(N_STATE):
            rates[i] = record.f[i]
        return 0

    @cfunc("int32(float64, voidptr, CPointer(float64), voidptr)")
    def gaps(_t, y, values, data):
        system = carray(data, (1,), _DATA)[0].system
        state, gap = carray(array_of(y), (N_STATE,)), carray(values, (2,))
        for wall in range(2):
            zero = JUST_OFF if system.mode.touch[wall].on else 0.0
            gap[wall] = wall_gap(state, system.par, wall)[0] - zero
        return 0

    @njit
    def solve(
        data, memory, vector, y, t_end, touches, latest, signs, found, t, count, has_jacobian
    ):
        system, n_touches, total = data[0].system, 0, 0
        touch = system.mode.touch
        while True:
            for wall in range(2):
                signs[wall] = 1 if touch[wall].on else -1
            direct(memory, signs.ctypes)
            status = cvode(memory, t_end, vector, t.ctypes, _NORMAL)
            evaluations(memory, count.ctypes)
            total += count[0]
            if has_jacobian:
                for_jacobian(memory, count.ctypes)
                total += count[0]
            if status != _ROOT_RETURN:
                return status, n_touches, total
            roots(memory, found.ctypes)
            for wall in range(2):
                if found[wall] == 0:
                    continue
                if touch[wall].on:
                    touch[wall].on = 0
                    touch[wall].chi = 0.0
                    touches[latest[wall], 1] = t[0]
                elif n_touches == _ROOM:
                    return _FULL, n_touches, total
                else:
                    _, rate = wall_gap(y, system.par, wall)
                    touch[wall].on = 1
                    hysteresis = system.par.hysteresis * system.par.contact.stiffness
                    touch[wall].chi = hysteresis / max(-rate, system.par.v_0_floor)
                    touches[n_touches, 0], touches[n_touches, 1] = t[0], math.nan
                    touches[n_touches, 2] = 1.0 - 2.0 * wall
                    latest[wall] = n_touches
                    n_touches += 1
            restart(memory, t[0], vector)

    return rhs, gaps, solve


class _Solver:
    """CVODE's memory for one run."""

    def __init__(self, scene: Scene, method: str) -> None:
        parameters = packed(scene)
        self.data = np.zeros(1, _DATA)
        self.data["system"] = make_system(parameters)
        self.y = np.concatenate(scene.initial_coordinates())
        weights = error_scale(parameters[0])[:N_STATE].copy()
        rhs, gaps, _ = _compiled()
        context, pointer = c_void_p(), c_void_p
        _function("core", "SUNContext_Create", c_int, c_int, pointer)(0, byref(context))
        make = _function("cvode", "N_VMake_Serial", pointer, c_int64, pointer, pointer)
        self.vector = make(N_STATE, self.y.ctypes.data, context)
        tolerances = make(N_STATE, weights.ctypes.data, context)
        create = _function("cvode", "CVodeCreate", pointer, c_int, pointer)
        self.memory = create(METHODS[method], context)

        def call(name: str, *values: Any) -> None:
            kinds = [c_double if isinstance(value, float) else pointer for value in values]
            if name == "CVodeSetMaxNumSteps":
                kinds = [c_long]
            elif name == "CVodeRootInit":
                kinds[0] = c_int
            status = _function("cvode", name, c_int, pointer, *kinds)(self.memory, *values)
            assert status == 0, f"{name}: {status}"

        call("CVodeInit", rhs.address, 0.0, self.vector)
        call("CVodeSVtolerances", 0.0, tolerances)
        call("CVodeSetUserData", self.data.ctypes.data)
        call("CVodeSetMaxNumSteps", _MAX_STEPS)
        call("CVodeSetStopTime", scene.run.t_end)
        call("CVodeRootInit", 2, gaps.address)
        if method == "BDF":
            matrix = _function("cvode", "SUNDenseMatrix", pointer, c_int64, c_int64, pointer)
            jacobian = matrix(N_STATE, N_STATE, context)
            dense = _function("cvode", "SUNLinSol_Dense", pointer, pointer, pointer, pointer)
            call("CVodeSetLinearSolver", dense(self.vector, jacobian, context), jacobian)
        else:
            fixed = _function("cvode", "SUNNonlinSol_FixedPoint", pointer, pointer, c_int, pointer)
            call("CVodeSetNonlinearSolver", fixed(self.vector, 0, context))
        self._kept = weights, context  # CVODE has their addresses


def prepare(scene: Scene, method: str) -> tuple[Callable[[], Any], Callable[[Any], Outcome]]:
    """Set a run up at the scene's ``run.rtol``; return what runs it and what reads the outcome."""
    solver, touches = _Solver(scene, method), np.zeros((_ROOM, 3))
    latest, t, count = np.zeros(2, np.int64), np.zeros(1), np.zeros(1, np.int64)
    signs, found = np.zeros(2, np.int32), np.zeros(2, np.int32)
    solve = _compiled()[2]

    def run() -> tuple[int, int, int]:
        result: tuple[int, int, int] = solve(
            *(solver.data, solver.memory, solver.vector, solver.y, scene.run.t_end, touches),
            *(latest, signs, found, t, count, method == "BDF"),
        )
        return result

    def read(result: tuple[int, int, int]) -> Outcome:
        status, n_touches, evaluations = result
        if status == _FULL:
            return Outcome.failed(f"more than {_ROOM} touches", evaluations)
        if status < 0:
            return Outcome.failed(f"CVODE stopped with status {status}", evaluations)
        rows = np.zeros(n_touches, TOUCHED)
        rows["start"], rows["end"], rows["wall"] = touches[:n_touches].T
        rows["peak_force"] = np.nan
        return Outcome(q=solver.y[:8].copy(), evaluations=evaluations, touches=rows)

    return run, read
