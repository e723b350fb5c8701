r"""One step of Radau IIA of order 5, for second-order systems with a few stiff directions.

Hairer and Wanner (Solving Ordinary Differential Equations II, 2nd ed. 1996, IV.8): three
stages, L-stable, stiffly accurate, error estimate of order 3.  The states are (q, v) with
q' = v, so that each linear system of 2m unknowns is reduced to one of m:

    (s^2 - s A_v - A_q) dq = r_v + s r_q - A_v r_q,     dv = s dq - r_q

with A_q, A_v the derivatives of the accelerations and s an eigenvalue of the method over h.

Stiff are only the few directions in which springs and contacts act.  With an orthonormal
basis Q (r, m) of them and W = A Q^T (m, r), found by differences along Q,

    A ~ W Q,    (s^2 - s A_v - A_q)^-1 = s^-2 (1 + Z (1 - Q Z)^-1 Q),   Z = (s W_v + W_q) / s^2

so what is factorised is r by r.  Newton's iteration minds no error of its derivatives but in
its number of turns; with all m directions it is the full method.
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

    rank: np.ndarray  # (1,), how many directions are in use
    Q: np.ndarray  # (m, m), a row each, orthonormal
    W_q: np.ndarray  # (m, m), derivatives of the accelerations, a row for each direction
    W_v: np.ndarray
    Z_real: np.ndarray  # (m, m), those of the real system, a row for each direction
    Z_pair: np.ndarray  # (2m, m), of the complex one: real parts, then imaginary ones
    real: np.ndarray  # (m, m), inverse of 1 - Q Z
    pair: np.ndarray  # (m, m), complex
    Z: np.ndarray  # (3, total), stage increments
    S: np.ndarray  # (3, total), stage derivatives
    W: np.ndarray  # (3, 2m), transformed increments
    b: np.ndarray  # (4, 2m), right-hand sides: real, real and imaginary part of the complex one
    c: np.ndarray  # (4, m), what of them lies along the directions


def make_work(m: int, total: int) -> Work:
    """Return memory for m coordinates and ``total`` places of y."""

    def square() -> np.ndarray:
        return np.zeros((m, m))

    return Work(
        rank=np.zeros(1, np.int64),
        Q=square(),
        W_q=square(),
        W_v=square(),
        Z_real=square(),
        Z_pair=np.zeros((2 * m, m)),
        real=square(),
        pair=np.zeros((m, m), complex),
        Z=np.zeros((3, total)),
        S=np.zeros((3, total)),
        W=np.zeros((3, 2 * m)),
        b=np.zeros((4, 2 * m)),
        c=np.zeros((4, m)),
    )


class Implicit(NamedTuple):
    """The compiled steps of one right-hand side."""

    derivatives: Callable[..., Any]
    solve_step: Callable[..., Any]


@kernel
def orthonormalise(Q, count):
    """Make the first ``count`` rows of ``Q`` orthonormal (Gram and Schmidt, modified).

    Rows that depend on those before them are dropped; returns how many are left.
    """
    m = Q.shape[1]
    kept = 0
    for k in range(count):
        before = 0.0
        for i in range(m):
            before += Q[k, i] * Q[k, i]
        for j in range(kept):
            along = 0.0
            for i in range(m):
                along += Q[j, i] * Q[k, i]
            for i in range(m):
                Q[k, i] -= along * Q[j, i]
        after = 0.0
        for i in range(m):
            after += Q[k, i] * Q[k, i]
        if after > 1e-16 * before:
            inverse = 1.0 / math.sqrt(after)
            for i in range(m):
                Q[kept, i] = Q[k, i] * inverse
            kept += 1
    return kept


@kernel
def invert(M, n):
    """Invert the upper left (n, n) of ``M`` in place by Gauss and Jordan's elimination.

    Returns False if it is singular.  Its diagonal is kept as pivots: 1 - Q Z is 1 where a
    direction is not stiff and large where it is.
    """
    for k in range(n):
        if abs(M[k, k]) == 0.0:
            return False
        inverse = 1.0 / M[k, k]
        M[k, k] = 1.0
        for j in range(n):
            M[k, j] *= inverse
        for i in range(n):
            if i != k:
                factor = M[i, k]
                M[i, k] = 0.0
                for j in range(n):
                    M[i, j] -= factor * M[k, j]
    return True


@kernel
def factor_systems(h, work):
    """Prepare the real and the complex system for the step ``h``; False if singular."""
    rank, Q, W_q, W_v, Z_real, Z_pair, real, pair, _, _, _, _, _ = work
    r = rank[0]
    m = Q.shape[1]
    s = h / _GAMMA
    z = h / complex(_MU_RE, _MU_IM)
    z2 = z * z
    for k in range(r):
        for i in range(m):
            Z_real[k, i] = s * (W_v[k, i] + s * W_q[k, i])
            Z_pair[k, i] = z.real * W_v[k, i] + z2.real * W_q[k, i]
            Z_pair[m + k, i] = z.imag * W_v[k, i] + z2.imag * W_q[k, i]
    for j in range(r):
        for k in range(r):
            one = 1.0 if j == k else 0.0
            x = 0.0
            re = 0.0
            im = 0.0
            for i in range(m):
                x += Q[j, i] * Z_real[k, i]
                re += Q[j, i] * Z_pair[k, i]
                im += Q[j, i] * Z_pair[m + k, i]
            real[j, k] = one - x
            pair[j, k] = complex(one - re, -im)
    return invert(real, r) and invert(pair, r)


@kernel
def solve_real(h, work):
    """Solve (gamma / h - J) x = b[0], (2m,); the answer replaces it."""
    rank, Q, _, W_v, Z_real, _, real, _, _, _, _, right, c = work
    r = rank[0]
    m = Q.shape[1]
    b = right[0]
    s = _GAMMA / h
    d = right[3]
    for k in range(r):
        c[0, k] = 0.0
        for i in range(m):
            c[0, k] += Q[k, i] * b[i]
    for i in range(m):
        d[i] = b[m + i] + s * b[i]
    for k in range(r):
        for i in range(m):
            d[i] -= W_v[k, i] * c[0, k]
    for k in range(r):
        c[1, k] = 0.0
        for i in range(m):
            c[1, k] += Q[k, i] * d[i]
    for k in range(r):
        x = 0.0
        for j in range(r):
            x += real[k, j] * c[1, j]
        for i in range(m):
            d[i] += Z_real[k, i] * x
    scale = 1.0 / (s * s)
    for i in range(m):
        dq = d[i] * scale
        b[m + i] = s * dq - b[i]
        b[i] = dq


@kernel
def solve_pair(h, work):
    """Solve the complex system for b[1] + i b[2], (2m,); the answer replaces them."""
    rank, Q, _, W_v, _, Z_pair, _, pair, _, _, _, right, c = work
    r = rank[0]
    m = Q.shape[1]
    re, im = right[1], right[2]
    z_re, z_im = _MU_RE / h, _MU_IM / h
    d, e = right[3, :m], right[3, m:]
    for k in range(r):
        c[0, k] = 0.0
        c[1, k] = 0.0
        for i in range(m):
            c[0, k] += Q[k, i] * re[i]
            c[1, k] += Q[k, i] * im[i]
    for i in range(m):
        d[i] = re[m + i] + z_re * re[i] - z_im * im[i]
        e[i] = im[m + i] + z_re * im[i] + z_im * re[i]
    for k in range(r):
        for i in range(m):
            d[i] -= W_v[k, i] * c[0, k]
            e[i] -= W_v[k, i] * c[1, k]
    for k in range(r):
        c[2, k] = 0.0
        c[3, k] = 0.0
        for i in range(m):
            c[2, k] += Q[k, i] * d[i]
            c[3, k] += Q[k, i] * e[i]
    for k in range(r):
        x = 0.0
        y = 0.0
        for j in range(r):
            p = pair[k, j]
            x += p.real * c[2, j] - p.imag * c[3, j]
            y += p.real * c[3, j] + p.imag * c[2, j]
        for i in range(m):
            d[i] += Z_pair[k, i] * x - Z_pair[m + k, i] * y
            e[i] += Z_pair[k, i] * y + Z_pair[m + k, i] * x
    scale = 1.0 / complex(z_re * z_re - z_im * z_im, 2.0 * z_re * z_im)
    for i in range(m):
        x = d[i] * scale.real - e[i] * scale.imag
        y = e[i] * scale.real + d[i] * scale.imag
        d_re = z_re * x - z_im * y - re[i]
        d_im = z_re * y + z_im * x - im[i]
        re[i] = x
        im[i] = y
        re[m + i] = d_re
        im[m + i] = d_im


def make_implicit(rhs: Callable[..., Any], directions: Callable[..., Any]) -> Implicit:
    """Compile the steps for a right-hand side of the form q' = v, v' = a(q, v).

    Parameters
    ----------
    rhs
        ``rhs(t, y, f, par, mode, scratch)``, compiled; the first 2m places of ``y`` are q
        and v, the others integrals.
    directions
        ``directions(y, par, mode, Q)``, compiled; writes the stiff directions of the
        coordinates into rows of ``Q`` (m, m) and returns how many, at most m.
    """

    @kernel
    def derivatives(par, mode, scratch, t, y, f_0, y_s, q_small, v_small, work):
        """Fill the derivatives of the accelerations along the directions, by differences.

        ``f_0`` is the right-hand side at ``y``.  Returns how many evaluations it took.
        """
        rank, Q, W_q, W_v, _, _, _, _, _, S, _, _, _ = work
        m = Q.shape[1]
        r = orthonormalise(Q, directions(y, par, mode, Q))
        rank[0] = r
        for k in range(r):
            for half in range(2):
                small = q_small if half == 0 else v_small
                for i in range(m):
                    y_s[i] = y[i]
                    y_s[m + i] = y[m + i]
                for i in range(m):
                    y_s[half * m + i] += small * Q[k, i]
                rhs(t, y_s, S[0], par, mode, scratch)
                W = W_q if half == 0 else W_v
                for i in range(m):
                    W[k, i] = (S[0, m + i] - f_0[m + i]) / small
        return 2 * r

    @kernel
    def solve_step(par, mode, scratch, t, y, f_0, h, y_s, y_new, f_new, weights, work, F):
        """Take a step of length ``h`` with factors made for it; ``work.Z`` is the first guess.

        Writes result, derivative and dense output (the cubic through the stages, in the
        nested form of :mod:`capture_sim.solver.runge_kutta`).  Returns (iterations, rate
        of convergence, weighted error); iterations is -1 if Newton's method failed.
        """
        _, _, _, _, _, _, _, _, Z, S, W, right, _ = work
        b = right[0]
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
                right[1, i] = one
                right[2, i] = -two
            solve_real(h, work)
            solve_pair(h, work)
            norm = 0.0
            for i in range(n):
                d0, d1, d2 = b[i], right[1, i], -right[2, i]
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
        solve_real(h, work)
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
