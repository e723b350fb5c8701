"""Explicit Runge-Kutta pairs with dense output, each as its coefficients.

A pair is data; :mod:`capture_sim.solver.runge_kutta` steps any of them.

Dense output has the nested form of Hairer, Norsett and Wanner (Solving Ordinary
Differential Equations I, 2nd ed. 1993, II.6),

    y(x) = y_0 + x (F_0 + (1 - x) (F_1 + x (F_2 + (1 - x) (F_3 + ...)))),   F = h G K

so that a pair is complete with one more matrix ``G``.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np


class Pair(NamedTuple):
    """Coefficients of an explicit pair with ``s`` stages, ``e`` extra ones for dense output.

    Attributes
    ----------
    A : ndarray (s + 1 + e, s + 1 + e)
        Stage weights; row ``s`` are the weights of the step itself (first same as last).
    C : ndarray (s + 1 + e,)
        Stage times.
    E5, E3 : ndarray (s + 1,)
        Error estimates, combined as e5^2 / sqrt(e5^2 + 0.01 e3^2); E3 is zero where a
        pair has one estimate only.
    G : ndarray (rows, s + 1 + e)
        Dense output.
    stages : int
        s, evaluations per step.
    order : int
        Order of the result.
    error_order : int
        Order of the error estimate; 0: there is none, steps are of fixed length.
    """

    A: np.ndarray
    C: np.ndarray
    E5: np.ndarray
    E3: np.ndarray
    G: np.ndarray
    stages: int
    order: int
    error_order: int


def _dense(step: np.ndarray, stages: int, total: int, rest: np.ndarray) -> np.ndarray:
    """Return G from the step's weights and the pair's own rows beyond the first three."""
    first = np.zeros(total)
    first[0] = 1.0
    last = np.zeros(total)
    last[stages] = 1.0
    delta = np.zeros(total)
    delta[:stages] = step
    return np.vstack([delta, first - delta, 2.0 * delta - (first + last), rest])


def dormand_prince_5() -> Pair:
    """Return the 5(4) pair of Dormand and Prince (1980), dense order 4 (Hairer's DOPRI5)."""
    # loaded here: it takes a quarter of a second, and one pair is all that a run needs
    from scipy.integrate import RK45

    s = RK45.n_stages
    A = np.zeros((s + 1, s + 1))
    A[:s, : RK45.A.shape[1]] = RK45.A
    A[s, :s] = RK45.B
    rest = np.array(
        [
            -12715105075 / 11282082432,
            0.0,
            87487479700 / 32700410799,
            -10690763975 / 1880347072,
            701980252875 / 199316789632,
            -1453857185 / 822651844,
            69997945 / 29380423,
        ]
    )
    return Pair(
        A=A,
        C=np.append(RK45.C, 1.0),
        E5=np.asarray(RK45.E, dtype=float),
        E3=np.zeros(s + 1),
        G=_dense(RK45.B, s, s + 1, rest[None, :]),
        stages=s,
        order=5,
        error_order=4,
    )


def dormand_prince_853() -> Pair:
    """Return the 8(5,3) pair of Dormand and Prince, dense order 7 (Hairer's DOP853)."""
    from scipy.integrate import DOP853

    s = DOP853.n_stages
    extra = len(DOP853.C_EXTRA)
    total = s + 1 + extra
    A = np.zeros((total, total))
    A[:s, :s] = DOP853.A
    A[s, :s] = DOP853.B
    A[s + 1 :, : DOP853.A_EXTRA.shape[1]] = DOP853.A_EXTRA
    return Pair(
        A=A,
        C=np.concatenate([DOP853.C, [1.0], DOP853.C_EXTRA]),
        E5=np.asarray(DOP853.E5, dtype=float),
        E3=np.asarray(DOP853.E3, dtype=float),
        G=_dense(DOP853.B, s, total, DOP853.D),
        stages=s,
        order=8,
        error_order=7,
    )


def runge_kutta_4() -> Pair:
    """Return the classical Runge-Kutta method (Kutta 1901), without error estimate.

    For fixed steps; dense output is the cubic Hermite polynomial, of order 3.
    """
    A = np.zeros((5, 5))
    A[1, 0] = A[2, 1] = 0.5
    A[3, 2] = 1.0
    step = np.array([1.0, 2.0, 2.0, 1.0]) / 6.0
    A[4, :4] = step
    return Pair(
        A=A,
        C=np.array([0.0, 0.5, 0.5, 1.0, 1.0]),
        E5=np.zeros(5),
        E3=np.zeros(5),
        G=_dense(step, 4, 5, np.zeros((0, 5))),
        stages=4,
        order=4,
        error_order=0,
    )


#: Pairs by the name of the method; "rk4" runs with fixed steps.
PAIRS = {"dopri5": dormand_prince_5, "dop853": dormand_prince_853, "rk4": runge_kutta_4}
