"""Explicit Runge-Kutta pairs with dense output, each as its coefficients.

A pair is data: :mod:`capture_sim.dynamics.solver.runge_kutta` takes steps with any of them.

Dense output gives y inside a step of length h, at its fraction x (0..1).  It has the nested form
of Hairer, Norsett and Wanner (Solving Ordinary Differential Equations I, 2nd ed. 1993, II.6),

    y(x) = y_0 + x (F_0 + (1 - x) (F_1 + x (F_2 + (1 - x) (F_3 + ...)))),   F = h G K

where row i of K is dy/dt at stage i.  A pair therefore needs one matrix ``G`` for its dense output.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from functools import cache
from typing import NamedTuple

import numpy as np

#: Largest number of evaluations of a step with its dense output, and of rows of the latter.
MAX_STAGES, MAX_ROWS = 16, 7


class Pair(NamedTuple):
    """Coefficients of an explicit pair with ``s`` stages, and ``e`` more for its dense output."""

    A: np.ndarray  # (s + 1 + e, s + 1 + e) stage weights; row s: the step (first same as last)
    C: np.ndarray  # (s + 1 + e,) stage times
    E5: np.ndarray  # (s + 1,) error estimates, combined as e5^2 / sqrt(e5^2 + 0.01 e3^2)
    E3: np.ndarray  # (s + 1,) zero for a pair with one estimate
    G: np.ndarray  # (rows, s + 1 + e) dense output
    stages: int  # s, evaluations per step
    order: int  # of the result
    error_order: int  # of the error estimate; 0: none, steps of fixed length


def _matrix(rows: Iterable[Mapping[int, float]], columns: int) -> np.ndarray:
    """Return a matrix of ``columns`` columns from its rows, each a mapping of column to entry."""
    rows = tuple(rows)
    matrix = np.zeros((len(rows), columns))
    for i, row in enumerate(rows):
        matrix[i, list(row)] = list(row.values())
    return matrix


def _dense(step: np.ndarray, stages: int, rest: np.ndarray) -> np.ndarray:
    """Return the matrix G of a pair's dense output.

    Its first three rows make y and dy/dt right at both ends of a step, and follow from the weights
    of the step, ``step`` (of ``stages`` stages).  ``rest`` are the rows after these, which each
    pair has of its own; its width is the number of all stages.
    """
    total = rest.shape[1]
    first, last, delta = np.zeros((3, total))
    first[0] = 1.0
    last[stages] = 1.0
    delta[:stages] = step[:stages]
    return np.vstack([delta, first - delta, 2.0 * delta - (first + last), rest])


@cache
def dormand_prince_5() -> Pair:
    """Return the 5(4) pair of Dormand and Prince (1980), Hairer's DOPRI5.

    Its dense output has order 4.
    """
    s = 6
    A = _matrix(_DOPRI5_A, s + 1)
    return Pair(
        A=A,
        C=np.array(_DOPRI5_C),
        E5=_matrix([_DOPRI5_E], s + 1)[0],
        E3=np.zeros(s + 1),
        G=_dense(A[s], s, _matrix([_DOPRI5_D], s + 1)),
        stages=s,
        order=5,
        error_order=4,
    )


@cache
def dormand_prince_853() -> Pair:
    """Return the 8(5,3) pair of Dormand and Prince, Hairer's DOP853.

    Its dense output has order 7.
    """
    s, total = 12, 16
    A = _matrix(_DOP853_A, total)
    return Pair(
        A=A,
        C=np.array(_DOP853_C),
        E5=_matrix([_DOP853_E5], s + 1)[0],
        E3=_matrix([_DOP853_E3], s + 1)[0],
        G=_dense(A[s], s, _matrix(_DOP853_D, total)),
        stages=s,
        order=8,
        error_order=7,
    )


@cache
def runge_kutta_4() -> Pair:
    """Return the classical Runge-Kutta method (Kutta 1901).

    It has no error estimate, so it is for steps of fixed length.  Its dense output is the cubic
    Hermite polynomial, of order 3.
    """
    A = np.zeros((5, 5))
    A[1, 0] = A[2, 1] = 0.5
    A[3, 2] = 1.0
    A[4, :4] = np.array([1.0, 2.0, 2.0, 1.0]) / 6.0
    return Pair(
        A=A,
        C=np.array([0.0, 0.5, 0.5, 1.0, 1.0]),
        E5=np.zeros(5),
        E3=np.zeros(5),
        G=_dense(A[4], 4, np.zeros((0, 5))),
        stages=4,
        order=4,
        error_order=0,
    )


#: Pairs by the name of the method; "rk4" runs with fixed steps.
PAIRS = {"dopri5": dormand_prince_5, "dop853": dormand_prince_853, "rk4": runge_kutta_4}

# Dormand and Prince (1980); each row's weights by stage
_DOPRI5_A: tuple[dict[int, float], ...] = (
    {},
    {0: 1 / 5},
    {0: 3 / 40, 1: 9 / 40},
    {0: 44 / 45, 1: -56 / 15, 2: 32 / 9},
    {0: 19372 / 6561, 1: -25360 / 2187, 2: 64448 / 6561, 3: -212 / 729},
    {0: 9017 / 3168, 1: -355 / 33, 2: 46732 / 5247, 3: 49 / 176, 4: -5103 / 18656},
    {0: 35 / 384, 2: 500 / 1113, 3: 125 / 192, 4: -2187 / 6784, 5: 11 / 84},
)
#: Nodes, error weights and dense output of DOPRI5 (Dormand and Prince 1980; Shampine 1986).
_DOPRI5_C = (0.0, 1 / 5, 3 / 10, 4 / 5, 8 / 9, 1.0, 1.0)
_DOPRI5_E = {
    0: -71 / 57600,
    2: 71 / 16695,
    3: -71 / 1920,
    4: 17253 / 339200,
    5: -22 / 525,
    6: 1 / 40,
}
_DOPRI5_D = {
    0: -12715105075 / 11282082432,
    2: 87487479700 / 32700410799,
    3: -10690763975 / 1880347072,
    4: 701980252875 / 199316789632,
    5: -1453857185 / 822651844,
    6: 69997945 / 29380423,
}

# Hairer, Norsett and Wanner's dop853.f; the last three rows are stages of the dense output only
# fmt: off
_DOP853_A: tuple[dict[int, float], ...] = (
    {},
    {0: 0.05260015195876773},
    {0: 0.0197250569845379, 1: 0.0591751709536137},
    {0: 0.02958758547680685, 2: 0.08876275643042054},
    {0: 0.2413651341592667, 2: -0.8845494793282861, 3: 0.924834003261792},
    {0: 0.037037037037037035, 3: 0.17082860872947386, 4: 0.12546768756682242},
    {0: 0.037109375, 3: 0.17025221101954405, 4: 0.06021653898045596, 5: -0.017578125},
    {0: 0.03709200011850479, 3: 0.17038392571223998, 4: 0.10726203044637328,
     5: -0.015319437748624402, 6: 0.008273789163814023},
    {0: 0.6241109587160757, 3: -3.3608926294469414, 4: -0.868219346841726, 5: 27.59209969944671,
     6: 20.154067550477894, 7: -43.48988418106996},
    {0: 0.47766253643826434, 3: -2.4881146199716677, 4: -0.590290826836843, 5: 21.230051448181193,
     6: 15.279233632882423, 7: -33.28821096898486, 8: -0.020331201708508627},
    {0: -0.9371424300859873, 3: 5.186372428844064, 4: 1.0914373489967295, 5: -8.149787010746927,
     6: -18.52006565999696, 7: 22.739487099350505, 8: 2.4936055526796523, 9: -3.0467644718982196},
    {0: 2.273310147516538, 3: -10.53449546673725, 4: -2.0008720582248625, 5: -17.9589318631188,
     6: 27.94888452941996, 7: -2.8589982771350235, 8: -8.87285693353063, 9: 12.360567175794303,
     10: 0.6433927460157636},
    {0: 0.054293734116568765, 5: 4.450312892752409, 6: 1.8915178993145003, 7: -5.801203960010585,
     8: 0.3111643669578199, 9: -0.1521609496625161, 10: 0.20136540080403034,
     11: 0.04471061572777259},
    {0: 0.056167502283047954, 6: 0.25350021021662483, 7: -0.2462390374708025,
     8: -0.12419142326381637, 9: 0.15329179827876568, 10: 0.00820105229563469,
     11: 0.007567897660545699, 12: -0.008298},
    {0: 0.03183464816350214, 5: 0.028300909672366776, 6: 0.053541988307438566,
     7: -0.05492374857139099, 10: -0.00010834732869724932, 11: 0.0003825710908356584,
     12: -0.00034046500868740456, 13: 0.1413124436746325},
    {0: -0.42889630158379194, 5: -4.697621415361164, 6: 7.683421196062599, 7: 4.06898981839711,
     8: 0.3567271874552811, 12: -0.0013990241651590145, 13: 2.9475147891527724,
     14: -9.15095847217987},
)
#: Nodes of DOP853 (Hairer, Norsett and Wanner 1993).
_DOP853_C = (
    0.0, 0.05260015195876773, 0.0789002279381516, 0.1183503419072274, 0.2816496580927726,
    0.3333333333333333, 0.25, 0.3076923076923077, 0.6512820512820513, 0.6, 0.8571428571428571, 1.0,
    1.0, 0.1, 0.2, 0.7777777777777778,
)
_DOP853_E5 = {
    0: 0.01312004499419488, 5: -1.2251564463762044, 6: -0.4957589496572502, 7: 1.6643771824549864,
    8: -0.35032884874997366, 9: 0.3341791187130175, 10: 0.08192320648511571,
    11: -0.022355307863886294,
}
_DOP853_E3 = {
    0: -0.18980075407240762, 5: 4.450312892752409, 6: 1.8915178993145003, 7: -5.801203960010585,
    8: -0.4226823213237919, 9: -0.1521609496625161, 10: 0.20136540080403034,
    11: 0.02265179219836082,
}
_DOP853_D = (
    {0: -8.428938276109013, 5: 0.5667149535193777, 6: -3.0689499459498917, 7: 2.38466765651207,
     8: 2.117034582445028, 9: -0.871391583777973, 10: 2.2404374302607883, 11: 0.6315787787694688,
     12: -0.08899033645133331, 13: 18.148505520854727, 14: -9.194632392478356,
     15: -4.436036387594894},
    {0: 10.427508642579134, 5: 242.28349177525817, 6: 165.20045171727028, 7: -374.5467547226902,
     8: -22.113666853125306, 9: 7.733432668472264, 10: -30.674084731089398, 11: -9.332130526430229,
     12: 15.697238121770845, 13: -31.139403219565178, 14: -9.35292435884448,
     15: 35.81684148639408},
    {0: 19.985053242002433, 5: -387.0373087493518, 6: -189.17813819516758, 7: 527.8081592054236,
     8: -11.57390253995963, 9: 6.8812326946963, 10: -1.0006050966910838, 11: 0.7777137798053443,
     12: -2.778205752353508, 13: -60.19669523126412, 14: 84.32040550667716, 15: 11.99229113618279},
    {0: -25.69393346270375, 5: -154.18974869023643, 6: -231.5293791760455, 7: 357.6391179106141,
     8: 93.40532418362432, 9: -37.45832313645163, 10: 104.0996495089623, 11: 29.8402934266605,
     12: -43.53345659001114, 13: 96.32455395918828, 14: -39.17726167561544,
     15: -149.72683625798564},
)
# fmt: on
