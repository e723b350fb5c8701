"""The rows of a front, with the details that a user should know of each row.

The details are the sensitivity of a row to its values (sharpness), how long the tip stays captured,
and its position then.  They also list the values at an end of their range, and the loads without a
limit that have grown.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from capture_sim.scene.parts import Scene
from capture_sim.studies.evaluate.dispersion import Probability
from capture_sim.studies.evaluate.limits import Measure
from capture_sim.studies.evaluate.outcome import CAPTURED
from capture_sim.studies.search.evaluator import Candidate, Evaluator, Requirements, costs_of
from capture_sim.studies.search.refinement import Goal
from capture_sim.studies.vary.inputs import Input

#: A load that is neither limited nor an objective is reported if it is at least this multiple of
#: the load with the scene's own buffer.
GROWN = 3.0
#: The loads that are compared with the loads of the scene's own buffer.
WATCHED = (
    *("max_axial_stroke_in", "max_axial_stroke_out", "max_torsion", "max_buffer_force"),
    *("max_buffer_torque", "max_normal_force"),
)
#: Relative change of each value of a row for its sharpness.
SHARP = 0.01
#: Scenes without a latch are also run to these multiples of t_end.
LONGER, LONGEST = 3.0, 10.0

CONVERGED, ENDED, SETTLED = "converged", "budget ended", "no gain left, one seed"
#: Of a row in a gap of the front: the best buffer that was run there.
UNREFINED = "not refined"


@dataclass(frozen=True)
class Sharpness:
    """Sensitivity of a row: the worst results of runs with one value 1 % larger or smaller."""

    change: float  # largest relative increase of an objective
    excess: float  # largest relative excess of a limit; 0 if all limits are kept
    not_held: bool  # True if a run does not capture, or if the tip leaves again


@dataclass(frozen=True)
class DesignRow:
    """A buffer of the front."""

    candidate: Candidate  # at the scene's tolerance; with draws: quantiles in new draws
    goal: Goal
    is_knee: bool = False
    convergence: str = ENDED
    check: Probability | None = None  # probability of success in new draws
    at_ends: tuple[str, ...] = ()  # values at an end of their range, in words
    stays: float | None = None  # last of t_end, 3 and 10 t_end with tip at BE, s; None with latch
    sharpness: Sharpness | None = None
    grown: tuple[tuple[Measure, float], ...] = ()  # loads without a limit, ratio to own buffer
    behind: float = 0.0  # distance of the tip's centre behind BE, m; 0 within the capture radius
    behind_at: float = 0.0  # first of these times at which the tip is behind BE, s


def detailed(
    rows: Sequence[DesignRow],
    own: Candidate,
    scene: Scene,
    requirements: Requirements,
    variables: Sequence[Input],
    evaluators: Mapping[float, Evaluator],
) -> list[DesignRow]:
    """Return the rows with their details: range ends, sharpness, time at BE, grown loads.

    ``own`` is the scene's own buffer.  ``evaluators`` has, by factor, the evaluator of the scene
    with t_end multiplied by this factor; the factor 1 must be included.
    """
    if not rows:
        return []
    values = [row.candidate.values for row in rows]
    found = []
    places = _places(scene, values, evaluators)
    sharp = _sharpnesses(rows, requirements, variables, evaluators[1.0])
    for row, place, sharpness in zip(rows, places, sharp, strict=True):
        at_ends = [
            f"{each.name} at the {end} end of its range"
            for each in variables
            if (end := each.end_at(row.candidate.values[each.name]))
        ]
        found.append(
            dataclasses.replace(
                row,
                at_ends=tuple(at_ends),
                stays=None if scene.latch is not None else place.until,
                grown=_grown(requirements, row.candidate, own),
                sharpness=sharpness,
                behind=place.behind,
                behind_at=place.behind_at,
            )
        )
    return found


def lasting(scene: Scene, t_end: float) -> Scene:
    """Return the scene with ``t_end`` (s) as the end of its run."""
    return dataclasses.replace(scene, run=dataclasses.replace(scene.run, t_end=t_end))


class _Place(NamedTuple):
    """How long a tip stays at BE, and how far behind BE it is when it is first found there."""

    until: float = 0.0  # s
    behind: float = 0.0  # m
    behind_at: float = 0.0  # s


def _places(
    scene: Scene, values: Sequence[Mapping[str, float]], evaluators: Mapping[float, Evaluator]
) -> list[_Place]:
    """Return the positions of the tips at t_end and, without a latch, at 3 and 10 t_end.

    ``values`` are the free values of each row.
    """
    places = [_Place()] * len(values)
    staying = set(range(len(values)))
    for factor, evaluator in evaluators.items():
        if scene.latch is not None and factor > 1.0:
            break
        t_end = factor * scene.run.t_end
        for k, each in enumerate(evaluator.alone(values)):
            if k not in staying:
                continue
            holds = each.verdict == CAPTURED and not each.left_again
            behind = each.behind if holds else 0.0
            if holds and not behind:
                places[k] = _Place(t_end)
                continue
            staying.remove(k)
            if behind:
                places[k] = places[k]._replace(behind=behind, behind_at=t_end)
    return places


def _grown(
    requirements: Requirements, found: Candidate, own: Candidate
) -> tuple[tuple[Measure, float], ...]:
    """Return the loads without a limit that are at least GROWN times those of the own buffer.

    Each load has its ratio to the load of the own buffer.
    """
    known = {each.key for each in (*requirements.objectives, *requirements.limits)}
    grown = []
    for key in WATCHED:
        if key in known:
            continue
        value, before = found.loads[key], own.loads[key]
        if before > 0.0 and value / before >= GROWN:
            grown.append((Measure(key), value / before))
    return tuple(grown)


def _sharpnesses(
    rows: Sequence[DesignRow],
    requirements: Requirements,
    variables: Sequence[Input],
    exact: Evaluator,
) -> list[Sharpness | None]:
    """Return for each row the worst results of runs with one value 1 % larger or smaller.

    None if a row was checked with draws, or if there is an area of approach.
    """
    moved = [
        (k, {**row.candidate.values, each.name: row.candidate.values[each.name] * factor})
        for k, row in enumerate(rows)
        if row.check is None and not requirements.area
        for each in variables
        for factor in (1.0 - SHARP, 1.0 + SHARP)
        if row.candidate.values[each.name]
    ]
    found = exact.alone([values for _, values in moved]) if moved else []
    of_rows: list[list[Candidate]] = [[] for _ in rows]
    for (k, _), candidate in zip(moved, found, strict=True):
        of_rows[k].append(candidate)
    return [
        None if row.check is not None or requirements.area else _worst(row, each, requirements)
        for row, each in zip(rows, of_rows, strict=True)
    ]


def _worst(row: DesignRow, found: Sequence[Candidate], requirements: Requirements) -> Sharpness:
    held = [x for x in found if x.verdict == CAPTURED]
    held = [x for x in held if requirements.allow_leaving or not x.left_again]
    if not held:
        return Sharpness(math.nan, math.nan, not_held=bool(found))
    before = np.array(row.candidate.costs(requirements.objectives))
    change = float(np.expm1((costs_of(held, requirements.objectives) - before).max()))
    excess = max(
        (each.use(x.loads[each.key]) - 1.0 for each in requirements.limits for x in held),
        default=0.0,
    )
    return Sharpness(change, max(excess, 0.0), not_held=len(held) < len(found))
