"""Design of a buffer: limits and objectives in, one buffer or the front of the best buffers out.

Some values of a scene are free.  The search (:mod:`capture_sim.studies.search`) has two steps, for
the scene alone and then, where there are dispersions, with draws.  NSGA-II covers the ranges
(:mod:`capture_sim.studies.coverage`).  Each row that is shown is then refined on its own: one
objective is minimised, the others held (:mod:`capture_sim.studies.refinement`).  A row says how far
it has converged: by the gain of its last pass, and by a second coverage and refinement with another
seed, which alone shows a basin that the first has missed.  The search runs at the tolerance of
sweeps and within limits that are smaller by 1e-5; the rows are then run as the scene is.

An objective that the buffer does not decide ends the search, unless the ranges are narrow.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, field
from functools import partial

import numpy as np

from capture_sim.scene.parts import Scene
from capture_sim.studies.candidates import Archive, Candidate, Evaluator, Requirements, costs_of
from capture_sim.studies.executors import InProcess
from capture_sim.studies.front import knee, require_pymoo
from capture_sim.studies.limit_costs import LimitCost, limit_costs
from capture_sim.studies.limits import Measure
from capture_sim.studies.refinement import Evaluate
from capture_sim.studies.rows import DesignRow
from capture_sim.studies.search import (
    RESERVE,
    DesignSearch,
    Window,
    search_requirements,
    search_scene,
)
from capture_sim.studies.variables import FREE, FreeVariable, make_variables, with_values

#: Most rows of the table over a front.
MAX_ROWS = 12
#: Candidates of a search; with an area of approach each of them needs about 100 runs, with
#: dispersions as many as there are draws.
CANDIDATES, CANDIDATES_OF_AREA, CANDIDATES_OF_DRAWS = 8000, 1000, 1500
#: Most candidates with draws that the cost of a limit begins with.
_KEPT_OF_DRAWS = 100


@dataclass(frozen=True)
class Design:
    """The result of a design; the rows are in the order of the first objective."""

    scene: Scene  # that was given
    requirements: Requirements
    variables: tuple[FreeVariable, ...]
    rows: tuple[DesignRow, ...]  # one with one objective
    own: Candidate  # the scene's own buffer
    refusal: str  # why there is no buffer; empty if there is one
    interrupted: bool = False  # under dispersions, the front is then that of the scene alone
    history: tuple[Candidate, ...] = field(default=(), repr=False)  # in order
    archive: Archive = field(default_factory=Archive, repr=False, compare=False)

    @property
    def met(self) -> bool:
        """Whether there is a buffer."""
        return not self.refusal

    @property
    def front(self) -> tuple[Candidate, ...]:
        """The buffers of the rows."""
        return tuple(row.candidate for row in self.rows)

    @property
    def knee(self) -> int:
        """Index of the row at the knee."""
        return next(k for k, row in enumerate(self.rows) if row.is_knee)

    def scene_of(self, candidate: Candidate) -> Scene:
        """Return the scene with a candidate's buffer."""
        return with_values(self.scene, candidate.values)


def design_buffer(
    scene: Scene,
    requirements: Requirements,
    free: Sequence[str] = FREE,
    *,
    window: Window | None = None,
    candidates: int | None = None,
    seed: int = 1,
    executor: Executor | None = None,
    report: Callable[[Candidate], None] | None = None,
    archive: Archive | None = None,
) -> Design:
    """Find the buffers that capture within limits and that no other beats in all objectives.

    Parameters
    ----------
    scene
        Scene with vehicles, cone, contact and approach; its values of free parameters are only
        compared with the front.
    requirements
        Objectives, limits, and the dispersions under which they must hold.
    free
        Names of the values to search, e.g. ``"buffer.preload"``; with a range as
        ``"buffer.k_A=100:2000"``, or a catalogue as ``"buffer.k_A=[450,500,560]"``.
        ``"damping_ratio"`` is the damper as a share of the critical one.  ``buffer.c_A_rebound``
        keeps its ratio to ``buffer.c_A`` unless it is free.
    window
        Values of an objective over which the rows are spaced; None: over the whole front.
    candidates
        Number of buffers to try in all, 100 or more; None for 8000, 1500 with dispersions, or 1000
        with an area of approach.
    seed
        Seed of the search and of the draws; the same seed gives the same front.
    executor
        Executor as in ``concurrent.futures``; None for this process.
    report
        Function called with every candidate.
    archive
        Runs that were made before, and those of this call; see
        :class:`capture_sim.studies.candidates.Archive`.

    Returns
    -------
    Design
        Its front, or the reason why there is none.  After Ctrl-C, the front found so far.

    Raises
    ------
    SceneError
        A name or a value is invalid, or the chaser never meets the cone.
    MissingPackageError
        pymoo is not installed.
    """
    require_pymoo()
    variables = make_variables(scene, requirements.limits, free)
    budget = candidates or default_candidates(requirements)
    search = DesignSearch(
        scene, requirements, variables, window, seed, executor or InProcess(), report, archive
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
        _knee_marked(rows, requirements.objectives),
        own,
        refusal,
        interrupted,
        tuple(search.history),
        search.archive,
    )


def default_candidates(requirements: Requirements) -> int:
    """Return the number of buffers that a design tries unless another is given."""
    if requirements.area:
        return CANDIDATES_OF_AREA
    return CANDIDATES if requirements.under is None else CANDIDATES_OF_DRAWS


def beaten_by(design: Design) -> list[tuple[Measure, float]]:
    """Return the best value of each objective on the front, the others no worse than the own.

    Objectives in which no buffer of the front beats the scene's own are left out.
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
    """Return the costs of a row's active limits in the objectives, from a share of the budget."""
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


def _knee_marked(rows: Sequence[DesignRow], objectives: Sequence[Measure]) -> tuple[DesignRow, ...]:
    if not rows:
        return ()
    at = knee(costs_of([row.candidate for row in rows], objectives))
    return tuple(dataclasses.replace(row, is_knee=k == at) for k, row in enumerate(rows))
