"""The check: which rules do these measurements break?

Offline, :func:`check` looks at a whole recording.  Live, a node keeps the last seconds in a
:class:`capture_sim.plausibility.live.LiveMeasurements` and calls the same function with what that
returns: before the release nothing moves and nothing touches, so that the rules of units, frames,
clocks and sources speak, and in flight those of the buffer and the force, too.  A rule whose
evidence is missing says nothing.

    doubts = check(live.measured(), scene, waived=("frames_differ",))
    refused = [doubt for doubt in doubts if doubt.grade is Grade.REFUSED]  # do not release

``doubt.line`` is the line to show; ``doubt.rule.name`` is what a user waives.
"""

from __future__ import annotations

from collections.abc import Collection

from capture_sim.errors import SceneError
from capture_sim.plausibility import buffer, clocks, force, frames, sources, units
from capture_sim.plausibility.measured import Measured
from capture_sim.plausibility.motion import MeasuredMotion
from capture_sim.plausibility.rules import RULES, Doubt, Grade, Rule, broken
from capture_sim.scene.parts import Scene

_GRADES = list(Grade)
#: The modules of rules, those that others rest on first.
_MODULES = [module.__name__ for module in (sources, units, frames, clocks, buffer, force)]


def _place(item: tuple[str, Rule]) -> int:
    return _MODULES.index(item[1].check.__module__)


_in_order = dict(sorted(RULES.items(), key=_place))
RULES.clear()
RULES.update(_in_order)


def check(
    measured: Measured, scene: Scene | None = None, waived: Collection[str] = ()
) -> tuple[Doubt, ...]:
    """Return the doubts about measurements, the gravest first.

    Parameters
    ----------
    measured
        A whole recording, or the last seconds.
    scene
        Geometry of the bench; None to skip the rules that need it.
    waived
        Names of rules that are not checked.

    Raises
    ------
    SceneError
        A waived rule does not exist.
    """
    check_names(waived)
    doubts = tuple(broken(MeasuredMotion(measured, scene), waived))
    return tuple(sorted(doubts, key=lambda doubt: _GRADES.index(doubt.grade)))


def check_names(waived: Collection[str]) -> None:
    """Raise SceneError if a waived rule does not exist."""
    unknown = [name for name in waived if name not in RULES]
    if unknown:
        raise SceneError(f"rule {unknown[0]!r}: not found; rules: {', '.join(RULES)}")


def rules_with_scene() -> list[str]:
    """Return the names of the rules that need a scene."""
    return [name for name, each in RULES.items() if each.needs_scene]


def table_of_rules() -> str:
    """Return all rules as a table of Markdown, for the documentation."""
    head = "| rule | grade | compares | broken | reason of the threshold |\n|---|---|---|---|---|\n"
    return head + "".join(
        f"| `{each.name}` | {each.grade} | {each.compares} | {each.threshold} | {each.reason} |\n"
        for each in RULES.values()
    )
