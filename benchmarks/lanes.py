"""Whether several runs in the lanes of a vector unit would pay: the equations alone.

    python -m benchmarks.lanes

An evaluation of the equations of ``paper_designed`` within a touch, in CPU time of one thread:

- the kernels' own text, for one state after the other;
- the same text called in a loop over the states, as a compiler may vectorise it;
- a second text, written for lanes: the states in columns, a selection in place of each branch.

The second text has one wall's touch, the buffer and nothing else.  It is compared with the kernels
before it is timed.  A run of the same scene shows which share of its time the equations take.
Writes a part of docs/model.md.
"""

from __future__ import annotations

import math
import statistics
import time
from argparse import Namespace
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numba
import numpy as np

from benchmarks.costs import run_cost
from benchmarks.pages import ratio, table, write_parts
from capture_sim.base.compiled.kernels import entry_kernel, records
from capture_sim.dynamics.model.equations import (
    AXIAL,
    FRICTION,
    HYSTERESIS,
    IMPULSE,
    N_TOTAL,
    TORSION,
    make_system,
    rate_of_change,
)
from capture_sim.dynamics.model.parameters import pack
from capture_sim.scene.loading import load_scene

SCENE = "paper_designed"
#: States that one call evaluates, and evaluations of each that one timing has.
STATES, EVALUATIONS = 64, 4_000
#: Timings of each program, in turn.
ROUNDS = 15
#: Runs in which the share of the equations is measured: end, s, and tolerances.
HORIZON, RTOLS = 0.35, (1e-6, 1e-10)
#: Largest difference of the two texts, relative to the largest value of the derivative.
AGREEMENT = 1e-11


@entry_kernel
def one_by_one(states, rates, systems, evaluations):
    """Evaluate one state after the other by the kernels' text, each many times."""
    for i in range(states.shape[0]):
        for _ in range(evaluations):
            rate_of_change(0.0, states[i], rates[i], systems[i])
            states[i, 0] += 1e-18 * rates[i, 8]  # an evaluation waits for the one before


@entry_kernel
def in_a_loop(states, rates, systems, evaluations):
    """Evaluate all states in an inner loop by the kernels' text."""
    for _ in range(evaluations):
        for i in range(states.shape[0]):
            rate_of_change(0.0, states[i], rates[i], systems[i])
            states[i, 0] += 1e-18 * rates[i, 8]


