"""Design of a buffer: from limits and objectives to one buffer or the front of the best buffers.

Some values of a scene are free.  The search (:mod:`capture_sim.studies.search.search`) is made
for the scene without dispersions and then, if there are dispersions, with draws, in these steps:

- NSGA-II covers the ranges (:mod:`capture_sim.studies.search.coverage`).
- Each row of the table is refined separately: one objective is minimised, with ceilings for the
  other objectives (:mod:`capture_sim.studies.search.refinement`).
- The convergence of a row is the gain of its last pass, and the difference to a second coverage and
  refinement with another seed.  Only the second seed can show that the first missed a basin.

The search runs at the tolerance of sweeps, with limits that are smaller by 1e-5.  The rows are then
run at the tolerance of the scene.

The search ends at once if an objective does not depend on the buffer, unless the ranges are narrow.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from capture_sim.base.notebook import drawn, html_table
from capture_sim.scene.loading import as_scene
from capture_sim.scene.parts import Scene
from capture_sim.studies.evaluate.executors import InProcess
from capture_sim.studies.evaluate.limits import Measure
from capture_sim.studies.search.evaluator import (
    Archive,
    Candidate,
    Evaluator,
    Requirements,
    costs_of,
)
from capture_sim.studies.search.front import knee, layers, require_pymoo
from capture_sim.studies.search.limit_costs import LimitCost, limit_costs
from capture_sim.studies.search.refinement import Evaluate
from capture_sim.studies.search.rows import CONVERGED, UNREFINED, DesignRow
from capture_sim.studies.search.search import (
    RESERVE,
    DesignSearch,
    Window,
    search_requirements,
    search_scene,
)
from capture_sim.studies.search.variables import FREE, make_variables, with_values
from capture_sim.studies.vary.inputs import Input

#: Maximum number of rows of the table of a front.
MAX_ROWS = 12
#: Default number of candidates of a search.  With an area of approach each candidate needs about
#: 100 runs, with dispersions as many runs as there are draws.
CANDIDATES, CANDIDATES_OF_AREA, CANDIDATES_OF_DRAWS = 8000, 1000, 1500
#: Maximum number of candidates with draws from which the search for the cost of a limit starts.
_KEPT_OF_DRAWS = 100


@dataclass(frozen=True)
class Design:
    """The result of a design; the rows are in the order of the first objective."""

    scene: Scene  # the given scene
    requirements: Requirements
    variables: tuple[Input, ...]
    rows: tuple[DesignRow, ...]  # a single row if there is one objective
    own: Candidate  # the scene's own buffer
    refusal: str  # why there is no buffer; empty if there is a buffer
    interrupted: bool = False  # True: with dispersions, the front is of the scene without them
    history: tuple[Candidate, ...] = field(default=(), repr=False)  # all candidates, in order
    archive: Archive = field(default_factory=Archive, repr=False, compare=False)

    @property
    def met(self) -> bool:
        """True if there is a buffer."""
        return not self.refusal

    @property
    def whole_front(self) -> list[tuple[Candidate, int | None]]:
        """All buffers that were run and that no other one beats, with their rows' numbers or None.

        Those without a number were run at the search's tolerance, and only to t_end.
        """
        objectives = self.requirements.objectives
        numbered = [(row.candidate, number) for number, row in enumerate(self.rows, 1)]
        known = {_rounded(each) for each, _ in numbered}
        is_drawn = self.requirements.under is not None and not self.interrupted
        found: list[tuple[Candidate, int | None]] = [*numbered]
        for each in self.history:
            values = _rounded(each)
            if each.feasible and (each.share is not None) == is_drawn and values not in known:
                known.add(values)
                found.append((each, None))
        if not found:
            return []
        costs = costs_of([each for each, _ in found], objectives)
        best = set(layers(costs)[0].tolist()) | set(range(len(numbered)))
        return [found[k] for k in sorted(best, key=lambda k: tuple(costs[k]))]

    @property
    def front(self) -> tuple[Candidate, ...]:
        """The buffers of the rows, in their order."""
        return tuple(row.candidate for row in self.rows)

    @property
    def knee(self) -> int:
        """Index of the row at the knee."""
        return next(k for k, row in enumerate(self.rows) if row.is_knee)

    def plot(self) -> Any:
        """Return a matplotlib figure; see :func:`capture_sim.plot`.

        Raises
        ------
        MissingPackageError
            matplotlib is not installed.
        """
        return drawn(self)

    def _repr_html_(self) -> str:
        """Return the rows for a notebook: objectives and values, in SI units."""
        objectives = [each.key for each in self.requirements.objectives]
        rows = [("row", *objectives, *(each.name for each in self.variables))]
        for number, row in enumerate(self.rows, 1):
            candidate = row.candidate
            cells = [candidate.loads[key] for key in objectives] + [*candidate.values.values()]
            name = f"{number}, the knee" if row.is_knee else f"{number}"
            rows.append((name, *(f"{cell:.5g}" for cell in cells)))
        lines = [self.refusal] if self.refusal else []
        return html_table(f"design of {self.scene.name}", rows, lines)

    def scene_of(self, candidate: Candidate) -> Scene:
        """Return the scene with a candidate's buffer."""
        return with_values(self.scene, candidate.values)


