"""The result of a calibration: values, errors, tests, and whether it counts."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from capture_sim.base.notebook import drawn, html_table
from capture_sim.scene.parts import Scene
from capture_sim.scene.paths import LAUNCH, get, with_values
from capture_sim.studies.fit.checks import (
    SETTLED,
    Agreeing,
    BlockMean,
    Finding,
    clustered,
    left_out,
    undetermined,
)
from capture_sim.studies.fit.descent import Found, step_covariance
from capture_sim.studies.fit.held import Held, held_of
from capture_sim.studies.fit.joint import Linear, Problem, inverse
from capture_sim.studies.fit.prediction import Prediction
from capture_sim.studies.fit.profiles import Profile
from capture_sim.studies.fit.score_tests import Score
from capture_sim.studies.fit.trial import OWN_SIZE
from capture_sim.studies.vary.inputs import Known

#: Names of a trial's start poses.
STARTS = tuple(f"initial.{v}.{name}" for v in ("chaser", "target") for name in ("x", "y", "theta"))
#: Two parameters are hard to separate if their errors are correlated more than this.
INSEPARABLE = 0.95
#: A fit that fails only tests of these kinds is usable, with larger errors, if chi2 per degree of
#: freedom is at most this.  tests/studies/test_calibration.py tries it with small faults of sensors
#: and buffers (test_values_of_a_usable_fit_are_within_its_errors).
_USABLE, USABLE_CHI2 = frozenset({"residuals", "lacks"}), 1.1
#: What is said of a fit that Ctrl-C has ended.
UNFINISHED = Finding(
    "unfinished",
    "unfinished: interrupted before the search and its tests had ended",
    "start it again",
)


class Start(NamedTuple):
    """Start poses and release of a trial, with standard errors; SI."""

    trial: str
    values: np.ndarray  # (6,), of STARTS
    errors: np.ndarray
    release: float  # s after the assumed release
    release_error: float
    is_release_fitted: bool
    slopes: np.ndarray  # (7, d), derivatives of values and release by the search vector
    end: float  # s, end of the measurements used
    cut: float  # s, hold that ended the trial; infinite if there is none
    noise: Mapping[str, np.ndarray]  # standard deviations by series


class Lacking(NamedTuple):
    """A parameter that the model lacks.

    Its estimate is from a fit with all other parameters, or from the score test if it cannot be
    fitted.
    """

    score: Score
    estimate: float  # SI
    error: float
    gain: float  # decrease of chi2
    rivals: tuple[str, ...] = ()  # other candidates with about this gain, the largest first


@dataclass(frozen=True, repr=False)
class Calibration:
    """Parameters of a bench, their errors, and the tests of both; SI units."""

    names: tuple[str, ...]  # names of the shared parameters
    values: np.ndarray  # (k,)
    # (k,), standard errors by noise and by the held values; infinite if not determined
    errors: np.ndarray
    units: tuple[str, ...]
    begun: np.ndarray  # (k,), values at which the search began
    covariance: np.ndarray  # (k, k)
    starts: tuple[Start, ...]  # of each trial
    chi2: float  # of all residuals and weighed values
    freedom: int  # residuals less parameters
    # predicted distance to the minimum, standard errors; of the fitted values if others are held
    left: float
    # of each search but the best: chi2 above the best, and distance from it in standard errors
    restarts: tuple[tuple[float, float], ...]
    agreement: Agreeing  # of all trials
    agreements: tuple[Agreeing, ...]  # of each trial with all other trials
    blocks: tuple[BlockMean, ...]  # means of residuals
    scores: tuple[Score, ...]  # candidates for parameters that the model lacks
    lacking: tuple[Lacking, ...]
    findings: tuple[Finding, ...]  # reasons to reject the fit; empty if there is none
    simulations: int
    scene: Scene = field(repr=False)  # of the first trial, with the fitted values
    weighed: Mapping[str, Known] = field(default_factory=dict)
    held: tuple[Held, ...] = ()  # values that were not asked for, with their uncertainties
    noise_errors: np.ndarray = field(default_factory=lambda: np.zeros(0))  # (k,), with these exact
    notes: tuple[str, ...] = ()  # what of the trials was missing or not used
    profiles: tuple[Profile, ...] = ()
    prediction: Prediction | None = field(default=None, repr=False)
    problem: Problem | None = field(default=None, repr=False)
    linear: Linear | None = field(default=None, repr=False)
    #: Covariance (d, d) of the place of ``linear``, with those of the trials' own numbers.
    whole: np.ndarray | None = field(default=None, repr=False)

    def __repr__(self) -> str:
        """Return the values and whether the fit was found valid, in one line."""
        values = (f"{n} = {v:.6g}" for n, v in zip(self.names, self.values, strict=True))
        return f"Calibration({', '.join(values)}; {self.verdict})"

    def plot(self) -> Any:
        """Return a matplotlib figure; see :func:`capture_sim.plot`.

        Raises
        ------
        MissingPackageError
            matplotlib is not installed.
        """
        return drawn(self)

    def _repr_html_(self) -> str:
        """Return the values with their standard errors for a notebook, and the findings."""
        columns = zip(self.names, self.values, self.errors, self.units, strict=True)
        rows = ((n, f"{v:.6g}", f"+- {e:.2g}", "" if u == "1" else u) for n, v, e, u in columns)
        lines = [f"{self.verdict}: {finding.line}" for finding in self.findings]
        return html_table(f"calibration: {self.verdict}", rows, lines)

    @property
    def is_found(self) -> bool:
        """True if every test of the fit was passed."""
        return not self.findings

    @property
    def is_usable(self) -> bool:
        """True if the fit is found, or if its residuals are noise but for a small part.

        In the second case the errors contain what the residuals of each measured quantity in each
        phase of a trial pull the values by, see :func:`checks.clustered`.
        """
        return self.is_found or _only_widens(self.findings, self.reduced_chi2)

    @property
    def verdict(self) -> str:
        """``found``, ``usable`` or ``not found``."""
        return "found" if self.is_found else "usable" if self.is_usable else "not found"

    @property
    def reduced_chi2(self) -> float:
        """chi2 per degree of freedom."""
        return self.chi2 / self.freedom

    @property
    def correlation(self) -> np.ndarray:
        """Correlations (k, k) of the errors."""
        scale = np.sqrt(np.maximum(np.diag(self.covariance), 1e-300))
        return np.asarray(self.covariance / np.outer(scale, scale))

    @property
    def left_out(self) -> np.ndarray:
        """Change (n, k) of the values, SI, if each of n trials were left out; of a linear model."""
        assert self.problem is not None
        assert self.linear is not None
        k = len(self.names)
        parameters = zip(self.problem.parameters[:k], self.linear.place[:k], strict=True)
        slopes = [parameter.slope(float(x)) for parameter, x in parameters]
        return left_out(self.linear, self.problem)[:, :k] * slopes

    def fields_of(self, scene: Scene) -> dict[str, float]:
        """Return the values that the fit found for fields of a scene by path, SI.

        Held values are among them, because the fitted ones belong to them; hanging mass and drop
        height only where the scene gives them as numbers.
        """
        assert self.problem is not None
        assert self.linear is not None
        return {
            path: parameter.value(float(x))
            for parameter, x in zip(
                self.problem.parameters, self.linear.place[: self.problem.shared], strict=True
            )
            for path in parameter.paths
            if path not in LAUNCH or get(scene, path) is not None
        }


def _only_widens(findings: Sequence[Finding], reduced_chi2: float) -> bool:
    """Return True if findings leave a fit usable, with larger errors."""
    kinds = {finding.kind for finding in findings}
    return bool(kinds) and kinds <= _USABLE and reduced_chi2 <= USABLE_CHI2


def _freedom(problem: Problem) -> int:
    return max(problem.rows - problem.dimension + int(problem.fixed.sum()), 1)


def _covariance(at: Linear, problem: Problem, findings: Sequence[Finding]) -> np.ndarray:
    """Return the covariance (d, d) of a fit, for its errors and its predictions."""
    covariance = step_covariance(at, problem)
    if _only_widens(findings, at.chi2 / _freedom(problem)):
        covariance = covariance + clustered(at, problem) - at.covariance
    return covariance


def _aim(at: Linear) -> np.ndarray:
    """Return the move (d,) to the minimum of a linear model, of the numbers that are free."""
    move, free = np.zeros(at.place.size), at.free
    move[free] = -inverse(at.hessian[np.ix_(free, free)]) @ at.gradient[free]
    return move


def left_of_fitted(at: Linear, problem: Problem, fitted: int) -> float:
    """Return the distance of the fitted parameters from the aim of a search, in standard errors.

    The other parameters of the search are held values; where they go does not matter by itself.
    """
    covariance = step_covariance(at, problem)[:fitted, :fitted]
    move = _aim(at)[:fitted]
    return math.sqrt(max(float(move @ np.linalg.pinv(covariance) @ move), 0.0))


def result_of(
    problem: Problem,
    found: Found,
    findings: Sequence[Finding],
    whole: Agreeing | None = None,
    each: Sequence[Agreeing] = (),
    blocks: Sequence[BlockMean] = (),
    candidates: Sequence[Score] = (),
    lacking: Sequence[Lacking] = (),
    *,
    fitted: int | None = None,
    noise: np.ndarray | None = None,
) -> Calibration:
    """Return a fit as a Calibration, in SI units.

    ``fitted``: number of parameters without the held ones; None if there are none.  ``noise``:
    their covariance with the held ones exact.
    """
    at, shared_count = found.best.linear, problem.shared
    k = shared_count if fitted is None else fitted
    parameters = problem.parameters[:k]
    covariance = _covariance(at, problem, findings)
    slopes = np.array([p.slope(float(x)) for p, x in zip(parameters, at.place[:k], strict=True)])
    values = np.array([p.value(float(x)) for p, x in zip(parameters, at.place[:k], strict=True)])
    known = covariance[:shared_count, :shared_count]
    if k < shared_count:
        # where chatter is rough, a search may end before its aim, and each elsewhere
        aim = _aim(at)
        covariance = covariance + np.outer(aim, aim)
        as_low = [end.linear.place for end in found.others if end.linear.chi2 < at.chi2 + SETTLED]
        for place in as_low:
            covariance += np.outer(place - at.place, place - at.place) / len(as_low)
    shared = covariance[:k, :k] * np.outer(slopes, slopes)
    errors = np.sqrt(np.maximum(np.diag(shared), 0.0))
    for direction, error in undetermined(at, k):
        if not math.isfinite(error):
            errors[np.abs(direction) > 1e-3] = math.inf
    fields, _ = problem.values(at.place)
    first = problem.trials[0].scene
    return Calibration(
        names=tuple(p.name for p in parameters),
        values=values,
        errors=errors,
        units=tuple(p.unit for p in parameters),
        begun=np.array([p.begin for p in parameters]),
        covariance=shared,
        starts=tuple(_start_of(problem, at, n, covariance) for n in range(len(problem.trials))),
        chi2=at.chi2,
        freedom=_freedom(problem),
        left=found.best.left if noise is None else left_of_fitted(at, problem, k),
        restarts=tuple(found.restarts),
        agreement=whole or Agreeing(0.0, 0, 1.0),
        agreements=tuple(each),
        blocks=tuple(blocks),
        scores=tuple(candidates),
        lacking=tuple(lacking),
        held=held_of(problem.parameters, at.place[:shared_count], known, k),
        noise_errors=errors
        if noise is None
        else np.sqrt(np.maximum(np.diag(noise), 0.0)) * np.abs(slopes),
        findings=tuple(findings),
        simulations=problem.simulations,
        scene=with_values(first, fields),
        problem=problem,
        linear=at,
        whole=covariance,
    )


def _start_of(problem: Problem, at: Linear, number: int, covariance: np.ndarray) -> Start:
    """Return the start poses and release of a trial, with standard errors."""
    trial, own = problem.trials[number], problem.own(number)

    def poses(coordinates: np.ndarray) -> np.ndarray:
        along, across, turned, x, y, theta, _ = coordinates * OWN_SIZE
        initial = trial.scene.initial
        c, s = math.cos(theta), math.sin(theta)
        away = np.array([initial.target.x + along, initial.target.y + across])
        away -= [initial.chaser.x, initial.chaser.y]
        chaser = np.array([initial.chaser.x + x, initial.chaser.y + y])
        target = chaser + np.array([[c, -s], [s, c]]) @ away
        angles = initial.chaser.theta + theta, initial.target.theta + turned + theta
        return np.array([*chaser, angles[0], *target, angles[1]])

    place = at.place[own]
    slopes = np.stack(
        [(poses(place + d) - poses(place - d)) / 2e-3 for d in 1e-3 * np.eye(len(place))], axis=1
    )
    full = np.zeros((len(STARTS) + 1, problem.dimension))
    full[:-1, own] = slopes
    full[-1, own.stop - 1] = OWN_SIZE[-1]
    errors = np.sqrt(np.maximum(np.diag(full @ covariance @ full.T), 0.0))
    return Start(
        trial=trial.name,
        values=poses(place),
        errors=errors[:-1],
        release=float(place[-1] * OWN_SIZE[-1]),
        release_error=float(errors[-1]),
        is_release_fitted=trial.is_release_fitted,
        slopes=full,
        end=trial.end,
        cut=trial.cut,
        noise={channel.name: channel.sigma for channel in trial.channels},
    )