def over_lanes(lanes: int) -> Callable[..., None]:
    """Return a compiled function for states in columns, ``lanes`` at a time."""
    powers_of_2 = 2.0 ** np.arange(64)

    @numba.njit(inline="always")
    def sine_cosine(x: Any) -> Any:  # of an angle below pi / 4: none here is larger
        z = x * x
        w = z * z
        s = (-1.66666666666666324348e-01 + z * 8.33333333332248946124e-03) + w * (
            (-1.98412698298579493134e-04 + z * 2.75573137070700676789e-06)
            + w * (-2.50507602534068634195e-08 + z * 1.58969099521155010221e-10)
        )
        c = (4.16666666666666019037e-02 + z * -1.38888888888741095749e-03) + w * (
            (2.48015872894767294178e-05 + z * -2.75573143513906633035e-07)
            + w * (2.08757232129817482790e-09 + z * -1.13596475577881948265e-11)
        )
        half = 0.5 * z
        top = 1.0 - half
        return x + x * z * s, top + (((1.0 - top) - half) + w * c)

    @numba.njit(inline="always")
    def hyperbolic_tangent(x: Any) -> Any:
        size = min(abs(x), 20.0)
        z = size * size
        top = 135135.0 + z * (17325.0 + z * (378.0 + z))
        bottom = 135135.0 + z * (62370.0 + z * (3150.0 + z * 28.0))
        near = size * top / bottom
        y = 2.0 * size
        n = math.floor(y * 1.44269504088896338700 + 0.5)
        r = y - n * 6.93147180369123816490e-01 - n * 1.90821492927058770002e-10
        r2 = r * r
        r4 = r2 * r2
        low = (1.0 + r) + r2 * (1.0 / 2.0 + r * (1.0 / 6.0))
        middle = (1.0 / 24.0 + r * (1.0 / 120.0)) + r2 * (1.0 / 720.0 + r * (1.0 / 5040.0))
        high = (1.0 / 40320.0 + r * (1.0 / 362880.0)) + r2 * (
            1.0 / 3628800.0 + r * (1.0 / 39916800.0)
        )
        power = low + r4 * (middle + r4 * (high + r4 * (1.0 / 479001600.0)))
        far = 1.0 - 2.0 / (power * powers_of_2[int(n)] + 1.0)
        value = near if size < 0.45 else far
        return value if x > 0.0 else -value

    @numba.njit(error_model="numpy", fastmath={"contract", "nsz"})
    def evaluate(Y: Any, F: Any, chi: Any, p: Any, evaluations: Any) -> None:
        a, m_C, m_P, d, h_0 = p.a, p.m_C, p.m_P, p.d, p.h_0
        first_moment_0, hinge_inertia_0 = p.first_moment_0, p.hinge_inertia_0
        L_T, R_c, R_t, cos_b, sin_b = p.L_T, p.R_c, p.R_t, p.cos_b, p.sin_b
        K, mu, inverse_v_eps = p.K, p.mu, p.inverse_v_eps
        k_A, c_A, c_A_rebound, k_T, c_T = p.k_A, p.c_A, p.c_A_rebound, p.k_T, p.c_T
        I_S, m_total = p.I_S, p.m_total
        inverse_m_SC, inverse_m_P = p.inverse_m_SC, p.inverse_m_P
        inverse_m_T, inverse_I_T = p.inverse_m_T, p.inverse_I_T
        m_CP = m_C + m_P
        for block in range(Y.shape[0]):
            y, f, x = Y[block], F[block], chi[block]
            for _ in range(evaluations):
                for i in range(lanes):
                    omega, spin, rate, h = (
                        y[10 * lanes + i],
                        y[11 * lanes + i],
                        y[12 * lanes + i],
                        y[4 * lanes + i],
                    )
                    sS, cS = sine_cosine(y[2 * lanes + i])
                    sP, cP = sine_cosine(y[3 * lanes + i])
                    sT, cT = sine_cosine(y[7 * lanes + i])
                    cD = cP * cS + sP * sS
                    sD = sP * cS - cP * sS
                    r = h - d
                    moment = first_moment_0 + m_P * h
                    inverse_P = 1.0 / (hinge_inertia_0 + m_P * r * r)
                    swing, turn = a * omega, h * spin
                    rx = y[i] + a * cS + h * cP - y[5 * lanes + i]
                    ry = y[1 * lanes + i] + a * sS + h * sP - y[6 * lanes + i]
                    ux = y[8 * lanes + i] - swing * sS + rate * cP - turn * sP - y[13 * lanes + i]
                    uy = y[9 * lanes + i] + swing * cS + rate * sP + turn * cP - y[14 * lanes + i]
                    px = cT * rx + sT * ry
                    py = cT * ry - sT * rx
                    wx = cT * ux + sT * uy + y[15 * lanes + i] * py
                    wy = cT * uy - sT * ux - y[15 * lanes + i] * px
                    # the face of the wall on +y
                    gap = (-(px + L_T) * sin_b - (py - R_c) * cos_b) - R_t
                    nx, ny = -sin_b, -cos_b
                    gap_rate = nx * wx + ny * wy
                    depth = max(-gap, 0.0)
                    shape = depth * math.sqrt(depth)
                    elastic = K * shape
                    force = max(elastic - x[i] * shape * gap_rate, 0.0)
                    slip = wy * nx - wx * ny - (gap + R_t) * (spin - y[15 * lanes + i])
                    friction = -force * (mu * hyperbolic_tangent(slip * inverse_v_eps))
                    dist = gap + R_t
                    fx = force * nx - friction * ny
                    fy = force * ny + friction * nx
                    tip = -dist * friction
                    target = -((px - dist * nx) * fy - (py - dist * ny) * fx)
                    gx = cT * fx - sT * fy
                    gy = sT * fx + cT * fy
                    f_u = gx * cP + gy * sP
                    f_w = gy * cP - gx * sP
                    damping = c_A_rebound if rate > 0.0 else c_A
                    axial = -k_A * (h - h_0) - damping * rate
                    twist = spin - omega
                    torque = -k_T * (y[3 * lanes + i] - y[2 * lanes + i]) - c_T * twist
                    w2, s2 = a * omega * omega, spin * spin
                    coriolis = 2.0 * m_P * rate * spin
                    R_u = f_u + m_CP * w2 * cD + moment * s2
                    R_w = f_w - m_CP * w2 * sD - coriolis
                    R_S = a * (sD * R_u + cD * R_w) - torque
                    R_P = h * f_w + tip + torque - moment * w2 * sD - coriolis * r
                    R_h = f_u + axial + m_P * (w2 * cD + r * s2)
                    part = moment * inverse_P
                    reduced_u = R_u - R_h
                    reduced_w = R_w - part * R_P
                    reduced_S = R_S - a * (cD * part * R_P + sD * R_h)
                    coupled = moment * part
                    S_uS = m_C * a * sD
                    S_wS = a * cD * (m_CP - coupled)
                    S_S = I_S + a * a * (m_CP - cD * cD * coupled - m_P * sD * sD)
                    e_u = S_uS * inverse_m_SC
                    e_w = S_wS / (m_total - coupled)
                    inverse_S = 1.0 / (S_S - e_u * S_uS - e_w * S_wS)
                    alpha = (reduced_S - e_u * reduced_u - e_w * reduced_w) * inverse_S
                    acc_u = reduced_u * inverse_m_SC - e_u * alpha
                    acc_w = reduced_w / (m_total - coupled) - e_w * alpha
                    f[8 * lanes + i] = acc_u * cP - acc_w * sP
                    f[9 * lanes + i] = acc_u * sP + acc_w * cP
                    f[10 * lanes + i] = alpha
                    f[11 * lanes + i] = (R_P - moment * (acc_w + a * cD * alpha)) * inverse_P
                    f[12 * lanes + i] = R_h * inverse_m_P - (acc_u + a * sD * alpha)
                    f[13 * lanes + i] = -gx * inverse_m_T
                    f[14 * lanes + i] = -gy * inverse_m_T
                    f[15 * lanes + i] = target * inverse_I_T
                    f[16 * lanes + i] = damping * rate * rate
                    f[17 * lanes + i] = c_T * twist * twist
                    f[18 * lanes + i] = -(force - elastic) * gap_rate
                    f[20 * lanes + i] = -friction * slip
                    f[24 * lanes + i] = force
                    y[i] += 1e-18 * f[8 * lanes + i]
                for k in range(8):
                    for i in range(lanes):
                        f[k * lanes + i] = y[(8 + k) * lanes + i]

    return evaluate


