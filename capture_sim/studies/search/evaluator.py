"""Evaluation of buffers for a design: by one run, by runs with drawn values, by capture range.

The capture range is the share of an area of approaches (angle and offset) that ends in a capture.

A buffer is feasible if its run keeps all limits and ends in a capture that the tip has not left
again.  Infeasible buffers are compared by their violation.  If a load exceeds its limit, the
violation is the logarithm of the largest ratio of a load to its limit.  A capture that the tip left
again has a larger violation.  A run without a capture has a still larger one, which grows with the
closest approach to BE.  A run that stopped has the largest violation.

With dispersions, all candidates are run with the same draws.  The loads of a candidate are then
quantiles: the values that the required number of draws does not exceed.  The search selects the
candidate that suits these particular draws best.  Therefore it requires one standard deviation more
successful draws than the requested share.  Without dispersions, the capture range is computed with
the scene's own values.  With dispersions, the runs along each grid line of the area use the values
of one draw.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, field
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from capture_sim.base.journal import Journal
from capture_sim.errors import SceneError
from capture_sim.scene import paths
from capture_sim.scene.parts import Scene
from capture_sim.studies.evaluate.capture_range import capture_ranges, points_of
from capture_sim.studies.evaluate.dispersion import Probability, probability
from capture_sim.studies.evaluate.executors import answers, workers_of
from capture_sim.studies.evaluate.limits import CAPTURE_RANGE, LOAD_KEYS, ROUND_OFF, Limit, Measure
from capture_sim.studies.evaluate.outcome import CAPTURED
from capture_sim.studies.evaluate.sweep import FAILED, Recipe, result_columns, run_rows, samples_of
from capture_sim.studies.search.variables import fields_of
from capture_sim.studies.vary.inputs import Input
from capture_sim.studies.vary.sampling import Correlations

#: Number of draws of each candidate, and number of new draws of the check at the end.
DRAWS, CHECK_DRAWS = 60, 400
#: Share of the draws that are run first.  The others are run only if the candidate may still be
#: feasible.
_FIRST_DRAWS = 0.25
#: Violations: the maximum for a limit (the logarithm of load over limit), and the values for a
#: capture that the tip left, for a run without a capture and for a run that stopped.
_MAX_EXCESS, _LEFT, _NO_CAPTURE, _STOPPED = 5.0, 6.0, 12.0, 100.0
#: Results of a run that a design needs in addition to the columns of a sweep.
_ALSO = ("behind",)
#: Draws are run only for candidates whose own run has a smaller violation than this value.
_WORTH_DRAWS = 0.4
#: The area is run only for candidates whose own run has a smaller violation than this value.  The
#: others count as a capture range of 0, which adds 1 to the violation if a range is required.
_WORTH_AREA = 0.1
#: Bisections of each edge of a capture range; the error of an edge is then 1/32 of a cell.
_BISECTIONS = 4
#: Maximum number of runs in one task of a worker, and the number of tasks of each worker for a
#: small population.
_RUNS_OF_CHUNK, _CHUNKS = 20, 4


@dataclass(frozen=True)
class Dispersions:
    """Distributions by name, as for :func:`capture_sim.sweep`, and their correlations."""

    vary: Mapping[str, Any]
    correlations: Correlations = field(default_factory=dict)


@dataclass(frozen=True)
class Requirements:
    """Limits that a buffer must keep, and objectives.

    Attributes
    ----------
    objectives : tuple of Measure
        Loads to minimise, or the capture range to maximise; one to three.
    limits : tuple of Limit
        Upper limits of loads.
    under : Dispersions or None
        Dispersions with which the limits must be kept; None for the scene's own values only.
    confidence : float
        Share of the draws that must end in a capture with all limits kept.
    draws : int
        Number of draws of each candidate.
    area : tuple of Input
        Area of approach for the capture range, see
        :mod:`capture_sim.studies.evaluate.capture_range`.
    least_range : float
        Least capture range that is required, 0 to 1.
    allow_leaving : bool
        True to accept a capture that the tip has left again at ``run.t_end``.
    hold_at_be : bool
        True if a tip that is then further behind BE than the capture radius counts as having left,
        because it has flown through the target.  So does a tip that the scene's latch has missed.
    """

    objectives: tuple[Measure, ...]
    limits: tuple[Limit, ...] = ()
    under: Dispersions | None = None
    confidence: float = 0.95
    draws: int = DRAWS
    area: tuple[Input, ...] = ()
    least_range: float = 0.0
    allow_leaving: bool = False
    hold_at_be: bool = True

    def __post_init__(self) -> None:
        """Raise SceneError if a capture range is required or an objective, but there is no area."""
        asked = self.least_range or any(each.key == CAPTURE_RANGE for each in self.objectives)
        if asked and not self.area:
            raise SceneError("capture_range: must have an area of approach (--approach)")

    def tightened(self, share: float) -> Requirements:
        """Return the requirements with all limits reduced by a share, e.g. 0.01 for 1 %."""
        return dataclasses.replace(self, limits=tuple(x.scaled(1.0 - share) for x in self.limits))

    def with_limit(self, limit: Limit, factor: float) -> Requirements:
        """Return the requirements with one limit multiplied by a factor."""
        limits = tuple(x.scaled(factor) if x == limit else x for x in self.limits)
        return dataclasses.replace(self, limits=limits)


@dataclass(frozen=True)
class Candidate:
    """A buffer that was tried, and its results.

    With dispersions, the loads are quantiles at the required share of the draws.
    """

    values: Mapping[str, float]  # by name, SI
    loads: Mapping[str, float]  # by name in results, SI; NaN if not measured
    verdict: str  # of the scene's own run
    violation: float  # 0 if the buffer is feasible
    share: float | None = None  # of draws captured within the limits; None without draws
    range_error: float = math.nan  # error of the capture range
    left_again: bool = False  # the tip was captured, and is outside at t_end
    behind: float = 0.0  # distance of its centre behind BE at t_end, m; 0 within the capture radius

    @property
    def feasible(self) -> bool:
        """True if the buffer meets the requirements."""
        return self.violation <= 0.0

    @property
    def captured_share(self) -> float:
        """Capture range, 0 to 1; 0 if it was not measured."""
        return _number(self.loads.get(CAPTURE_RANGE, 0.0))

    def costs(self, objectives: Sequence[Measure]) -> list[float]:
        """Return the costs of the objectives; a lower cost is better, see :meth:`Measure.cost`."""
        return [each.cost(_number(self.loads[each.key])) for each in objectives]


def costs_of(candidates: Sequence[Candidate], objectives: Sequence[Measure]) -> np.ndarray:
    """Return the costs of candidates, (n, objectives); a lower cost is better."""
    costs = [each.costs(objectives) for each in candidates]
    return np.array(costs, dtype=float).reshape(-1, len(objectives))


def _number(value: float) -> float:
    return 0.0 if math.isnan(value) else value


#: Kinds of runs in an archive: runs at the tolerance of the search, and runs of an earlier design.
SEARCH, EARLIER = "search", "earlier"
#: Suffix of the kind of runs that no search has asked for yet: another design does not begin there.
_AHEAD = ", ahead"


class _Runs(NamedTuple):
    """Results of some runs, in the order of the runs."""

    verdicts: list[str]
    left_again: list[bool]
    loads: np.ndarray  # (n, keys), SI
    violations: np.ndarray  # (n,)
    behind: list[float]  # distance of the tip's centre behind BE, m


#: Stored results of a run: verdict, left again, closest approach to BE, loads.
_Result = tuple[Any, ...]


class Archive:
    """All runs of a design by kind and input values, in a journal or in memory only.

    A run that is in the archive is not repeated.  A design that was killed therefore resumes and
    gives the same result as an uninterrupted design.
    """

    def __init__(self, journal: Journal | None = None) -> None:
        self._journal = journal
        self._known: dict[tuple[str, tuple[str, ...], tuple[float, ...]], _Result] = {}
        #: Runs of an earlier design, as (names, values), from which this design starts.
        self.earlier: list[tuple[tuple[str, ...], tuple[float, ...]]] = []
        for entry in journal.entries if journal is not None else ():
            self._learn(*entry)

    def add(
        self,
        kind: str,
        names: Sequence[str],
        rows: Sequence[Sequence[float]],
        results: Sequence[_Result],
    ) -> None:
        """Store runs.

        Runs of the kind ``earlier`` are of an earlier design, from which this design starts.
        """
        if self._journal is not None:
            self._journal.add([kind, names, rows, results])
        self._learn(kind, names, rows, results)

    def _learn(
        self,
        kind: str,
        names: Sequence[str],
        rows: Sequence[Sequence[float]],
        results: Sequence[_Result],
    ) -> None:
        if kind == EARLIER:
            self.earlier += [(tuple(names), tuple(row)) for row in rows]
            kind = SEARCH
        for row, result in zip(rows, results, strict=True):
            self._known[kind, tuple(names), tuple(row)] = tuple(result)

    def get(self, kind: str, names: tuple[str, ...], row: tuple[float, ...]) -> _Result | None:
        """Return the results of a run; None if it is not in the archive."""
        return self._known.get((kind, names, row))


#: Function that returns candidates by their values if all of them were run before, else None.
KnownOf = Callable[[Sequence[Mapping[str, float]]], list[Candidate] | None]
#: Function that yields the values of buffers that may be asked for later, the likeliest first.
Ahead = Callable[[KnownOf], Iterator[Mapping[str, float]]]


class Evaluator:
    """Runs buffers and returns them as candidates.

    ``history`` has all candidates in order.  ``kind`` names the scene's run settings in the
    archive.
    """

    def __init__(
        self,
        scene: Scene,
        requirements: Requirements,
        seed: int,
        executor: Executor,
        report: Callable[[Candidate], None] | None = None,
        archive: Archive | None = None,
        kind: str = SEARCH,
    ) -> None:
        self._scene, self._requirements = scene, requirements
        self._seed, self._executor, self._report = seed, executor, report
        self._archive, self._kind = archive or Archive(), kind
        self.history: list[Candidate] = []
        self._columns = (*result_columns(check=False, limited=False), *_ALSO)
        wanted = ("verdict", "left_again", *_ALSO, "nearest_distance", *LOAD_KEYS)
        self._wanted = [self._columns.index(name) for name in wanted]

    def under(self, requirements: Requirements) -> Evaluator:
        """Return an evaluator with other requirements, for the same scene and archive."""
        return Evaluator(
            *(self._scene, requirements, self._seed, self._executor, self._report),
            *(self._archive, self._kind),
        )

    def alone(
        self, values: Sequence[Mapping[str, float]], ahead: Ahead | None = None
    ) -> list[Candidate]:
        """Return candidates evaluated by the scene's own run and, if there is one, over the area.

        ``values`` are the free values of each buffer by name, SI.  ``ahead`` gives those of buffers
        that may be asked for later: workers that are free run them, for the archive alone.
        """
        return self._noted(self._alone(values, ahead))

    def known(self, values: Sequence[Mapping[str, float]]) -> list[Candidate] | None:
        """Return candidates that :meth:`alone` would not run; None if it would."""
        results = []
        for row in (fields_of(self._scene, each) for each in values):
            names, numbers = tuple(row), tuple(row.values())
            result = self._archive.get(self._kind, names, numbers)
            result = result or self._archive.get(self._kind + _AHEAD, names, numbers)
            if result is None:
                return None
            results.append(result)
        if not results or self._requirements.area:
            return None
        return self._candidates(values, self._evaluated(results))

    def _noted(self, candidates: list[Candidate]) -> list[Candidate]:
        self.history += candidates
        for candidate in candidates:
            if self._report is not None:
                self._report(candidate)
        return candidates

    def _alone(
        self, values: Sequence[Mapping[str, float]], ahead: Ahead | None = None
    ) -> list[Candidate]:
        hints = ahead(self.known) if ahead is not None else iter(())
        later = (fields_of(self._scene, each) for each in hints)
        runs = self._run([fields_of(self._scene, each) for each in values], later)
        found = self._candidates(values, runs)
        return self._with_ranges(found) if self._requirements.area else found

    @staticmethod
    def _candidates(values: Sequence[Mapping[str, float]], runs: _Runs) -> list[Candidate]:
        return [
            Candidate(
                *(each, dict(zip(LOAD_KEYS, loads, strict=True)), verdict, violation),
                left_again=left_again,
                behind=behind,
            )
            for each, loads, verdict, violation, left_again, behind in zip(
                values,
                *(runs.loads.tolist(), runs.verdicts, runs.violations.tolist()),
                *(runs.left_again, runs.behind),
                strict=True,
            )
        ]

    def _run(
        self, rows: Sequence[Mapping[str, float]], ahead: Iterable[Mapping[str, float]] = ()
    ) -> _Runs:
        """Return the results of some runs; runs in the archive are not repeated."""
        names = tuple(rows[0])
        values = [tuple(row.values()) for row in rows]
        known = partial(self._archive.get, self._kind, names)
        run_ahead = partial(self._archive.get, self._kind + _AHEAD, names)
        new = dict.fromkeys(row for row in values if known(row) is None)
        if came := {row: result for row in new if (result := run_ahead(row)) is not None}:
            self._archive.add(self._kind, names, list(came), list(came.values()))
        asked = [row for row in new if row not in came]
        workers = workers_of(self._executor)
        later: dict[tuple[float, ...], None] = {}
        if 0 < len(asked) < workers:
            for row in (tuple(each.values()) for each in itertools.islice(ahead, 4 * workers)):
                if row not in new and known(row) is None and run_ahead(row) is None:
                    later[row] = None
                if len(asked) + len(later) == workers:
                    break
        size = max(min(_RUNS_OF_CHUNK, len(asked) // (_CHUNKS * workers)), 1)
        tasks = [asked[k : k + size] for k in range(0, len(asked), size)] + [[row] for row in later]
        work = partial(run_rows, Recipe(self._scene, names), False, (), also=_ALSO)
        for task, done in zip(tasks, answers(self._executor, work, tasks), strict=True):
            results = [tuple(row[k] for k in self._wanted) for row in done]
            kind = self._kind + (_AHEAD if task[0] in later else "")
            self._archive.add(kind, names, task, results)
        return self._evaluated([result for row in values if (result := known(row)) is not None])

    def _evaluated(self, results: Sequence[_Result]) -> _Runs:
        """Return the outcomes of some runs, evaluated by the requirements."""
        verdicts, left, behind, nearest, *loads = zip(*results, strict=True)
        by_load = np.array(loads, dtype=float).T
        holds = self._requirements.hold_at_be
        # a tip that a latch has missed only lingers at BE
        forces = np.nan_to_num(by_load[:, LOAD_KEYS.index("max_latch_force")])
        misses = (forces == 0.0) & (holds and self._scene.latch is not None)
        lefts = [
            bool(x or missed) or (holds and y > 0.0)
            for x, y, missed in zip(left, behind, misses.tolist(), strict=True)
        ]
        violations = self._violations(verdicts, lefts, np.array(nearest, dtype=float), by_load)
        return _Runs(list(verdicts), lefts, by_load, violations, list(behind))

    def _violations(
        self,
        verdicts: Sequence[str],
        left: Sequence[bool],
        nearest: np.ndarray,
        loads: np.ndarray,
    ) -> np.ndarray:
        violations = np.zeros(len(loads))
        for limit in self._requirements.limits:
            use = np.nan_to_num(loads[:, LOAD_KEYS.index(limit.key)]) / limit.value
            excess = np.log(np.clip(use, 1e-9, None)) * (use > 1.0 + ROUND_OFF)
            violations = np.maximum(violations, np.minimum(excess, _MAX_EXCESS))
        if not self._requirements.allow_leaving:
            violations += np.where(left, _LEFT, 0.0)
        closeness = np.minimum(np.nan_to_num(nearest, nan=1.0) / self._scene.cone.L_c, 5.0)
        captured = np.array(verdicts) == CAPTURED
        violations += np.where(captured, 0.0, _NO_CAPTURE + closeness)
        violations[np.array(verdicts) == FAILED] = _STOPPED
        return violations

    def _with_ranges(self, found: list[Candidate]) -> list[Candidate]:
        """Return candidates with their capture range.

        The range is NaN, which counts as 0, for candidates that are far from feasible.
        """
        area, least = self._requirements.area, self._requirements.least_range
        worth = [n for n, each in enumerate(found) if each.violation < _WORTH_AREA]
        nothing = [
            dataclasses.replace(
                each,
                loads={**each.loads, CAPTURE_RANGE: math.nan},
                violation=each.violation + (1.0 if least else 0.0),
            )
            for each in found
        ]
        if not worth:
            return nothing
        points = points_of(area)
        names = [axis.name for axis in area]
        # the draws of the search; all points of a line have the same draw
        draws: list[dict[str, float]] = [{}]
        if self._requirements.under is not None:
            draws = self.draws(self._requirements.draws, 0)
        along = max(range(len(area)), key=lambda k: len(area[k].values))

        def is_captured(asked: Sequence[tuple[int, tuple[float, ...]]]) -> np.ndarray:
            rows = []
            for case, point in asked:
                line = points.index(
                    tuple(area[k].values[0] if k == along else x for k, x in enumerate(point))
                )
                of_line = self._dispersed(found[worth[case]].values, draws[line % len(draws)])
                rows.append({**of_line, **dict(zip(names, point, strict=True))})
            return self._run(rows).violations <= 0.0

        asked = list(itertools.product(range(len(worth)), points))
        grid = is_captured(asked).reshape(len(worth), -1)
        ranges = capture_ranges(area, grid, is_captured, _BISECTIONS)
        for n, of_range in zip(worth, ranges, strict=True):
            missing = max(least - of_range.share, 0.0)
            nothing[n] = dataclasses.replace(
                found[n],
                loads={**found[n].loads, CAPTURE_RANGE: of_range.share},
                violation=found[n].violation + missing,
                range_error=of_range.error,
            )
        return nothing

    def draws(self, count: int, stream: int) -> list[dict[str, float]]:
        """Return ``count`` draws of the dispersions, each as values by name.

        Different streams have different draws.  SceneError if an axis is not a distribution.
        """
        under = self._requirements.under
        assert under is not None
        seed = self._seed + 1_000_003 * (stream + 1)
        samples = samples_of(
            self._scene, under.vary, count, seed=seed, correlations=under.correlations
        )
        for axis in samples.axes:
            if axis.distribution is None:
                raise SceneError(f"{axis.name} = {axis.text}: must be a distribution")
        names = [axis.name for axis in samples.axes]
        return [dict(zip(names, row, strict=True)) for row in samples.rows]

    def _dispersed(
        self, values: Mapping[str, float], draw: Mapping[str, float]
    ) -> dict[str, float]:
        """Return the fields of a scene for a candidate's values and a draw.

        If a field is both free and dispersed, the candidate's value is multiplied by the ratio of
        the draw to the scene's value.  SceneError if the scene's value is 0.
        """
        buffer = fields_of(self._scene, values)
        found = {**buffer, **draw}
        for name in set(buffer) & set(draw):
            own = paths.get(self._scene, name)
            if not own:
                raise SceneError(f"{name}: must not be 0 in the scene to be dispersed and free")
            found[name] = buffer[name] * draw[name] / own
        return found

    def _run_draws(
        self, values: Sequence[Mapping[str, float]], draws: Sequence[Mapping[str, float]]
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return loads (n, draws, keys) and violations (n, draws) of candidates."""
        rows = [self._dispersed(each, draw) for each in values for draw in draws]
        runs = self._run(rows)
        shape = len(values), len(draws)
        return runs.loads.reshape(*shape, -1), runs.violations.reshape(shape)

    def with_draws(
        self,
        draws: Sequence[Mapping[str, float]],
        values: Sequence[Mapping[str, float]],
        _: Ahead | None = None,
    ) -> list[Candidate]:
        """Return candidates evaluated with draws, which occupy the workers.

        Candidates far from feasible are evaluated by their own run only.  Candidates that can no
        longer be feasible after the first quarter of the draws are not run with the other draws.
        """
        found = self._alone(values)
        worth = [n for n, each in enumerate(found) if each.violation < _WORTH_DRAWS]
        for n, candidate in enumerate(found):
            if n not in worth:  # larger than the violation of any candidate with draws
                violation = candidate.violation + 2.0 * _STOPPED
                found[n] = dataclasses.replace(candidate, violation=violation)
        if not worth:
            return self._noted(found)
        n_first = math.ceil(_FIRST_DRAWS * len(draws))
        loads, violations = self._run_draws([values[n] for n in worth], draws[:n_first])
        n_failed = np.count_nonzero(violations > 0.0, axis=1)
        may_succeed = n_failed <= len(draws) - self.required(len(draws))
        for k, n in enumerate(worth):
            if not may_succeed[k]:
                found[n] = self._summarised(found[n], loads[k], violations[k])
        others = [(k, n) for k, n in enumerate(worth) if may_succeed[k]]
        if others and n_first < len(draws):
            rest = self._run_draws([values[n] for _, n in others], draws[n_first:])
            for (k, n), more_loads, more in zip(others, *rest, strict=True):
                of_draws = np.concatenate([loads[k], more_loads])
                found[n] = self._summarised(found[n], of_draws, np.append(violations[k], more))
        return self._noted(found)

    def required(self, count: int) -> int:
        """Return the number of draws, out of ``count``, that must succeed in the search."""
        share = self._requirements.confidence
        return min(math.ceil(share * count + math.sqrt(share * (1.0 - share) * count)), count)

    def _summarised(
        self,
        candidate: Candidate,
        loads: np.ndarray,
        violations: np.ndarray,
        required: int | None = None,
    ) -> Candidate:
        """Return a candidate with the quantiles of its loads and its violation over the draws.

        ``loads`` is (draws, keys), ``violations`` (draws,).  ``required`` is the number of draws
        that must not exceed the quantiles; by default that of the search.
        """
        rank = (required or self.required(len(violations))) - 1
        quantiles = np.sort(np.nan_to_num(loads), axis=0)[rank].tolist()
        # a missing capture range adds to the violation
        of_range = max(self._requirements.least_range - candidate.captured_share, 0.0)
        return dataclasses.replace(
            candidate,
            loads={**candidate.loads, **dict(zip(LOAD_KEYS, quantiles, strict=True))},
            violation=float(np.sort(violations)[rank]) + of_range,
            share=float(np.mean(violations <= 0.0)),
        )

    def check(
        self, candidates: Sequence[Candidate], stream: int, count: int | None = None
    ) -> list[tuple[Candidate, Probability]]:
        """Return each candidate with its quantiles in new draws, and its share of successful draws.

        ``count`` is the number of draws, CHECK_DRAWS by default.
        """
        draws = self.draws(count or CHECK_DRAWS, stream)
        loads, violations = self._run_draws([each.values for each in candidates], draws)
        required = math.ceil(self._requirements.confidence * len(draws))
        return [
            (self._summarised(*of_candidate, required), probability(of_candidate[2] <= 0.0))
            for of_candidate in zip(candidates, loads, violations, strict=True)
        ]
