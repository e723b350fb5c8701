"""The rows of a front, and what each should be known for.

How sharp a row is, until when the tip stays captured, and where it is then; which values are at an
end of their range, and which loads without a limit have grown.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from capture_sim.scene.parts import Scene
from capture_sim.studies.candidates import Candidate, Evaluator, Requirements, costs_of
from capture_sim.studies.dispersion import Probability
from capture_sim.studies.limits import Measure
from capture_sim.studies.outcome import CAPTURED, run_to_end
from capture_sim.studies.refinement import Goal
from capture_sim.studies.variables import FreeVariable, with_values

#: A load that is neither limited nor minimised is named from this multiple of the own buffer's on.
GROWN = 3.0
#: The loads that are watched for that.
WATCHED = (
    *("max_axial_stroke_in", "max_axial_stroke_out", "max_torsion", "max_buffer_force"),
    *("max_buffer_torque", "max_normal_force"),
)
#: By which share each value of a row is changed, to see how sharp the row is.
SHARP = 0.01
#: Without a latch, rows are also run to these multiples of t_end.
LONGER, LONGEST = 3.0, 10.0

CONVERGED, ENDED = "converged", "budget ended"


@dataclass(frozen=True)
class Sharpness:
    """How sharp a row is: the worst of its runs with one value 1 % larger or smaller."""

    change: float  # of the worst objective, relative
    excess: float  # of the worst limit, relative; 0 if all are kept
    not_held: bool  # a run does not capture, or the tip leaves again


@dataclass(frozen=True)
class DesignRow:
    """A buffer of the front."""

    candidate: Candidate  # at the tolerance of the scene; with draws: quantiles in new draws
    goal: Goal
    is_knee: bool = False
    convergence: str = ENDED
    check: Probability | None = None  # of success with new draws
    at_ends: tuple[str, ...] = ()  # values at an end of their range, in words
    stays: float | None = None  # s: the last of t_end, 3 and 10 t_end with the tip at BE
    sharpness: Sharpness | None = None
    grown: tuple[tuple[Measure, float], ...] = ()  # loads without a limit, over the own buffer's
    behind: float = 0.0  # m, of the tip's centre behind BE; 0 within the capture radius
    behind_at: float = 0.0  # s: the first of these times at which it is behind


def detailed(
    rows: Sequence[DesignRow],
    own: Candidate,
    scene: Scene,
    requirements: Requirements,
    variables: Sequence[FreeVariable],
    evaluators: Mapping[float, Evaluator],
) -> list[DesignRow]:
    """Return rows with what they should be known for: ends, sharpness, staying, other loads.

    ``evaluators`` are those of the scene with t_end times a factor, by the factor; 1 is one.
    """
    if not rows:
        return []
    values = [row.candidate.values for row in rows]
    found = []
    for row, place in zip(rows, _places(scene, values, evaluators), strict=True):
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
                sharpness=_sharpness(row, requirements, variables, evaluators[1.0]),
                behind=place.behind,
                behind_at=place.behind_at,
            )
        )
    return found


def lasting(scene: Scene, t_end: float) -> Scene:
    """Return a scene that runs to a time, s."""
    return dataclasses.replace(scene, run=dataclasses.replace(scene.run, t_end=t_end))


class _Place(NamedTuple):
    """Until when a tip stays, s, and how far behind BE it is at the first time that it is, m."""

    until: float = 0.0
    behind: float = 0.0
    behind_at: float = 0.0


def _places(
    scene: Scene, values: Sequence[Mapping[str, float]], evaluators: Mapping[float, Evaluator]
) -> list[_Place]:
    """Return where the tips are at t_end and, without a latch, at 3 and 10 t_end."""
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
            of_row = lasting(with_values(scene, values[k]), t_end)
            behind = run_to_end(of_row).behind if holds else 0.0
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
    """Return the unlimited loads that are far above those of the user's own buffer."""
    known = {each.key for each in (*requirements.objectives, *requirements.limits)}
    grown = []
    for key in WATCHED:
        if key in known:
            continue
        value, before = found.loads[key], own.loads[key]
        if before > 0.0 and value / before >= GROWN:
            grown.append((Measure(key), value / before))
    return tuple(grown)


def _sharpness(
    row: DesignRow, requirements: Requirements, variables: Sequence[FreeVariable], exact: Evaluator
) -> Sharpness | None:
    """Return the worst of the runs with one value 1 % larger or smaller; None with draws."""
    if row.check is not None or requirements.area:
        return None
    values = row.candidate.values
    moved = [
        {**values, each.name: values[each.name] * factor}
        for each in variables
        for factor in (1.0 - SHARP, 1.0 + SHARP)
        if values[each.name]
    ]
    found = exact.alone(moved) if moved else []
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