def touching_states(parameters: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return states (n, 26) within a touch of the +y wall's face, and their systems (n,)."""
    p = parameters[0]
    random = np.random.default_rng(1)
    states = np.zeros((STATES, N_TOTAL))
    systems = np.concatenate([make_system(parameters) for _ in range(STATES)])
    for y, system in zip(states, systems, strict=True):
        y[[2, 3, 7]] = random.uniform(-0.3, 0.3, 3)
        y[4] = p["h_0"] - random.uniform(0.0, 0.01)
        y[8:16] = random.uniform(-0.1, 0.1, 8)
        # the tip's centre in the target's frame: on the face, less a penetration
        along = random.uniform(0.2, 0.8) * p["L_c"]
        inside = p["R_t"] - random.uniform(1e-6, 2e-5)
        px = -p["L_T"] - along * p["cos_b"] - inside * p["sin_b"]
        py = p["R_c"] + along * p["sin_b"] - inside * p["cos_b"]
        c, s = math.cos(y[7]), math.sin(y[7])
        y[0] = c * px - s * py - p["a"] * math.cos(y[2]) - y[4] * math.cos(y[3])
        y[1] = s * px + c * py - p["a"] * math.sin(y[2]) - y[4] * math.sin(y[3])
        touch = system["mode"]["touch"][0]
        touch["on"], touch["chi"] = 1, random.uniform(0.2, 2.0) * p["K"]
    return states, records(systems)


def _columns(rows: np.ndarray, lanes: int) -> np.ndarray:
    """Return (blocks, fields * lanes) of (n, fields): the lanes of a field are side by side."""
    blocks = rows.reshape(STATES // lanes, lanes, -1).transpose(0, 2, 1)
    return np.ascontiguousarray(blocks).reshape(STATES // lanes, -1)


def equations(_: Namespace, __: Path) -> list[str]:
    """Nanoseconds of an evaluation, and against the kernels' text."""
    parameters = pack(load_scene(SCENE), 0.0, 0.0)
    states, systems = touching_states(parameters)
    rates = np.zeros_like(states)
    one_by_one(states, rates, systems, 1)
    programs: dict[str, Callable[[], None]] = {
        "kernels, one state after the other": lambda: one_by_one(
            states, rates, systems, EVALUATIONS
        ),
        "kernels, in a loop over states": lambda: in_a_loop(states, rates, systems, EVALUATIONS),
    }
    chi = np.array([[s["mode"]["touch"][0]["chi"]] for s in systems])
    for lanes in (1, 8, 64):
        evaluate = over_lanes(lanes)
        columns, found = _columns(states, lanes), _columns(np.zeros_like(states), lanes)
        factors = _columns(chi, lanes)
        evaluate(columns, found, factors, parameters[0], 1)
        _compare(
            found.reshape(-1, N_TOTAL, lanes), _columns(rates, lanes).reshape(-1, N_TOTAL, lanes)
        )
        programs[f"written for lanes, {lanes} at a time"] = partial(
            evaluate, columns, found, factors, parameters[0], EVALUATIONS
        )
    seconds = _timings(programs)
    first = next(iter(seconds.values()))
    rows = []
    for name, found in seconds.items():
        each = [s / (STATES * EVALUATIONS) * 1e9 for s in found]
        low, _, high = statistics.quantiles(each, n=4)
        share = ratio(min(found) / min(first))
        rows.append([name, f"{min(each):.1f}", f"{low:.1f} to {high:.1f}", share])
    whole = [run_cost(load_scene(SCENE, [f"run.rtol={rtol}"]), HORIZON, ROUNDS) for rtol in RTOLS]
    shares = [
        run.evaluations * min(first) / (STATES * EVALUATIONS) / run.seconds.low for run in whole
    ]
    return [
        table(["program", "ns", "quartiles", "to the first"], rows),
        "",
        f"Share of the equations in a run of {SCENE} to {HORIZON} s, if all of its evaluations "
        "were within a touch: "
        + ", ".join(f"{s:.2f} at rtol {r:g}" for s, r in zip(shares, RTOLS, strict=True))
        + ".",
    ]


def _compare(found: np.ndarray, expected: np.ndarray) -> None:
    """Check the second text against the kernels."""
    used = [*range(16), AXIAL, TORSION, HYSTERESIS, FRICTION, IMPULSE]
    error = np.abs(found - expected)[:, used].max() / np.abs(expected[:, used]).max()
    if not error <= AGREEMENT:
        raise AssertionError(f"the texts differ by {error:.3g}: must be at most {AGREEMENT:g}")


def _timings(programs: Mapping[str, Callable[[], None]]) -> dict[str, list[float]]:
    """Return CPU times of the programs in turn, s; a first round, which compiles, is left out."""
    found: dict[str, list[float]] = {name: [] for name in programs}
    for _ in range(ROUNDS + 1):
        for name, program in programs.items():
            began = time.thread_time()
            program()
            found[name].append(time.thread_time() - began)
    return {name: seconds[1:] for name, seconds in found.items()}


if __name__ == "__main__":
    write_parts("model", __doc__, {"lanes": equations})
