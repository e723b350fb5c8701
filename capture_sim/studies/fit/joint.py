"""The joint problem of all trials of a bench: residuals, their derivatives and information.

The place of a search is one vector (d,): the coordinates of the k shared parameters, then the seven
numbers of each trial.  Derivatives by the shared parameters are central differences with steps of
one standard error along the principal axes of their covariance.  With shorter steps, the roughness
of the chatter would count as information.  The standard error of a common factor of masses and
stiffnesses would then be a tenth of the correct one.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from capture_sim.studies.evaluate.executors import InProcess, answers, workers_of
from capture_sim.studies.fit.trial import (
    OWN,
    OWN_SIZE,
    RELATIVE,
    FittedTrial,
    SimulatedMotion,
    View,
    exact_columns,
    residuals,
    sensor_column,
    simulate,
    view,
)
from capture_sim.studies.vary.inputs import Input

#: Longest step of a difference, in coordinates, and step while no covariance is known.
_LONGEST, _FIRST = 0.03, 0.01
#: Shortest step of a difference; with a shorter one, round-off would matter.
_SHORTEST = 1e-6
#: Longest, first and shortest step for the relative start of a trial, in units of OWN_SIZE.
_LONGEST_OWN, _FIRST_OWN, _SHORTEST_OWN = 0.3, 0.05, 1e-4
#: Directions whose information is below this share of the largest are not determined.
UNDETERMINED = 1e-10


@dataclass(frozen=True)
class Prior:
    """Prior knowledge of the place (d,), independent of the trials: centres and standard errors.

    An infinite error means that nothing is known of a number.
    """

    centre: np.ndarray
    error: np.ndarray

    @property
    def weight(self) -> np.ndarray:
        """Inverse variances, (d,)."""
        return np.asarray(1.0 / self.error**2)

    def chi2(self, place: np.ndarray) -> float:
        """Return the squared distance of a place (d,) from the centre, in standard errors."""
        return float(self.weight @ (place - self.centre) ** 2)


@dataclass
class Shown:
    """Simulation of one trial at a place, its sensor readings, and the residuals."""

    motion: SimulatedMotion
    view: View
    residuals: np.ndarray  # (n,)


@dataclass
class Linear:
    """Linear model of the problem at a place: residuals and their derivatives."""

    place: np.ndarray  # (d,)
    chi2: float  # of the data and the prior
    shown: list[Shown]
    jacobians: list[np.ndarray]  # (n, k + 7) of each trial
    hessian: np.ndarray  # (d, d), with the prior
    gradient: np.ndarray  # (d,), half of that of chi2
    free: np.ndarray  # (d,) bool: False if fixed, or held at an end of its range by the gradient

    @property
    def covariance(self) -> np.ndarray:
        """Covariance (d, d) of the place; zero along directions that are not determined."""
        return inverse(self.hessian)

    @property
    def decrease(self) -> float:
        """Decrease of chi2 to the minimum of the linear model if only the free numbers change."""
        free = self.free
        along = self.gradient[free]
        return float(along @ inverse(self.hessian[np.ix_(free, free)]) @ along)


def inverse(hessian: np.ndarray) -> np.ndarray:
    """Return the inverse of an information matrix, zero along directions without information."""
    covariance = np.zeros_like(hessian)
    # a number without any information, such as a known release, would only have rounding errors
    known = np.flatnonzero(np.diag(hessian) > 0.0)
    if not known.size:
        return covariance
    block = np.ix_(known, known)
    scale = np.sqrt(np.diag(hessian)[known])
    values, vectors = np.linalg.eigh(hessian[block] / np.outer(scale, scale))
    with np.errstate(divide="ignore"):
        inverted = np.where(values > UNDETERMINED * values[-1], 1.0 / values, 0.0)
    covariance[block] = (vectors * inverted) @ vectors.T / np.outer(scale, scale)
    return covariance


@dataclass
class Problem:
    """The problem of fitting shared parameters to some trials jointly."""

    trials: Sequence[FittedTrial]
    parameters: Sequence[Input]
    simulations: int = 0
    #: Called after each simulation.
    tick: Callable[[], None] = field(default=lambda: None)
    #: Runs the simulations of a linear model and of candidates side by side.
    executor: Executor = field(default_factory=InProcess)

    @property
    def shared(self) -> int:
        """Number of shared parameters."""
        return len(self.parameters)

    @property
    def dimension(self) -> int:
        """Length d of the place: the number of shared parameters plus seven of each trial."""
        return self.shared + len(OWN) * len(self.trials)

    @property
    def rows(self) -> int:
        """Number of residuals of all trials, without those of a prior."""
        return sum(trial.size for trial in self.trials)

    def own(self, number: int) -> slice:
        """Return the slice of the place that has the seven numbers of a trial."""
        begin = self.shared + len(OWN) * number
        return slice(begin, begin + len(OWN))

    @property
    def limits(self) -> tuple[np.ndarray, np.ndarray]:
        """Lower and upper limits of the place, (d,) each; infinite for the trials' own numbers."""
        low, high = np.full(self.dimension, -math.inf), np.full(self.dimension, math.inf)
        for k, parameter in enumerate(self.parameters):
            low[k], high[k] = parameter.limits
        return low, high

    @property
    def fixed(self) -> np.ndarray:
        """Mask (d,) of the numbers that are not fitted: the releases that are known exactly."""
        is_fixed = np.zeros(self.dimension, bool)
        for number, trial in enumerate(self.trials):
            is_fixed[self.own(number).stop - 1] = not trial.is_release_fitted
        return is_fixed

    def weighed(self) -> Prior:
        """Return the prior that the weighed values give; all other errors are infinite."""
        centre, error = np.zeros(self.dimension), np.full(self.dimension, math.inf)
        for k, parameter in enumerate(self.parameters):
            if parameter.prior is not None:
                centre[k], error[k] = parameter.prior
        return Prior(centre, error)

    def until(self, times: Sequence[float]) -> Problem:
        """Return the problem with each trial cut off after a time, s."""
        cut = [trial.until(t) for trial, t in zip(self.trials, times, strict=True)]
        return self.replaced(cut)

    def replaced(
        self, trials: Sequence[FittedTrial], parameters: Sequence[Input] | None = None
    ) -> Problem:
        """Return a problem of other trials or parameters, whose simulations this one counts."""
        parameters = self.parameters if parameters is None else parameters
        return Problem(trials, parameters, tick=self._count, executor=self.executor)

    def _count(self) -> None:
        self.simulations += 1
        self.tick()

    # values

    def values(self, place: np.ndarray) -> tuple[dict[str, float], dict[str, float]]:
        """Return fields of the scene by path and errors of sensors by name at a place (d,), SI."""
        fields: dict[str, float] = {}
        sensors: dict[str, float] = {}
        for parameter, coordinate in zip(self.parameters, place[: self.shared], strict=True):
            value = parameter.value(float(coordinate))
            if not parameter.paths:
                sensors[parameter.name] = value
            for path in parameter.paths:
                fields[path] = value
        return fields, sensors

    def residuals_at(self, asked: Sequence[Asked]) -> list[np.ndarray | None]:
        """Return the residuals (n,) of trials at places, side by side where there are workers.

        They are None where a trial cannot be simulated.
        """
        found: list[np.ndarray | None] = []
        tasks = [self._task(*each) for each in asked]
        # a trial is sent once with all of its tasks in a group
        size = max(len(tasks) // (4 * workers_of(self.executor)), 1)
        groups = [tasks[k : k + size] for k in range(0, len(tasks), size)]
        for group in answers(self.executor, _residuals_of, groups):
            for each in group:
                self._count()
                found.append(each)
        return found

    def _task(self, number: int, place: np.ndarray, more: Mapping[str, float] | None) -> _Task:
        fields, sensors = self.values(place)
        return _Task(
            self.trials[number], {**fields, **(more or {})}, place[self.own(number)], sensors
        )

    def chi2(self, place: np.ndarray, prior: Prior) -> tuple[float, list[Shown]]:
        """Return chi2 of data and prior at a place, and the simulated trials.

        If the place is out of range or a trial cannot be simulated, chi2 is infinite and the list
        is empty.
        """
        low, high = self.limits
        if np.any(place < low) or np.any(place > high):
            return math.inf, []
        shown = []
        tasks = [self._task(number, place, None) for number in range(len(self.trials))]
        for one in answers(self.executor, _shown, tasks):
            self._count()
            if one is None:
                return math.inf, []
            shown.append(one)
        data = sum(float(one.residuals @ one.residuals) for one in shown)
        return data + prior.chi2(place), shown

    # derivatives

    def linear(
        self,
        place: np.ndarray,
        prior: Prior,
        covariance: np.ndarray | None,
        known: tuple[float, list[Shown]] | None = None,
    ) -> Linear:
        """Return the linear model of the problem at a place.

        ``covariance`` (d, d) gives the directions and lengths of the differences; None for default
        steps.  ``known`` is the result of :meth:`chi2` at the place, None to compute it.
        """
        chi2, shown = self.chi2(place, prior) if known is None else known
        k = self.shared
        hessian, gradient = np.diag(prior.weight), prior.weight * (place - prior.centre)
        axes = self._axes(covariance)
        changes = iter(self._differences(place, shown, covariance, axes))
        jacobians = []
        for number, one in enumerate(shown):
            J = np.zeros((one.residuals.size, k + len(OWN)))
            J[:, :k] = self._shared_columns(number, one, axes, changes)
            for i, length in enumerate(self._own_lengths(number, covariance)):
                J[:, k + i] = next(changes) / length
            J[:, k + RELATIVE :] = exact_columns(self.trials[number], one.view)
            if not self.trials[number].is_release_fitted:
                J[:, -1] = 0.0
            jacobians.append(J)
            where = np.r_[0:k, self.own(number)]
            hessian[np.ix_(where, where)] += J.T @ J
            gradient[where] += J.T @ one.residuals
        low, high = self.limits
        held = ((place <= low) & (gradient > 0.0)) | ((place >= high) & (gradient < 0.0))
        free = ~(held | self.fixed)
        return Linear(place, chi2, shown, jacobians, hessian, gradient, free)

    def _bench_parameters(self) -> list[int]:
        return [i for i, parameter in enumerate(self.parameters) if parameter.paths]

    def _axes(self, covariance: np.ndarray | None) -> np.ndarray:
        """Return the difference steps for the m parameters that are fields of the scene.

        Each column of the result (m, m) is one step, in coordinates.
        """
        bench = self._bench_parameters()
        if covariance is None or not bench:
            return np.eye(len(bench)) * _FIRST
        values, vectors = np.linalg.eigh(covariance[np.ix_(bench, bench)])
        # a direction without information has no variance here: it gets the longest step
        lengths = np.sqrt(np.maximum(values, 0.0))
        lengths[lengths < _SHORTEST] = _LONGEST
        longest = _LONGEST / np.abs(vectors).max(axis=0)
        return np.asarray(vectors * np.clip(lengths, _SHORTEST, longest))

    def _own_lengths(self, number: int, covariance: np.ndarray | None) -> list[float]:
        """Return the difference steps for the relative start of a trial."""
        begin, lengths = self.own(number).start, []
        for i in range(begin, begin + RELATIVE):
            length = _FIRST_OWN
            if covariance is not None and covariance[i, i] > 0.0:
                length = min(max(math.sqrt(covariance[i, i]), _SHORTEST_OWN), _LONGEST_OWN)
            lengths.append(length)
        return lengths

    def _differences(
        self,
        place: np.ndarray,
        shown: Sequence[Shown],
        covariance: np.ndarray | None,
        axes: np.ndarray,
    ) -> list[np.ndarray]:
        """Return the changes (n,) of the residuals for the steps of each trial, by central
        differences: along the axes of the shared fields, then by the trial's relative start.

        If one side is out of range or cannot be simulated, the difference is one-sided.  If both
        are, it is zero.
        """
        low, high = self.limits
        bench = self._bench_parameters()
        steps: list[tuple[int, np.ndarray]] = []
        for number in range(len(shown)):
            for axis in axes.T:
                step = np.zeros(place.size)
                step[bench] = axis
                steps.append((number, step))
            begin = self.own(number).start
            for i, length in enumerate(self._own_lengths(number, covariance)):
                step = np.zeros(place.size)
                step[begin + i] = length
                steps.append((number, step))
        sides = [(n, place + sign * step) for n, step in steps for sign in (1.0, -1.0)]
        inside = [bool(np.all(at >= low) and np.all(at <= high)) for _, at in sides]
        asked = [Asked(*side) for side, is_in in zip(sides, inside, strict=True) if is_in]
        known = iter(self.residuals_at(asked))
        found = [next(known) if is_in else None for is_in in inside]
        return [
            _change(shown[number].residuals, ahead, back)
            for (number, _), ahead, back in zip(steps, found[::2], found[1::2], strict=True)
        ]

    def _shared_columns(
        self, number: int, one: Shown, axes: np.ndarray, changes: Iterator[np.ndarray]
    ) -> np.ndarray:
        """Return the derivatives (n, k) of a trial's residuals by the shared coordinates."""
        bench, k = self._bench_parameters(), self.shared
        columns = np.zeros((one.residuals.size, k))
        if bench:
            along = [next(changes) for _ in bench]
            columns[:, bench] = np.linalg.solve(axes.T, np.stack(along, axis=1).T).T
        for i, parameter in enumerate(self.parameters):
            if not parameter.paths:
                column = sensor_column(self.trials[number], one.motion, one.view, parameter.name)
                columns[:, i] = column * parameter.scale.size
        return columns


class Asked(NamedTuple):
    """A simulation that is asked for: of a trial, at a place, with values of further fields."""

    number: int
    place: np.ndarray
    more: Mapping[str, float] | None = None


class _Task(NamedTuple):
    """A simulation as a worker gets it."""

    trial: FittedTrial
    fields: dict[str, float]
    own: np.ndarray
    sensors: dict[str, float]


def _shown(task: _Task) -> Shown | None:
    motion = simulate(*task)
    if motion is None:
        return None
    trial, _, own, sensors = task
    seen = view(trial, motion, own, sensors)
    return Shown(motion, seen, residuals(trial, motion, seen, float(own[-1] * OWN_SIZE[-1])))


def _residuals_of(tasks: Sequence[_Task]) -> list[np.ndarray | None]:
    shown = [_shown(task) for task in tasks]
    return [None if one is None else one.residuals for one in shown]


def _change(middle: np.ndarray, ahead: np.ndarray | None, back: np.ndarray | None) -> np.ndarray:
    if ahead is not None and back is not None:
        return np.asarray(0.5 * (ahead - back))
    if ahead is not None:
        return np.asarray(ahead - middle)
    if back is not None:
        return np.asarray(middle - back)
    return np.zeros(middle.size)
