"""Tests of a fit: whether restarts agree, trials agree, and residuals are noise.

A fit in a false minimum can have a small predicted decrease and a chi2 like that of noise.  Such a
minimum is revealed by restarts, by trials that disagree, and by residuals whose means over 30 ms
are larger than those of noise.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from capture_sim.studies.fit.descent import Found
from capture_sim.studies.fit.joint import UNDETERMINED, Linear, Problem, inverse
from capture_sim.studies.fit.trial import OWN_SIZE, FittedTrial
from capture_sim.studies.vary.inputs import Input

#: Duration of the means of residuals, s.
BLOCK = 0.03
#: Phases of a trial.
PHASES = ("held", "approach", "contact", "after")
#: Ends of the phases ``approach`` and ``contact``, s after the first contact: two frames of a
#: 100 Hz camera before it, and after the first group of touches.  ``held`` ends at the release.
_APPROACH_END, _CONTACT_END = -0.02, 0.25
#: Probabilities of a false alarm: for trials that agree, and for all means of residuals together.
ALARM_TRIALS, ALARM_BLOCKS = 1e-4, 1e-3
#: Conditions for convergence: largest decrease of chi2 that the linear model predicts; restarts
#: with chi2 above the best by less than the second number must end nearer to the best than the
#: third (standard errors); smallest number of restarts that must do so.
LEFT, AS_LOW, AS_NEAR, AGREEING = 2.0, 4.0, 2.0, 2
#: Largest distance of the fitted parameters from the aim of the search with the held values, and
#: from the ends of restarts; their errors contain both.  Such an end is the same place if chi2 is
#: higher by less than the second number: 50 and more numbers settle slowly where chi2 is rough.
LEFT_OF_FITTED, SETTLED = 3.0, 10.0
#: Standard error, in coordinates, above which a direction of the parameters is not determined.
VAGUE = 0.5


class Finding(NamedTuple):
    """A reason to reject a fit, in words, and advice what to do.

    ``kind`` is the name of the test that failed, e.g. ``"convergence"``.
    """

    kind: str
    text: str
    advice: str

    @property
    def line(self) -> str:
        """Reason and advice in one line."""
        return f"{self.text}; {self.advice}"


class Agreeing(NamedTuple):
    """Chi2 test that all trials, or one trial and all others, have the same parameters.

    ``p`` is the probability of a larger statistic by chance.
    """

    statistic: float
    freedom: int
    p: float


class BlockMean(NamedTuple):
    """Chi2 test that the residuals of one measured quantity in one phase of a trial are noise.

    Their means over 30 ms are tested.  ``trial`` is the number of the trial, from 0, and ``part``
    the column of the channel's values.
    """

    trial: int
    channel: str
    part: int
    phase: str
    statistic: float  # sum of the squares of the means, in units of their noise
    means: int  # number of means
    p: float


def chi2_tail(statistic: float, freedom: int) -> float:
    """Return the probability of a chi2 above ``statistic``; 1 without degrees of freedom."""
    from scipy.stats import chi2

    return float(chi2.sf(statistic, freedom)) if freedom > 0 else 1.0


@dataclass(frozen=True)
class Reduced:
    """Information of one trial on the k shared parameters.

    It is that of chi2 minimised over the seven numbers of the trial.  ``gradient`` is half of the
    derivative of chi2.
    """

    hessian: np.ndarray  # (k, k)
    gradient: np.ndarray  # (k,)


def reduced(at: Linear, number: int, shared: int) -> Reduced:
    """Return the information of the trial with a number, from its residuals alone, without a prior.

    ``shared`` is the number of shared parameters.
    """
    J, r = at.jacobians[number], at.shown[number].residuals
    H, g = J.T @ J, J.T @ r
    cross, own = H[:shared, shared:], H[shared:, shared:]
    scale = np.sqrt(np.maximum(np.diag(own), 1e-300))
    inverted = np.linalg.pinv(own / np.outer(scale, scale), rcond=1e-12, hermitian=True)
    inverted /= np.outer(scale, scale)
    return Reduced(
        H[:shared, :shared] - cross @ inverted @ cross.T, g[:shared] - cross @ inverted @ g[shared:]
    )


def _distance(hessian: np.ndarray, gradient: np.ndarray) -> tuple[float, int]:
    """Return the squared distance to the minimum of chi2, in standard errors, and its freedom.

    The freedom is the number of directions with information.
    """
    scale = np.sqrt(np.maximum(np.diag(hessian), 1e-300))
    values, vectors = np.linalg.eigh(hessian / np.outer(scale, scale))
    kept = values > 1e-8 * max(float(values[-1]), 1e-300)
    along = vectors.T @ (gradient / scale)
    return float((along[kept] ** 2 / values[kept]).sum()), int(kept.sum())


def trials_agree(at: Linear, problem: Problem) -> tuple[Agreeing, list[Agreeing]]:
    """Return the test that all trials have the same parameters, and one test for each trial.

    The latter compares a trial with all others.  With fewer than two trials or no shared parameter,
    p is 1 and there are no tests of each trial.
    """
    k = problem.shared
    if len(problem.trials) < 2 or k == 0:
        return Agreeing(0.0, 0, 1.0), []
    parts = [reduced(at, number, k) for number in range(len(problem.trials))]
    H = sum((part.hessian for part in parts), np.zeros((k, k)))
    g = sum((part.gradient for part in parts), np.zeros(k))
    joint, rank = _distance(H, g)
    distances = [_distance(part.hessian, part.gradient) for part in parts]
    statistic = max(sum(d for d, _ in distances) - joint, 0.0)
    freedom = sum(n for _, n in distances) - rank
    whole = Agreeing(statistic, freedom, chi2_tail(statistic, freedom))
    each = []
    for part, (own, n) in zip(parts, distances, strict=True):
        rest, m = _distance(H - part.hessian, g - part.gradient)
        apart = max(own + rest - joint, 0.0)
        each.append(Agreeing(apart, n + m - rank, chi2_tail(apart, n + m - rank)))
    return whole, each


def block_means(at: Linear, problem: Problem) -> list[BlockMean]:
    """Return the tests of the means of residuals over 30 ms, by trial, measured quantity and phase.

    Phases with fewer than four samples are left out.
    """
    found = []
    for number, (trial, one) in enumerate(zip(problem.trials, at.shown, strict=True)):
        release = float(at.place[problem.own(number)][-1] * OWN_SIZE[-1])
        begin = 0
        for channel in trial.channels:
            size = channel.values.size
            rows = one.residuals[begin : begin + size].reshape(channel.values.shape)
            begin += size
            phases = _phases(trial, channel.t, release)
            blocks = np.floor((channel.t - channel.t[0]) / BLOCK).astype(int)
            for phase, name in enumerate(PHASES):
                inside = phases == phase
                if inside.sum() < 4:
                    continue
                _, block = np.unique(blocks[inside], return_inverse=True)
                counts = np.bincount(block)
                for part in range(channel.values.shape[1]):
                    sums = np.bincount(block, weights=rows[inside][:, part])
                    statistic = float((sums**2 / counts).sum())
                    found.append(
                        BlockMean(
                            number,
                            channel.name,
                            part,
                            name,
                            statistic,
                            counts.size,
                            chi2_tail(statistic, counts.size),
                        )
                    )
    return found


def neighbours(at: Linear, problem: Problem) -> list[list[np.ndarray]]:
    """Return the correlation of successive residuals, (m,) by trial and channel; 0 for noise."""
    found = []
    for trial, one in zip(problem.trials, at.shown, strict=True):
        begin, of_trial = 0, []
        for channel in trial.channels:
            size = channel.values.size
            rows = one.residuals[begin : begin + size].reshape(channel.values.shape)
            begin += size
            squares = np.maximum((rows**2).sum(axis=0), 1e-300)
            of_trial.append((rows[1:] * rows[:-1]).sum(axis=0) / squares)
        found.append(of_trial)
    return found


def left_out(at: Linear, problem: Problem) -> np.ndarray:
    """Return the change (n, k) of the k shared coordinates if each of n trials were left out.

    It is that of the linear model.  The prior of weighed and held values stays.
    """
    k = problem.shared
    parts = [reduced(at, number, k) for number in range(len(problem.trials))]
    prior = problem.weighed()
    weight = prior.weight[:k]
    off = np.where(weight > 0.0, at.place[:k] - np.where(weight > 0.0, prior.centre[:k], 0.0), 0.0)
    H = sum((part.hessian for part in parts), np.diag(weight))
    g = sum((part.gradient for part in parts), weight * off)
    best = -inverse(H) @ g
    return np.array([-inverse(H - p.hessian) @ (g - p.gradient) - best for p in parts])


def clustered(at: Linear, problem: Problem) -> np.ndarray:
    """Return the covariance (d, d) of a place whose residuals are correlated in a way not known.

    The residuals of one measured part in one phase of a trial are a cluster.  Of each, what it
    alone pulls the parameters by counts (cluster-robust covariance: Liang and Zeger, Biometrika 73,
    1986), beside the covariance by independent noise.
    """
    pulls = np.zeros((problem.dimension, problem.dimension))
    for number, (trial, one, J) in enumerate(
        zip(problem.trials, at.shown, at.jacobians, strict=True)
    ):
        chosen = np.r_[0 : problem.shared, problem.own(number)]
        release = float(at.place[problem.own(number)][-1] * OWN_SIZE[-1])
        begin = 0
        for channel in trial.channels:
            shape, end = channel.values.shape, begin + channel.values.size
            phases = _phases(trial, channel.t, release)
            products = (J[begin:end] * one.residuals[begin:end, None]).reshape(*shape, -1)
            begin = end
            for phase in range(len(PHASES)):
                for pull in products[phases == phase].sum(axis=0):
                    pulls[np.ix_(chosen, chosen)] += np.outer(pull, pull)
    covariance = at.covariance
    return np.asarray(covariance + covariance @ pulls @ covariance)


def _phases(trial: FittedTrial, t: np.ndarray, release: float) -> np.ndarray:
    """Return the index in PHASES at each time, (n,); ``release`` in s."""
    ends = [release, trial.contact + _APPROACH_END, trial.contact + _CONTACT_END]
    return np.searchsorted(np.maximum.accumulate(ends), t, side="right")


def undetermined(at: Linear, k: int) -> list[tuple[np.ndarray, float]]:
    """Return the directions of the first k parameters that the fit does not determine.

    Each direction (k,) has length one in coordinates, and is returned with its standard error along
    it: above ``VAGUE``, or infinite without any information.
    """
    if not k:
        return []
    H, rest = at.hessian[:k, :k], at.hessian[k:, k:]
    cross = at.hessian[:k, k:]
    scale = np.sqrt(np.maximum(np.diag(rest), 1e-300))
    inverted = np.linalg.pinv(rest / np.outer(scale, scale), rcond=1e-12, hermitian=True)
    information = H - cross @ (inverted / np.outer(scale, scale)) @ cross.T
    values, vectors = np.linalg.eigh(0.5 * (information + information.T))
    floor = UNDETERMINED * max(float(values[-1]), 1e-300)
    found = []
    for value, vector in zip(values, vectors.T, strict=True):
        error = math.inf if value <= floor else 1.0 / math.sqrt(value)
        if error > VAGUE:
            found.append((vector, error))
    return found


def direction_words(parameters: Sequence[Input], direction: np.ndarray) -> tuple[str, str]:
    """Return what a direction that is not determined means, in words, and advice what to do."""
    main = np.flatnonzero(np.abs(direction) > 0.25 * np.abs(direction).max()).tolist()
    names = [parameters[i].name for i in main]
    if len(names) == 1:
        return (
            f"{names[0]}: the measurements do not depend on it",
            "leave it out of the fit, or make a trial that depends on it",
        )
    listed = f"{', '.join(names[:-1])} and {names[-1]}"
    # masses, inertias and stiffnesses that all grow together change no motion
    same = len({math.copysign(1.0, direction[i]) for i in main}) == 1
    logs = all(parameters[i].is_log for i in main)
    if same and logs and any(name.endswith(("mass", "inertia")) for name in names):
        text = f"only the ratios of {listed} are determined, not their size"
        masses = [name for name in names if name.endswith("mass")] or names
        return text, f"weigh one: --weighed {masses[0]}='VALUE +- ERROR kg'"
    text = f"only a combination of {listed} is determined"
    return text, "leave one out of the fit, or give it by --weighed"


def at_bounds(place: np.ndarray, problem: Problem, fitted: int) -> list[Input]:
    """Return which of the first parameters are at an end of their range at a place (d,).

    A held value may be there, e.g. a drag of 0.
    """
    found = []
    for parameter, coordinate in zip(problem.parameters[:fitted], place[:fitted], strict=True):
        low, high = parameter.limits
        if coordinate - low < 1e-6 or high - coordinate < 1e-6:
            found.append(parameter)
    return found


def convergence(found: Found, left: float | None = None) -> tuple[str, int]:
    """Return the reason why a fit has not converged, and the number of restarts that agree.

    The reason is empty if the fit has converged.  ``left``: distance of the fitted parameters from
    the aim of a search in which held values have joined, in its standard errors, which contain the
    distance; None if none have.
    """
    near, low = (AS_NEAR, AS_LOW) if left is None else (LEFT_OF_FITTED, SETTLED)
    agreeing = sum(higher < low and apart < near for higher, apart in found.restarts)
    other = [apart for higher, apart in found.restarts if higher < AS_LOW and apart >= near]
    if left is not None and left > LEFT_OF_FITTED:
        text = f"with the held values, the search ended {left:.2g} standard errors from its aim"
        return text, agreeing
    if left is None and found.best.linear.decrease > LEFT:
        return f"the search ended {found.best.left:.2g} standard errors from its aim", agreeing
    if other:
        return (
            f"restarts fit as well {max(other):.2g} standard errors away",
            agreeing,
        )
    if len(found.restarts) < min(found.asked, AGREEING):
        return f"only {len(found.restarts)} of {found.asked} restarts could be simulated", agreeing
    if len(found.restarts) >= AGREEING and agreeing < AGREEING:
        return (
            f"only {agreeing} of {len(found.restarts)} restarts came back to the same place",
            agreeing,
        )
    return "", agreeing


def block_finding(blocks: Sequence[BlockMean], problem: Problem) -> Finding | None:
    """Return the finding on the block means of residuals; None if noise explains them."""
    if not blocks:
        return None
    worst = min(blocks, key=lambda block: (block.p, -block.statistic / block.means))
    if worst.p * len(blocks) >= ALARM_BLOCKS:
        return None
    parts = {3: ("x", "y", "theta"), 1: ("",)}
    trial = problem.trials[worst.trial]
    width = next(c.values.shape[1] for c in trial.channels if c.name == worst.channel)
    name = f"{worst.channel} {parts[width][worst.part]}".strip()
    return Finding(
        "residuals",
        f"the residuals are not noise: means over 30 ms of {name} in phase {worst.phase} of "
        f"{trial.name} have chi2 {worst.statistic:.4g} for {worst.means}",
        "see what the model lacks, leave the trial out, or start nearer to the bench",
    )


def is_noise(problem: Problem, at: Linear) -> bool:
    """Return True if noise explains the means of the residuals."""
    return block_finding(block_means(at, problem), problem) is None
