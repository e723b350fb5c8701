"""What can be done against the delay of a loop: each way by itself, without ROS.

``passivity``
    Observer and controller of Hannaford and Ryu (2002): what the loop has put in beyond what the
    rig's contact gave back is taken out by scaling the wrench.
``hybrid``
    The yardstick, after the European Proximity Operations Simulator (arXiv 1409.0562): a virtual
    spring and damper, which know no delay, are added to the measured force.
``prediction1``, ``prediction2``
    The rig is sent the place where the tip will be when the answer is used.
``model``
    A law of the walls in the vehicles' own steps, fitted to the rig's wrenches touch by touch;
    the measured wrench corrects it.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from capture_sim.errors import CaptureSimError
from capture_sim.hardware.walls import TipState, Touching, WallLaw, Wrench


class Compensation(NamedTuple):
    """Which ways are used together.

    Attributes
    ----------
    passivity, hybrid, model
        See the module.
    prediction
        Order in time: 0 none, 1 with the velocity, 2 with the acceleration as well.
    """

    passivity: bool = False
    hybrid: bool = False
    model: bool = False
    prediction: int = 0


WAYS = ("none", "passivity", "hybrid", "prediction1", "prediction2", "model")


def compensation(text: str) -> Compensation:
    """Return what a name stands for; several are joined by +, as in ``model+passivity``.

    Raises
    ------
    CaptureSimError
        A name is unknown, or hybrid and model, which both are the law of the walls, are joined.
    """
    names = set(text.split("+"))
    if not names <= set(WAYS):
        raise CaptureSimError(
            f"compensation = {text!r}: must be one of {', '.join(WAYS)}, or several joined by +"
        )
    if {"hybrid", "model"} <= names:
        raise CaptureSimError(f"compensation = {text!r}: hybrid and model exclude each other")
    order = 2 if "prediction2" in names else int("prediction1" in names)
    return Compensation("passivity" in names, "hybrid" in names, "model" in names, order)


def gain_rate(exponent: float) -> float:
    """Return g of exp(g delay / duration), by which a small delay raises the restitution.

    To first order in the delay the force is that of the present penetration less
    ``delay * dF/dt``, which feeds in ``delay * integral of F' v^2 dt`` (the negative damping of a
    delayed spring): 2 g delay / duration of the approach's energy.  For a spring it is pi^2 / 2.

    Parameters
    ----------
    exponent
        p of F = K x^p.

    Notes
    -----
    With n = p + 1, z = x / x_max and v = v_0 sqrt(1 - z^n) the duration is
    2 / n B(1 / n, 1 / 2) x_max / v_0, the integral of F' v^2 dt p B(p / n, 3 / 2) m v_0^3 / x_max.
    """
    n = exponent + 1.0
    return 2.0 * exponent / n * _beta(1.0 / n, 0.5) * _beta(exponent / n, 1.5)


def _beta(a: float, b: float) -> float:
    """Return Euler's integral of t^(a - 1) (1 - t)^(b - 1) from 0 to 1."""
    return math.gamma(a) * math.gamma(b) / math.gamma(a + b)


def critical_delay(
    mass: float, stiffness: float, damping: float = 0.0, virtual: float = 0.0
) -> float:
    """Return the delay at which a mass on a late spring and damper neither decays nor grows, s.

    Parameters
    ----------
    mass
        kg.
    stiffness, damping
        N/m and N s/m, of what is measured and comes late.
    virtual
        N s/m, of a damper that is computed and comes at once.

    Notes
    -----
    m s^2 + b_v s + (b s + k) exp(-s tau) = 0 with s = j w: the moduli give w, the arguments tau.
    For b_v = 0 it is the critical delay of arXiv 1309.3512.
    """
    half = 0.5 * (damping**2 - virtual**2)
    w2 = (half + math.sqrt(half**2 + (mass * stiffness) ** 2)) / mass**2
    w = math.sqrt(w2)
    return (math.atan2(damping * w, stiffness) + math.atan2(virtual, mass * w)) / w


def critical_damping(mass: float, stiffness: float, delay: float) -> float:
    """Return the virtual damper (N s/m) that makes a delay (s) of a late spring the critical one.

    To first order it is k tau; see :func:`critical_delay`: cos(w tau) = m w^2 / k gives w.
    """
    # loaded here: it takes half a second
    from scipy.optimize import brentq

    def gap(w: float) -> float:
        return math.cos(w * delay) - mass * w**2 / stiffness

    w = brentq(gap, 0.0, min(math.sqrt(stiffness / mass), 0.5 * math.pi / delay), rtol=1e-14)
    return float(stiffness * math.sin(w * delay) / w)