def design_buffer(
    scene: Scene | str | Path,
    requirements: Requirements,
    free: Sequence[str] = FREE,
    *,
    window: Window | None = None,
    candidates: int | None = None,
    seed: int = 1,
    executor: Executor | None = None,
    report: Callable[[Candidate], None] | None = None,
    archive: Archive | None = None,
    costs: bool = False,
) -> Design:
    """Find the non-dominated buffers that capture within the limits.

    Parameters
    ----------
    scene
        Scene with vehicles, cone, contact and approach, its name or its file.  Its own buffer is
        compared with the front.  The search also starts from it if it is within the ranges.
    requirements
        Objectives, limits, and the dispersions with which the limits must be kept.
    free
        Names of the values to search, e.g. ``"buffer.preload"``, with a range, e.g.
        ``"buffer.k_A=100:2000"``, or with a catalogue, e.g. ``"buffer.k_A=[450,500,560]"``.
        ``"damping_ratio"`` is the damper as a share of critical damping.  ``buffer.c_A_rebound``
        keeps its ratio to ``buffer.c_A`` unless it is free.
    window
        Range of an objective over which the rows are spaced; None for the complete front.
    candidates
        Total number of buffers to try, 100 or more; None for 8000, 1500 with dispersions, or 1000
        with an area of approach.
    seed
        Seed of the search and of the draws; the same seed gives the same front.
    executor
        Executor as in ``concurrent.futures``; None for this process.
    report
        Function called with every candidate.
    archive
        Archive with earlier runs, to which the runs of this call are added; see
        :class:`capture_sim.studies.search.evaluator.Archive`.
    costs
        True to leave candidates for :func:`costs_of_limits`.

    Returns
    -------
    Design
        The front, or the reason why there is none.  After Ctrl-C, the front found so far.

    Raises
    ------
    SceneError
        A name or a value is invalid, or the chaser never meets the cone.
    MissingPackageError
        pymoo is not installed.

    Warnings
    --------
    Without dispersions in ``requirements``, the buffers are those for the nominal approach alone.
    Only a row whose ``convergence`` says so has converged.

    See Also
    --------
    capture_sim.sweep : A table of given or drawn buffers.

    Examples
    --------
    The damper with the least force that stays within a stroke of 5 mm:

    >>> from capture_sim.studies.evaluate.limits import make_limits, make_objectives
    >>> from capture_sim.studies.search.design import design_buffer
    >>> from capture_sim.studies.search.evaluator import Requirements
    >>> limits = make_limits({"max_axial_stroke_in_before_latch": "5 mm"})
    >>> asked = Requirements(make_objectives(["max_buffer_force_before_latch"]), limits)
    >>> found = design_buffer("tilt_0", asked, ["buffer.c_A=1:50"], candidates=100)
    >>> best = found.rows[0].candidate
    >>> best.verdict, best.loads["max_axial_stroke_in_before_latch"] <= 0.005
    ('captured', True)
    """
    require_pymoo()
    scene = as_scene(scene)
    variables = make_variables(scene, requirements.limits, free)
    budget = candidates or default_candidates(requirements)
    search = DesignSearch(
        *(scene, requirements, variables, window, seed, executor or InProcess(), report, archive),
        reserve=RESERVE if costs else 0.0,
    )
    interrupted, refusal = False, ""
    rows: list[DesignRow] = []
    try:
        refusal = search.alone(budget)
    except KeyboardInterrupt:
        interrupted = True
    if not refusal:
        rows = search.confirmed(interrupted=interrupted)
        if rows and requirements.under is not None and not interrupted:
            try:
                rows = search.with_draws(budget)
            except KeyboardInterrupt:
                interrupted = True
        refusal = search.refusal(rows)
    own = search.own(with_draws=not interrupted)
    if not interrupted:
        rows = search.detailed(rows, own)
    return Design(
        scene,
        requirements,
        search.variables,
        _knee_marked(rows, requirements.objectives, is_part=window is not None),
        own,
        refusal,
        interrupted,
        tuple(search.history),
        search.archive,
    )


