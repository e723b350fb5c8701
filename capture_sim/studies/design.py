"""Design of a buffer: limits in, the buffer with the least peak force out.

Some values of a scene are free.  Differential evolution (:mod:`scipy.optimize`) searches them in
two passes, over their whole ranges and then around the best buffer; it evaluates each population
through the executor of the sweeps.  A buffer is feasible if its run ends in a capture and keeps all
limits.  Every feasible buffer is better than every infeasible one; feasible ones are compared by
their peak force, others by how far they are from feasible.  A run is given up as soon as its loads
exceed those of the best buffers.  Both passes run at the tolerance of sweeps.  A last one, simplex
searches from the best buffer, runs at the tolerance of the scene.

Under dispersions, a candidate is run with the same draws as all others.  Its loads are then
quantiles: what the required number of draws does not exceed.  As the best candidate is the one that
suits these draws best, the search requires one standard deviation more of them than the share
asked for.  The result is checked with draws that the search has not seen.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np
from scipy.optimize import differential_evolution, minimize

from capture_sim.errors import SceneError
from capture_sim.scene import paths
from capture_sim.scene.approach import APPROACH, approach_of
from capture_sim.scene.parts import Scene
from capture_sim.scene.quantities import accept
from capture_sim.scene.units import in_si
from capture_sim.studies.axes import declaration_of
from capture_sim.studies.dispersion import Probability, probability
from capture_sim.studies.executors import InProcess, answers
from capture_sim.studies.limits import Limit
from capture_sim.studies.outcome import CAPTURED, Outcome, run_to_end
from capture_sim.studies.sampling import Correlations
from capture_sim.studies.sweep import (
    FAILED,
    GIVEN_UP,
    RTOL,
    Recipe,
    result_columns,
    run_rows,
    samples_of,
)

#: Values that are searched unless others are named.
FREE = ("buffer.k_A", "buffer.k_T", "buffer.c_A")
#: Values that a table of the spring's force replaces.
_OF_AXIAL_SPRING = ("buffer.k_A", "buffer.k_A3", "buffer.preload")
#: The load whose peak is to be small.
OBJECTIVE = "max_normal_force"
#: Draws of each candidate, and new draws of the check at the end.
DRAWS, CHECK_DRAWS = 60, 400

#: Candidates of a population for each free value, and populations of the two passes.
_POPULATION = 10
_GENERATIONS, _LOCAL_GENERATIONS = 24, 15
#: The second pass searches this share of each range, around the best buffer of the first.
_LOCAL_WIDTH = 0.12
#: The last pass: sizes of the first simplices and where they end, in shares of the ranges, and the
#: most runs of each for every free value.
_SIMPLICES, _SIMPLEX_END, _SIMPLEX_RUNS = (0.03, 0.01, 0.003), 1e-5, 25
#: Under dispersions: populations of a round, and rounds, each with twice the draws.
_ROBUST_GENERATIONS, _ROUNDS = 10, 3
#: Share of the draws after which a candidate is given up that can no longer be feasible.
_FIRST_DRAWS = 0.25
#: Standard deviation of the forces of a population at which its search ends, N.
_FORCE_TOLERANCE = 1e-3
#: A feasible buffer has its force as merit, an infeasible one this and more, N.
_INFEASIBLE = 1e9
#: A limit is violated by the share by which it is exceeded, up to the first of these.  Every run
#: without a capture is worse, by its distance from BE, and a run that stopped is worst.
_MAX_EXCESS, _NO_CAPTURE, _STOPPED = 100.0, 1e4, 1e6
#: Violation of a buffer whose run was given up, at least.
_BEYOND = 1e-3
#: Runs with draws are made only of candidates whose own run violates by less.
_WORTH_DRAWS = 0.5
#: Strokes where no limit is given, m and rad, as measures of the ranges only.
_USUAL_STROKE, _USUAL_TORSION = 0.02, 0.01
#: Most runs that a worker does in one go, and the chunks that a population is divided into, if it
#: is smaller.
_RUNS_OF_CHUNK, _CHUNKS = 20, 8


@dataclass(frozen=True)
class Variable:
    """A free value and the range that is searched; on a logarithmic scale if both ends are > 0."""

    name: str
    low: float
    high: float
    unit: str = ""

    def value(self, share: float) -> float:
        """Return the value at a share of the range, 0 to 1."""
        if self.low > 0.0:
            return float(self.low * (self.high / self.low) ** share)
        return float(self.low + (self.high - self.low) * share**3)

    def share(self, value: float) -> float:
        """Return the share of the range at a value."""
        inside = min(max(value, self.low), self.high)
        if self.low > 0.0:
            return math.log(inside / self.low) / math.log(self.high / self.low)
        return float(((inside - self.low) / (self.high - self.low)) ** (1.0 / 3.0))


@dataclass(frozen=True)
class Dispersions:
    """Distributions by name, as for :func:`capture_sim.sweep`, and their correlations."""

    vary: Mapping[str, Any]
    correlations: Correlations = field(default_factory=dict)


@dataclass(frozen=True)
class Requirements:
    """What a buffer must keep.

    Attributes
    ----------
    limits : tuple of Limit
        Upper limits of loads.
    under : Dispersions or None
        Dispersions under which the limits must hold; None for the scene alone.
    confidence : float
        Share of the draws that must be captured with all limits kept.
    draws : int
        Number of draws of each candidate.
    """

    limits: tuple[Limit, ...]
    under: Dispersions | None = None
    confidence: float = 0.95
    draws: int = DRAWS


@dataclass(frozen=True)
class Candidate:
    """A buffer that was tried.

    Under dispersions the loads are quantiles at the required share of the draws.
    """

    values: Mapping[str, float]  # by name, SI
    loads: Mapping[str, float]  # the limited ones and the peak force, SI
    verdict: str  # of the scene's own run
    violation: float  # 0: feasible
    share: float | None = None  # of the draws that are captured within the limits; None without

    @property
    def feasible(self) -> bool:
        """Whether the buffer meets the requirements."""
        return self.violation <= 0.0

    @property
    def peak_force(self) -> float:
        """Peak normal force, N."""
        return self.loads[OBJECTIVE]

    @property
    def merit(self) -> float:
        """What the search minimises: the force of a feasible buffer."""
        return self.peak_force if self.feasible else _INFEASIBLE * (1.0 + self.violation)


@dataclass(frozen=True)
class Design:
    """The result of a design."""

    requirements: Requirements
    variables: tuple[Variable, ...]
    best: Candidate  # the buffer, or the one nearest to the requirements
    scene: Scene  # with this buffer
    outcome: Outcome  # of the scene's whole run
    refusal: str  # why no buffer of those tried meets the requirements; empty if one does
    check: Probability | None = None  # of success with new draws
    history: tuple[Candidate, ...] = field(default=(), repr=False)  # in order

    @property
    def met(self) -> bool:
        """Whether there is a buffer."""
        return not self.refusal


def design_buffer(
    scene: Scene,
    requirements: Requirements,
    free: Sequence[str] = FREE,
    *,
    seed: int = 1,
    executor: Executor | None = None,
    report: Callable[[Candidate], None] | None = None,
) -> Design:
    """Find the buffer that captures within limits with the least peak force.

    Parameters
    ----------
    scene
        Scene with vehicles, cone, contact and approach; its values of free parameters are ignored.
    requirements
        Limits, and the dispersions under which they must hold.
    free
        Names of the values to search, e.g. ``"buffer.preload"``; with a range as
        ``"buffer.k_A=100:2000"``.  ``buffer.c_A_rebound`` keeps its ratio to ``buffer.c_A`` unless
        it is free.
    seed
        Seed of the search and of the draws; the same seed gives the same buffer.
    executor
        Executor as in ``concurrent.futures``; None for this process.
    report
        Function called with every candidate.

    Returns
    -------
    Design
        Its buffer, or the reason why no candidate meets the requirements.

    Raises
    ------
    SceneError
        A name or a value is invalid, or the chaser never meets the cone.
    """
    variables = make_variables(scene, requirements.limits, free)
    search = _Search(scene, requirements, variables, seed, executor or InProcess(), report)
    best = search.nominal()
    check = None
    if requirements.under is not None and best.feasible:
        best, check = search.robust()
    final = search.scene_of(best)
    return Design(
        requirements,
        variables,
        best,
        final,
        run_to_end(final),
        search.refusal(best, check),
        check,
        tuple(search.history),
    )


def make_variables(
    scene: Scene, limits: Sequence[Limit], free: Sequence[str]
) -> tuple[Variable, ...]:
    """Return the values to search with their ranges.

    Ranges that are not given are those around a buffer that absorbs the energy of the approach
    within the limits of its strokes.  SceneError if a name or a range is invalid.
    """
    usual = _usual_ranges(scene, limits)
    variables: list[Variable] = []
    for text in free:
        name, _, given = (part.strip() for part in text.partition("="))
        what = declaration_of(scene, name)
        if name in APPROACH or what.kind is not float:
            raise SceneError(f"free {name}: must be a number of the scene")
        if scene.buffer.force_table is not None and name in _OF_AXIAL_SPRING:
            raise SceneError(
                f"free {name}: must not be free with buffer.force_table, which gives the spring"
            )
        if given:
            low, colon, high = given.partition(":")
            try:
                if not colon:
                    raise ValueError(given)
                ends = in_si(low, what.unit), in_si(high, what.unit)
            except ValueError:
                raise SceneError(
                    f"free {name} = {given}: must be LOW:HIGH in {what.unit or '1'}"
                ) from None
        elif name in usual:
            ends = usual[name]
        else:
            raise SceneError(f"free {name}: must have a range, {name}=LOW:HIGH")
        for end in ends:
            accept(end, what, f"free {name}")
        if not ends[0] < ends[1]:
            raise SceneError(f"free {name} = {given}: must be LOW < HIGH")
        if name in (variable.name for variable in variables):
            raise SceneError(f"free {name}: must be given once")
        variables.append(Variable(name, *ends, what.unit))
    if not variables:
        raise SceneError("free: must have one value or more")
    return tuple(variables)


def reduced_mass(scene: Scene) -> float:
    """Return the reduced mass of both vehicles, kg."""
    chaser, target = scene.chaser_total_mass, scene.target.mass
    return chaser * target / (chaser + target)


def _usual_ranges(scene: Scene, limits: Sequence[Limit]) -> dict[str, tuple[float, float]]:
    """Return ranges around a buffer that absorbs the approach's energy within its strokes."""
    given = {limit.key.removesuffix("_before_latch"): limit.value for limit in limits}
    stroke = given.get("max_axial_stroke_in", _USUAL_STROKE)
    torsion = given.get("max_torsion", _USUAL_TORSION)
    speed = approach_of(scene).speed
    k_A = reduced_mass(scene) * (speed / stroke) ** 2
    c_A = 2.0 * reduced_mass(scene) * speed / stroke  # critical on that spring
    k_T = k_A * stroke * scene.rest_length / torsion
    c_T = k_T * torsion * scene.rest_length / speed
    turning = speed / scene.rest_length
    return {
        "buffer.k_A": (k_A / 50.0, k_A * 20.0),
        "buffer.k_T": (k_T / 100.0, k_T * 100.0),
        "buffer.c_A": (c_A / 300.0, c_A * 10.0),
        "buffer.c_A_rebound": (c_A / 300.0, c_A * 10.0),
        "buffer.preload": (0.0, k_A * stroke),
        "buffer.friction": (0.0, k_A * stroke),
        "buffer.k_A3": (0.0, 100.0 * k_A / stroke**2),
        "buffer.c_A2": (0.0, 10.0 * c_A / speed),
        "buffer.c_T": (0.0, 10.0 * c_T),
        "buffer.k_T3": (0.0, 100.0 * k_T / torsion**2),
        "buffer.c_T2": (0.0, 10.0 * c_T / turning),
    }