def predicted(
    tip: TipState, delay: float, rates: np.ndarray, accelerations: np.ndarray
) -> TipState:
    """Return where the tip will be after ``delay`` (s), from rates and accelerations (3,).

    The time stays that of the place that it is made from, by which the answer is known.
    """
    moved = np.array(tip[1:4]) + rates * delay + 0.5 * accelerations * delay**2
    return TipState(tip.t, *moved.tolist(), *(rates + accelerations * delay).tolist())


def passive_share(
    slope: float, bend: float, low: float, high: float, wanted: float, allowed: float
) -> float:
    """Return the share of a wrench, nearest to the wanted one, that does no more than this work.

    Parameters
    ----------
    slope, bend
        J: a share s does the work s slope + s^2 bend over a step, for the tip yields in
        proportion to the force.
    low, high
        Limits of the share; 0 lies between them.
    wanted
        The share to take if it does not do too much.
    allowed
        J; where no share does as little, the one with the least work is returned.
    """

    def work(share: float) -> float:
        return share * (slope + share * bend)

    shares = [wanted, low, high, 0.0]
    if bend != 0.0:
        vertex = -0.5 * slope / bend
        spread = math.sqrt(max(vertex**2 + allowed / bend, 0.0))
        shares += [vertex - spread, vertex, vertex + spread]
    shares = [share for share in shares if low <= share <= high]
    least = max(allowed, min(map(work, shares))) + 1e-9 * abs(slope)
    good = (share for share in shares if work(share) <= least)
    return min(good, key=lambda share: abs(share - wanted), default=0.0)


class ContactFit:
    """Stiffness, damping and friction of walls, from wrenches at known places.

    Recursive least squares: of k and c in F_n = penetration^p (k + c penetration'), and of mu in
    F_t = -mu F_n tanh(slip / slip_speed).

    Parameters
    ----------
    prior
        What is assumed at first; its stiffness scales the fit, its exponent stays.
    noise
        N, standard deviation of a measured force.
    doubt
        By which share the prior's stiffness may be wrong (standard deviation).
    """

    #: m/s: that of the bench's touches; scales the damping against the stiffness
    SPEED = 0.1
    #: by what the covariance grows from touch to touch, so that a contact may change
    FORGET = 1.1

    def __init__(self, prior: WallLaw, noise: float = 0.1, doubt: float = 10.0) -> None:
        if prior.stiffness <= 0.0:
            raise CaptureSimError(
                f"stiffness of the model = {prior.stiffness:g} N/m^p: must be > 0"
            )
        self._prior, self._variance = prior, noise**2
        scale = self.SPEED / prior.stiffness
        self._theta = np.array([1.0, prior.damping * scale])
        self._P = np.diag([doubt**2, 1.0])
        self._mu, self._P_mu = prior.friction, 1.0

    @property
    def law(self) -> WallLaw:
        """What is found so far; it never makes energy."""
        k, c = (max(float(value), 0.0) for value in self._theta)
        # a stiffness of 0 would be no wall at all, and nothing more would be learnt
        k = max(k, 1e-9)
        stiffness = self._prior.stiffness
        return self._prior._replace(
            stiffness=k * stiffness, damping=c * stiffness / self.SPEED, friction=max(self._mu, 0.0)
        )

    def ignorance(self, wall: Touching) -> float:
        """Return the variance of the normal force that the fit foretells there, N^2."""
        row = self._row(wall)
        return float(row @ self._P @ row)

    def learn(self, wall: Touching, wrench: Wrench) -> None:
        """Take in the wrench of one wall."""
        normal = wrench[0] * wall.nx + wrench[1] * wall.ny
        if normal <= 0.0:  # a law that never pulls says nothing about it
            return
        row = self._row(wall)
        gain = self._P @ row / (self._variance + row @ self._P @ row)
        self._theta = self._theta + gain * (normal - row @ self._theta)
        self._P = self._P - np.outer(gain, row @ self._P)
        rub = wrench[1] * wall.nx - wrench[0] * wall.ny
        slope = -normal * math.tanh(wall.slip / self._prior.slip_speed)
        gain_mu = self._P_mu * slope / (self._variance + slope**2 * self._P_mu)
        self._mu += gain_mu * (rub - slope * self._mu)
        self._P_mu *= 1.0 - gain_mu * slope

    def next_touch(self) -> None:
        """Forget a little."""
        self._P = self._P * self.FORGET
        self._P_mu *= self.FORGET

    def _row(self, wall: Touching) -> np.ndarray:
        elastic = self._prior.stiffness * wall.penetration**self._prior.exponent
        return np.array([elastic, elastic * wall.rate / self.SPEED])
