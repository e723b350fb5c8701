"""What a model lacks, after a fit: candidates are fitted too, one at a time, and named in words."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence
from contextlib import suppress

import numpy as np

from capture_sim.scene.paths import expanded
from capture_sim.studies.fit.checks import ALARM_TRIALS, is_noise, trials_agree
from capture_sim.studies.fit.descent import (
    HOPELESS,
    HopelessError,
    descend,
    grow,
    step_covariance,
)
from capture_sim.studies.fit.joint import Linear, Problem
from capture_sim.studies.fit.parameters import begins, parameters_of
from capture_sim.studies.fit.result import Lacking
from capture_sim.studies.fit.score_tests import NAMED, Score, differing, scores
from capture_sim.studies.vary.inputs import Input

#: Largest number of lacking parameters, which are added one at a time, and largest number of
#: candidates that are tried for each.
_MAX_ADDED, _MAX_TRIED = 3, 2
#: A further candidate is tried only if its gain exceeds this share of the best gain.
_ALIKE = 0.3
#: A candidate whose gain is this share of the best gain is not told from the best.
_RIVAL = 0.7
#: Largest number of search steps after a candidate is added.
_ADDED_STEPS = 6
#: A fit is bad if chi2 per measured value is above this.
BAD = 1.5


def what_lacks(
    problem: Problem,
    at: Linear,
    candidates: Sequence[Score],
    may_go_on: Callable[[], bool],
) -> tuple[list[Lacking], bool]:
    """Add the parameters that the model lacks, one at a time, and return them.

    The first is added in any case, others while ``may_go_on``.  Also return whether they are
    enough: with them the residuals are noise, and the trials agree.
    """
    found: list[Lacking] = []
    most = 1 if at.chi2 > HOPELESS * problem.rows else _MAX_ADDED
    for _ in range(most):
        likely = _likely(candidates)
        likely = [s for s in likely if s.gain > _ALIKE * likely[0].gain][:_MAX_TRIED]
        if not likely or (found and not may_go_on()):
            break
        best: tuple[Lacking, Problem, Linear] | None = None
        for score in likely:
            tried = with_one_more(problem, at, score)
            if tried is not None and (best is None or tried[0].gain > best[0].gain):
                best = tried
        if best is None:
            one = likely[0]
            found.append(Lacking(one, one.estimate, one.error, one.gain))
            break
        if BAD * problem.rows < at.chi2 < HOPELESS * problem.rows and may_go_on():
            best = with_one_more(problem, at, best[0].score, grown=True) or best
        rivals = tuple(
            each.name
            for each in _likely(candidates)
            if each.name != best[0].score.name and each.gain > _RIVAL * best[0].score.gain
        )
        found.append(best[0]._replace(rivals=rivals))
        problem, at = best[1:]
        candidates = scores(at, problem)
    if any(not one.score.can_be_fitted for one in found):
        return found, True  # not tried
    return found, is_noise(problem, at) and trials_agree(at, problem)[0].p >= ALARM_TRIALS


def _likely(candidates: Sequence[Score]) -> list[Score]:
    """Return the candidates with gains above NAMED."""
    return [score for score in candidates if score.gain > NAMED]


def with_one_more(
    problem: Problem,
    at: Linear,
    score: Score,
    added: Input | None = None,
    *,
    grown: bool = False,
) -> tuple[Lacking, Problem, Linear] | None:
    """Return a fit with one more parameter, started at its estimate; None if it is impossible.

    ``added``: the parameter; None for the one of the score's name.
    """
    if not score.can_be_fitted:
        return None
    if added is None:
        (added,) = parameters_of(problem.trials[0].scene, [score.name])
    low, high = added.limits
    start = (
        added.position(score.estimate)
        if not added.is_log
        else (
            added.position(added.begin)
            + float(np.clip(score.estimate / added.begin - 1.0, -0.7, 0.7))
        )
    )
    if not math.isfinite(start):
        return None
    start = float(np.clip(start, low, high))
    # an existing parameter that sets the added field too, e.g. c_rr of both vehicles, stays
    wider = problem.replaced(
        problem.trials, [*problem.parameters, dataclasses.replace(added, begin=score.estimate)]
    )
    place = np.insert(at.place, problem.shared, start)
    prior = wider.weighed()
    d = wider.dimension
    covariance = np.zeros((d, d))
    kept = [i for i in range(d) if i != problem.shared]
    covariance[np.ix_(kept, kept)] = step_covariance(at, problem)
    size = added.slope(start)
    covariance[problem.shared, problem.shared] = min((score.error / size) ** 2, 1e-2)
    search = descend(wider, place, prior, covariance, most=_ADDED_STEPS)
    if grown and at.chi2 > BAD * problem.rows:
        # a wrong model has biased the other parameters: restart all of them
        begin = begins(wider.parameters)
        begin[-1] = start
        with suppress(HopelessError):  # what was found without them stays
            there, spread_there = grow(wider, begin, np.random.default_rng(0))
            again = descend(wider, there, prior, spread_there, most=_ADDED_STEPS)
            if search is None or (again is not None and again.linear.chi2 < search.linear.chi2):
                search = again
    if search is None:
        return None
    end = search.linear
    value = added.value(float(end.place[problem.shared]))
    spread = math.sqrt(max(end.covariance[problem.shared, problem.shared], 0.0))
    error = spread * added.slope(float(end.place[problem.shared]))
    return Lacking(score, value, error, at.chi2 - end.chi2), wider, end


def differs_in(at: Linear, problem: Problem, number: int, fitted: int) -> str:
    """Return in words which parameter a trial may have another value of."""
    ranked = differing(at, problem, number, fitted)
    (best, change), *others = ranked
    rivals = [score.name for score, _ in others if score.gain > _RIVAL * best.gain]
    if rivals:
        return f"as if by another value of one of {', '.join((best.name, *rivals))}"
    size = f" ({change:+.2%})" if math.isfinite(change) else ""
    return f"as if by another {best.name} there{size}"


def names_with(name: str, parameters: Sequence[Input]) -> list[str]:
    """Return names of a fit with one more; a short name that has its path gives way to paths."""
    paths = expanded(name)
    found: list[str] = []
    for parameter in parameters:
        if set(parameter.paths) & set(paths):
            found += parameter.paths
        else:
            found.append(parameter.name)
    return found if name in found else [*found, name]


def lacking_text(one: Lacking) -> str:
    """Return a sentence on a parameter that the model lacks."""
    value = (
        f"{one.estimate:.4g} +- {one.error:.2g}"
        if math.isfinite(one.error)
        else (f"about {one.estimate:.3g}")
    )
    unit = "" if one.score.unit == "1" else f" {one.score.unit}"
    if one.rivals:
        names = ", ".join((one.score.name, *one.rivals))
        return (
            f"the model lacks one of {names}, which these trials do not tell apart: chi2 falls by "
            f"{one.gain:.4g} with {one.score.name} = {value}{unit}"
        )
    return (
        f"the model lacks {one.score.name} = {value}{unit} ({one.score.words}): "
        f"chi2 falls by {one.gain:.4g} with it"
    )
