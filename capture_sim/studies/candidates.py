"""How a design evaluates buffers: by the scene's own run, under dispersions, and over an area.

A buffer is feasible if its run ends in a capture and keeps all limits.  Infeasible ones are
compared by their violation: the sum of the shares by which limits are exceeded; a run without a
capture is worse, by its distance from BE, and a run that stopped is worst.

Under dispersions, a candidate is run with the same draws as all others.  Its loads are then
quantiles: what the required number of draws does not exceed.  As the best candidate is the one that
suits these draws best, the search requires one standard deviation more of them than the share
asked for.  The capture range is that of the scene's own values: with dispersions, each line of the
area has one of the draws.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np

from capture_sim.errors import SceneError
from capture_sim.scene import paths
from capture_sim.scene.parts import Scene
from capture_sim.studies.axes import Axis
from capture_sim.studies.capture_range import capture_ranges, points_of
from capture_sim.studies.dispersion import Probability, probability
from capture_sim.studies.executors import answers
from capture_sim.studies.limits import CAPTURE_RANGE, LOAD_KEYS, Limit, Measure
from capture_sim.studies.outcome import CAPTURED
from capture_sim.studies.sampling import Correlations
from capture_sim.studies.sweep import FAILED, Recipe, result_columns, run_rows, samples_of
from capture_sim.studies.variables import rebound_of

#: Draws of each candidate, and new draws of the check at the end.
DRAWS, CHECK_DRAWS = 60, 400
#: Share of the draws after which a candidate is given up that can no longer be feasible.
_FIRST_DRAWS = 0.25
#: A limit is violated by the share by which it is exceeded, up to the first of these.  Every run
#: without a capture is worse, by its distance from BE, and a run that stopped is worst.
_MAX_EXCESS, _NO_CAPTURE, _STOPPED = 100.0, 1e4, 1e6
#: Runs with draws are made only of candidates whose own run violates by less.
_WORTH_DRAWS = 0.5
#: Runs over the area are made only of candidates whose own run violates by less; the others count
#: as capturing nothing, which is a violation of 1 more where a capture range is required.
_WORTH_AREA = 0.1
#: Bisections of the edge of a capture range; the error is then 1/32 of a cell at each edge.
_BISECTIONS = 4
#: Most runs that a worker does in one go, and the chunks that a population is divided into, if it
#: is smaller.
_RUNS_OF_CHUNK, _CHUNKS = 20, 8


@dataclass(frozen=True)
class Dispersions:
    """Distributions by name, as for :func:`capture_sim.sweep`, and their correlations."""

    vary: Mapping[str, Any]
    correlations: Correlations = field(default_factory=dict)


@dataclass(frozen=True)
class Requirements:
    """What a buffer must keep, and what is to be small.

    Attributes
    ----------
    objectives : tuple of Measure
        Loads to minimise, or the capture range to maximise; one to three.
    limits : tuple of Limit
        Upper limits of loads.
    under : Dispersions or None
        Dispersions under which the limits must hold; None for the scene alone.
    confidence : float
        Share of the draws that must be captured with all limits kept.
    draws : int
        Number of draws of each candidate.
    area : tuple of Axis
        Area of approach for the capture range, see :mod:`capture_sim.studies.capture_range`.
    least_range : float
        Least capture range, 0 to 1.
    """

    objectives: tuple[Measure, ...]
    limits: tuple[Limit, ...] = ()
    under: Dispersions | None = None
    confidence: float = 0.95
    draws: int = DRAWS
    area: tuple[Axis, ...] = ()
    least_range: float = 0.0

    def __post_init__(self) -> None:
        """Raise SceneError if a capture range is asked for without an area."""
        asked = self.least_range or any(each.key == CAPTURE_RANGE for each in self.objectives)
        if asked and not self.area:
            raise SceneError("capture_range: must have an area of approach (--approach)")


@dataclass(frozen=True)
class Candidate:
    """A buffer that was tried.

    Under dispersions the loads are quantiles at the required share of the draws.
    """

    values: Mapping[str, float]  # by name, SI
    loads: Mapping[str, float]  # by name in results, SI; NaN if not measured
    verdict: str  # of the scene's own run
    violation: float  # 0: feasible
    share: float | None = None  # of the draws that are captured within the limits; None without
    range_error: float = math.nan  # of the capture range

    @property
    def feasible(self) -> bool:
        """Whether the buffer meets the requirements."""
        return self.violation <= 0.0

    @property
    def captured_share(self) -> float:
        """Capture range, 0 to 1; 0 if it was not measured."""
        return _number(self.loads.get(CAPTURE_RANGE, 0.0))

    def costs(self, objectives: Sequence[Measure]) -> list[float]:
        """Return the objectives, each so that less is better; see :meth:`Measure.cost`."""
        return [each.cost(_number(self.loads[each.key])) for each in objectives]


def _number(value: float) -> float:
    return 0.0 if math.isnan(value) else value


class Evaluator:
    """Runs buffers; ``history`` has all candidates in order."""

    def __init__(
        self,
        scene: Scene,
        requirements: Requirements,
        seed: int,
        executor: Executor,
        report: Callable[[Candidate], None] | None = None,
    ) -> None:
        self._scene, self._requirements = scene, requirements
        self._seed, self._executor, self._report = seed, executor, report
        self.history: list[Candidate] = []
        self._columns = result_columns(check=False, limited=False)

    def alone(self, values: Sequence[Mapping[str, float]]) -> list[Candidate]:
        """Return candidates by the scene's own run."""
        return self._noted(self._alone(values))

    def _noted(self, candidates: list[Candidate]) -> list[Candidate]:
        self.history += candidates
        for candidate in candidates:
            if self._report is not None:
                self._report(candidate)
        return candidates

    def _alone(self, values: Sequence[Mapping[str, float]]) -> list[Candidate]:
        rows = [{**each, **rebound_of(self._scene, each)} for each in values]
        verdicts, loads, violations = self._run(rows)
        found = [
            Candidate(each, dict(zip(LOAD_KEYS, of_row, strict=True)), verdict, violation)
            for each, of_row, verdict, violation in zip(
                values, loads.tolist(), verdicts, violations.tolist(), strict=True
            )
        ]
        return self._with_ranges(found) if self._requirements.area else found

    def _run(self, rows: Sequence[Mapping[str, float]]) -> tuple[list[str], np.ndarray, np.ndarray]:
        """Return verdicts, loads (n, keys) and violations (n,) of some runs."""
        size = max(min(_RUNS_OF_CHUNK, len(rows) // _CHUNKS), 1)
        values = [tuple(row.values()) for row in rows]
        chunks = [values[k : k + size] for k in range(0, len(rows), size)]
        work = partial(run_rows, Recipe(self._scene, tuple(rows[0])), False, ())
        done = [row for results in answers(self._executor, work, chunks) for row in results]
        by_name = dict(zip(self._columns, zip(*done, strict=True), strict=True))
        loads = np.array([by_name[key] for key in LOAD_KEYS], dtype=float).T
        return list(by_name["verdict"]), loads, self._violations(by_name, loads)

    def _violations(self, by_name: Mapping[str, Sequence[Any]], loads: np.ndarray) -> np.ndarray:
        violations = np.zeros(len(loads))
        for limit in self._requirements.limits:
            use = np.nan_to_num(loads[:, LOAD_KEYS.index(limit.key)]) / limit.value
            violations += np.clip(use - 1.0, 0.0, _MAX_EXCESS)
        verdicts = np.array(by_name["verdict"])
        distance = np.nan_to_num(np.array(by_name["nearest_distance"], dtype=float), nan=1.0)
        closeness = np.minimum(distance / self._scene.cone.L_c, 5.0)
        violations += np.where(verdicts == CAPTURED, 0.0, _NO_CAPTURE + closeness)
        violations[verdicts == FAILED] = _STOPPED
        return violations

    def _with_ranges(self, found: list[Candidate]) -> list[Candidate]:
        """Return candidates with their capture range, 0 for those far from feasible."""
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
        # the draws of the search; a line has one, wherever its points are
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
            return self._run(rows)[2] <= 0.0

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
        """Return draws of the dispersions by name; each stream has others."""
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
        """Return a candidate's values with a draw; that of a free value is one of its ratio."""
        buffer = {**values, **rebound_of(self._scene, values)}
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
        _, loads, violations = self._run(rows)
        shape = len(values), len(draws)
        return loads.reshape(*shape, -1), violations.reshape(shape)

    def with_draws(
        self, draws: Sequence[Mapping[str, float]], values: Sequence[Mapping[str, float]]
    ) -> list[Candidate]:
        """Return candidates by all draws; those far from feasible by their own run alone."""
        found = self._alone(values)
        worth = [n for n, each in enumerate(found) if each.violation < _WORTH_DRAWS]
        for n, candidate in enumerate(found):
            if n not in worth:  # worse than any with draws
                violation = candidate.violation + 2.0 * _STOPPED
                found[n] = dataclasses.replace(candidate, violation=violation)
        if not worth:
            return self._noted(found)
        n_first = math.ceil(_FIRST_DRAWS * len(draws))
        loads, violations = self._run_draws([values[n] for n in worth], draws[:n_first])
        n_failed = np.count_nonzero(violations > 0.0, axis=1)
        may_succeed = n_failed <= len(draws) - self._required(len(draws))
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

    def _required(self, count: int) -> int:
        """Return how many of some draws the search requires to succeed."""
        share = self._requirements.confidence
        return min(math.ceil(share * count + math.sqrt(share * (1.0 - share) * count)), count)

    def _summarised(
        self,
        candidate: Candidate,
        loads: np.ndarray,
        violations: np.ndarray,
        required: int | None = None,
    ) -> Candidate:
        """Return a candidate with its quantiles over draws: what the required share keeps."""
        rank = (required or self._required(len(violations))) - 1
        quantiles = np.sort(np.nan_to_num(loads), axis=0)[rank].tolist()
        # its own violation has that of the capture range
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
        """Return candidates with their quantiles in new draws, and their share of success."""
        draws = self.draws(count or CHECK_DRAWS, stream)
        loads, violations = self._run_draws([each.values for each in candidates], draws)
        required = math.ceil(self._requirements.confidence * len(draws))
        return [
            (self._summarised(*of_candidate, required), probability(of_candidate[2] <= 0.0))
            for of_candidate in zip(candidates, loads, violations, strict=True)
        ]
