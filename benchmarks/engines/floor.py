"""The floor: the bare loop that a specialist would write for one scene, in C++.

``floor.cpp`` has DOP853 over 16 states with located events, and equations without energy ledger;
what a run of capture_sim needs more is the price of what it computes besides.  Made with the C++
compiler that setting up needs, for this processor.
"""

from __future__ import annotations

import ctypes
import functools
import hashlib
import os
import subprocess
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from scipy.integrate._ivp import dop853_coefficients as table

from benchmarks.engines.own import packed
from benchmarks.trial import TOUCHED, Outcome
from capture_sim.dynamics.engine.step_length import error_scale
from capture_sim.scene.laws import FrictionLaw
from capture_sim.scene.parts import HERTZ, Scene

_SOURCE = Path(__file__).with_name("floor.cpp")
_BUILD = Path(__file__).resolve().parents[2] / "build" / "floor"
_OPTIONS = ("-O3", "-march=native", "-ffp-contract=fast", "-fno-math-errno", "-fno-trapping-math")
_ROOM = 4096  # touches
#: The fields of the C++ struct, by their names in PARAMETERS.
_FIELDS = (
    *("m_S", "I_S", "m_C", "m_P", "m_T", "I_T", "a", "first_moment_0", "hinge_inertia_0", "d"),
    *("k_A", "c_A", "k_T", "c_T", "h_0", "R_t", "L_T", "R_c", "L_c", "cos_b", "sin_b", "K"),
    *("hysteresis", "v_0_floor", "mu", "inverse_v_eps"),
)


def _terms(weights: np.ndarray) -> str:
    """Return a sum of rows of K in C++, without those of weight zero."""
    return " + ".join(f"{w!r} * K[{j}][i]" for j, w in enumerate(weights.tolist()) if w)


_HEADER = """\
// Written by floor.py from SciPy's coefficients.
using Stages = double[ROWS][N];

inline void stage_sum(int s, const double* y, const Stages& K, double h, double* out) {
    switch (s) {
%(stages)s
    }
}

inline void error_sums(const Stages& K, const double* weights, double* a, double* b) {
    double fives[N], threes[N];
    for (int i = 0; i < N; ++i) fives[i] = weights[i] * (%(five)s);
    for (int i = 0; i < N; ++i) threes[i] = weights[i] * (%(three)s);
    for (int i = 0; i < N; ++i) *a += fives[i] * fives[i];
    for (int i = 0; i < N; ++i) *b += threes[i] * threes[i];
}

inline void dense_rows(const double* y, const double* y_new, const Stages& K, double h,
                       double F[7][N]) {
    for (int i = 0; i < N; ++i) {
        const double change = y_new[i] - y[i];
        F[0][i] = change;
        F[1][i] = h * K[0][i] - change;
        F[2][i] = 2.0 * change - h * (K[12][i] + K[0][i]);
%(dense)s
    }
}
"""


def _header() -> str:
    """Return the text of dop853_sums.h."""
    case = "    case {}: for (int i = 0; i < N; ++i) out[i] = y[i] + h * ({}); break;"
    row = "        F[{}][i] = h * ({});"
    return _HEADER % {
        "stages": "\n".join(case.format(s, _terms(table.A[s])) for s in range(1, 16)),
        "five": _terms(table.E5),
        "three": _terms(table.E3),
        "dense": "\n".join(row.format(3 + k, _terms(table.D[k])) for k in range(4)),
    }


@functools.cache
def _solver() -> Any:
    """Return the compiled loop."""
    text = _header()
    compiler = os.environ.get("CXX", "g++")
    name = hashlib.sha256(f"{compiler}{_OPTIONS}{text}{_SOURCE.read_text()}".encode()).hexdigest()
    library = _BUILD / f"floor_{name[:16]}.so"
    if not library.exists():
        _BUILD.mkdir(parents=True, exist_ok=True)
        (_BUILD / "dop853_sums.h").write_text(text)
        made = library.with_suffix(f".{os.getpid()}")
        command = [compiler, *_OPTIONS, "-shared", "-fPIC", f"-I{_BUILD}", "-o", str(made)]
        subprocess.run([*command, str(_SOURCE)], check=True)
        made.rename(library)
    solve = ctypes.CDLL(str(library)).solve
    solve.restype = ctypes.c_long
    return solve


def check(parameters: Mapping[str, Any], scene: Scene) -> None:
    """Raise a ValueError for a scene of which the loop lacks a part."""
    has = ("has_supports", "has_latch", "has_stops", "has_shaped_buffer")
    missing = [name for name in has if parameters[name]]
    if missing or scene.rail is not None or parameters["contact"]["exponent"] != HERTZ:
        raise ValueError(f"the floor has no {', '.join(missing) or 'rail'}: {scene.name}")
    if parameters["friction_law"] != FrictionLaw.TANH:
        raise ValueError(f"the floor has the friction law tanh only: {scene.name}")


def prepare(scene: Scene) -> tuple[Callable[[], Any], Callable[[Any], Outcome]]:
    """Set a run up at the scene's ``run.rtol``; return what runs it and what reads the outcome."""
    par = packed(scene)[0]
    check(par, scene)
    given = {"K": par["contact"]["stiffness"]}
    constants = np.array([float(given[n] if n in given else par[n]) for n in _FIELDS])
    y = np.concatenate(scene.initial_coordinates())
    weights, touches = 1.0 / error_scale(par)[:16], np.zeros((_ROOM, 3))
    evaluations, solve = ctypes.c_long(0), _solver()
    arguments = (
        *(ctypes.c_void_p(array.ctypes.data) for array in (constants, y, weights)),
        ctypes.c_double(scene.run.t_end),
        ctypes.c_void_p(touches.ctypes.data),
        ctypes.c_long(_ROOM),
        ctypes.byref(evaluations),
    )

    def read(count: int) -> Outcome:
        if count < 0:
            reason = "the step fell below 1e-15 s" if count == -1 else f"more than {_ROOM} touches"
            return Outcome.failed(reason, evaluations.value)
        rows = np.zeros(count, TOUCHED)
        rows["start"], rows["end"], rows["wall"] = touches[:count].T
        rows["peak_force"] = np.nan
        return Outcome(q=y[:8].copy(), evaluations=evaluations.value, touches=rows)

    def run(_kept: object = (constants, y, weights, touches)) -> Any:
        return solve(*arguments)  # which has only their addresses

    return run, read