def with_values(scene: Scene, values: Mapping[str, float]) -> Scene:
    """Return a scene with other values; a rebound damper keeps its ratio to the damper."""
    changed: Scene = paths.with_values(scene, {**values, **_rebound(scene, values)})
    return changed


def _rebound(scene: Scene, values: Mapping[str, float]) -> dict[str, float]:
    """Return the rebound damper that belongs to a damper, by its name; empty if there is none."""
    own = scene.buffer
    name = "buffer.c_A_rebound"
    if own.c_A_rebound is None or own.c_A == 0.0 or name in values or "buffer.c_A" not in values:
        return {}
    return {name: own.c_A_rebound / own.c_A * values["buffer.c_A"]}


def _at_tolerance_of_sweeps(scene: Scene) -> Scene:
    """Return the scene at the tolerance of sweeps, or at its own if that is looser."""
    return dataclasses.replace(
        scene, run=dataclasses.replace(scene.run, rtol=max(scene.run.rtol, RTOL))
    )


class _Search:
    """The search for one design, and its history."""

    def __init__(
        self,
        scene: Scene,
        requirements: Requirements,
        variables: tuple[Variable, ...],
        seed: int,
        executor: Executor,
        report: Callable[[Candidate], None] | None,
    ) -> None:
        self._given, self._scene = scene, _at_tolerance_of_sweeps(scene)
        self._requirements, self._variables = requirements, variables
        self._seed, self._executor, self._report = seed, executor, report
        self.history: list[Candidate] = []
        self.n_runs = 0
        #: Loads beyond which a buffer is of no use to the present pass.
        self._ceilings: Mapping[str, float] | None = None
        #: The loads that are limited, and the force that is to be small.
        self._keys = tuple(dict.fromkeys([OBJECTIVE, *(x.key for x in requirements.limits)]))
        self._columns = result_columns(check=False, limited=False)

    def scene_of(self, candidate: Candidate) -> Scene:
        """Return the scene with a candidate's buffer."""
        return with_values(self._given, candidate.values)

    def nominal(self) -> Candidate:
        """Return the best buffer of the scene without dispersions."""
        whole = [(0.0, 1.0)] * len(self._variables)
        best = self._minimise(self._run_alone, whole, _GENERATIONS, None)
        best = self._minimise(self._run_alone, self._around(best), _LOCAL_GENERATIONS, best)
        if not best.feasible:
            return best
        self._scene = self._given  # what is found holds at its tolerance
        best = self._polished(best)
        if not best.feasible:  # a limit is exceeded by the error of a coarse run
            best = self._minimise(self._run_alone, self._around(best), _LOCAL_GENERATIONS, best)
        return best

    def _polished(self, best: Candidate) -> Candidate:
        """Return the best of some simplex searches (Nelder-Mead), each from the best so far.

        The force jumps where the sequence of touches changes, so the simplices begin with several
        sizes.
        """
        n_before = len(self.history)

        def merit(shares: np.ndarray) -> float:
            candidates = self._run_alone([self._values(shares.clip(0.0, 1.0).tolist())])
            self.history += candidates
            return candidates[0].merit

        for size in _SIMPLICES:
            start = np.array(self._shares(best))
            # towards the middle of the ranges
            corners = start + size * np.diag(np.where(start < 0.5, 1.0, -1.0))
            options = {
                "initial_simplex": np.vstack([start, corners]),
                "maxfev": _SIMPLEX_RUNS * len(start),
                "xatol": _SIMPLEX_END,
                "fatol": _FORCE_TOLERANCE,
            }
            minimize(merit, start, method="Nelder-Mead", options=options)
            best = min(self.history[n_before:], key=lambda candidate: candidate.merit)
        return best

    def robust(self) -> tuple[Candidate, Probability]:
        """Return the best buffer under dispersions, and its share of success in new draws."""
        self._scene = _at_tolerance_of_sweeps(self._given)
        population = self._promising()
        for number in range(_ROUNDS):
            draws = self._draws(self._requirements.draws * 2**number, 2 * number)
            n_before = len(self.history)
            evaluate = partial(self._run_with_draws, draws)
            bounds = [(0.0, 1.0)] * len(self._variables)
            best = self._minimise(evaluate, bounds, _ROBUST_GENERATIONS, population)
            check = self._check(best, 2 * number + 1)
            if best.feasible and check.estimate >= self._requirements.confidence:
                break
            # the draws were too kind, or too few: more of them, beginning with the best
            population = sorted(self.history[n_before:], key=lambda each: each.merit)
            population = population[: _POPULATION * len(self._variables)]
        return best, check

    def _minimise(
        self,
        evaluate: Callable[[Sequence[Mapping[str, float]]], list[Candidate]],
        bounds: list[tuple[float, float]],
        generations: int,
        start: Candidate | Sequence[Candidate] | None,
    ) -> Candidate:
        """Return the best candidate of a differential evolution within shares of the ranges."""
        n_before, size = len(self.history), _POPULATION * len(self._variables)

        def merits(shares: np.ndarray) -> np.ndarray:
            columns = np.atleast_2d(shares.T)
            self._ceilings = self._ceilings_of(self.history[n_before:], size)
            candidates = evaluate([self._values(row) for row in columns.tolist()])
            self._ceilings = None
            self.history += candidates
            return np.array([candidate.merit for candidate in candidates])

        options: dict[str, Any] = {"init": "latinhypercube"}
        if isinstance(start, Candidate):
            options["x0"] = np.clip(self._shares(start), *np.array(bounds).T)
        elif start is not None:
            options["init"] = np.array([self._shares(each) for each in start])
        differential_evolution(
            merits,
            bounds,
            popsize=max(size // len(bounds), 5),
            maxiter=generations,
            # of the forces; a share of the mean would stop a population without any capture
            tol=0.0,
            atol=_FORCE_TOLERANCE,
            polish=False,
            updating="deferred",
            vectorized=True,
            seed=self._seed,
            **options,
        )
        found = self.history[n_before:]
        return min(found, key=lambda candidate: candidate.merit)

    def _ceilings_of(self, found: Sequence[Candidate], size: int) -> Mapping[str, float] | None:
        """Return the loads of the worst of the best buffers of a pass, of the population's size.

        A buffer beyond them is not among the best whatever its further run.  There are none before
        so many are feasible, and none under dispersions, where buffers with more force and more
        margin are of use.
        """
        merits = sorted(candidate.merit for candidate in found)[:size]
        if len(merits) < size or merits[-1] >= _INFEASIBLE or self._requirements.under is not None:
            return None
        limits = {limit.key: limit.value for limit in self._requirements.limits}
        return {**limits, OBJECTIVE: merits[-1]}

    def _values(self, shares: Sequence[float]) -> dict[str, float]:
        pairs = zip(self._variables, shares, strict=True)
        return {variable.name: variable.value(share) for variable, share in pairs}

    def _shares(self, candidate: Candidate) -> list[float]:
        return [variable.share(candidate.values[variable.name]) for variable in self._variables]

    def _around(self, best: Candidate) -> list[tuple[float, float]]:
        half = 0.5 * _LOCAL_WIDTH
        return [(max(x - half, 0.0), min(x + half, 1.0)) for x in self._shares(best)]

    def _promising(self) -> list[Candidate]:
        """Return a population of feasible buffers: half by their force, half by their margin."""
        size = _POPULATION * len(self._variables)
        feasible = [candidate for candidate in self.history if candidate.feasible]
        by_margin = sorted(feasible, key=self._largest_use)[:size]
        by_force = sorted(feasible, key=lambda candidate: candidate.merit)[:size]
        both = [each for pair in zip(by_margin, by_force, strict=True) for each in pair]
        found = list({id(candidate): candidate for candidate in both}.values())[:size]
        # a population has five or more
        return (found * 5)[: max(len(found), 5)]

    def _largest_use(self, candidate: Candidate) -> float:
        limits = self._requirements.limits
        return max((limit.use(candidate.loads[limit.key]) for limit in limits), default=0.0)

    def _run(
        self, names: Sequence[str], rows: Sequence[tuple[float, ...]]
    ) -> tuple[list[str], np.ndarray, np.ndarray]:
        """Return verdicts, loads (n, keys) and violations (n,) of some runs."""
        size = max(min(_RUNS_OF_CHUNK, len(rows) // _CHUNKS), 1)
        chunks = [rows[k : k + size] for k in range(0, len(rows), size)]
        recipe = Recipe(self._scene, tuple(names))
        work = partial(run_rows, recipe, False, (), ceilings=self._ceilings)
        done = [row for results in answers(self._executor, work, chunks) for row in results]
        self.n_runs += len(done)
        by_name = dict(zip(self._columns, zip(*done, strict=True), strict=True))
        loads = np.array([by_name[key] for key in self._keys], dtype=float).T
        return list(by_name["verdict"]), loads, self._violations(by_name, loads)

    def _violations(self, by_name: Mapping[str, Sequence[Any]], loads: np.ndarray) -> np.ndarray:
        violations = np.zeros(len(loads))
        for limit in self._requirements.limits:
            use = np.nan_to_num(loads[:, self._keys.index(limit.key)]) / limit.value
            violations += np.clip(use - 1.0, 0.0, _MAX_EXCESS)
        verdicts = np.array(by_name["verdict"])
        distance = np.nan_to_num(np.array(by_name["nearest_distance"], dtype=float), nan=1.0)
        closeness = np.minimum(distance / self._scene.cone.L_c, 5.0)
        is_complete = verdicts != GIVEN_UP
        violations += np.where((verdicts == CAPTURED) | ~is_complete, 0.0, _NO_CAPTURE + closeness)
        violations = np.where(is_complete, violations, np.maximum(violations, _BEYOND))
        violations[verdicts == FAILED] = _STOPPED
        return violations

    def _run_alone(self, values: Sequence[Mapping[str, float]]) -> list[Candidate]:
        """Return candidates by the scene's own run."""
        buffers = [{**each, **_rebound(self._scene, each)} for each in values]
        rows = [tuple(buffer.values()) for buffer in buffers]
        verdicts, loads, violations = self._run(tuple(buffers[0]), rows)
        found = [
            self._candidate(*each)
            for each in zip(values, loads, verdicts, violations.tolist(), strict=True)
        ]
        for candidate in found:
            if self._report is not None:
                self._report(candidate)
        return found

    def _candidate(
        self,
        values: Mapping[str, float],
        loads: np.ndarray,
        verdict: str,
        violation: float,
        share: float | None = None,
    ) -> Candidate:
        by_key = dict(zip(self._keys, loads.tolist(), strict=True))
        return Candidate(values, by_key, verdict, violation, share)

    def _draws(self, count: int, stream: int) -> list[dict[str, float]]:
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
        buffer = {**values, **_rebound(self._scene, values)}
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
        _, loads, violations = self._run(tuple(rows[0]), [tuple(row.values()) for row in rows])
        shape = len(values), len(draws)
        return loads.reshape(*shape, -1), violations.reshape(shape)

    def _run_with_draws(
        self, draws: Sequence[Mapping[str, float]], values: Sequence[Mapping[str, float]]
    ) -> list[Candidate]:
        """Return candidates by all draws; those far from feasible by their own run alone."""
        found = self._run_alone(values)
        worth = [n for n, each in enumerate(found) if each.violation < _WORTH_DRAWS]
        for n, candidate in enumerate(found):
            if n not in worth:  # worse than any with draws
                violation = candidate.violation + 2.0 * _STOPPED
                found[n] = dataclasses.replace(candidate, violation=violation)
        if not worth:
            return found
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
        return found

    def _required(self, count: int) -> int:
        """Return how many of some draws the search requires to succeed."""
        share = self._requirements.confidence
        return min(math.ceil(share * count + math.sqrt(share * (1.0 - share) * count)), count)

    def _summarised(
        self, candidate: Candidate, loads: np.ndarray, violations: np.ndarray
    ) -> Candidate:
        """Return a candidate with its quantiles over draws: what the required share keeps."""
        rank = self._required(len(violations)) - 1
        quantiles = np.sort(np.nan_to_num(loads), axis=0)[rank]
        violation = float(np.sort(violations)[rank])
        share = float(np.mean(violations <= 0.0))
        return self._candidate(candidate.values, quantiles, candidate.verdict, violation, share)

    def _check(self, candidate: Candidate, stream: int) -> Probability:
        """Return the share of new draws in which a candidate is captured within the limits."""
        draws = self._draws(CHECK_DRAWS, stream)
        _, violations = self._run_draws([candidate.values], draws)
        return probability(violations[0] <= 0.0)

    def refusal(self, best: Candidate, check: Probability | None) -> str:
        """Return why the best buffer does not meet the requirements; empty if it does."""
        required = self._requirements.confidence
        searched = ", ".join(
            f"{each.name} {each.low:.4g} to {each.high:.4g}" for each in self._variables
        )
        among = f"among {len(self.history)} buffers tried ({searched})"
        values = ", ".join(f"{name} = {value:.5g}" for name, value in best.values.items())
        if best.feasible and check is not None and check.estimate < required:
            return (
                f"the best {among}, {values}, is captured within the limits in {check.met} of "
                f"{check.computed} new draws; {required:.0%} are required"
            )
        if best.feasible:
            return ""
        if best.share is not None:
            return (
                f"{among}, none is captured within the limits in {required:.0%} of the draws; the "
                f"nearest, {values}, is in {best.share:.1%}"
            )
        if best.verdict != CAPTURED:
            return f"{among}, none captures; the nearest, {values}, ends {best.verdict}"
        excess = ", ".join(
            f"{limit.meaning} {limit.shown(best.loads[limit.key])} {limit.load.shown_in} (limit "
            f"{limit.shown(limit.value)})"
            for limit in self._requirements.limits
            if limit.use(best.loads[limit.key]) > 1.0
        )
        return f"{among}, none captures within the limits; the nearest, {values}, has {excess}"
