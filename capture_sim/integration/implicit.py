r"""One step of Radau IIA of order 5, for second-order systems with a stiff part.

Hairer and Wanner (Solving Ordinary Differential Equations II, 2nd ed. 1996, IV.8): three
stages, L-stable, stiffly accurate, error estimate of order 3.  The states are (q, v) with
q' = v, so that each linear system of 2m unknowns is reduced to one of m:

    (s^2 - s A_v - A_q) dq = r_v + s r_q - A_v r_q,     dv = s dq - r_q

with A_q, A_v the derivatives of the accelerations and s an eigenvalue of the method over h.

The derivatives are central differences: Newton's iteration converges by a factor of 1e3 to
1e4 a time with them, so exact ones would save nothing, and they are made a few times per
stiff stretch.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from capture_sim.kernels import kernel

_ROOT = math.sqrt(6.0)
C = np.array([(4.0 - _ROOT) / 10.0, (4.0 + _ROOT) / 10.0, 1.0])
#: Stage weights of Radau IIA, order 5 (Ehle 1969).
A = np.array(
    [
        [(88 - 7 * _ROOT) / 360, (296 - 169 * _ROOT) / 1800, (-2 + 3 * _ROOT) / 225],
        [(296 + 169 * _ROOT) / 1800, (88 + 7 * _ROOT) / 360, (-2 - 3 * _ROOT) / 225],
        [(16 - _ROOT) / 36, (16 + _ROOT) / 36, 1 / 9],
    ]
)


def _transform() -> tuple[float, complex, np.ndarray, np.ndarray]:
    """Return the eigenvalues of A^-1 and the real matrices T, T^-1 that split it.

    T^-1 A^-1 T is a real eigenvalue beside a 2x2 block (re, im; -im, re).
    """
    values, vectors = np.linalg.eig(np.linalg.inv(A))
    real = int(np.argmin(np.abs(values.imag)))
    pair = int(np.argmax(values.imag))
    T = np.column_stack([vectors[:, real].real, vectors[:, pair].real, vectors[:, pair].imag])
    return float(values[real].real), complex(values[pair]), T, np.linalg.inv(T)


_GAMMA, _MU, _T, _TI = _transform()
_MU_RE, _MU_IM = _MU.real, _MU.imag
# error estimate: (gamma / h - J)^-1 (f_0 + E Z / h), weights of Hairer and Wanner
_E = np.array([-13.0 - 7.0 * _ROOT, -13.0 + 7.0 * _ROOT, -1.0]) / 3.0

NEWTON_MOST = 7
NEWTON_DONE = 1e-3  # of the error that a step may make


class Work(NamedTuple):
    """Memory of an implicit stepper for m coordinates and ``total`` places of y."""

    A_q: np.ndarray  # (m, m), derivatives of the accelerations
    A_v: np.ndarray
    real: np.ndarray  # (m, m), factors
    pair: np.ndarray  # (m, m), complex
    real_pivots: np.ndarray
    pair_pivots: np.ndarray
    Z: np.ndarray  # (3, total), stage increments
    S: np.ndarray  # (3, total), stage derivatives
    W: np.ndarray  # (3, 2m), transformed increments
    b: np.ndarray  # (2m,)
    d: np.ndarray  # (m,)
    c: np.ndarray  # (m,), complex
    r: np.ndarray  # (2m,), complex


def make_work(m: int, total: int) -> Work:
    """Return memory for m coordinates and ``total`` places of y."""
    square = (m, m)
    return Work(
        np.zeros(square),
        np.zeros(square),
        np.zeros(square),
        np.zeros(square, complex),
        np.zeros(m, np.int64),
        np.zeros(m, np.int64),
        np.zeros((3, total)),
        np.zeros((3, total)),
        np.zeros((3, 2 * m)),
        np.zeros(2 * m),
        np.zeros(m),
        np.zeros(m, complex),
        np.zeros(2 * m, complex),
    )


class Implicit(NamedTuple):
    """The compiled steps of one right-hand side."""

    derivatives: Callable[..., Any]
    solve_step: Callable[..., Any]


@kernel
def factorise(M, pivots):
    """LU with partial pivoting, in place; returns False if the matrix is singular."""
    n = M.shape[0]
    for k in range(n):
        p = k
        for i in range(k + 1, n):
            if abs(M[i, k]) > abs(M[p, k]):
                p = i
        pivots[k] = p
        if abs(M[p, k]) == 0.0:
            return False
        if p != k:
            for j in range(n):
                M[k, j], M[p, j] = M[p, j], M[k, j]
        inverse = 1.0 / M[k, k]
        for i in range(k + 1, n):
            M[i, k] *= inverse
            factor = M[i, k]
            for j in range(k + 1, n):
                M[i, j] -= factor * M[k, j]
    return True


@kernel
def substitute(M, pivots, b):
    """Solve with the factors of :func:`factorise`; the answer replaces ``b``."""
    n = M.shape[0]
    for k in range(n):
        p = pivots[k]
        if p != k:
            b[k], b[p] = b[p], b[k]
    for k in range(n):
        for i in range(k + 1, n):
            b[i] -= M[i, k] * b[k]
    for k in range(n - 1, -1, -1):
        for j in range(k + 1, n):
            b[k] -= M[k, j] * b[j]
        b[k] /= M[k, k]


@kernel
def factor_systems(h, work):
    """Factorise the real and the complex system for the step ``h``; False if singular."""
    A_q, A_v, real, pair, real_pivots, pair_pivots, _, _, _, _, _, _, _ = work
    m = A_q.shape[0]
    s = _GAMMA / h
    z = complex(_MU_RE / h, _MU_IM / h)
    for i in range(m):
        for j in range(m):
            real[i, j] = -s * A_v[i, j] - A_q[i, j]
            pair[i, j] = -z * A_v[i, j] - A_q[i, j]
        real[i, i] += s * s
        pair[i, i] += z * z
    return factorise(real, real_pivots) and factorise(pair, pair_pivots)


@kernel
def solve_real(h, work, b):
    """Solve (gamma / h - J) x = b, (2m,); the answer replaces ``b``."""
    _, A_v, real, _, pivots, _, _, _, _, _, right, _, _ = work
    m = A_v.shape[0]
    s = _GAMMA / h
    for i in range(m):
        total = b[m + i] + s * b[i]
        for j in range(m):
            total -= A_v[i, j] * b[j]
        right[i] = total
    substitute(real, pivots, right)
    for i in range(m):
        dq = right[i]
        b[m + i] = s * dq - b[i]
        b[i] = dq


@kernel
def solve_pair(h, work):
    """Solve the complex system for r (2m,); the answer replaces it."""
    _, A_v, _, pair, _, pivots, _, _, _, _, _, right, r = work
    m = A_v.shape[0]
    z = complex(_MU_RE / h, _MU_IM / h)
    for i in range(m):
        total = r[m + i] + z * r[i]
        for j in range(m):
            total -= A_v[i, j] * r[j]
        right[i] = total
    substitute(pair, pivots, right)
    for i in range(m):
        dq = right[i]
        r[m + i] = z * dq - r[i]
        r[i] = dq


def make_implicit(rhs: Callable[..., Any]) -> Implicit:
    """Compile the steps for a right-hand side of the form q' = v, v' = a(q, v).

    Parameters
    ----------
    rhs
        ``rhs(t, y, f, par, mode, scratch)``, compiled; the first 2m places of ``y`` are q
        and v, the others integrals.
    """

    @kernel
    def derivatives(par, mode, scratch, t, y, y_s, q_small, v_small, work):
        """Fill the derivatives of the accelerations at ``y`` by central differences."""
        A_q, A_v, _, _, _, _, _, S, _, _, _, _, _ = work
        m = A_q.shape[0]
        for k in range(2 * m):
            y_s[k] = y[k]
        for k in range(2 * m):
            small = q_small if k < m else v_small
            y_s[k] = y[k] + small
            rhs(t, y_s, S[0], par, mode, scratch)
            y_s[k] = y[k] - small
            rhs(t, y_s, S[1], par, mode, scratch)
            y_s[k] = y[k]
            for i in range(m):
                slope = (S[0, m + i] - S[1, m + i]) / (2.0 * small)
                if k < m:
                    A_q[i, k] = slope
                else:
                    A_v[i, k - m] = slope

    @kernel
    def solve_step(par, mode, scratch, t, y, f_0, h, y_s, y_new, f_new, weights, work, F):
        """Take a step of length ``h`` with factors made for it; ``work.Z`` is the first guess.

        Writes result, derivative and dense output (the cubic through the stages, in the
        nested form of :mod:`capture_sim.integration.explicit`).  Returns (iterations, rate
        of convergence, weighted error); iterations is -1 if Newton's method failed.
        """
        _, _, _, _, _, _, Z, S, W, b, _, _, r = work
        n = y_s.shape[0]
        total = y.shape[0]
        for i in range(n):
            for k in range(3):
                W[k, i] = _TI[k, 0] * Z[0, i] + _TI[k, 1] * Z[1, i] + _TI[k, 2] * Z[2, i]
        norm_before = -1.0
        rate = 0.0
        iterations = -1
        for iteration in range(NEWTON_MOST):
            for k in range(3):
                for i in range(n):
                    y_s[i] = y[i] + Z[k, i]
                rhs(t + C[k] * h, y_s, S[k], par, mode, scratch)
            for i in range(n):
                f0, f1, f2 = S[0, i], S[1, i], S[2, i]
                b[i] = _TI[0, 0] * f0 + _TI[0, 1] * f1 + _TI[0, 2] * f2 - _GAMMA / h * W[0, i]
                one = _TI[1, 0] * f0 + _TI[1, 1] * f1 + _TI[1, 2] * f2
                two = _TI[2, 0] * f0 + _TI[2, 1] * f1 + _TI[2, 2] * f2
                one -= (_MU_RE * W[1, i] + _MU_IM * W[2, i]) / h
                two -= (_MU_RE * W[2, i] - _MU_IM * W[1, i]) / h
                r[i] = complex(one, -two)
            solve_real(h, work, b)
            solve_pair(h, work)
            norm = 0.0
            for i in range(n):
                d0, d1, d2 = b[i], r[i].real, -r[i].imag
                W[0, i] += d0
                W[1, i] += d1
                W[2, i] += d2
                for k in range(3):
                    Z[k, i] = _T[k, 0] * W[0, i] + _T[k, 1] * W[1, i] + _T[k, 2] * W[2, i]
                w = weights[i]
                norm += (d0 * d0 + d1 * d1 + d2 * d2) * w * w
            norm = math.sqrt(norm / (3.0 * n))
            if not norm < 1e300:
                return -1, 1.0, 0.0
            if norm_before > 0.0:
                rate = norm / norm_before
                if rate >= 1.0:
                    return -1, rate, 0.0
            if norm == 0.0 or (norm_before > 0.0 and rate / (1.0 - rate) * norm < NEWTON_DONE):
                iterations = iteration + 1
                break
            norm_before = norm
        if iterations < 0:
            return -1, rate, 0.0

        for i in range(n):
            y_new[i] = y[i] + Z[2, i]
        rhs(t + h, y_new, f_new, par, mode, scratch)
        for i in range(n, total):
            f0, f1, f2 = S[0, i], S[1, i], f_new[i]
            for k in range(3):
                Z[k, i] = h * (A[k, 0] * f0 + A[k, 1] * f1 + A[k, 2] * f2)
            y_new[i] = y[i] + Z[2, i]
        for i in range(n):
            b[i] = f_0[i] + (_E[0] * Z[0, i] + _E[1] * Z[1, i] + _E[2] * Z[2, i]) / h
        solve_real(h, work, b)
        error = 0.0
        for i in range(n):
            error += (b[i] * weights[i]) ** 2
        for i in range(total):
            one = (Z[0, i] / C[0] - Z[2, i]) / (1.0 - C[0])
            two = (Z[1, i] / C[1] - Z[2, i]) / (1.0 - C[1])
            F[0, i] = Z[2, i]
            F[2, i] = (two - one) / (C[1] - C[0])
            F[1, i] = one - C[0] * F[2, i]
        for k in range(3, F.shape[0]):
            for i in range(total):
                F[k, i] = 0.0
        return iterations, rate, math.sqrt(error / n)

    return Implicit(derivatives, solve_step)
