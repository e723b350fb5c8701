"""The joint fit of trials: the search, the held values, restarts, and the tests at its end."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence
from concurrent.futures import Executor

import numpy as np

from capture_sim.dynamics.bench import Bench
from capture_sim.dynamics.compilation import compile_kernels
from capture_sim.errors import SceneError, SimulationError
from capture_sim.scene.paths import with_values
from capture_sim.studies.evaluate.executors import InProcess
from capture_sim.studies.fit.checks import (
    ALARM_TRIALS,
    LEFT,
    Finding,
    at_bounds,
    block_finding,
    block_means,
    convergence,
    direction_words,
    is_noise,
    trials_agree,
    undetermined,
)
from capture_sim.studies.fit.descent import (
    HOPELESS,
    RESTARTS,
    EndedSearch,
    Found,
    HopelessError,
    apart,
    descend,
    grow,
    renoised,
    restart,
    sigma_of,
    step_covariance,
)
from capture_sim.studies.fit.joint import Linear, Problem
from capture_sim.studies.fit.lacking import (
    BAD,
    differs_in,
    lacking_text,
    names_with,
    what_lacks,
    with_one_more,
)
from capture_sim.studies.fit.parameters import SENSOR_ERRORS, begins
from capture_sim.studies.fit.result import (
    UNFINISHED,
    USABLE_CHI2,
    Calibration,
    Lacking,
    left_of_fitted,
    result_of,
)
from capture_sim.studies.fit.score_tests import NAMED, needed, scores
from capture_sim.studies.fit.trial import FittedTrial
from capture_sim.studies.vary.inputs import Input

#: Largest number of search steps after the held values have joined.
_HELD_STEPS = 12
#: Predicted decrease of chi2 below which a search with the held values ends: its 50 and more
#: numbers each gain a little in the roughness of chi2, of about one unit.
_HELD_ENOUGH = 1.0
#: Number of times that the search is begun again with the axes of its own last model.
_HELD_TRIES = 4
#: A held value that is fitted from the start must lower chi2 to this share, or end a bad fit.
_PROGRESS = 0.5
#: Number of held values that are fitted from the start if the others do not join otherwise.
_HELD_GROWN = 2
#: Number of simulations of each trial after which no further way is tried.
MOST_SIMULATIONS = 20_000
#: Step of the first derivatives by a held value, as a share of its uncertainty.
_HELD_SHARE = 0.05
#: A bad fit is repeated once from another start.  Standard deviation of the new start from the
#: first one, in coordinates.
_ELSEWHERE = 0.15


def fit_trials(
    trials: Sequence[FittedTrial],
    parameters: Sequence[Input],
    *,
    restarts: int = RESTARTS,
    seed: int = 0,
    report: Callable[[int, int], None] | None = None,
    has_scores: bool = True,
    held: Sequence[Input] = (),
    executor: Executor | None = None,
) -> Calibration:
    """Fit parameters to trials and test the fit; see :func:`capture_sim.calibrate`.

    ``has_scores``: True to search also for parameters that the model lacks.
    ``held``: weighed parameters that are not asked for.  Errors of sensors are fitted from the
    start, since their derivatives need no simulation; values of the scene join the fit at its end.
    ``executor`` as in :func:`capture_sim.calibrate`.
    """
    compile_kernels()
    sensors = [parameter for parameter in held if not parameter.paths]
    joining = [parameter for parameter in held if parameter.paths]
    counted = _Progress(MOST_SIMULATIONS * len(trials), report)
    fitted, parameters = len(parameters), [*parameters, *sensors]
    problem = Problem(trials, parameters, tick=counted, executor=executor or InProcess())
    unknown = problem.dimension - len(sensors)
    if problem.rows < unknown:
        raise SceneError(
            f"{problem.rows} measured values for {unknown} parameters (with seven of "
            "each trial): must be more values than parameters"
        )
    begin = begins(parameters)
    _check_start(problem, begin)
    fitting = _Fitting(problem, fitted)
    try:
        fitting.run(begin, seed)
        if not fitting.joins(joining):
            is_another = restarts > 0 and fitting.begins_elsewhere(begin, seed)
            if not (is_another and fitting.joins(joining)):
                fitting.join_one_by_one(joining)
        fitting.confirm(restarts, seed)
        found = _tested(fitting, has_scores=has_scores)
    except HopelessError as no_way:
        found = _hopeless(no_way, fitted)
    except KeyboardInterrupt:
        if fitting.latest is None:
            raise
        found = fitting.unfinished()
    return dataclasses.replace(found, simulations=counted.done)


class _Progress:
    """Counts simulations and reports their number."""

    def __init__(self, most: int, report: Callable[[int, int], None] | None) -> None:
        self.done, self.most, self._report = 0, most, report

    def __call__(self) -> None:
        self.done += 1
        if self._report is not None:
            self._report(self.done, self.most)


def _check_start(problem: Problem, begin: np.ndarray) -> None:
    """Raise SceneError if a trial cannot be simulated where the search begins."""
    place = np.zeros(problem.dimension)
    place[: problem.shared] = begin
    fields, _ = problem.values(place)
    for trial in problem.trials:
        try:
            bench = Bench(with_values(trial.scene, fields))
            bench.advance(np.array([min(max(trial.end, 0.01), trial.scene.run.t_end)]))
        except (SceneError, SimulationError) as error:
            raise SceneError(f"{trial.name}: cannot be simulated at the start: {error}") from None


def _hopeless(no_way: HopelessError, fitted: int) -> Calibration:
    """Return the result of a search that has ended early."""
    part, at, after = no_way.part, no_way.at, no_way.after
    when = f"{1e3 * after:.3g} ms after" if after > 0.0 else "before"
    finding = Finding(
        "convergence",
        f"not converged: the search has ended {when} the first contact, where chi2 is "
        f"{at.chi2 / part.rows:.4g} per measured value: the scene's bench does not move so",
        "look for wrong units, axes or values of the scene, or for another scene",
    )
    blocks = block_means(at, part)
    worst = block_finding(blocks, part)
    findings = [finding, *([worst] if worst is not None else [])]
    return result_of(part, Found(EndedSearch(at, 0)), findings, blocks=blocks, fitted=fitted)


class _Fitting:
    """A fit in progress; its latest state is available at any time."""

    def __init__(self, problem: Problem, fitted: int) -> None:
        self.problem = problem
        self.latest: tuple[Problem, Linear] | None = None
        self.found: Found | None = None
        self.joined: EndedSearch | None = None  # the search with the held values, if they joined
        self.is_cut_off = False  # True if they should have joined, but no search had them
        self.whole = problem  # counts the simulations of all others
        self.is_ended_early = False  # True if something was not tried for want of simulations
        self.fitted = fitted  # number of parameters, without held ones
        self.noise: np.ndarray | None = None  # their covariance with held ones exact

    def may_go_on(self) -> bool:
        """Return False, and remember it, if as many simulations were made as a fit may have."""
        is_left = self.whole.simulations < MOST_SIMULATIONS * len(self.whole.trials)
        self.is_ended_early = self.is_ended_early or not is_left
        return is_left

    def run(self, begin: np.ndarray, seed: int) -> None:
        """Fit over a growing horizon, then with the noise of the residuals."""
        rng = np.random.default_rng(seed)
        search = self._grown(self.problem, begin, rng)
        search = self._renoised(search)
        self.found = Found(search)
        self._keep(self.found.best.linear)

    def begins_elsewhere(self, begin: np.ndarray, seed: int) -> bool:
        """Repeat a bad fit from another start: chatter may have trapped it in a false minimum.

        Return True if that fit is better.
        """
        assert self.found is not None
        before, first = self.problem, self.found.best
        if first.linear.chi2 <= BAD * before.rows or not self.may_go_on():
            return False
        rng = np.random.default_rng([seed, 2])
        low, high = (limits[: begin.size] for limits in before.limits)
        there = np.clip(begin + _ELSEWHERE * rng.standard_normal(begin.size), low, high)
        try:
            search = self._grown(before, there, rng)
        except (HopelessError, SceneError):  # nothing works from there: what was found stays
            search = first
        if search.linear.chi2 >= first.linear.chi2:
            self.problem = before
            return False
        self.found = Found(self._renoised(search))
        self._keep(self.found.best.linear)
        return True

    def confirm(self, restarts: int, seed: int) -> None:
        """Restart a fit that may count."""
        assert self.found is not None
        best = self.joined or self.found.best
        if not _may_count(self.problem, best.linear):
            return
        rng = np.random.default_rng([seed, 1])
        enough = {"enough": _HELD_ENOUGH} if self.joined else {}
        self.found = restart(self.problem, best, rng, restarts, **enough)
        if self.joined:
            self.joined = self.found.best
        self._keep(self.found.best.linear)

    def join_one_by_one(self, held: Sequence[Input]) -> None:
        """Fit the held value that explains most of the residuals from the start; others join then.

        A fit that began with wrong values of them may have ended where they do not help.
        """
        assert self.found is not None
        for _ in range(_HELD_GROWN):
            at = self.found.best.linear
            if at.chi2 > HOPELESS * self.problem.rows or not self.may_go_on():
                return
            ranked = [(needed(at, self.problem, each), each) for each in held]
            best, needy = max(
                ((score, each) for score, each in ranked if score is not None),
                key=lambda pair: pair[0].gain,
                default=(None, None),
            )
            if best is None or needy is None or best.gain < NAMED:
                return
            tried = with_one_more(self.problem, at, best, needy, grown=True)
            if tried is None:
                return
            if tried[2].chi2 >= max(_PROGRESS * at.chi2, min(at.chi2, BAD * self.problem.rows)):
                return
            _, self.problem, at = tried
            self.found = Found(EndedSearch(at, 0))
            self._keep(at)
            held = [each for each in held if each is not needy]
            if self.joins(held):
                return

    def joins(self, held: Sequence[Input]) -> bool:
        """Let held values join the fit as weighed parameters, and go on for a few steps.

        Return False if no search from here explains the trials.
        """
        assert self.found is not None
        if not held:
            return _may_count(self.problem, self.found.best.linear)
        if self.found.best.linear.chi2 > HOPELESS * self.problem.rows:
            return False
        self.is_cut_off = False
        narrow, at = self.problem, self.found.best.linear
        k, n = narrow.shared, len(held)
        covariance = step_covariance(at, narrow)
        wide = narrow.replaced(narrow.trials, [*narrow.parameters, *held])
        prior = wide.weighed()
        place = np.insert(at.place, k, prior.centre[k : k + n])
        wider = np.zeros((wide.dimension, wide.dimension))
        kept = [*range(k), *range(k + n, wide.dimension)]
        wider[np.ix_(kept, kept)] = covariance
        # the trials know most of them better than that: with longer steps, touches would be others
        wider[range(k, k + n), range(k, k + n)] = (_HELD_SHARE * prior.error[k : k + n]) ** 2
        least = math.inf
        for _ in range(_HELD_TRIES):
            search = descend(wide, place, prior, wider, most=_HELD_STEPS, enough=_HELD_ENOUGH)
            if search is None or search.linear.decrease < LEFT:
                break
            if search.linear.chi2 > least - _HELD_ENOUGH:
                break  # the other axes were no better
            least = search.linear.chi2
            if search.linear.chi2 > BAD * wide.rows:
                return False  # they are not why, either
            # the axes of the derivatives were wrong: those of this model are better
            place, wider = search.linear.place, step_covariance(search.linear, wide)
        if search is None:
            self.is_cut_off = True
            return False
        if not (is_noise(narrow, at) or _may_count(wide, search.linear)):
            return False  # they would hide a part of what the model lacks
        self.problem, self.joined = wide, search
        self.noise = _given_the_rest(covariance[:k, :k], self.fitted)
        self._keep(search.linear)
        return True

    def _grown(self, problem: Problem, begin: np.ndarray, rng: np.random.Generator) -> EndedSearch:
        place, covariance = grow(problem, begin, rng, self._keep_early)
        return self._search(problem, place, covariance)

    def _renoised(self, search: EndedSearch) -> EndedSearch:
        """Repeat the search with the noise estimated from the residuals."""
        problem = renoised(self.problem, sigma_of(self.problem, search.linear))
        at = search.linear
        return self._search(problem, at.place, step_covariance(at, problem))

    def _search(
        self, problem: Problem, place: np.ndarray, covariance: np.ndarray | None
    ) -> EndedSearch:
        self.problem = problem
        search = descend(problem, place, problem.weighed(), covariance, keep=self._keep)
        if search is None:
            raise SceneError(
                "the search left the range in which the bench works: begin nearer to the bench"
            )
        return search

    def _keep_early(self, part: Problem, at: Linear) -> None:
        self.latest = part, at

    def _keep(self, at: Linear) -> None:
        self.latest = self.problem, at

    def unfinished(self) -> Calibration:
        """Return the latest state as a calibration with the finding ``unfinished``."""
        assert self.latest is not None
        problem, at = self.latest
        self.noise = None
        fitted = min(self.fitted, problem.shared)
        return result_of(problem, Found(EndedSearch(at, 0)), [UNFINISHED], fitted=fitted)


def _may_count(problem: Problem, at: Linear) -> bool:
    """Return True if a fit may be found or usable, as far as its residuals go."""
    return at.chi2 <= USABLE_CHI2 * problem.rows or is_noise(problem, at)


def _given_the_rest(covariance: np.ndarray, count: int) -> np.ndarray:
    """Return the covariance (count, count) of the first numbers where all others are exact."""
    others = covariance[:count, count:]
    known = others @ np.linalg.pinv(covariance[count:, count:]) @ others.T
    return np.asarray(covariance[:count, :count] - known)


def _tested(fitting: _Fitting, *, has_scores: bool) -> Calibration:
    """Test a fit and return it as a calibration."""
    assert fitting.found is not None
    problem, found = fitting.problem, fitting.found
    findings: list[Finding] = []
    left = None
    if fitting.joined is not None:
        # what a restart is off by counts in errors that have the held values
        fitted = fitting.fitted
        wide = step_covariance(fitting.joined.linear, problem)[:fitted, :fitted]
        ends = [apart(found.best, end, wide) for end in found.others]
        found = dataclasses.replace(found, best=fitting.joined, restarts=ends)
        left = left_of_fitted(fitting.joined.linear, problem, fitting.fitted)
    reason, _ = convergence(found, left)
    if fitting.is_cut_off:
        reason = "with the held values, the search left the range in which the bench works"
    at = found.best.linear
    if reason:
        findings.append(
            Finding(
                "convergence",
                f"not converged: {reason}",
                "fit fewer parameters, weigh one, or start nearer to the bench",
            )
        )
    whole, each = trials_agree(at, problem)
    if whole.p < ALARM_TRIALS:
        worst = int(np.argmax([one.statistic for one in each]))
        findings.append(
            Finding(
                "trials",
                f"the trials do not agree (chi2 {whole.statistic:.4g} for {whole.freedom}): "
                f"{problem.trials[worst].name} is furthest from the others "
                f"({each[worst].statistic:.4g} for {each[worst].freedom}), "
                f"{differs_in(at, problem, worst, fitting.fitted)}",
                "leave it out, or look for what changed on the bench",
            )
        )
    blocks = block_means(at, problem)
    if (finding := block_finding(blocks, problem)) is not None:
        findings.append(finding)
    candidates = scores(at, problem) if has_scores else []
    lacking: list[Lacking] = []
    is_enough = True
    if candidates and candidates[0].gain > NAMED:
        lacking, is_enough = what_lacks(problem, at, candidates, fitting.may_go_on)
    if fitting.is_ended_early:
        text = f"the search ended after {fitting.whole.simulations} simulations, with ways untried"
        findings.append(Finding("budget", text, "start nearer to the bench, or fit fewer trials"))
    for one in lacking:
        if not is_enough:
            advice = (
                "with all that is named the residuals are still not noise, so the cause may be "
                "another, which has no candidate, e.g. a hysteresis"
            )
        elif one.rivals:
            advice = "measure them apart: the cause may also have no candidate"
        elif one.score.can_be_fitted:
            names = " ".join(names_with(one.score.name, problem.parameters[: fitting.fitted]))
            advice = f"if the bench can have it, fit it too: --fit {names}"
        else:
            advice = "add it to the scene, if the bench can have it"
        if one.score.name in SENSOR_ERRORS and one.score.name.startswith("delay"):
            advice += ", or set the clock right"
        findings.append(Finding("lacks", lacking_text(one), advice))
    for parameter in at_bounds(at.place, problem, fitting.fitted):
        value = parameter.value(float(at.place[list(problem.parameters).index(parameter)]))
        findings.append(
            Finding(
                "bound",
                f"{parameter.name} = {value:.6g} {parameter.unit}".rstrip()
                + " is at the end of its range",
                "the model lacks something, or the scene's other values are wrong",
            )
        )
    for direction, _ in undetermined(at, fitting.fitted):
        findings.append(Finding("undetermined", *direction_words(problem.parameters, direction)))
    tests = whole, each, blocks, candidates, lacking
    return result_of(problem, found, findings, *tests, fitted=fitting.fitted, noise=fitting.noise)
