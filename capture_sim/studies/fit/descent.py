"""The search for the least chi2: Levenberg and Marquardt's method over a growing horizon.

The first contact determines all motion after it.  A fit of complete trials from values that are
wrong by some percent ends in one of many false minima of the chatter.  So the fit first covers
only times before the first contact, then a few hundredths of a second after it, and so on.  Each
result is close enough to the minimum of the next fit.  Restarts then check the result.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial

import numpy as np

from capture_sim.dynamics.bench import Bench
from capture_sim.errors import SimulationError
from capture_sim.run.series import PARTS
from capture_sim.studies.fit.joint import Linear, Prior, Problem, inverse
from capture_sim.studies.fit.trial import OWN, OWN_SIZE, FittedTrial

#: Ends of the horizon, s after the first contact.
HORIZON = (-0.8, -0.25, -0.01, 0.02, 0.05, 0.1, 0.25, 0.5, 0.9)
#: Standard errors of the priors of the early fits: of a logarithm, of another coordinate, and of
#: the relative start, in units of OWN_SIZE.
_WEAK_LOG, _WEAK, _WEAK_START = 0.5, 0.3, (5.0, 5.0, 20.0)
#: Predicted decrease of chi2 below which a search ends: of the final fit, and of an early fit.
#: Below them, the largest number of steps of each.
_ENOUGH, _ENOUGH_EARLY = 0.1, 1.0
_STEPS, _STEPS_EARLY = 12, 5
#: An early fit explains the values added to a shorter fit if chi2 grows by less than their number
#: times the first factor, plus the second number of standard deviations of noise.  Otherwise it is
#: repeated from ``_DRAWS`` random starts.  If that fails too, the step of the horizon is halved if
#: it is longer than ``_MIN_HORIZON_STEP`` (s), at most ``_MAX_HALVINGS`` times.  If two starts end
#: with the same chi2, to a share ``_SAME`` of what is not explained, the minimum is no false one:
#: the model lacks something, or a held value is wrong, and the fit goes on.  With chi2 per value
#: above ``_LOST`` the later fits are not repeated either.
_EXCESS, _EXCESS_NOISE, _SAME, _LOST = 1.15, 4.0, 0.02, 5.0
_DRAWS, _MIN_HORIZON_STEP, _MAX_HALVINGS = 2, 0.03, 5
#: Damping of the first step, relative to the diagonal of the Hessian; its factor after a step that
#: lowers chi2 and after one that does not; damping at which the search gives up.
_DAMPING, _EASIER, _HARDER, _STIFFEST = 1e-3, 0.1, 8.0, 1e4
#: Longest step of a shared parameter, in coordinates: of the scene, and of a sensor, which changes
#: no motion.
_MAX_STEP, _MAX_SENSOR_STEP = 0.7, 20.0
#: Standard deviation of the restarts about the best place, in standard errors.
_AWAY = 1.5
#: A restart is moved nearer to the best place, to these shares of its distance in turn, if a trial
#: cannot be simulated there or moves quite differently, e.g. because the tip starts in a wall.  It
#: moves quite differently if chi2 is higher by more than ``_USABLE`` per parameter.
_NEARER, _USABLE = (1.0, 0.5, 0.25, 0.125), 1000.0
#: Number of successive restarts that must find no better place, and largest number of restarts.
RESTARTS, _MAX_RESTARTS = 2, 10
#: Decrease of chi2 from which the end of a restart counts as a better place.  Kinks of chi2 leave a
#: roughness of about one unit.
_BETTER = 0.5
#: If chi2 per measured value is above this, neither noise nor a held value is why; and the limit
#: before the first contact, where the motion has no chatter.
HOPELESS, HOPELESS_BEFORE = 100.0, 10.0
#: Largest shift from the assumed release that is tried, s, and the step of the shifts, s.  If the
#: first contact is later than that, shifts up to the contact are tried.
_RELEASE_RANGE, _RELEASE_STEP = 3.0, 0.01


class HopelessError(Exception):
    """No values explain the trials until ``after``, s after the contact: the search ends there."""

    def __init__(self, part: Problem, at: Linear, after: float) -> None:
        super().__init__(at.chi2 / part.rows)
        self.part, self.at, self.after = part, at, after


@dataclass
class EndedSearch:
    """Result of one search: the last linear model, and the number of steps."""

    linear: Linear
    steps: int

    @property
    def left(self) -> float:
        """Distance to the minimum that the linear model predicts, in standard errors."""
        return math.sqrt(max(self.linear.decrease, 0.0))


@dataclass
class Found:
    """The best search of a fit, and how far from it the other searches ended."""

    best: EndedSearch
    #: For each search but the best: chi2 minus that of the best, and distance in standard errors.
    restarts: list[tuple[float, float]] = field(default_factory=list)
    others: list[EndedSearch] = field(default_factory=list, repr=False)  # these searches
    asked: int = 0  # number of successive restarts that must find no better place


def descend(
    problem: Problem,
    place: np.ndarray,
    prior: Prior,
    covariance: np.ndarray | None,
    *,
    enough: float = _ENOUGH,
    most: int = _STEPS,
    keep: Callable[[Linear], None] = lambda at: None,
) -> EndedSearch | None:
    """Search for the least chi2 from a place (d,); None if a trial cannot be simulated there.

    ``covariance`` (d, d) gives the steps of the first derivatives; None for default steps.  The
    search ends if the predicted decrease of chi2 is below ``enough``, if no step lowers chi2, or
    after ``most`` steps.  ``keep`` is called with each linear model.
    """
    known = problem.chi2(place, prior)
    if not known[1]:
        return None
    at = problem.linear(place, prior, covariance, known)
    keep(at)
    damping = _DAMPING
    low, high = problem.limits
    longest_steps = np.array(
        [_MAX_STEP if parameter.paths else _MAX_SENSOR_STEP for parameter in problem.parameters]
    )
    for step in range(most):
        if at.decrease < enough:
            return EndedSearch(at, step)
        while damping < _STIFFEST:
            diagonal = np.maximum(np.diag(at.hessian), 1e-12)
            damped = at.hessian + damping * np.diag(diagonal)
            free = at.free
            move = np.zeros(place.size)
            move[free] = -np.linalg.solve(damped[np.ix_(free, free)], at.gradient[free])
            # along a direction without information the step could be of any size
            longest = float(np.abs(move[: problem.shared] / longest_steps).max(initial=0.0))
            move *= min(1.0, 1.0 / max(longest, 1e-300))
            there = np.clip(at.place + move, low, high)
            known = problem.chi2(there, prior)
            if known[0] < at.chi2:
                break
            damping *= _HARDER
        else:
            return EndedSearch(at, step)
        damping = max(damping * _EASIER, 1e-7)
        gained = at.chi2 - known[0]
        at = problem.linear(there, prior, step_covariance(at, problem), known)
        keep(at)
        if gained < 0.02 * enough and step > 2:
            return EndedSearch(at, step + 1)
    return EndedSearch(at, most)


def step_covariance(at: Linear, problem: Problem) -> np.ndarray:
    """Return the covariance (d, d) at a place, increased if noise does not explain chi2.

    The factor is chi2 per degree of freedom, and at least 1.
    """
    excess = max(1.0, at.chi2 / max(problem.rows - problem.dimension, 1))
    return at.covariance * excess


def weak_prior(problem: Problem, begin: np.ndarray) -> Prior:
    """Return the prior for early fits: that of the weighed values, and weak priors for all others.

    ``begin`` has the coordinates (k,) about which the weak priors of shared parameters are centred.
    """
    known = problem.weighed()
    centre, error = known.centre.copy(), known.error.copy()
    for k, parameter in enumerate(problem.parameters):
        if not math.isfinite(error[k]):
            centre[k], error[k] = begin[k], _WEAK_LOG if parameter.is_log else _WEAK
            if not parameter.paths:
                error[k] = 10.0 if parameter.name.startswith("delay.") else 5.0
    for number in range(len(problem.trials)):
        own = problem.own(number)
        for i, size in enumerate(_WEAK_START):
            error[own.start + i] = size
    return Prior(centre, error)


def first_place(problem: Problem, begin: np.ndarray) -> np.ndarray:
    """Return the place (d,) where a fit begins.

    The shared coordinates (k,) are ``begin``.  Release and start of each trial are estimated from
    its measured poses.
    """
    place = np.zeros(problem.dimension)
    place[: problem.shared] = begin
    for number, trial in enumerate(problem.trials):
        own = place[problem.own(number)]
        if trial.is_release_fitted:
            own[-1] = _release(trial) / OWN_SIZE[-1]
        own[: len(OWN) - 1] = _start(trial, float(own[-1] * OWN_SIZE[-1]))
    return place


def _release(trial: FittedTrial) -> float:
    """Return the estimated release of the chaser, s after the assumed release.

    It is the time shift at which the simulated path of the chaser fits the measured path best.
    With fewer than eight poses before the contact, it is 0.
    """
    chaser = trial.channels[0]
    end = min(trial.contact, trial.end) - 0.02
    kept = chaser.t < end
    if kept.sum() < 8:
        return 0.0
    t, heading = chaser.t[kept], trial.scene.initial.chaser.theta
    along = chaser.values[kept, 0] * math.cos(heading) + chaser.values[kept, 1] * math.sin(heading)
    grid = np.arange(0.0, max(float(t[-1]) + _RELEASE_RANGE, 0.1), 0.02)
    bench = Bench(trial.scene)
    try:
        q = bench.advance(grid[grid <= trial.scene.run.t_end])["q"]
    except SimulationError as error:
        q = error.partial["q"]
    path = q[:, 0] * math.cos(heading) + q[:, 1] * math.sin(heading)
    latest = max(trial.contact, _RELEASE_RANGE) if math.isfinite(trial.contact) else _RELEASE_RANGE
    shifts = np.arange(-_RELEASE_RANGE, latest, _RELEASE_STEP)
    costs = []
    for shift in shifts:
        off = along - np.interp(t - shift, grid[: path.size], path)
        # a path that hardly moves would fit anywhere: the start pose is that of the scene to 20 mm
        offset = float(np.clip(off.mean(), -0.02, 0.02))
        costs.append(float(((off - offset) ** 2).sum()))
    return float(shifts[int(np.argmin(costs))])


def _start(trial: FittedTrial, release: float) -> np.ndarray:
    """Return the start of a trial, (6,) in units of OWN_SIZE, from the poses before the release.

    It is zero, the start of the scene, if a vehicle has fewer than three poses there.
    """
    initial = trial.scene.initial
    shifts = []
    for channel, pose in zip(trial.channels, (initial.chaser, initial.target), strict=False):
        before = channel.values[channel.t < release]
        if len(before) < 3:
            return np.zeros(6)
        shifts.append(np.median(before, axis=0) - [pose.x, pose.y, pose.theta])
    (x, y, theta), (x_T, y_T, theta_T) = shifts
    # the target relative to the chaser, in the chaser's own frame
    c, s = math.cos(theta), math.sin(theta)
    away = np.array([initial.target.x + x_T, initial.target.y + y_T])
    away -= [initial.chaser.x + x, initial.chaser.y + y]
    own = np.array([c * away[0] + s * away[1], c * away[1] - s * away[0]])
    own -= [initial.target.x - initial.chaser.x, initial.target.y - initial.chaser.y]
    return np.array([*own, theta_T - theta, x, y, theta]) / OWN_SIZE[:6]


def grow(
    problem: Problem,
    begin: np.ndarray,
    rng: np.random.Generator,
    keep: Callable[[Problem, Linear], None] = lambda part, at: None,
) -> tuple[np.ndarray, np.ndarray | None]:
    """Return the place (d,) after fits over a growing horizon, and its covariance (d, d).

    If the fit over a longer time does not explain the added measurements, the chatter has several
    minima.  The fit is then repeated from random places near the result of the shorter fit.  If
    that fails, the step of the horizon is halved.  The covariance is None if no fit was made, e.g.
    because no trial shows a contact.  ``keep`` is called with each part and its linear model.
    HopelessError if chi2 is that of no bench.
    """
    prior = weak_prior(problem, begin)
    stage = _Stage(first_place(problem, begin), None, 0.0, 0)
    contacts = [trial.contact for trial in problem.trials]
    if not any(map(math.isfinite, contacts)):
        return stage.place, None
    waiting, reached, spare = list(HORIZON), -math.inf, _MAX_HALVINGS
    while waiting:
        after = waiting[0]
        ends = [contact + after for contact in contacts]
        if not all(map(_is_enough, problem.trials, ends)):
            del waiting[0]
            continue
        part = problem.until(ends)
        ended = _stage_fit(part, stage, prior, spare, rng, keep, is_after=after > 0.0)
        if ended is None:
            break
        is_far = math.isfinite(reached) and after - reached > _MIN_HORIZON_STEP and after > 0.0
        if spare > 0 and is_far and not (ended.is_found_again or ended.is_explained_since(stage)):
            spare -= 1
            waiting.insert(0, 0.5 * (after + reached))
            continue
        limit = HOPELESS_BEFORE if after < 0.0 else HOPELESS
        if ended.at is not None and ended.chi2 > limit * part.rows:
            raise HopelessError(part, ended.at, after)
        if ended.is_found_again and ended.chi2 > _LOST * part.rows:
            spare = 0
        stage, reached = ended, after
        del waiting[0]
    return stage.place, stage.covariance


@dataclass
class _Stage:
    """Result of an early fit, with the number of residuals ``rows`` of the data."""

    place: np.ndarray
    covariance: np.ndarray | None
    chi2: float
    rows: int
    at: Linear | None = None
    is_found_again: bool = False  # True if two starts have ended there

    def is_explained_since(self, shorter: _Stage) -> bool:
        """Return True if noise explains what chi2 has grown by since a shorter fit.

        ``shorter``: the fit to fewer of the measurements; without any, everything is explained.
        """
        added = self.rows - shorter.rows
        if not shorter.rows or added <= 0:
            return True
        return self.chi2 - shorter.chi2 < _EXCESS * added + _EXCESS_NOISE * math.sqrt(2.0 * added)


def _stage_fit(
    part: Problem,
    stage: _Stage,
    prior: Prior,
    spare: int,
    rng: np.random.Generator,
    keep: Callable[[Problem, Linear], None],
    *,
    is_after: bool,
) -> _Stage | None:
    """Return an early fit that starts from the result of a shorter one, or from places near it.

    The result is the first fit that explains the added measurements, or the best of all.  None if
    no start can be simulated.  ``is_after``: the fit goes beyond the first contact.
    """
    best: _Stage | None = None
    for place in [stage.place, *(_drawn_near(stage, part, rng) if spare > 0 else [])]:
        search = descend(
            part,
            place,
            prior,
            stage.covariance,
            enough=_ENOUGH_EARLY,
            most=_STEPS_EARLY if is_after else _STEPS,
            keep=partial(keep, part),
        )
        if search is None:
            continue
        at, before = search.linear, best
        best = ended = _Stage(at.place, step_covariance(at, part), at.chi2, part.rows, at)
        if before is not None:
            best = min(before, ended, key=lambda each: each.chi2)
            unexplained = best.chi2 - stage.chi2 - (part.rows - stage.rows)
            best.is_found_again = abs(ended.chi2 - before.chi2) < _SAME * unexplained
        if best.is_found_again or best.is_explained_since(stage):
            break
    return best


def _drawn_near(stage: _Stage, part: Problem, rng: np.random.Generator) -> list[np.ndarray]:
    """Return places drawn from the errors of a fit; none if these are not known."""
    if stage.covariance is None:
        return []
    values, vectors = np.linalg.eigh(stage.covariance)
    root = vectors * np.sqrt(np.maximum(values, 0.0))
    off = [root @ rng.standard_normal(values.size) for _ in range(_DRAWS)]
    return [np.clip(stage.place + each, *part.limits) for each in off]


def _is_enough(trial: FittedTrial, end: float) -> bool:
    return sum(int((channel.t <= end).sum()) for channel in trial.channels) > 30


def restart(
    problem: Problem,
    found: EndedSearch,
    rng: np.random.Generator,
    count: int = RESTARTS,
    enough: float = _ENOUGH,
) -> Found:
    """Search again from random places near the best place, and return the best search of all.

    It ends when ``count`` successive restarts have found no better place, or after ten restarts.
    A search ends if the predicted decrease of chi2 is below ``enough``.
    """
    prior = problem.weighed()
    best = found
    ends: list[EndedSearch] = []
    since_best, tried = 0, 0
    while since_best < count and tried < (_MAX_RESTARTS if count else 0):
        tried += 1
        at = best.linear
        covariance = step_covariance(at, problem)
        values, vectors = np.linalg.eigh(covariance)
        draw = vectors @ (np.sqrt(np.maximum(values, 0.0)) * rng.standard_normal(values.size))
        low, high = problem.limits
        for share in _NEARER:
            start = np.clip(at.place + share * _AWAY * draw, low, high)
            chi2, shown = problem.chi2(start, prior)
            if shown and chi2 < at.chi2 + _USABLE * problem.dimension:
                break
        else:
            continue
        again = descend(problem, start, prior, covariance, enough=enough)
        if again is None:
            continue
        ends.append(again)
        since_best += 1
        if again.linear.chi2 < best.linear.chi2:
            if again.linear.chi2 < best.linear.chi2 - max(_BETTER, enough):
                since_best = 0
            best = again
    ends = [found, *ends]
    others = [end for end in ends if end is not best]
    covariance = best.linear.covariance[: problem.shared, : problem.shared]
    return Found(best, [apart(best, end, covariance) for end in others], others, asked=count)


def apart(best: EndedSearch, other: EndedSearch, covariance: np.ndarray) -> tuple[float, float]:
    """Return chi2 of another search minus that of the best, and the distance between their ends.

    The distance is that of the first k parameters, in the standard errors of ``covariance`` (k, k).
    """
    off = (other.linear.place - best.linear.place)[: len(covariance)]
    information = inverse(covariance)
    return other.linear.chi2 - best.linear.chi2, math.sqrt(max(off @ information @ off, 0.0))


def sigma_of(problem: Problem, at: Linear) -> list[dict[str, np.ndarray]]:
    """Return the noise of each trial from first differences of its residuals.

    Each dict has the standard deviations (m,), in SI units, by the name of a channel; channels with
    fewer than nine samples are left out.  Third differences of the measurements would give up to
    10 % too much if samples are not evenly spaced, and so hide a false fit.
    """
    found = []
    for trial, one in zip(problem.trials, at.shown, strict=True):
        begin, of_trial = 0, {}
        for channel in trial.channels:
            rows = one.residuals[begin : begin + channel.values.size]
            begin += channel.values.size
            steps = np.abs(np.diff(rows.reshape(channel.values.shape), axis=0))
            if len(steps) < 8:
                continue
            limit = 8.0 * np.median(steps, axis=0) + 1e-9
            mean = np.where(steps <= np.maximum(limit, 1e-9), steps, 0.0).sum(axis=0)
            count = (steps <= np.maximum(limit, 1e-9)).sum(axis=0)
            # the mean size of a difference of two values is 2 / sqrt(pi) standard deviations
            sigma = channel.sigma * 0.5 * math.sqrt(math.pi) * mean / np.maximum(count, 1)
            least = [part.noise for part in PARTS[channel.name]]
            of_trial[channel.name] = np.maximum(sigma, least)
        found.append(of_trial)
    return found


def renoised(problem: Problem, noises: Sequence[dict[str, np.ndarray]]) -> Problem:
    """Return the problem with other standard deviations of the noise of each trial."""
    trials = [trial.with_noise(noise) for trial, noise in zip(problem.trials, noises, strict=True)]
    return problem.replaced(trials)