def default_candidates(requirements: Requirements) -> int:
    """Return the number of buffers that a design tries by default."""
    if requirements.area:
        return CANDIDATES_OF_AREA
    return CANDIDATES if requirements.under is None else CANDIDATES_OF_DRAWS


def beaten_by(design: Design) -> list[tuple[Measure, float]]:
    """Return the objectives in which the front beats the scene's own buffer, with the best values.

    For each objective, the value (SI) is the best on the front among buffers that are at least as
    good as the scene's own buffer in all other objectives.  Objectives without such an improvement
    are left out.
    """
    objectives = design.requirements.objectives
    own, front = costs_of([design.own], objectives)[0], costs_of(design.front, objectives)
    found = []
    for k, objective in enumerate(objectives):
        no_worse = np.delete(front <= own, k, axis=1).all(axis=1)
        better = [n for n in np.flatnonzero(no_worse).tolist() if front[n, k] < own[k]]
        if better:
            best = min(better, key=lambda n: float(front[n, k]))
            found.append((objective, design.front[best].loads[objective.key]))
    return found


def costs_of_limits(
    design: Design,
    row: DesignRow,
    *,
    seed: int = 1,
    executor: Executor | None = None,
    candidates: int | None = None,
) -> tuple[LimitCost, ...]:
    """Return the cost of each active limit of a row in the objectives.

    Empty if the row has not converged: its own gap may be larger than the cost.
    The number of candidates is the share RESERVE of the budget ``candidates``, whose default is
    that of :func:`design_buffer`.  See :mod:`capture_sim.studies.search.limit_costs`.
    """
    if row.convergence != CONVERGED:
        return ()
    scene, requirements = search_scene(design.scene), search_requirements(design.requirements)
    runs = Evaluator(scene, requirements, seed, executor or InProcess(), None, design.archive)
    draws = runs.draws(requirements.draws, 0) if requirements.under is not None else []

    def evaluate(others: Requirements) -> Evaluate:
        under = runs.under(others)
        return partial(under.with_draws, draws) if draws else under.alone

    is_drawn = bool(draws)
    known = [x for x in design.history if (x.share is not None) == is_drawn and x.violation < 0.2]
    at = np.array(row.candidate.costs(requirements.objectives))
    known.sort(key=lambda x: float(np.abs(x.costs(requirements.objectives) - at).max()))
    budget = int(RESERVE * (candidates or default_candidates(design.requirements)))
    return limit_costs(
        row.candidate,
        [x.values for x in known[: _KEPT_OF_DRAWS if draws else None]],
        design.variables,
        requirements,
        evaluate,
        budget,
        seed,
    )


def _rounded(candidate: Candidate) -> tuple[str, ...]:
    """Return the values of a buffer as texts, equal for buffers that differ by round-off."""
    return tuple(f"{value:.9g}" for value in candidate.values.values())


def _knee_marked(
    rows: Sequence[DesignRow], objectives: Sequence[Measure], *, is_part: bool
) -> tuple[DesignRow, ...]:
    """Return the rows with the knee marked, one that was refined if there is one.

    With ``is_part`` the rows are those of a window, whose ends are no knee.
    """
    if not rows:
        return ()
    allowed = [k for k, row in enumerate(rows) if row.convergence != UNREFINED]
    allowed = allowed or list(range(len(rows)))  # those that were refined may be beaten by others
    if is_part and len(allowed) > 2:
        allowed = allowed[1:-1]
    costs = costs_of([rows[k].candidate for k in allowed], objectives)
    at = allowed[knee(costs)]
    return tuple(dataclasses.replace(row, is_knee=k == at) for k, row in enumerate(rows))
